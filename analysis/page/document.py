"""The page as a whole: its sections, its one script, and nothing that needs another file to be read."""

from __future__ import annotations

import base64
import hashlib
import io
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import PurePath
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html
from PIL import Image
from rich.table import Table

from planner.errors import visible

# Tables of the page, of their own or as the command line prints them: both say the same because they are the same.

MOST_ROWS = 400
"""Rows of a table that are shown; the files beside the page hold all."""
FOLDED_FROM = 40
"""Longer tables are folded away until somebody asks for them."""
VERDICTS = re.compile(r"\b(fails|holds|vacuous|says nothing|undecided|not reproduced|reproduced)\b", re.IGNORECASE)
LOOKS = {
    "fails": "fails",
    "not reproduced": "fails",
    "holds": "holds",
    "reproduced": "holds",
    "undecided": "unsure",
    "vacuous": "empty",
    "says nothing": "empty",
}
"""How each verdict is shown: a colour and a sign, so that the colour is not all."""


@dataclass(frozen=True)
class TableData:
    """A table: `columns` names, `rows` of as many cells, `words` the columns that hold words, not numbers.

    unfolded: a long one is shown at once.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: frozenset[int] = frozenset({0})
    unfolded: bool = False

    @property
    def shown(self) -> Sequence[tuple[str, ...]]:
        """The rows that a page has room for."""
        return self.rows[:MOST_ROWS]

    @property
    def is_long(self) -> bool:
        """Whether it is folded away."""
        return len(self.shown) > FOLDED_FROM


def from_rich(table: Table, unfolded: bool = False) -> TableData:
    """A table of the command line; right-aligned columns hold numbers."""
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    words = frozenset(place for place, column in enumerate(table.columns) if column.justify != "right")
    names = tuple(str(column.header) for column in table.columns)
    return TableData(str(table.title or ""), names, tuple(zip(*columns, strict=True)), words, unfolded)


def parted(text: str) -> tuple[str, str, str, str]:
    """A text before its verdict, the verdict and its look, and the text after it; "" for what is not there."""
    found = VERDICTS.search(text)
    if found is None:
        return text, "", "", ""
    return text[: found.start()], found[0], LOOKS[found[0].lower()], text[found.end() :]


# HTML that cannot be broken by what stands in it: templates escape every text that is not HTML already.

_UNIT = re.compile(r"(?<=\d) (?=[%\w±])|(?<=%) (?=±)|(?<=[±<>]) (?=\d)")
"""The space between a number and what it counts, or a sign and its number."""
_OPTION = re.compile(r"(--[a-z][\w-]*(?: (?!-)[^\s;,()]+)?)")
"""An option with its value, if it has one."""


def _shown(value: Any) -> Any:
    """A value as a template puts it in, before it is escaped: invisible, unpaired and turning characters are named."""
    return value if isinstance(value, Html) else "" if value is None else visible(str(value))


def unbroken(text: object) -> str:
    """A text in which no line ends between a number and its unit, or between a sign and its number."""
    return text if isinstance(text, Html) else _UNIT.sub("\N{NO-BREAK SPACE}", str(_shown(text)))


def with_code(text: str) -> Html:
    """A sentence; what stands between backticks is code. An option and its value stay on one line."""
    if isinstance(text, Html):
        return text
    parts = visible(text).split("`")
    if len(parts) % 2 == 0:  # one of them has no partner
        return _with_options("`".join(parts), unbroken)
    code = Html("<code>{}</code>")
    return Html().join(
        code.format(_with_options(part, str)) if at % 2 else _with_options(part, unbroken)
        for at, part in enumerate(parts)
    )


def _with_options(text: str, rest: Callable[[str], str]) -> Html:
    """Options keep their spaces, so that they can be copied into a shell; `rest`: of what stands between them."""
    option = Html('<span class="whole">{}</span>')
    pieces = enumerate(_OPTION.split(text))
    return Html().join(option.format(piece) if at % 2 else rest(piece) for at, piece in pieces)


TEMPLATES = Environment(
    loader=PackageLoader("analysis.page"), autoescape=True, finalize=_shown, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
TEMPLATES.filters |= {"parted": parted, "with_code": with_code, "unbroken": unbroken}
TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def block(name: str, *values: object) -> Html:
    """A macro of `templates/blocks.html`; nothing of one that has nothing to say."""
    macro = getattr(TEMPLATES.get_template("blocks.html").module, name)
    return Html(macro(*values).strip())


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
