"""The folder of `starts --out`: the page, the picture, the plan from the best starts, and the answer as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from analysis.depots.answer import Starts
from analysis.depots.table import starts_json
from analysis.kit.folder import json_text, write_all


def save_starts(starts: Starts, folder: Path, command: str) -> list[Path]:
    """Write everything about one answer into `folder` (made if it is not there); returns the files.

    `command`: the command line that made it, for the page.
    """
    from analysis.depots.page import starts_page
    from analysis.depots.picture import starts_figure
    from analysis.pictures.style import png_of

    pictures = {"starts.png": png_of(starts_figure, starts)}
    files: dict[str, str | bytes] = {
        **pictures,
        "starts.json": json_text(starts_json(starts)),
        "plan.json": json.dumps(starts.plan().to_json(), separators=(",", ":")) + "\n",
    }
    return write_all(folder, {"index.html": starts_page(starts, command, pictures, sorted(files)), **files})
