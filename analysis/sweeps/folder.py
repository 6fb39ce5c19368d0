"""The folder of `sweep --out`: page, pictures, rows, JSON."""

from __future__ import annotations

from pathlib import Path

from analysis.kit.folder import json_text, write_all
from analysis.sweeps.rows_report import rows_csv
from analysis.sweeps.sweep import Sweep
from analysis.sweeps.sweep_report import PICTURES, sweep_json


def save_sweep(sweep: Sweep, folder: Path, command: str) -> list[Path]:
    """Write pictures, rows as CSV, the JSON and the page into `folder` (made if it is not there); returns the files."""
    from analysis.pictures.style import png_of
    from analysis.sweeps.plots_rows import rows_figure
    from analysis.sweeps.sweep_html import sweep_html

    pictures = {f"{figure}.png": png_of(rows_figure, sweep.rows, figure, sweep.spec.source.stem) for figure in PICTURES}
    files = {"rows.csv": rows_csv(sweep.rows), "sweep.json": json_text(sweep_json(sweep))}
    page = sweep_html(sweep, command, pictures, list(files))
    return write_all(folder, {"index.html": page, **pictures, **files})
