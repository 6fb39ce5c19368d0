"""What every answer can do, whatever it is the answer to: show itself, say itself as JSON, save itself in a folder."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from html import escape
from importlib import import_module
from importlib.metadata import version
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from rich.console import Console
from rich.table import Table

from analysis.report.minutes import with_minutes
from analysis.report.model import Report
from analysis.utils.folder import as_text, json_text, write_all
from analysis.utils.tables import frame_of, print_lines
from planner.files import check_new
from planner.formatting import Rows, html_of, text_of

if TYPE_CHECKING:
    from planner.files import Json

# A report on a terminal, in a folder, as JSON, in a console.

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
    said = with_minutes(as_json(report.json()), report.pace)
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
    from analysis.pictures.style import png_of
    from analysis.report.html import page_of
    from analysis.report.picture import figure_of

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
