"""Tables and lines of all results, on a console and as the text and JSON of a folder."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console, ConsoleOptions, RenderableType
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from planner.arguments import argument
from planner.errors import UsageError, visible
from planner.formatting import chance, counted, in_percent
from planner.settings import SETTINGS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from planner.formatting import Pace
    from planner.plan.plan import Plan
    from planner.settings import Settings
    from planner.world.world import World


# Tables and lines on a console: no figure, interval or name is ever cut.

KEPT_WHOLE, SHORT = 16, 10
"""Longest name, and longest header, in characters, that are not wrapped."""


class FittedTable(Table):
    """A table that fits the console: first it drops columns of `dropped`, in order; then it is split into blocks.

    Figures (right-aligned columns) are never wrapped; words and headers are wrapped only between words. A name in
    `dropped` that several columns share means the last of them.
    """

    dropped: tuple[str, ...] = ()

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        if not self.columns:
            return
        sizes = [self._sizes(console, options, place) for place in range(len(self.columns))]
        kept, gone = list(range(len(self.columns))), list[int]()
        for name in self.dropped:
            if self._widths(kept, sizes, options.max_width):
                break
            gone.append(max(place for place in kept if self.columns[place].header == name))
            kept.remove(gone[-1])
        for number, places in enumerate(self._blocks(kept, sizes, options.max_width)):
            yield self._part(places, self._widths(places, sizes, options.max_width), "" if number else self.title)
        if gone:
            names = ", ".join(map(self._named, sorted(gone)))
            has = "has it" if len(gone) == 1 else "have them"
            width = f"omitted at a width of {options.max_width} characters"
            yield Text(f"{width}: {names}; a wider window, --out and --json {has}")

    def _named(self, place: int) -> str:
        """A column's header; if several columns share it, with the header of the column before."""
        headers = [str(column.header) for column in self.columns]
        return headers[place] if headers.count(headers[place]) == 1 else f"{headers[place - 1]} {headers[place]}"

    def _sizes(self, console: Console, options: ConsoleOptions, place: int) -> tuple[int, int]:
        """Characters that a column needs, and that it takes without any wrapping; padding apart."""
        wide, column = options.update(max_width=100_000), self.columns[place]
        header, *cells = (Measurement.get(console, wide, text) for text in (column.header, *column.cells))
        whole = max((cell.maximum for cell in cells), default=0)
        needed = whole
        if column.justify != "right":
            # Words may wrap between words, figures may not.
            needed = max(*(cell.minimum for cell in cells), min(whole, KEPT_WHOLE)) if cells else 0
        named = header.maximum if header.maximum <= SHORT else header.minimum
        return max(needed, named), max(whole, header.maximum)

    def _widths(self, places: Sequence[int], sizes: Sequence[tuple[int, int]], room: int) -> list[int]:
        """Widths of columns side by side, with spare width for words first; empty if they do not fit."""
        part = self._part(places, [0] * len(places), "")
        spare = room - sum(map(part._get_padding_width, range(len(places)))) - part._extra_width
        spare -= sum(sizes[place][0] for place in places)
        if spare < 0:
            return []
        widths = [sizes[place][0] for place in places]
        for number in sorted(range(len(places)), key=lambda number: self.columns[places[number]].justify == "right"):
            more = min(spare, sizes[places[number]][1] - widths[number])
            widths[number], spare = widths[number] + more, spare - more
        return widths

    def _blocks(self, kept: Sequence[int], sizes: Sequence[tuple[int, int]], room: int) -> Iterator[list[int]]:
        """The blocks of columns; each begins with the first column, which names the rows."""
        first, *rest = kept
        block = [first]
        for place in rest:
            if len(block) > 1 and not self._widths([*block, place], sizes, room):
                yield block
                block = [first]
            block.append(place)
        yield block

    def _part(self, places: Sequence[int], widths: Sequence[int], title: Any) -> Table:
        part = Table(title=title or None, box=self.box, title_justify=self.title_justify, padding=self.padding,
                     pad_edge=self.pad_edge, collapse_padding=self.collapse_padding)  # fmt: skip
        fixed: Sequence[int | None] = widths or [None] * len(places)
        part.columns = [
            replace(self.columns[place], _index=number, width=width, overflow="fold")
            for number, (place, width) in enumerate(zip(places, fixed, strict=True))
        ]
        part.rows = self.rows
        return part


