"""A report on a terminal, in a folder, as JSON, in a console."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from analysis.kit.folder import as_text, json_text, write_all
from analysis.kit.tables import print_lines
from analysis.report.blocks import Report
from analysis.report.minutes import with_minutes
from planner.files import check_new
from planner.shown import Rows

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


def print_report(report: Report, console: Console, headline: bool = True) -> None:
    """For a person at a terminal: the answer, how sure it is, what was looked at, tables and how to read them.

    `headline`: whether the answer itself is printed; it may stand there already.
    """
    above = [""] if report.last else [*report.heading, *report.took]
    print_lines(console, (*[report.headline] * headline, *report.findings, *above))
    for part in report.parts:
        if not part.aside:
            for table in part.tables:
                console.print(table)
            print_lines(console, part.notes)
    print_lines(console, [*report.last, *(f"note: {note}" for note in report.notes), *report.warnings])


def print_more(report: Report, first: Report, console: Console) -> None:
    """The lines that a report has beyond those of a first one, which was printed; tables are the same."""
    printed = set(_lines(first))
    more = [line for line in _lines(report) if line not in printed]
    print_lines(console, ["", *more] if more else [])


def _lines(report: Report) -> list[str]:
    notes = (note for part in report.parts if not part.aside for note in part.notes)
    return [report.headline, *report.findings, *notes, *(f"note: {note}" for note in report.notes), *report.warnings]


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
