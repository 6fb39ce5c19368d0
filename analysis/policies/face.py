"""The face of the answer of `reproduce policies`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.policies.folder import save_study
from analysis.policies.study import Study
from analysis.policies.table import headline, print_study, study_json

FACE: Face[Study] = Face(print_study, study_json, headline, save_study)
