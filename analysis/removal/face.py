"""The face of the answer of `clear`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.removal.answer import Clearing
from analysis.removal.folder import save_clearing
from analysis.removal.table import clearing_json, headline, print_clearing, rows

FACE: Face[Clearing] = Face(print_clearing, clearing_json, headline, save_clearing, rows=rows)
