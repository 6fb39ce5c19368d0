"""The face of the answer of `starts`."""

from __future__ import annotations

from analysis.depots.answer import Starts
from analysis.depots.folder import save_starts
from analysis.depots.table import headline, print_starts, rows, starts_json
from analysis.kit.face import Face

FACE: Face[Starts] = Face(print_starts, starts_json, headline, save_starts, rows=rows)
