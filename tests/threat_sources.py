"""Scenarios with threats, and files for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from planner.world.scenario import load_input
from planner.world.world import World


def world_file(folder: Path, threat: np.ndarray, name: str = "w.npz", **more: object) -> str:
    World.create(threat, **more).save(folder / name, force=True)  # type: ignore[arg-type]
    return name


def load(folder: Path, threats: list, height: int = 6, width: int = 9, **more: object) -> np.ndarray:
    """Threat `[H, W]` of a scenario with these sources; the map has one obstacle, at [0, 1]."""
    if "map" not in more:
        ground = np.zeros((height, width))
        ground[0, 1] = np.nan
        more["map"] = {"file": world_file(folder, ground)}
    path = folder / "scenario.yaml"
    path.write_text(yaml.safe_dump({"threats": threats, **more}))
    return load_input(path).threat


def raster(folder: Path, values: np.ndarray, name: str = "r.npy") -> str:
    np.save(folder / name, values)
    return name
