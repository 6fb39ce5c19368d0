"""The base class of results: display, JSON, saving to a folder; and the fields that the results of searches share."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from analysis.report.model import KeyFigure, Report
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate, in_unit, losses_shown
from analysis.utils.tables import as_text, frame_of, json_text, print_lines, write_all
from planner.files import Json, check_new
from planner.formatting import Pace, Rows, counted, html_of, text_of
from planner.json_objects import as_json
from planner.settings import Settings
from planner.world.world import World

# Times in a JSON object are given in steps and, where the step has a length, in minutes: `time` and `time_minutes`.

TIMES = ("time", "time_to", "makespan", "deadline", "max_steps", "step", "steps")
"""Keys whose values are times in steps."""
OF_AN_ESTIMATE = ("mean", "se", "ci95", "max")
NO_TIMES = ("control",)
"""Keys below which a name of TIMES is not a time."""


def with_minutes(said: Any, pace: Pace) -> Any:
    """A JSON value with the minutes of every time added; unchanged if the length of a step is not known."""
    if not pace:
        return said
    if isinstance(said, list):
        return [with_minutes(one, pace) for one in said]
    if not isinstance(said, dict):
        return said
    out: dict[str, Any] = {}
    for name, value in said.items():
        out[name] = value if name in NO_TIMES else with_minutes(value, pace)
        minutes = _minutes(value, name, pace) if name in TIMES else None
        out |= {} if minutes is None else {f"{name}_minutes": minutes}
    return out


def _minutes(value: Any, name: str, pace: Pace) -> Any:
    """A number, a list or an estimate in steps, converted to minutes; None for other values."""
    if isinstance(value, Mapping):
        kept = value if name == "time_to" else [key for key in OF_AN_ESTIMATE if key in value]
        return {key: _minutes(value[key], "", pace) for key in kept} or None
    if isinstance(value, list):
        return [_minutes(one, "", pace) for one in value]
    return None if value is None or isinstance(value, bool | str) else value * pace.minutes


# A result on a terminal, in a folder, as JSON, in a console.

FORMAT = 2
"""Of the JSON object of a report: 2 since release 0.4, which renamed keys (CHANGELOG.md)."""
WIDE = 140
"""Characters in a line of a folder's text file."""


def json_of(report: Report) -> Any:
    """The JSON object of a report, times in minutes too where a step has a length."""
    said = {"format": FORMAT} | with_minutes(as_json(report.result), report.pace)
    return said | {"step_seconds": report.pace.seconds} if report.pace else said


def rows_of(report: Report) -> Rows:
    """Names and values for a console or a notebook: the key figures and the notes."""
    figures = [(one.name, f"{one.value} ({one.note})" if one.note else one.value) for one in report.figures]
    return [*figures, *(("note", note) for note in report.notes)]


def print_report(report: Report, console: Console, earlier: Report | None = None) -> None:
    """Print a report on a terminal: summary, findings, inputs, tables, notes.

    Args:
        report: the report. console: where it is printed.
        earlier: a report that was printed before; its lines and tables are omitted.
    """
    printed = [] if earlier is None else [_content(one) for one in _printed(earlier)]
    new = [one for one in _printed(report) if _content(one) not in printed]
    if printed and new:
        console.print()
    for one in new:
        if isinstance(one, str):
            print_lines(console, [one])
        else:
            console.print(one)


def _printed(report: Report) -> Iterator[str | Table]:
    """The lines and tables for a terminal, in order."""
    yield from (report.summary, *report.findings)
    yield from [""] if report.last else [*report.heading, *report.took]
    for part in report.parts:
        if not part.page_only:
            yield from part.tables
            yield from part.notes
    yield from (*report.last, *(f"note: {note}" for note in report.notes), *report.warnings)


def _content(one: str | Table) -> object:
    """A line, or a table's title and cells, for comparison."""
    return one if isinstance(one, str) else (one.title, [[column.header, *column.cells] for column in one.columns])


