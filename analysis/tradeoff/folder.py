"""The folder of `front --out`: the page, the picture, the plan of the pick, and the answer as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from analysis.kit.folder import json_text, write_all
from analysis.tradeoff.front import Front
from analysis.tradeoff.table import front_json


def save_front(front: Front, folder: Path, command: str) -> list[Path]:
    """Write everything about one front into `folder` (made if it is not there); returns the files.

    `command`: the command line that made it, for the page.
    """
    from analysis.pictures.style import png_of
    from analysis.tradeoff.page import front_page
    from analysis.tradeoff.picture import front_figure

    pictures = {"front.png": png_of(front_figure, front)}
    files: dict[str, str | bytes] = {**pictures, "front.json": json_text(front_json(front))}
    if front.picked is not None:
        files["plan.json"] = json.dumps(front.plan_of(front.picked).to_json(), separators=(",", ":")) + "\n"
    return write_all(folder, {"index.html": front_page(front, command, pictures, sorted(files)), **files})
