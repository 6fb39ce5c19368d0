"""The face of the answer of `sweep`."""

from __future__ import annotations

from analysis.kit.face import Face
from analysis.sweeps.folder import save_sweep
from analysis.sweeps.sweep import Sweep
from analysis.sweeps.sweep_report import headline, print_sweep, sweep_json

FACE: Face[Sweep] = Face(print_sweep, sweep_json, headline, save_sweep)
