"""The face of the answer of `reproduce`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.reproduction.reproduce import Reproduction
from analysis.reproduction.table import headline, print_reproduction, reproduction_json, save_reproduction

FACE: Face[Reproduction] = Face(print_reproduction, reproduction_json, headline, save_reproduction)
