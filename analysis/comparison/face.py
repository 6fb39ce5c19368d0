"""The face of the answer of `compare`."""

from __future__ import annotations

from analysis.comparison.compare import Comparison
from analysis.comparison.table import comparison_json, headline, print_comparison, rows
from analysis.kit.face import Face

FACE: Face[Comparison] = Face(print_comparison, comparison_json, headline, rows=rows)