def make_table(
    columns: Iterable[str],
    title: str | None = None,
    rows: Iterable[Sequence[str]] = (),
    *,
    left: Container[str] = ("",),
    dropped: Iterable[str] = (),
    **look: Any,
) -> FittedTable:
    """A table.

    Args:
        columns: their names. title: of the table. rows: the texts of its cells.
        left: names of left-aligned columns of words.
        dropped: names of columns that may be omitted, the least important first, as in `FittedTable`.
        look: as in rich's Table.
    """
    table = FittedTable(title=title, box=box.SIMPLE_HEAD, title_justify="left", **look)
    table.dropped = tuple(dropped)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right")
    for row in rows:
        table.add_row(*row)
    return table


@dataclass(frozen=True)
class Column:
    """A column of a table whose rows are objects: a title, and the cell of a row.

    Attributes:
        title: its header. of: the cell of a row: text, a number, None (empty), or an estimate, which has two columns.
        interval: header of an estimate's interval; "": the mean alone. scale, most: as in `Estimate.columns`.
        words: left-aligned. shown: False leaves the column out.
    """

    title: str
    of: Callable[[Any], Any]
    interval: str = ""
    scale: float = 1.0
    most: int | None = None
    words: bool = False
    shown: object = True

    def cells(self, row: Any) -> tuple[str, ...]:
        """The cell of a row, with its interval if the column has one."""
        value, more = self.of(row), ("",) * bool(self.interval)
        if hasattr(value, "columns"):
            mean, interval = value.columns(self.scale, self.most)
            return (mean, interval) if self.interval else (mean,)
        return ("" if value is None else str(value), *more)


def in_percents(title: str, of: Callable[[Any], Any], interval: str = "from .. to", **look: Any) -> Column:
    """A column of an estimate of a fraction, in percent, with its interval."""
    return Column(title, of, interval, 100.0, 100, **look)


def table_of(
    columns: Iterable[Column], rows: Iterable[Any], title: str | None = None, dropped: Iterable[str] = (), **look: Any
) -> FittedTable:
    """A table of objects; arguments as in `make_table`."""
    shown = [column for column in columns if column.shown]
    names = [name for column in shown for name in (column.title, *[column.interval] * bool(column.interval))]
    cells = ([cell for column in shown for cell in column.cells(row)] for row in rows)
    return make_table(names, title, cells, left=[one.title for one in shown if one.words], dropped=dropped, **look)


def robots_table(plan: Plan, survival: Sequence[float] | NDArray[np.float64], title: str | None = None) -> FittedTable:
    """A row for each robot of a plan; `survival`: the probability of each to survive its nominal path."""
    from planner.plan.plan import drive_of

    drive = drive_of(robot.path for robot in plan.robots)
    columns = (
        Column("robot", lambda k: k),
        Column("start", lambda k: list(divmod(int(plan.robots[k].path[0]), plan.shape[1]))),
        Column("moves", lambda k: f"{drive.moves[k]:,}"),
        Column("quarter turns", lambda k: f"{drive.turns[k]:,}"),
        Column("areas covered", lambda k: "" if plan.is_external
               else sum(leg.kind == "cover" for leg in plan.robots[k].legs)),
        Column("survives its path, %", lambda k: in_percent(survival[k], 2)),
    )  # fmt: skip
    return table_of(columns, range(len(plan.robots)), title)


def print_lines(console: Console, lines: Sequence[str]) -> None:
    """Print lines verbatim, without markup."""
    for line in lines:
        console.print(line, markup=False, highlight=False)


# The console of tables, summaries and progress: it escapes control characters in text from files.


class SafeConsole(Console):
    """A rich console for untrusted text: control characters are shown as escapes, and markup is ignored.

    A broken pipe is left to the caller.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"markup": False, "emoji": False, **options})

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError."""
        raise BrokenPipeError

    def render_str(self, text: str, **options: Any) -> Text:
        """The text with escapes, so that tables and wrapped lines have room for them."""
        return super().render_str(visible(text), **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Escape text on output; the console's own control codes (colours, cursor) are not text."""
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else visible(text), style, control)


# Tables as pandas DataFrames (the extra `pandas`).


def frame_of(table: Mapping[str, Any] | Iterable[Mapping[str, Any]]) -> Any:
    """A DataFrame from columns by name, or from rows of JSON types (`coverage.mean`; an interval gives two columns).

    Raises UsageError if pandas is not installed.
    """
    try:
        import pandas
    except ImportError as error:
        raise UsageError("pandas is not installed", fix="pip install pandas") from error
    return pandas.DataFrame(table if isinstance(table, Mapping) else [dict(_flat(row)) for row in table])


def _flat(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping):
        for key, one in value.items():
            yield from _flat(one, f"{name}.{key}" if name else key)
    elif name.endswith("ci95") and value is not None:
        yield from zip((f"{name}.low", f"{name}.high"), value, strict=True)
    else:
        yield name, value


