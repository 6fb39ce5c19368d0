"""The face of the answer of `front`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.tradeoff.folder import save_front
from analysis.tradeoff.front import Front
from analysis.tradeoff.table import front_json, headline, print_front, rows

FACE: Face[Front] = Face(print_front, front_json, headline, save_front, rows=rows)
