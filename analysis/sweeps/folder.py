"""TODO what this file is for."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

from analysis.sweeps.rows_report import write_rows
from analysis.sweeps.sweep import Sweep
from analysis.sweeps.sweep_report import PICTURES, sweep_json
from planner.errors import UsageError
from planner.files import atomic_write


def save_sweep(sweep: Sweep, folder: Path, command: list[str]) -> list[Path]:
    """Write pictures, rows as CSV, the JSON and the page into `folder` (made if it is not there); returns the files."""
    from analysis.sweeps.plots_rows import rows_png
    from analysis.sweeps.sweep_html import sweep_html

    try:
        folder.mkdir(parents=True, exist_ok=True)
        pictures = {f"{figure}.png": rows_png(sweep.rows, figure, sweep.spec.source.stem) for figure in PICTURES}
        written = []
        for name, content in pictures.items():
            with atomic_write(folder / name, "wb") as out:
                out.write(content)
            written.append(folder / name)
        rows, answer, page = folder / "rows.csv", folder / "sweep.json", folder / "index.html"
        write_rows(sweep.rows, rows)
        with atomic_write(answer) as text:
            json.dump(sweep_json(sweep), text, indent=1, allow_nan=False)
            text.write("\n")
        with atomic_write(page) as text:
            text.write(sweep_html(sweep, shlex.join(command), pictures, [rows.name, answer.name]))
        return [page, *written, rows, answer]
    except OSError as error:
        problem = f"--out {folder} cannot be written ({error.strerror})"
        raise UsageError(problem, expected="a folder to write to") from error
