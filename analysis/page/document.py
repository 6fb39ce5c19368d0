"""The HTML document of a page, which needs no other file; and plots: shapes, labels, and data for the pointer."""

from __future__ import annotations

import base64
import hashlib
import io
import math
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from importlib.resources import files
from pathlib import PurePath
from typing import Any, Literal

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup as Html
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from rich.table import Table

from analysis.statistics.estimates import Estimate
from planner.errors import visible
from planner.files import Json

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
    """A table: `columns` names, `rows` of as many cells, `words` the columns that hold words, not numbers.

    unfolded: a long table is shown in full.
    """

    title: str
    columns: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    words: frozenset[int] = frozenset({0})
    unfolded: bool = False

    @property
    def shown(self) -> Sequence[tuple[str, ...]]:
        """The rows that the page shows."""
        return self.rows[:MOST_ROWS]

    @property
    def is_long(self) -> bool:
        """Whether it is collapsed."""
        return len(self.shown) > FOLDED_FROM


def from_rich(table: Table, unfolded: bool = False) -> TableData:
    """A table of the command line; right-aligned columns hold numbers."""
    columns = [[str(cell) for cell in column.cells] for column in table.columns]
    words = frozenset(place for place, column in enumerate(table.columns) if column.justify != "right")
    names = tuple(str(column.header) for column in table.columns)
    return TableData(str(table.title or ""), names, tuple(zip(*columns, strict=True)), words, unfolded)


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
SCRIPTS = ("values.js", "choices.js", "curves.js", "cell_maps.js", "replay.js", "player.js", "start.js")
"""The files of the script, in the order in which they are joined."""
UNFOLDED = 3
"""Most pictures that are shown without collapsing."""
COLOURS = 128
"""Colours of an embedded picture: sufficient for letters, and a third of the file's bytes."""


@dataclass(frozen=True)
class Section:
    """A section of the page: its heading, its content, a line below the heading.

    fold: label of the control that opens it; "" if it is always shown.
    """

    title: str
    body: Html
    lead: str = ""
    fold: str = ""

    @property
    def anchor(self) -> str:
        """Its HTML id."""
        return re.sub(r"[^a-z0-9]+", "-", self.title.lower()).strip("-") or "part"


def document(sections: Sequence[Section], **values: object) -> str:
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


def reproduce_section(command: str, names: Sequence[str], again: str) -> Section:
    """The command line that makes this folder again, the versions, and the other files."""
    versions = [f"mrac-jax {known_version('mrac-jax')}", f"Python {platform.python_version()}"]
    versions += [f"{library} {known_version(library)}" for library in LIBRARIES]
    return Section("How to reproduce", block("reproduce", command, again, versions, names))


def pictures_section(pictures: Mapping[str, bytes]) -> Section:
    """The pictures, PNG files by name, embedded with their descriptions; collapsed if there are many."""
    shown = [(PurePath(name).name, *described(png, PurePath(name).stem)) for name, png in pictures.items()]
    fold = f"{len(shown)} pictures of this report" if len(shown) > UNFOLDED else ""
    lead = "For slides and papers; the PNG files in the same folder have all colours."
    return Section("Pictures", block("pictures", shown), lead, fold)


def described(png: bytes, name: str) -> tuple[str, Html]:
    """The description stored in a PNG file, or else its name; and the picture as a data URL with fewer colours."""
    out = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        words = image.info.get("Description") or name.replace("_", " ")
        few = image.convert("RGB").quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    few.save(out, format="png", optimize=True)
    return words, Html("data:image/png;base64," + base64.b64encode(out.getvalue()).decode())


# Plots: shapes that are stretched, with labels and the pointer's data.

# The data of a chart: curves by name, axes, and arrays thinned to the resolution of a screen.

MOST_POINTS = 400
"""Most points of a curve that are drawn; longer curves are thinned evenly."""
BARS_UP_TO = 40
"""Most points whose intervals are drawn as bars; with more points they form a band."""
CURVE_COLOURS = 8
SIDE = 1000
"""Units of the drawing in each direction; the browser stretches it."""


