"""The face of the answer of `size`."""

from __future__ import annotations

from analysis.design.size import TeamSize
from analysis.design.table import headline, print_size, save_size, size_json
from analysis.kit.face import Face

FACE: Face[TeamSize] = Face(print_size, size_json, headline, save_size)
