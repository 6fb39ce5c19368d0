"""How every command ends: the answer printed as tables or as JSON, files written, an exit status."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.cli.console import command_line, output_console
from analysis.utils.notes import say

if TYPE_CHECKING:
    from analysis.report.answer import Answer
    from analysis.report.model import Report

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


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
    earlier: Report | None = None,
) -> int:
    """Print `answer`, save it to `out`, say the notes and what was written; returns the exit status.

    It is saved even if nobody reads on what is printed (BrokenPipeError, raised afterwards).

    Args:
        said: its report, if it is not the one that everybody gets.
        command: what made it, for the page, if not the command line that is being run.
        source, beside: the INPUT, and files that were read beside it: they are not replaced.
        earlier: its report of before, which is printed already.
    """
    from analysis.inputs import read_files
    from analysis.report.answer import report_of, save_report
    from analysis.utils.progress import show_progress

    report, written, unread = said or report_of(answer), list[Path](), list[BrokenPipeError]()
    try:
        show(report, as_json, earlier)
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


def show(report: Report, as_json: bool, earlier: Report | None = None) -> None:
    """Print a report as tables or as JSON; `earlier`: as of `print_report`."""
    from analysis.report.answer import json_of, print_report

    if as_json:
        print_json(json_of(report))
    else:
        print_report(report, output_console(), earlier)


def print_json(content: object) -> None:
    """One JSON object on standard output, and nothing else."""
    print(json.dumps(content, allow_nan=False), flush=True)  # noqa: T201
