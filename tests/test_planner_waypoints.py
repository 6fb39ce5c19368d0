"""Waypoint files, against numbers worked out by hand on a map that is not square, moved and turned."""

from __future__ import annotations

import csv
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from test_planner_takeover import paths_plan

from planner.plan.plan import Plan, headings, waypoints_csv
from planner.world.world import World

TURNED = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, math.pi / 6))


def write_waypoints(plan: Plan, world: World, path: Path) -> None:
    path.write_text(waypoints_csv(plan, world), encoding="utf-8", newline="")


def rows_of(path: Path) -> list[list[float]]:
    with path.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.reader(lines))
    assert rows[0] == ["robot", "step", "x", "y", "yaw"]
    return [[float(value) for value in row] for row in rows[1:]]


def test_poses_by_hand(tmp_path: Path) -> None:
    """Grid frame: [0, 0] is at (0.25, 0.75) m of the lower-left corner, turned by 30 degrees and moved by (10, 20)."""
    write_waypoints(paths_plan(TURNED, [0, 0, 1, 4, 4, 3], [5]), TURNED, tmp_path / "w.csv")
    expected = [
        [0, 0, 9.841506, 20.774519, math.pi / 6],  # waits at its start, facing its first move
        [0, 1, 9.841506, 20.774519, math.pi / 6],
        [0, 2, 10.274519, 21.024519, math.pi / 6],  # east along the row
        [0, 3, 10.524519, 20.591506, -math.pi / 3],  # south: to the next row
        [0, 4, 10.524519, 20.591506, -math.pi / 3],  # waits
        [0, 5, 10.091506, 20.341506, -5 * math.pi / 6],  # west: 180 + 30 = -150 degrees
        [1, 0, 10.957532, 20.841506, math.pi / 6],  # never moves
    ]
    rows = rows_of(tmp_path / "w.csv")
    np.testing.assert_allclose(rows, expected, rtol=0, atol=6e-7)
    np.testing.assert_allclose([row[4] for row in rows], [row[4] for row in expected], rtol=0, atol=1e-14)


def test_without_an_origin_the_lower_left_corner_is_zero(tmp_path: Path) -> None:
    world = World.create(np.zeros((2, 3)))
    write_waypoints(paths_plan(world, [3, 0, 1]), world, tmp_path / "w.csv")
    text = (tmp_path / "w.csv").read_text(encoding="utf-8")
    assert text.splitlines() == [
        "robot,step,x,y,yaw",
        f"0,0,0.500000,0.500000,{math.pi / 2!r}",
        f"0,1,0.500000,1.500000,{math.pi / 2!r}",
        "0,2,1.500000,1.500000,0.0",
    ]


def test_far_coordinates_keep_their_digits_and_zero_has_no_sign(tmp_path: Path) -> None:
    far = World.create(np.zeros((1, 2)), cell_size=0.25, origin=(-0.125000001, 5_400_000.1, 0.0))
    write_waypoints(paths_plan(far, [0, 1]), far, tmp_path / "w.csv")
    lines = (tmp_path / "w.csv").read_text(encoding="utf-8").splitlines()
    assert lines[1:] == ["0,0,0.000000,5400000.225000,0.0", "0,1,0.250000,5400000.225000,0.0"]


@pytest.mark.parametrize("quarter_turns", range(-9, 10))
def test_yaw_is_always_in_the_half_open_circle(quarter_turns: int) -> None:
    """East, north, west, south in the grid, on maps turned by quarter turns: in (-pi, pi], the ends not confused."""
    world = World.create(np.zeros((3, 3)), origin=(0.0, 0.0, quarter_turns * math.pi / 2))
    found = headings(np.array([4, 5, 2, 1, 4]), world)
    grid = np.array([0, 0, 1, 2, 3])
    turns = (grid + quarter_turns) % 4
    expected = np.array([0, math.pi / 2, math.pi, -math.pi / 2])[turns]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert ((found > -math.pi) & (found <= math.pi)).all()


def test_the_yaw_points_from_cell_to_cell(tmp_path: Path) -> None:
    """Each move's direction in metres is that of the yaw written with the cell it enters."""
    rng = np.random.default_rng(3)
    world = World.create(np.zeros((4, 7)), cell_size=0.3, origin=(-3.0, 8.0, 2.2))
    path = [9]
    for _ in range(60):
        row, col = divmod(path[-1], 7)
        options = [(row, col), (row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)]
        inside = [r * 7 + c for r, c in options if 0 <= r < 4 and 0 <= c < 7]
        path.append(int(rng.choice(inside)))
    write_waypoints(paths_plan(world, path), world, tmp_path / "w.csv")
    rows = np.array(rows_of(tmp_path / "w.csv"))
    for before, after in pairwise(rows):
        moved = after[2:4] - before[2:4]
        if np.abs(moved).max() > 0:
            direction = [math.cos(after[4]), math.sin(after[4])]
            np.testing.assert_allclose(moved / 0.3, direction, rtol=0, atol=1e-5)
