"""What every answer can do: show itself, say itself as JSON, save itself; and what the answers of all searches hold."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from html import escape
from importlib import import_module
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from rich.console import Console
from rich.table import Table

from analysis.report.model import KeyFigure, Report
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate, in_unit, losses_shown
from analysis.utils.tables import as_text, frame_of, json_text, print_lines, write_all
from planner.files import Json, check_new
from planner.formatting import Pace, Rows, counted, html_of, text_of
from planner.settings import Settings
from planner.world.world import World

# Times of a JSON object in minutes beside those in steps: `time_minutes` beside `time`, and so on.

TIMES = ("time", "time_to", "makespan", "deadline", "max_steps", "step", "steps")
"""Keys whose values are times in steps."""
OF_AN_ESTIMATE = ("mean", "se", "ci95", "max")
NO_TIMES = ("control",)
"""Keys below which figures are called as times are, and are none."""


def with_minutes(said: Any, pace: Pace) -> Any:
    """What JSON holds, with the minutes of every time in it; as it is where nobody says how long a step takes."""
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
    """A number, numbers or an estimate in steps, in minutes; None for anything else."""
    if isinstance(value, Mapping):
        kept = value if name == "time_to" else [key for key in OF_AN_ESTIMATE if key in value]
        return {key: _minutes(value[key], "", pace) for key in kept} or None
    if isinstance(value, list):
        return [_minutes(one, "", pace) for one in value]
    return None if value is None or isinstance(value, bool | str) else value * pace.minutes


# What every answer can do, whatever it is the answer to: show itself, say itself as JSON, save itself in a folder.

# A report on a terminal, in a folder, as JSON, in a console.

FORMAT = 2
"""Of the JSON object of a report: 2 since release 0.4, which renamed keys (CHANGELOG.md)."""
WIDE = 140
"""Characters in a line of a folder's text file."""


