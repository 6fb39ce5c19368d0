"""The page as a whole: its sections, its one script, and nothing that needs another file to be read."""

from __future__ import annotations

import base64
import hashlib
import io
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import PurePath

from PIL import Image

from analysis.page.markup import TEMPLATES, Html, block

LIBRARIES = ("numpy", "scipy", "numba", "jax", "pymetis")
"""What the figures depend on, beside the program itself."""
SCRIPTS = ("values.js", "choices.js", "curves.js", "cell_maps.js", "replay.js", "player.js", "start.js")
"""The script's files, one a concern, in the order in which they are put together."""
UNFOLDED = 3
"""Pictures that are shown at once."""
COLOURS = 128
"""Of a picture in the page: enough for letters, and a third of the file's bytes."""


@dataclass(frozen=True)
class Section:
    """A part of the page: its heading, what stands under it, one line below the heading.

    fold: the words that unfold it; "" for what is always shown.
    """

    title: str
    body: Html
    lead: str = ""
    fold: str = ""

    @property
    def anchor(self) -> str:
        """Its address in the page."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "part"


def document(sections: Sequence[Section], **values: object) -> str:
    """The whole file, by `templates/page.html`: it needs no other. The same page gives the same bytes."""
    script = whole_script()
    return TEMPLATES.get_template("page.html").render(
        sections=[section for section in sections if section.body], script=script, rules=policy(script),
        styles=Html(asset("page.css")), version=known_version("mrac-jax"), **values,
    )  # fmt: skip


def page_head(title: str, styles: str, rules: str) -> Html:
    """The head of a page; `rules`: its content security policy."""
    return block("head", title, Html(styles), rules, known_version("mrac-jax"))


def policy(script: str, connect: str = "'none'") -> str:
    """What the browser itself enforces: this one script, the pictures in the page, and no request but to `connect`."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        f"connect-src {connect}; base-uri 'none'; form-action 'none'"
    )


def whole_script(parts: Iterable[str] | None = None) -> Html:
    """A page's one script, of these texts (default: a report's); nothing of it is seen outside."""
    texts = map(asset, SCRIPTS) if parts is None else parts
    return Html("\n".join(('"use strict";\n(() => {', *texts, "})();\n")))


def asset(name: str, package: str = "analysis.page") -> str:
    """A file of this package, or of another."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def known_version(library: str) -> str:
    """Its version, or "not installed"."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def reproduce_section(command: str, names: Sequence[str], again: str) -> Section:
    """The command line that makes this folder again, the versions, and the other files."""
    versions = [f"mrac-jax {known_version('mrac-jax')}", f"Python {platform.python_version()}"]
    versions += [f"{library} {known_version(library)}" for library in LIBRARIES]
    return Section("How to reproduce", block("reproduce", command, again, versions, names))


def pictures_section(pictures: Mapping[str, bytes]) -> Section:
    """The pictures, PNG files by name, each with its own description, in the page itself; many are folded away."""
    shown = [(PurePath(name).name, *described(png, PurePath(name).stem)) for name, png in pictures.items()]
    fold = f"{len(shown)} pictures of what is above" if len(shown) > UNFOLDED else ""
    lead = "For slides and papers; in full colour as the PNG files that were written beside this page."
    return Section("Pictures", block("pictures", shown), lead, fold)


def described(png: bytes, name: str) -> tuple[str, Html]:
    """What a PNG file says of itself, else its name; and it as a data address, in fewer colours."""
    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        words = image.info.get("Description") or name.replace("_", " ")
        few = image.convert("RGB").quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(out, format="png", optimize=True)
    return words, Html("data:image/png;base64," + base64.b64encode(out.getvalue()).decode())
