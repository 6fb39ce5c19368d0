"""The folder of `check INPUT --out`: page, table, JSON, picture."""

from __future__ import annotations

from pathlib import Path

from analysis.checking.as_json import check_json
from analysis.checking.check_map import MapCheck
from analysis.checking.table import print_check
from analysis.kit.folder import as_text, json_text, write_all


def save_check(checked: MapCheck, folder: Path, command: str) -> list[Path]:
    """Write the page, `check.txt` (the table), `check.json` and `check.png` into `folder`; returns the files.

    `command`: the command line that made it, for the page.
    """
    from analysis.checking.page import check_page
    from analysis.checking.picture import check_figure
    from analysis.pictures.style import png_of

    pictures = {"check.png": png_of(check_figure, checked)}
    return write_all(
        folder,
        {
            "index.html": check_page(checked, command, pictures),
            "check.txt": as_text(lambda console: print_check(checked, console)),
            "check.json": json_text(check_json(checked)),
            **pictures,
        },
    )