def as_json(value: Any) -> Any:
    """A value as JSON has it: as it says itself, data by name, arrays and tuples as lists, the undefined as None."""
    if hasattr(value, "to_json"):
        return as_json(value.to_json())
    if is_dataclass(value):
        return {one.name: as_json(getattr(value, one.name)) for one in fields(value)}
    if isinstance(value, Mapping):
        return {name: as_json(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(one) for one in value]
    if isinstance(value, np.ndarray | np.generic):
        return as_json(value.tolist())
    return None if isinstance(value, float) and not isfinite(value) else value


def json_of(report: Report) -> Any:
    """The JSON object of a report, times in minutes too where a step has a length."""
    said = {"format": FORMAT} | with_minutes(as_json(report.json()), report.pace)
    return said | {"step_seconds": report.pace.seconds} if report.pace else said


def rows_of(report: Report) -> Rows:
    """Names and values of a console and a notebook: the key figures, and what a user should know."""
    figures = [(one.name, f"{one.value} ({one.note})" if one.note else one.value) for one in report.figures]
    return [*figures, *(("note", note) for note in report.notes)]


def print_report(report: Report, console: Console, earlier: Report | None = None) -> None:
    """For a person at a terminal: the answer, how sure it is, what was looked at, tables and how to read them.

    `earlier`: a report of less, which was printed already: its lines and tables are left out.
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
    """The lines and tables of a terminal, in order."""
    yield from (report.headline, *report.findings)
    yield from [""] if report.last else [*report.heading, *report.took]
    for part in report.parts:
        if not part.aside:
            yield from part.tables
            yield from part.notes
    yield from (*report.last, *(f"note: {note}" for note in report.notes), *report.warnings)


def _content(one: str | Table) -> object:
    """A line, or a table's title and cells, to compare."""
    return one if isinstance(one, str) else (one.title, [[column.header, *column.cells] for column in one.columns])


def save_report(
    report: Report, folder: Path, command: str, spare: Iterable[Path] = (), force: bool = True
) -> list[Path]:
    """Write the page, the text, the JSON object, pictures and files into `folder`; returns them.

    `command`: the command line that made it, for the page. `spare`: files that are not replaced by another content;
    where one would be, all go to a folder within, of the report's name: they name each other. `force`: other files that
    are there already are replaced; else a UsageError.
    """
    from analysis.pictures import png_of
    from analysis.report.rendering import figure_of, page_of

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
    """Whether a file that is to be spared would come to hold something else."""
    held = content.encode() if isinstance(content, str) else content
    return file.resolve() in spared and file.is_file() and file.read_bytes() != held


MOST_SENTENCES = 6
"""Of a report's findings that a console or a notebook shows."""


class Answer:
    """What every answer is: stated by the function that `reported_by` names."""

    reported_by: ClassVar[str]
    """The function that makes its `Report`, as "module:function": reports load what answers do without."""

    partial: bool
    """It was interrupted, and holds what was done."""
    listed: ClassVar[str] = ""
    """What its JSON object lists, a row each of `to_dataframe`; "": the object itself is the one row."""

    def to_json(self) -> Json:
        """The JSON object that the command prints."""
        said: Json = json_of(report_of(self))
        return said

    def to_dataframe(self) -> Any:
        """What it lists as a pandas DataFrame (the extra `pandas`), with columns as its JSON object names them."""
        said = self.to_json()
        rows = said[self.listed] if self.listed else [said]
        return frame_of([{"figure": name, **row} for name, row in rows.items()] if isinstance(rows, dict) else rows)

    def save(self, folder: str | Path, *, force: bool = False) -> list[Path]:
        """Write what the command's `--out` writes; returns the files.

        `force`: replace files that are there already; without it that is a UsageError, and nothing is written.
        """
        return save_report(report_of(self), Path(folder), "", force=force)

    def _brief(self) -> tuple[str, Sequence[str], Rows]:
        """What a console or a notebook shows of an answer, a screen at most: the answer, sentences, key figures."""
        said = report_of(self)
        return f"{type(self).__name__}: {said.headline}", said.findings[:MOST_SENTENCES], rows_of(said)

    def __repr__(self) -> str:
        title, sentences, rows = self._brief()
        return text_of("\n".join([title, *sentences]), rows)

    def _repr_html_(self) -> str:
        title, sentences, rows = self._brief()
        said = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
        return html_of(title, rows).replace("<table>", f"{said}<table>", 1)


def report_of(answer: Answer) -> Report:
    """The report of an answer, by the function that its type names."""
    module, _, function = answer.reported_by.partition(":")
    said: Report = getattr(import_module(module), function)(answer)
    return said


def json_end(answer: Answer, notes: Sequence[str] = ()) -> Json:
    """What an answer's JSON object ends with: the version, whether it is partial, notes if there are any."""
    partial: Json = {"partial": True} if answer.partial else {}
    return {"version": version("mrac-jax")} | partial | ({"notes": list(notes)} if notes else {})


# What the answers of all searches hold: on which map, by whose settings, on whose luck, and how far.


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Searched(Answer):
    """What they share.

    Attributes:
        world, settings: the map, and what plans are made with. cells: accessible cells.
        choices: what was rolled out: most rollouts of each, seed, the step at which every mission ends.
        engine: that rolled out; "": all is exact. words: of the command `evaluate` for this input; empty in Python.
        partial: it was interrupted, and holds what was done. notes: what a user should know.
    """

    world: World
    settings: Settings
    choices: RolloutChoices
    cells: int
    engine: str
    words: tuple[str, ...] = ()
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def exact(self) -> bool:
        """Whether nothing was rolled out."""
        return not self.engine


# What reports say alike: on which map, on whose luck, how much is covered and lost, where an interval lies.

EXACT = "exact: nothing was rolled out"


def asked(world: World, robots: int, question: str) -> str:
    """ "site.npz, 3 robots: where to start?"."""
    return f"{world.name}, {counted(robots, 'robot')}: {question}"


def map_words(world: World, cells: int, robots: int = 0) -> str:
    """ "site.npz: 14 x 23 cells of 1 m, 300 accessible; 3 robots"; the team where there is one."""
    height, width = world.shape
    size = f"{height} x {width} cells of {world.cell_size:g} m, {cells:,} accessible"
    return f"{world.name}: {size}" + (f"; {counted(robots, 'robot')}" if robots else "")


def luck_words(world: World, choices: RolloutChoices, engine: str, rolled: str = "") -> str:
    """ "seed 0, numba", after what was `rolled` out; without an engine, that nothing was."""
    ends = "" if choices.deadline is None else f", every mission ended at {world.pace.step(choices.deadline)}"
    return (f"{rolled}seed {choices.seed}, {engine}" if engine else EXACT) + ends


def sourced(rollouts: int, said: str) -> str:
    """Where the figures of what was found come from, and they: "Exact expectation: 88.67 % covered"."""
    return f"Fresh rollouts: {said}" if rollouts else f"Exact expectation: {said.replace(' (exact)', '')}"


def share_figure(estimate: Estimate, name: str, note: str = "") -> KeyFigure:
    """A share as a key figure, with its interval."""
    mean, interval = estimate.columns(100.0, 100)
    return KeyFigure(f"{mean} %", name, in_unit(interval) + note)


def run_again(words: Sequence[str], how: Sequence[str], choices: RolloutChoices, *, exact: bool) -> str:
    """The command that evaluates what a search found; by another seed, whose luck had no part in it, if not `exact`."""
    luck = [] if exact else ["--rollouts", str(choices.rollouts), "--seed", str(choices.next_seed)]
    return shlex.join(["mrac-jax", "evaluate", *words, *how, *luck])


def search_end(answer: Any) -> Json:
    """What the JSON object of a search ends with: team, map, rollouts, and what every object ends with."""
    choices = answer.choices
    return {
        "robots": len(answer.starts),
        "starts": answer.starts,
        "accessible": answer.cells,
        "rollouts": choices.rollouts,
        "seed": choices.seed,
        "engine": answer.engine or None,
        "exact": not answer.engine,
        **json_end(answer, answer.notes),
    }


def team_figure(estimate: Estimate, robots: int, name: str = "robots lost") -> KeyFigure:
    """Of so many robots those that are lost, or what `name` says, as a key figure."""
    mean, interval = losses_shown(estimate, robots)
    return KeyFigure(mean, name, interval)