# Phrases on plans and settings.


def policy_text(settings: Settings) -> str:
    """A policy and its limits: "watchful, risk cap 0.25, optimised order of areas"."""
    limits = {name: getattr(settings, name) for name in ("risk_cap", "robot_value", "density", "deliver_every")}
    own = [
        f"{SETTINGS[name].title} {value:g}" for name, value in limits.items() if value != getattr(type(settings), name)
    ]
    own += ["optimised order of areas"] * (settings.priority is not None)
    return ", ".join([settings.rule.name, *own])


def plan_text(plan: Plan) -> str:
    """A plan: "6 areas, shared 10 times", then the end of its nominal run (`Plan.ends`).

    The policy comes first, unless it is the paper's without further settings.
    """
    often = "once" if plan.shares == 1 else f"{plan.shares:,} times"
    shared = f", shared {often}" if plan.shares else ""
    policy = "" if plan.settings is None else policy_text(plan.settings)
    by = "" if policy in ("", "mrac") else f"{policy}; "
    return f"{by}{counted(len(plan.areas), 'area')}{shared}; {plan.ends}"


def span_text(plan: Plan, pace: Pace) -> str:
    """ "makespan 1,315 steps, 2,612 moves, 511 quarter turns"; with the time of turns, if their cost is given.

    A run that ends before all is covered waits a few steps before it ends.
    """
    from planner.plan.plan import drive_of
    from planner.simulator.codes import Outcome

    drive = drive_of(robot.path for robot in plan.robots)
    driven = f"{counted(int(drive.moves.sum()), 'move')}, {counted(int(drive.turns.sum()), 'quarter turn')}"
    if pace.turn:
        steps = drive.time(pace.turn)
        driven += f": with turns {pace.steps(steps)}"
    if plan.outcome in (Outcome.NOT_WORTH_THE_RISK.word, Outcome.NO_PROGRESS.word):
        later = plan.time - plan.makespan
        end = f", the end {counted(later, 'step')} later" if later else ""
        return f"the last move is at {pace.step(plan.makespan)}{end}, {driven}"
    return f"makespan {pace.steps(plan.makespan)}, {driven}"


def failure_text(plan: Plan, world: World) -> str:
    """The meaning of the map's p with a Weibull shape, hazard multipliers or types; "" if p is a probability."""
    failure_model, worst = plan.failure_model, float(world.threat[world.free].max(initial=0.0))
    if failure_model.is_plain:
        return ""
    if failure_model.is_even:
        return f"{failure_model.description}: each robot has the p of its type; the map's own p applies to no type"
    chances = [failure_model.first_chance(worst, robot) for robot in range(len(plan.robots))]
    least, most = (chance(one) for one in (min(chances), max(chances)))
    fresh = least if least == most else f"{least} to {most}, by robot"
    return (
        f"{failure_model.description}: p is a dose, to which a visit adds -ln(1 - p); the first visit of the worst "
        f"cell, p = {chance(worst)}, destroys a fresh robot with {fresh}"
    )


def without_level(said: str) -> str:
    """The text of `Estimate.description` without "(95 %)", for a sentence in which % means coverage only."""
    return said.replace(" (95 %)", "").replace(", 95 %)", ")")


# Writing a folder: files are written completely or not at all; console output and JSON as text.


def as_text(draw: Callable[[Console], None], width: int = 120) -> str:
    """The output of `draw(console)`, as plain text."""
    console = SafeConsole(width=width, color_system=None, force_terminal=False)
    with console.capture() as captured:
        draw(console)
    return captured.get()


def csv_text(names: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """The text of a CSV file with a header row."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([names, *rows])
    return out.getvalue()


def json_text(content: object, *, compact: bool = False) -> str:
    """The text of a JSON file."""
    look: dict[str, Any] = {"separators": (",", ":")} if compact else {"indent": 1}
    return json.dumps(content, allow_nan=False, **look) + "\n"


def make_folder(folder: Path, name: str = "folder") -> None:
    """Make a folder, with its parents, if there is none. Raises UsageError that names the argument `name`."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"{argument(name)} {visible(str(folder))} cannot be written ({error.strerror})"
        raise UsageError(problem, expected="a folder to write to") from error


def write_all(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into `folder` (created if necessary), each completely or not at all; returns their paths."""
    make_folder(folder)
    from planner.files import atomic_write

    written: list[Path] = []
    for name, content in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        with atomic_write(folder / name, "wb" if isinstance(content, bytes) else "w") as out:
            out.write(content)
        written.append(folder / name)
    return written
