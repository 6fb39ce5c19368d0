"""How every command ends: the answer printed as tables or as JSON, files written, an exit status."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.cli.console import command_line, output_console
from analysis.utils.notes import say

if TYPE_CHECKING:
    from analysis.report.answer import Answer
    from analysis.report.model import Report

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


@dataclass(frozen=True, eq=False)
class First:
    """What was printed of an answer before the rest of it was known; `tables`: all of it, else the headline alone."""

    report: Report
    tables: bool

    def show(self) -> None:
        """Print it; where nobody reads it, the end of the command says so."""
        from analysis.report.answer import print_report
        from analysis.utils.tables import print_lines

        with suppress(BrokenPipeError):
            if self.tables:
                print_report(self.report, output_console())
            else:
                print_lines(output_console(), [self.report.headline])

    def show_rest(self, report: Report) -> None:
        """Print what `report`, the whole answer, has beyond it."""
        from analysis.report.answer import print_more, print_report

        if self.tables:
            print_more(report, self.report, output_console())
        else:
            print_report(report, output_console(), headline=False)


def deliver(
    answer: Answer,
    said: Report | None = None,
    *,
    out: Path | None = None,
    as_json: bool = False,
    notes: Iterable[str] = (),
    command: str | None = None,
    source: str | None = None,
    beside: Iterable[Path | None] = (),
    first: First | None = None,
) -> int:
    """Print `answer`, save it to `out`, say the notes and what was written; returns the exit status.

    It is saved even if nobody reads on what is printed (BrokenPipeError, raised afterwards).

    Args:
        said: its report, if it is not the one that everybody gets.
        command: what made it, for the page, if not the command line that is being run.
        source, beside: the INPUT, and files that were read beside it: they are not replaced.
        first: what was printed of it already.
    """
    from analysis.inputs import read_files
    from analysis.report.answer import report_of, save_report
    from analysis.utils.progress import show_progress

    report, written, unread = said or report_of(answer), list[Path](), list[BrokenPipeError]()
    try:
        show(report, as_json, first)
    except BrokenPipeError as error:
        unread.append(error)
    if out is not None:
        with show_progress() as progress:
            progress.doing("writing pictures and the page")
            line = command_line() if command is None else command
            written = save_report(report, out, line, read_files(source, *beside))
    say([*notes, *(f"wrote {file}" for file in written)])
    if unread:
        raise unread[0]
    return INTERRUPTED if answer.partial else CHECK_FAILED if report.faults else DONE


def show(report: Report, as_json: bool, first: First | None = None) -> None:
    """Print a report as tables or as JSON; `first`: what was printed of it already."""
    from analysis.report.answer import json_of, print_report

    if as_json:
        print_json(json_of(report))
    elif first is not None:
        first.show_rest(report)
    else:
        print_report(report, output_console())


def print_json(content: object) -> None:
    """One JSON object on standard output, and nothing else."""
    print(json.dumps(content, allow_nan=False), flush=True)  # noqa: T201
