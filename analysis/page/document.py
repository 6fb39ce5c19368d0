"""The HTML document of a page, which needs no other file."""

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
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html
from PIL import Image
from rich.table import Table

from planner.errors import visible

# The document: its tables, its sections, and its single script. It needs no other file.

# Tables of the page; those of the command line are shown unchanged.

MOST_ROWS = 400
"""Most rows of a table on a page; the other files of the folder hold all."""
FOLDED_FROM = 40
"""Longer tables are collapsed."""
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
"""CSS class of each verdict: a colour and a sign, because colour alone is not accessible."""


@dataclass(frozen=True)
class TableData:
    """A table: `columns` names, `rows` of as many cells, `words` the columns that hold words, not numbers."""

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: frozenset[int] = frozenset({0})

    @property
    def shown(self) -> Sequence[tuple[str, ...]]:
        """The rows that the page shows."""
        return self.rows[:MOST_ROWS]

    @property
    def is_long(self) -> bool:
        """Whether it is collapsed."""
        return len(self.shown) > FOLDED_FROM


def from_rich(table: Table) -> TableData:
    """A table of the command line; right-aligned columns hold numbers."""
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    words = frozenset(place for place, column in enumerate(table.columns) if column.justify != "right")
    names = tuple(str(column.header) for column in table.columns)
    return TableData(str(table.title or ""), names, tuple(zip(*columns, strict=True)), words)


def parted(text: str) -> tuple[str, str, str, str]:
    """The text before its verdict, the verdict and its CSS class, and the text after it; "" if there is none."""
    found = VERDICTS.search(text)
    if found is None:
        return text, "", "", ""
    return text[: found.start()], found[0], LOOKS[found[0].lower()], text[found.end() :]


# HTML in which text cannot break the markup: templates escape every text that is not HTML already.

_UNIT = re.compile(r"(?<=\d) (?=[%\w±])|(?<=%) (?=±)|(?<=[±<>]) (?=\d)")
"""The space between a number and its unit, or a sign and its number."""
_OPTION = re.compile(r"(--[a-z][\w-]*(?: (?!-)[^\s;,()]+)?)")
"""An option with its value, if it has one."""


def _as_text(value: Any) -> Any:
    """A value in a template before it is escaped: control and bidirectional characters are shown by name."""
    return value if isinstance(value, Html) else "" if value is None else visible(str(value))


def unbroken(text: object) -> str:
    """A text with no-break spaces between a number and its unit, and between a sign and its number."""
    return text if isinstance(text, Html) else _UNIT.sub("\N{NO-BREAK SPACE}", str(_as_text(text)))


def with_code(text: str) -> Html:
    """A sentence; text between backticks becomes code. An option and its value stay on one line."""
    if isinstance(text, Html):
        return text
    parts = visible(text).split("`")
    if len(parts) % 2 == 0:  # an unpaired backtick
        return _with_options("`".join(parts), unbroken)
    code = Html("<code>{}</code>")
    return Html().join(
        code.format(_with_options(part, str)) if at % 2 else _with_options(part, unbroken)
        for at, part in enumerate(parts)
    )


def _with_options(text: str, rest: Callable[[str], str]) -> Html:
    """Options keep their spaces, so that they can be copied into a shell; `rest`: converts the text between them."""
    option = Html('<span class="whole">{}</span>')
    pieces = enumerate(_OPTION.split(text))
    return Html().join(option.format(piece) if at % 2 else rest(piece) for at, piece in pieces)


TEMPLATES = Environment(
    loader=PackageLoader("analysis.page"), autoescape=True, finalize=_as_text, undefined=StrictUndefined,
    trim_blocks=True, lstrip_blocks=True,
)  # fmt: skip
TEMPLATES.filters |= {"parted": parted, "with_code": with_code, "unbroken": unbroken}
TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}


def block(name: str, *values: object) -> Html:
    """A macro of `templates/blocks.html`; "" if its content is empty."""
    macro = getattr(TEMPLATES.get_template("blocks.html").module, name)
    return Html(macro(*values).strip())


LIBRARIES = ("numpy", "scipy", "numba", "jax", "pymetis")
"""Libraries that affect the figures."""
SCRIPTS = ("values.js", "choices.js", "cell_maps.js", "replay.js", "player.js", "start.js")
"""The files of the script, in the order in which they are joined."""
UNFOLDED = 3
"""Most pictures that are shown without collapsing."""
COLOURS = 128
"""Colours of an embedded picture: sufficient for letters, and a third of the file's bytes."""


class PageSection(NamedTuple):
    """A section of the page: its heading, its content, a line below the heading.

    collapsed: label of the control that opens it; "" if it is always shown.
    """

    title: str
    body: Html
    intro: str = ""
    collapsed: str = ""

    @property
    def anchor(self) -> str:
        """Its HTML id."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "part"


def document(sections: Sequence[PageSection], **values: object) -> str:
    """The whole file, from `templates/page.html`. Equal content gives equal bytes."""
    script = whole_script()
    return TEMPLATES.get_template("page.html").render(
        sections=[section for section in sections if section.body], script=script, rules=policy(script),
        styles=Html(asset("page.css")), version=known_version("mrac-jax"), **values,
    )  # fmt: skip


def page_head(title: str, styles: str, rules: str) -> Html:
    """The head of a page; `rules`: its content security policy."""
    return block("head", title, Html(styles), rules, known_version("mrac-jax"))


def policy(script: str, connect: str = "'none'") -> str:
    """The content security policy: this one script, embedded pictures, and no request except to `connect`."""
    # The hash allows exactly this script, and no other.
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        f"connect-src {connect}; base-uri 'none'; form-action 'none'"
    )


def whole_script(parts: Iterable[str] | None = None) -> Html:
    """The single script of a page, joined from these texts (default: a report's) in one closure."""
    # One closure: the script defines no global names.
    texts = map(asset, SCRIPTS) if parts is None else parts
    return Html("\n".join(('"use strict";\n(() => {', *texts, "})();\n")))


def asset(name: str, package: str = "analysis.page") -> str:
    """The text of a file of a package."""
    return files(package).joinpath(name).read_text(encoding="utf-8")


def known_version(library: str) -> str:
    """The version of a library, or "not installed"."""
    try:
        return version(library)
    except PackageNotFoundError:
        return "not installed"


def reproduce_section(command: str, names: Sequence[str], again: str) -> PageSection:
    """The command line that makes this folder again, the versions, and the other files."""
    versions = [f"mrac-jax {known_version('mrac-jax')}", f"Python {platform.python_version()}"]
    versions += [f"{library} {known_version(library)}" for library in LIBRARIES]
    return PageSection("How to reproduce", block("reproduce", command, again, versions, names))


def pictures_section(pictures: Mapping[str, bytes]) -> PageSection:
    """The pictures, PNG files by name, embedded with their descriptions; collapsed if there are many."""
    shown = [(PurePath(name).name, *described(png, PurePath(name).stem)) for name, png in pictures.items()]
    collapsed = f"{len(shown)} pictures of this report" if len(shown) > UNFOLDED else ""
    intro = "For slides and papers; the PNG files in the same folder have all colours."
    return PageSection("Pictures", block("pictures", shown), intro, collapsed)


def described(png: bytes, name: str) -> tuple[str, Html]:
    """The description stored in a PNG file, or else its name; and the picture as a data URL with fewer colours."""
    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        words = image.info.get("Description") or name.replace("_", " ")
        few = image.convert("RGB").quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(out, format="png", compress_level=7)  # a twentieth larger than at 9, in a third of the time
    return words, Html("data:image/png;base64," + base64.b64encode(out.getvalue()).decode())
