"""The face of the answer of `evaluate`."""

from __future__ import annotations

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.as_json import to_json
from analysis.evaluation.folder import save_folder
from analysis.evaluation.table import print_evaluation
from analysis.evaluation.words import headline, rows
from analysis.kit.face import Face

FACE: Face[Evaluation] = Face(print_evaluation, to_json, headline, save_folder, rows=rows)
