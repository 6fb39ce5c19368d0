"""The folder of `clear --out`: the page, the pictures, the map without what was picked, and the answer as JSON."""

from __future__ import annotations

from pathlib import Path

from analysis.kit.folder import json_text, write_all
from analysis.removal.answer import Clearing
from analysis.removal.table import clearing_json


def save_clearing(clearing: Clearing, folder: Path, command: str) -> list[Path]:
    """Write everything about one answer into `folder` (made if it is not there); returns the files.

    `command`: the command line that made it, for the page.
    """
    from analysis.pictures.style import png_of
    from analysis.removal.page import clearing_page
    from analysis.removal.picture import clearing_figure, paid_figure

    pictures = {"clear.png": png_of(clearing_figure, clearing), "risk_paid.png": png_of(paid_figure, clearing)}
    files: dict[str, str | bytes] = {**pictures, "clear.json": json_text(clearing_json(clearing))}
    page = clearing_page(clearing, command, pictures, sorted(files))
    return write_all(folder, {"index.html": page, **files})