@dataclass(frozen=True, eq=False)
class Series:
    """A curve by name.

    Attributes:
        name: in the legend. x, y: of its points; NaN is omitted.
        low, high: of the interval of each point, if there are any.
        kind: "line", "step" (holds each value to the next x), "points" (marks only) or "bars".
        dashed: for reference curves. colour: index in the palette; None: the index of the series.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    kind: Literal["line", "step", "points", "bars"] = "line"
    dashed: bool = False
    colour: int | None = None

    @classmethod
    def of(cls, name: str, x: ArrayLike, estimates: Sequence[Estimate], scale: float = 100.0, **look: Any) -> Series:
        """Means times `scale` with their intervals; without intervals if one is unknown."""
        means, low, high = scale * np.array([(one.mean, *one.ci95) for one in estimates]).reshape(-1, 3).T
        known = bool(np.isfinite((low, high)).all())
        return cls(name, x, means, low if known else None, high if known else None, **look)


@dataclass(frozen=True)
class Chart:
    """Curves on one pair of axes.

    Attributes:
        title: its heading. series: the curves. x_name, y_name: of the axes. note: a line below.
        unit: after every value of y, for example "%". digits, x_digits: decimals of the values at the pointer.
        x_whole: label only integers. x_words: labels of 0, 1, 2, ....
        y_range: smallest range of the y axis; None: as the curves need, from 0. fit: the y axis begins at the curves'
            minimum instead of 0, and `y_range` limits it.
        at_x: (x, label) of vertical lines, if they are on the axis. at_y: (y, label) of horizontal ones.
        interval: meaning of low and high.
    """

    title: str
    series: tuple[Series, ...]
    x_name: str
    y_name: str
    note: str = ""
    unit: str = ""
    digits: int = 1
    x_digits: int = 0
    x_whole: bool = True
    x_words: Sequence[str] = ()
    y_range: tuple[float, float] | None = None
    fit: bool = False
    at_x: tuple[tuple[float, str], ...] = ()
    at_y: tuple[tuple[float, str], ...] = ()
    interval: str = "95 % interval"


@dataclass(frozen=True, eq=False)
class Points:
    """A series as arrays, thinned; `bars`: width of a bar."""

    about: Series
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    colour: int
    bars: float

    @property
    def ends(self) -> list[NDArray[np.float64]]:
        """All values that must fit on the y axis."""
        return [values for values in (self.y, self.low, self.high) if values is not None]


def points_of(series: Series, place: int) -> Points:
    """The series as arrays; `place` among the series gives the default colour."""
    x, y = (np.asarray(values, dtype=np.float64).ravel() for values in (series.x, series.y))
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    bars = float(np.diff(x[known]).min()) if series.kind == "bars" and len(known) > 1 else 1.0
    # Bars are bins, and are not thinned.
    if len(known) > MOST_POINTS and series.kind != "bars":
        known = known[np.unique(np.linspace(0, len(known) - 1, MOST_POINTS).round().astype(np.int64))]
    low, high = _ends(series.low, series.high, known, y)
    colour = place % CURVE_COLOURS if series.colour is None else series.colour
    return Points(series, x[known], y[known], low, high, colour, bars)


def _ends(
    low: ArrayLike | None, high: ArrayLike | None, known: NDArray[np.int64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """The intervals of the `known` points; an unknown end is replaced by the point."""
    if low is None or high is None:
        return None, None
    ends = (np.asarray(values, dtype=np.float64).ravel()[known] for values in (low, high))
    lower, upper = (np.where(np.isfinite(end), end, y[known]) for end in ends)
    return lower, upper


def x_range_of(points: Sequence[Points]) -> tuple[float, float]:
    """The range of the x axis."""
    low, high = min(float(one.x.min()) for one in points), max(float(one.x.max()) for one in points)
    wide = max((one.bars for one in points if one.about.kind == "bars"), default=0.0)
    few = wide or (0.03 * (high - low) if max(len(one.x) for one in points) <= BARS_UP_TO else 0.0)
    if high == low:
        few = max(few, 0.5)
    return low - few, high + few


def y_range_of(chart: Chart, points: Sequence[Points]) -> tuple[float, float]:
    """The range of the y axis."""
    every = np.concatenate([end for one in points for end in one.ends])
    low, high = min(float(every.min()), 0.0), max(float(every.max()), *(y for y, _ in chart.at_y), 0.0)
    if chart.fit:
        low = min([float(every.min()), *(y for y, _ in chart.at_y)])
        more, (least, most) = 0.05 * (high - low) or 1.0, chart.y_range or (-math.inf, math.inf)
        return max(low - more, least), min(high + more, most)
    high += 0.04 * (high - low)
    if chart.y_range is not None:
        low, high = min(low, chart.y_range[0]), max(float(every.max()), chart.y_range[1])
    return low, high if high > low else low + 1.0


class Frame:
    """Maps values to units of the drawing, and to fractions of the plot's width and height."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.x, self.y = x, y

    def across(self, x: float) -> float:
        """From 0 at the left to 1 at the right."""
        return (x - self.x[0]) / (self.x[1] - self.x[0])

    def up(self, y: float) -> float:
        """From 0 at the bottom to 1 at the top."""
        return (y - self.y[0]) / (self.y[1] - self.y[0])

    def place(self, x: float, y: float) -> str:
        """The point in the drawing's units: "across down"."""
        return f"{units(self.across(x))} {units(1 - self.up(y))}"


