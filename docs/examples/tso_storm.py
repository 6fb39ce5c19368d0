"""The storm of Team-Submodular-Orienteering as a graph for `mrac-jax graph` (`docs/other-planners.md`).

python docs/examples/tso_storm.py weather_15.jld storm.json; needs `h5py`. An edge is survived with exp(-a / max a)
to the power 1/4, a its weight there; node 1 is the base, and the last node; all others bring 1.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import h5py
import numpy as np


def main(source: str, target: str) -> None:
    """Writes the graph."""
    weight = h5py.File(source)["adjmat"][()]
    chance, names = np.exp(-weight / weight.max()) ** 0.25, [str(node) for node in range(1, len(weight))]
    edges = [[u, v, chance[i, j]] for i, u in enumerate(names) for j, v in enumerate(names) if i < j]
    nodes = {node: float(node != "1") for node in names}
    Path(target).write_text(json.dumps({"base": "1", "nodes": nodes, "edges": edges}), encoding="utf-8")


if __name__ == "__main__":
    main(*sys.argv[1:])