def save_report(
    report: Report, folder: Path, command: str, spare: Iterable[Path] = (), force: bool = True
) -> list[Path]:
    """Write the page, the text, the JSON object, pictures and files into `folder`, and return their paths.

    Args:
        report: the report. folder: is created if it does not exist.
        command: the command line that made the report, for the page.
        spare: files that must not be replaced by other content. In a conflict, all files go to a subfolder named after
            the report, because they refer to each other.
        force: replace other files that exist.

    Raises:
        UsageError: a file exists and `force` is False.
    """
    from analysis.pictures import png_of
    from analysis.report.rendering import figure_of, page_of

    # All contents are made before the first write, so that an error leaves the folder unchanged.
    pictures = {name: png_of(figure_of, report, name) for name in report.pictures}
    files: dict[str, str | bytes] = {
        f"{report.name}.txt": as_text(lambda console: print_report(report, console), WIDE),
        f"{report.name}.json": json_text(json_of(report)),
        **{name: make() for name, make in report.files.items()},
    }
    files |= pictures
    page, spared = page_of(report, command, pictures, sorted(files)), {file.resolve() for file in spare}
    if any(_replaces(folder / name, content, spared) for name, content in files.items()):
        folder /= report.name
    check_new(*(folder / name for name in ("index.html", *files)), force=force)
    return write_all(folder, {"index.html": page, **files})


def _replaces(file: Path, content: str | bytes, spared: Collection[Path]) -> bool:
    """Whether writing `content` would change a file that must be kept."""
    held = content.encode() if isinstance(content, str) else content
    return file.resolve() in spared and file.is_file() and file.read_bytes() != held


MOST_SENTENCES = 6
"""Most findings of a report that a console or a notebook shows."""


class Result:
    """Base class of all results. Its report is made by the function that `reported_by` names."""

    reported_by: ClassVar[str]
    """The function that makes its `Report`, as "module:function", imported on demand: reports load slow packages."""

    partial: bool
    """Whether the computation was interrupted; the result then holds the part that was done."""
    listed: ClassVar[str] = ""
    """Key of the list in the JSON object that gives the rows of `to_dataframe`; "": the object is the only row."""
    json_keys = "version partial?=interrupted"

    @property
    def summary(self) -> str:
        """The answer in one sentence."""
        return report_of(self).summary

    @property
    def interrupted(self) -> Literal[True] | None:
        """True if the computation was interrupted."""
        return True if self.partial else None

    @property
    def version(self) -> str:
        """The release that made the result."""
        return version("mrac-jax")

    def to_json(self) -> Json:
        """The JSON object that the command prints."""
        said: Json = json_of(report_of(self))
        return said

    def to_dataframe(self) -> Any:
        """The result as a pandas DataFrame (needs the extra `pandas`); its columns are the JSON object's keys."""
        said = self.to_json()
        rows = said[self.listed] if self.listed else [said]
        return frame_of([{"figure": name, **row} for name, row in rows.items()] if isinstance(rows, dict) else rows)

    def save(self, folder: str | Path, *, force: bool = False) -> list[Path]:
        """Write the files that the command's `--out` writes, and return their paths.

        Args:
            folder: is created if it does not exist. force: replace files that exist.

        Raises:
            UsageError: a file exists and `force` is False. Nothing is written.
        """
        return save_report(report_of(self), Path(folder), "", force=force)

    def _brief(self) -> tuple[str, Sequence[str], Rows]:
        """The text for a console or a notebook, at most a screen: summary, sentences, key figures."""
        said = report_of(self)
        return f"{type(self).__name__}: {said.summary}", said.findings[:MOST_SENTENCES], rows_of(said)

    def __repr__(self) -> str:
        title, sentences, rows = self._brief()
        return text_of("\n".join([title, *sentences]), rows)

    def _repr_html_(self) -> str:
        title, sentences, rows = self._brief()
        said = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
        return html_of(title, rows).replace("<table>", f"{said}<table>", 1)


def report_of(result: Result) -> Report:
    """The report of a result, from the function that its class names."""
    module, _, function = result.reported_by.partition(":")
    said: Report = getattr(import_module(module), function)(result)
    return said