def units(fraction: float) -> str:
    """A fraction of a side in the drawing's units, limited to near the drawing."""
    return f"{min(max(fraction, -1.0), 2.0) * SIDE:.1f}".rstrip("0").rstrip(".")


# Ticks of axes, and the format of their numbers.


def nice_step(rough: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is at least `rough` (> 0)."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 6, whole: bool = False) -> NDArray[np.floating]:
    """About `most` round numbers in `low .. high`, at most; integers if `whole`."""
    step = nice_step(max(high - low, 1e-12) / max(most, 1))
    if whole:
        step = max(step, 1.0)
    first = math.ceil(low / step - 1e-9)
    return np.arange(first, math.floor(high / step + 1e-9) + 1) * step


def label(value: float, step: float) -> str:
    """A tick's number, with the digits that its step needs: "20", "0.25", "1,500"."""
    digits = max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
    return f"{value + 0.0:,.{min(digits, 9)}f}"


Shape = tuple[str, str]
"""CSS class and path data of a shape."""
Word = tuple[str, str, float, str]
"""CSS class of a label, the side that its position (0 to 1) counts from, the position, and the text."""


@dataclass(frozen=True, eq=False)
class Plot:
    """The content of a plot for the template.

    Attributes:
        points: the curves. label: a text alternative. axes: shapes below the curves. curves: each with its shapes.
        words: labels around the drawing. under_the_pointer: values for the script.
    """

    points: Sequence[Points]
    label: str
    axes: Sequence[Shape]
    curves: Sequence[tuple[Points, Sequence[Shape]]]
    words: Sequence[Word]
    under_the_pointer: Json
    side: int = SIDE


def plot_of(chart: Chart, points: Sequence[Points], frame: Frame) -> Plot:
    """The plot of a chart."""
    y_ticks = ticks(*frame.y, 6)
    x_ticks = ticks(*frame.x, 8, chart.x_whole)
    x_set = np.unique(np.concatenate([one.x for one in points]))
    if len(x_set) <= 10 and chart.x_whole:
        x_ticks = x_set
    at_x = [(x, words) for x, words in chart.at_x if 0 <= frame.across(x) <= 1]
    at_y = [(y, words) for y, words in chart.at_y if 0 <= frame.up(y) <= 1]
    gap = float(np.diff(x_ticks).min()) if len(x_ticks) > 1 else 1.0
    step = float(np.diff(y_ticks).min()) if len(y_ticks) > 1 else 1.0
    unit = f" {chart.unit}" if chart.unit else ""
    return Plot(
        points,
        f"{chart.title}: {chart.y_name} over {chart.x_name}; {', '.join(one.about.name for one in points)}",
        [
            ("grid", "".join(f"M0 {units(1 - frame.up(y))}H{SIDE}" for y in y_ticks)),
            *(("mark", f"M{units(frame.across(x))} 0V{SIDE}") for x, _ in at_x),
            *(("mark", f"M0 {units(1 - frame.up(y))}H{SIDE}") for y, _ in at_y),
        ],
        [(one, _shapes(one, frame)) for one in points],
        [
            *(("y", "top", 1 - frame.up(y), label(y, step) + unit) for y in y_ticks),
            *_across_words(x_ticks, gap, frame, chart.x_words),
            *(("at-x end" if frame.across(x) > 0.5 else "at-x", "left", frame.across(x), words) for x, words in at_x),
            *(("at-y", "top", 1 - frame.up(y), words) for y, words in at_y),
        ],
        _under_the_pointer(chart, points, frame),
    )


def _across_words(places: NDArray[np.floating], gap: float, frame: Frame, words: Sequence[str]) -> list[Word]:
    """Labels of the x axis; those without room on a phone are marked, those without room on any screen are omitted."""
    out, last, narrow = [], -1.0, -1.0
    for x in places:
        text, at = words[round(x)] if words else label(float(x), gap), frame.across(float(x))
        if at - last < 0.045:
            continue
        tight = at - narrow < 0.025 * (len(text) + 1.5)
        out.append(("x tight" if tight else "x", "left", at, text))
        last, narrow = at, narrow if tight else at
    return out


def _shapes(one: Points, frame: Frame) -> list[Shape]:
    """The shapes of a series."""
    out, kind = [], one.about.kind
    if kind == "bars":
        half = 0.46 * one.bars
        path = "".join(
            f"M{frame.place(x - half, frame.y[0])}V{units(1 - frame.up(y))}H{units(frame.across(x + half))}"
            f"V{units(1 - frame.up(frame.y[0]))}Z"
            for x, y in zip(one.x, one.y, strict=True)
            if y > 0
        )
        return [("bars", path)]
    few = len(one.x) <= BARS_UP_TO
    if one.low is not None and one.high is not None:
        if few:
            bars = zip(one.x, one.low, one.high, strict=True)
            d = "".join(f"M{frame.place(x, low)}V{units(1 - frame.up(high))}" for x, low, high in bars)
            out.append(("whisker", d))
        else:
            there = _line(one.x, one.high, frame, kind)
            back = _line(one.x, one.low, frame, kind, back=True)
            out.append(("band", f"{there}L{back[1:]}Z"))
    if kind != "points":
        out.append(("line", _line(one.x, one.y, frame, kind)))
    if few or kind == "points":
        dots = "".join(f"M{frame.place(x, y)}h.01" for x, y in zip(one.x, one.y, strict=True))
        out.append(("dots" if kind == "points" or len(one.x) <= 25 else "dots small", dots))
    return out


def _line(x: NDArray[np.float64], y: NDArray[np.float64], frame: Frame, kind: str, back: bool = False) -> str:
    if kind == "step" and len(x) > 1:
        x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    order = slice(None, None, -1) if back else slice(None)
    return "M" + "L".join(frame.place(a, b) for a, b in zip(x[order], y[order], strict=True))


def _under_the_pointer(chart: Chart, points: Sequence[Points], frame: Frame) -> Json:
    """The values that the script shows at each x."""
    digits = chart.digits + 1

    def listed(values: NDArray[np.float64] | None) -> list[float] | None:
        return None if values is None else [round(float(value), digits) + 0.0 for value in values]

    return {
        "x": [round(bound, 9) for bound in frame.x],
        "y": [round(bound, 9) for bound in frame.y],
        "xName": chart.x_name,
        "unit": chart.unit,
        "digits": chart.digits,
        "xDigits": chart.x_digits,
        "xWords": list(chart.x_words),
        "series": [
            {
                "name": one.about.name,
                "colour": one.colour,
                "x": [round(float(x), 6) for x in one.x],
                "y": listed(one.y),
                "low": listed(one.low),
                "high": listed(one.high),
            }
            for one in points
        ],
    }


# Curves with intervals, drawn as SVG here, so that they need no script; the script adds the values at the pointer.
#
# The plot is stretched to the available width; lines keep their width, and all labels are HTML around it, so that it
# reads the same on a phone, on paper and on a wide screen.

__all__ = ["Chart", "Series", "curves_html"]
TABLE_ROWS = 40


def curves_html(chart: Chart, heading: str = "h3") -> Html:
    """The chart as a figure: `heading`, legend, plot, a collapsed table of its values. "" without points."""
    points = [points_of(series, place) for place, series in enumerate(chart.series)]
    points = [one for one in points if len(one.x)]
    if not points:
        return Html()
    frame = Frame(x_range_of(points), y_range_of(chart, points))
    sizes = [len(one.x) for one in points if one.low is not None]
    upright, shaded = any(size <= BARS_UP_TO for size in sizes), any(size > BARS_UP_TO for size in sizes)
    looks = "Upright lines, shaded" if upright and shaded else "Upright lines" if upright else "Shaded"
    note = [f"{looks}: {chart.interval}." if sizes else "", chart.note]
    words = " ".join(part for part in note if part)
    return block("chart", chart, plot_of(chart, points, frame), words, _values(chart, points), heading)


def _values(chart: Chart, points: Sequence[Points]) -> TableData:
    """The curves as a table, for screen readers and for copying."""
    every = np.unique(np.concatenate([one.x for one in points]))
    if len(every) > TABLE_ROWS:
        every = every[np.unique(np.linspace(0, len(every) - 1, TABLE_ROWS).round().astype(np.int64))]
    rows = []
    for x in every:
        cells = [chart.x_words[round(x)] if chart.x_words else f"{x:,.{chart.x_digits}f}"]
        for one in points:
            found = np.flatnonzero(one.x == x)
            cells.append(_value(one, int(found[0]), chart.digits) if len(found) else "")
        rows.append(tuple(cells))
    unit = f", {chart.unit}" if chart.unit else ""
    names = (chart.x_name.split("(")[0].strip(), *(f"{one.about.name}{unit}" for one in points))
    return TableData("", names, tuple(rows), frozenset())


def _value(one: Points, place: int, digits: int) -> str:
    shown = f"{one.y[place]:,.{digits}f}"
    if one.low is None or one.high is None or math.isclose(one.low[place], one.high[place]):
        return shown
    return f"{shown} ({one.low[place]:,.{digits}f} .. {one.high[place]:,.{digits}f})"
