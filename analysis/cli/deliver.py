"""How every command ends: files written, the answer printed as tables or as JSON, an exit status."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from analysis.cli.console import command_line, output_console
from analysis.kit.face import Face, Kind
from analysis.kit.notes import say

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


def deliver(
    answer: Kind,
    face: Face[Kind],
    *,
    out: Path | None = None,
    as_json: bool = False,
    notes: Iterable[str] = (),
    command: str | None = None,
) -> int:
    """Save `answer` to `out`, print it, say the notes and what was written; returns the exit status.

    `command`: what made it, for the page, if not the command line that is being run.
    """
    from analysis.kit.progress import show_progress

    written: list[Path] = []
    if out is not None and face.save is not None:
        with show_progress() as progress:
            progress.doing("pictures and page")
            written = face.save(answer, out, command_line() if command is None else command)
    if as_json:
        print_json(face.as_json(answer))
    else:
        face.show(answer, output_console())
    say([*notes, *(f"wrote {file}" for file in written)])
    return INTERRUPTED if answer.partial else CHECK_FAILED if face.faults(answer) else DONE


def print_json(content: object) -> None:
    """One JSON object on standard output, and nothing else."""
    print(json.dumps(content, allow_nan=False), flush=True)  # noqa: T201
