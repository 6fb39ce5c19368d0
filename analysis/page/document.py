"""The page as a whole, which needs no other file to be read; and plots: the drawing, the words, the pointer's data."""

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

# The page as a whole: its sections, its one script, and nothing that needs another file to be read.

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


# A plot: the drawing that is stretched, and the words and the pointer's data beside it.

# What a chart is made of: curves by name, axes, and the same as arrays, thinned to what a screen can show.

MOST_POINTS = 400
"""Points of a curve that are drawn and shown under the pointer; longer ones are thinned evenly."""
BARS_UP_TO = 40
"""Intervals of so few points are drawn as bars, of more as a band."""
CURVE_COLOURS = 8
SIDE = 1000
"""Units of the drawing in each direction, stretched to the space that there is."""


@dataclass(frozen=True, eq=False)
class Series:
    """A curve by name.

    Attributes:
        name: in the legend. x, y: of its points; NaN is left out.
        low, high: of the interval of each point, if there are any.
        kind: "line", "step" (holds each value to the next x), "points" (marks alone) or "bars".
        dashed: for what is only compared with. colour: its number in the palette; None: its place among the series.
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
        """Means times `scale` with their intervals; none where no interval is known of one."""
        means, low, high = scale * np.array([(one.mean, *one.ci95) for one in estimates]).reshape(-1, 3).T
        known = bool(np.isfinite((low, high)).all())
        return cls(name, x, means, low if known else None, high if known else None, **look)


@dataclass(frozen=True)
class Chart:
    """Curves on one pair of axes.

    Attributes:
        title: its heading. series: the curves. x_name, y_name: of the axes. note: a line below.
        unit: after every value of y, "%" say. digits, x_digits: decimals of the values shown under the pointer.
        x_whole: label whole numbers alone. x_words: of 0, 1, 2, ..., in their place.
        y_range: shown at least; None: what the curves need, from 0. fit: the y axis begins where the curves do,
            not at 0, and `y_range` is what it never leaves.
        at_x: (x, words) of upright lines, where they are on the axis. at_y: (y, words) of level ones.
        interval: what low and high are, in words.
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
    """A series as arrays, thinned; `bars`: how wide a bar is."""

    about: Series
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    colour: int
    bars: float

    @property
    def ends(self) -> list[NDArray[np.float64]]:
        """All that must fit on the y axis."""
        return [values for values in (self.y, self.low, self.high) if values is not None]


def points_of(series: Series, place: int) -> Points:
    """The series as arrays; `place` among the series gives the colour, where it names none."""
    x, y = (np.asarray(values, dtype=np.float64).ravel() for values in (series.x, series.y))
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    bars = float(np.diff(x[known]).min()) if series.kind == "bars" and len(known) > 1 else 1.0
    if len(known) > MOST_POINTS and series.kind != "bars":
        known = known[np.unique(np.linspace(0, len(known) - 1, MOST_POINTS).round().astype(np.int64))]
    low, high = _ends(series.low, series.high, known, y)
    colour = place % CURVE_COLOURS if series.colour is None else series.colour
    return Points(series, x[known], y[known], low, high, colour, bars)


def _ends(
    low: ArrayLike | None, high: ArrayLike | None, known: NDArray[np.int64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64] | None]:
    """The intervals of the `known` points; where an end is not known it is the point itself."""
    if low is None or high is None:
        return None, None
    ends = (np.asarray(values, dtype=np.float64).ravel()[known] for values in (low, high))
    lower, upper = (np.where(np.isfinite(end), end, y[known]) for end in ends)
    return lower, upper


def x_range_of(points: Sequence[Points]) -> tuple[float, float]:
    """What the x axis shows."""
    low, high = min(float(one.x.min()) for one in points), max(float(one.x.max()) for one in points)
    wide = max((one.bars for one in points if one.about.kind == "bars"), default=0.0)
    few = wide or (0.03 * (high - low) if max(len(one.x) for one in points) <= BARS_UP_TO else 0.0)
    if high == low:
        few = max(few, 0.5)
    return low - few, high + few


def y_range_of(chart: Chart, points: Sequence[Points]) -> tuple[float, float]:
    """What the y axis shows."""
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
    """From values to units of the drawing, and to percent of the plot's width and height."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.x, self.y = x, y

    def across(self, x: float) -> float:
        """From 0 at the left to 1 at the right."""
        return (x - self.x[0]) / (self.x[1] - self.x[0])

    def up(self, y: float) -> float:
        """From 0 at the bottom to 1 at the top."""
        return (y - self.y[0]) / (self.y[1] - self.y[0])

    def place(self, x: float, y: float) -> str:
        """The point as the drawing has it: "across down"."""
        return f"{units(self.across(x))} {units(1 - self.up(y))}"


def units(fraction: float) -> str:
    """A part of a side in the drawing's units, kept near the drawing."""
    return f"{min(max(fraction, -1.0), 2.0) * SIDE:.1f}".rstrip("0").rstrip(".")


# Where axes are labelled, and how numbers on them are written.


def nice_step(rough: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is at least `rough` (> 0)."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 6, whole: bool = False) -> NDArray[np.floating]:
    """At most about `most` round numbers in `low .. high`; whole ones if asked."""
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
"""How a path looks, and its letters."""
Word = tuple[str, str, float, str]
"""How a word looks, from which side it stands how far (0 to 1), and its text."""


@dataclass(frozen=True, eq=False)
class Plot:
    """What the template draws.

    Attributes:
        points: the curves. label: the plot in words. axes: paths below the curves. curves: each with its paths.
        words: beside the drawing. under_the_pointer: what the script shows.
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
    """Labels of the x axis; those that a phone has no room for are marked, and those that nobody has are left out."""
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
    """The marks of a series."""
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
    """What the script shows at each x."""
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


# Curves with intervals: drawn as SVG here, so that they are there without a script; the script adds the values.
#
# The plot is stretched to whatever width there is, lines keep their width, and every word is HTML beside it: so it
# reads
# the same on a phone, on paper and on a wide screen.

__all__ = ["Chart", "Series", "curves_html"]
TABLE_ROWS = 40


def curves_html(chart: Chart, heading: str = "h3") -> Html:
    """The chart as a figure: `heading`, legend, plot, the values as a table folded away. Nothing of no points."""
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
    """The curves as a table: for those who cannot see them, and for those who want to copy them."""
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