# Fields that the results of all searches share: map, settings, random numbers, extent.


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Searched(Result):
    """Base class of the results of searches.

    Attributes:
        world, settings: the map and the settings of the plans. cells: number of accessible cells.
        choices: most rollouts of each candidate, seed, step at which every mission ends.
        engine: the engine that simulated rollouts; "" if every value is exact.
        words: arguments of the command `evaluate` for this input; empty in Python.
        partial: whether the search was interrupted. notes: remarks for the user.
    """

    world: World
    settings: Settings
    choices: RolloutChoices
    cells: int
    engine: str
    words: tuple[str, ...] = ()
    partial: bool = False
    notes: tuple[str, ...] = ()
    json_keys = """
        robots=team starts accessible=cells choices.rollouts choices.seed engine=engine_or_none exact notes?
    """

    if TYPE_CHECKING:

        @property
        def starts(self) -> NDArray[np.int64]: ...

    @property
    def team(self) -> int:
        """Number of robots."""
        return len(self.starts)

    @property
    def first_fresh(self) -> int:
        """The first id of the rollouts that the search did not use."""
        return self.choices.rollouts

    @property
    def engine_or_none(self) -> str | None:
        """The engine; None if every value is exact."""
        return self.engine or None

    @property
    def exact(self) -> bool:
        """Whether all values are exact, without rollouts."""
        return not self.engine


def cell_counts(world: World, accessible: NDArray[np.bool_]) -> dict[str, int]:
    """Numbers of cells: total, free, accessible, and accessible with a threat above 0."""
    dangerous = accessible & (world.threat > 0)
    counts = {"free": world.free, "accessible": accessible, "dangerous": dangerous}
    return {"total": world.threat.size} | {name: int(cells.sum()) for name, cells in counts.items()}


# Phrases that reports share: the map, the random numbers, coverage and losses, intervals.

EXACT = "exact, without rollouts"


def asked(world: World, robots: int, question: str) -> str:
    """ "site.npz, 3 robots: where to start?"."""
    return f"{world.name}, {counted(robots, 'robot')}: {question}"


def map_text(world: World, cells: int, robots: int = 0) -> str:
    """ "site.npz: 14 x 23 cells of 1 m, 300 accessible; 3 robots"; without robots, the map alone."""
    height, width = world.shape
    size = f"{height} x {width} cells of {world.cell_size:g} m, {cells:,} accessible"
    return f"{world.name}: {size}" + (f"; {counted(robots, 'robot')}" if robots else "")


def seed_text(world: World, choices: RolloutChoices, engine: str, rolled: str = "") -> str:
    """The source of the figures: "seed 0, numba" after the text `rolled`; EXACT without an engine."""
    ends = "" if choices.deadline is None else f", every mission ended at {world.pace.step(choices.deadline)}"
    return (f"{rolled}seed {choices.seed}, {engine}" if engine else EXACT) + ends


def sourced(rollouts: int, said: str) -> str:
    """A sentence with its source: "Exact expectation: 88.67 % covered"."""
    return f"Fresh rollouts: {said}" if rollouts else f"Exact expectation: {said.replace(' (exact)', '')}"


def share_figure(estimate: Estimate, name: str, note: str = "") -> KeyFigure:
    """A fraction as a key figure in percent, with its interval."""
    mean, interval = estimate.columns(100.0, 100)
    return KeyFigure(f"{mean} %", name, in_unit(interval) + note)


def run_again(words: Sequence[str], how: Sequence[str], choices: RolloutChoices, *, exact: bool) -> str:
    """The command that evaluates the result of a search; with a seed that the search did not use, if not `exact`."""
    fresh = [] if exact else ["--rollouts", str(choices.rollouts), "--seed", str((choices.seed + 1) % 2**64)]
    return shlex.join(["mrac-jax", "evaluate", *words, *how, *fresh])


def search_report(found: Any, name: str, question: str, summary: str, extent: str, rolled: str, **more: Any) -> Report:
    """The report of a search: its question, the map and the random numbers, notes and settings.

    Args:
        found: the result, a `Searched` with `starts`. question: after the map and the team.
        extent: the searched alternatives, after the map. rolled: the rollouts, before their seed. more: of `Report`.
    """
    world, robots = found.world, len(found.starts)
    heading = (
        f"{map_text(world, found.cells, robots)}; {extent}",
        seed_text(world, found.choices, found.engine, rolled),
    )
    settings = {"settings": found.settings.described(world.pace)} | more
    return Report(name, name, asked(world, robots, question), summary, found, heading=heading,
                  notes=found.notes, pace=world.pace, **settings)  # fmt: skip


def team_figure(estimate: Estimate, robots: int, name: str = "robots lost") -> KeyFigure:
    """The number of lost robots, or another number that `name` states, of `robots` as a key figure."""
    mean, interval = losses_shown(estimate, robots)
    return KeyFigure(mean, name, interval)
