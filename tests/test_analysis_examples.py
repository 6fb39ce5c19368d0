"""The examples that ship: they load, they are what their script makes, and they are worth looking at."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from make_examples import main, office_floor, paper_world

import analysis.examples
from planner.world.levels import place_starts
from planner.world.scenario import load_input

FOLDER = Path(analysis.examples.__file__).parent


def test_the_script_makes_what_ships(tmp_path: Path) -> None:
    main(tmp_path)
    assert (tmp_path / "building_map.pgm").read_bytes() == (FOLDER / "building_map.pgm").read_bytes()
    assert load_input(tmp_path / "paper.npz").sha256 == load_input(FOLDER / "paper.npz").sha256
    assert load_input(FOLDER / "paper.npz").sha256 == paper_world().sha256
    assert office_floor().shape == (320, 480)


@pytest.mark.parametrize(
    ("name", "shape", "robots", "dangerous", "reachable"),
    [
        ("paper.npz", (20, 20), None, 100, 0.9),
        ("building.yaml", (32, 48), 4, 239, 1.0),
        ("terrain.yaml", (63, 60), 8, 1229, 0.99),
    ],
)
def test_examples(name: str, shape: tuple[int, int], robots: int | None, dangerous: int, reachable: float) -> None:
    world = load_input(FOLDER / name)
    assert (world.shape, world.team.robots, int((world.threat > 0).sum())) == (shape, robots, dangerous)
    starts, notes = place_starts(world, robots or 8)
    assert notes == ()
    assert world.accessible(starts).sum() >= reachable * world.free.sum()
    assert len(np.unique(world.threat[world.free])) <= 6


def test_no_example_is_large() -> None:
    assert sum(path.stat().st_size for path in FOLDER.iterdir() if path.is_file()) < 200_000
