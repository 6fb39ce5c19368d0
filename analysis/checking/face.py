"""The face of the answer of `check INPUT`."""

from __future__ import annotations

from analysis.checking.as_json import check_json
from analysis.checking.check_map import MapCheck
from analysis.checking.folder import save_check
from analysis.checking.table import headline, print_check
from analysis.kit.face import Face

FACE: Face[MapCheck] = Face(print_check, check_json, headline, save_check, faults=lambda checked: checked.faults)
