"""The folder of `evaluate --out`: the page, pictures, the plan, and the answer as JSON."""

from __future__ import annotations

from pathlib import Path

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import to_json
from analysis.kit.folder import json_text, write_all


def save_folder(evaluation: Evaluation, folder: Path, command: str) -> list[Path]:
    """Write everything about one evaluation into `folder` (made if it is not there); returns the files.

    `command`: the command line that made it, for the page.
    """
    from analysis.evaluation.page import evaluation_page
    from analysis.evaluation.pictures import draw_pictures

    pictures = draw_pictures(evaluation)
    return write_all(
        folder,
        {
            "index.html": evaluation_page(evaluation, command, pictures),
            **pictures,
            "plan.json": json_text(evaluation.plan.to_json(), compact=True),
            "evaluation.json": json_text(to_json(evaluation)),
        },
    )
