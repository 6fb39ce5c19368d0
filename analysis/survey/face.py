"""The face of the answer of `check --worlds`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.survey.as_json import survey_json
from analysis.survey.folder import save_survey
from analysis.survey.survey import Survey
from analysis.survey.table import headline, print_survey

FACE: Face[Survey] = Face(print_survey, survey_json, headline, save_survey, faults=lambda survey: survey.faults)
