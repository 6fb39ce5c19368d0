"""Writing a folder: every file whole or not at all, what a console prints as text, JSON as text."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from analysis.utils.tables import SafeConsole
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import atomic_write


def as_text(draw: Callable[[Console], None], width: int = 120) -> str:
    """What `draw(console)` prints, as plain text."""
    console = SafeConsole(width=width, color_system=None, force_terminal=False)
    with console.capture() as captured:
        draw(console)
    return captured.get()


def csv_text(names: Iterable[object], rows: Iterable[Iterable[object]]) -> str:
    """Rows below the names of their columns as the text of a CSV file."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([names, *rows])
    return out.getvalue()


def json_text(content: object, *, compact: bool = False) -> str:
    """A JSON object as the text of a file."""
    look: dict[str, Any] = {"separators": (",", ":")} if compact else {"indent": 1}
    return json.dumps(content, allow_nan=False, **look) + "\n"


def write_all(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Write files into `folder` (made if it is not there), each whole or not at all; returns their paths."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = f"{argument('folder')} {folder} cannot be written ({error.strerror})"
        raise UsageError(problem, expected="a folder to write to") from error
    written: list[Path] = []
    for name, content in contents.items():
        (folder / name).parent.mkdir(exist_ok=True)
        with atomic_write(folder / name, "wb" if isinstance(content, bytes) else "w") as out:
            out.write(content)
        written.append(folder / name)
    return written
