"""The folder that `--out DIR` writes: the page, pictures, the plan, and the answer as JSON."""

from __future__ import annotations

import json
from pathlib import Path

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import to_json
from analysis.evaluation.page import evaluation_page
from analysis.evaluation.pictures import draw_pictures, write_pictures
from planner.errors import UsageError
from planner.files import atomic_write


def save_folder(evaluation: Evaluation, folder: Path, command: str) -> list[Path]:
    """Write everything about one evaluation into `folder` (made if it is not there); returns the files.

    `command`: the command line that made it, for the page.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        plan, answer = folder / "plan.json", folder / "evaluation.json"
        evaluation.plan.save(plan)
        with atomic_write(answer) as out:
            json.dump(to_json(evaluation), out, indent=1, allow_nan=False)
            out.write("\n")
        pictures, page = draw_pictures(evaluation), folder / "index.html"
        written = write_pictures(pictures, folder)
        with atomic_write(page) as out:
            out.write(evaluation_page(evaluation, command, pictures))
        return [page, *written, plan, answer]
    except OSError as error:
        raise UsageError(
            f"--out {folder} cannot be written ({error.strerror})", expected="a folder to write to"
        ) from error
