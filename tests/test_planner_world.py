"""The world: what it accepts, where its cells lie on the ground, its file, its identity, and its graph."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, worlds_with_starts
from hypothesis import given

from planner.errors import InputError
from planner.files import atomic_write
from planner.world import World, load_world_file


@pytest.mark.parametrize(
    ("threat", "said"),
    [
        ([[0.0, -0.1]], "threat at \\[0, 1\\] is -0.1"),
        ([[0.0, 1.0]], "threat at \\[0, 1\\] is 1 "),
        ([[0.0], [np.inf]], "threat at \\[1, 0\\] is inf"),
        ([[np.nan, np.nan]], "every cell is an obstacle"),
        ([], "shape"),
        ([0.0, 0.1], "shape"),
        (np.zeros((0, 3)), "shape"),
        ([["a"]], "numbers"),
        ([[0.99999999]], "threat at"),
    ],
)
def test_wrong_threats_are_named(threat: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        World.create(threat)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("starts", "said"),
    [
        ([[0, 1]], "robot 0 starts at \\[0, 1\\], an obstacle"),
        ([[0, 0], [2, 0]], "robot 1 starts at \\[2, 0\\], outside the map"),
        ([[-1, 0]], "outside the map"),
        ([[0.5, 0]], "whole numbers"),
        ([], "shape"),
        ([0, 0], "shape"),
        (np.zeros((1025, 2), int), "at most 1024"),
    ],
)
def test_wrong_starts_are_named(starts: object, said: str) -> None:
    with pytest.raises(InputError, match=said):
        World.create([[0.0, np.nan, 0.0], [0.0, 0.0, 0.0]], starts)  # type: ignore[arg-type]


@pytest.mark.parametrize(("size", "origin"), [(0.0, (0, 0, 0)), (-1.0, (0, 0, 0)), (np.nan, (0, 0, 0)), (1.0, (0, 0))])
def test_wrong_frames_are_named(size: float, origin: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match=r"cell_size|origin"):
        World.create([[0.0]], cell_size=size, origin=origin)


def test_row_0_has_the_largest_y() -> None:
    world = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, 0.0))
    np.testing.assert_allclose(world.to_xy([0, 5]), [[10.25, 20.75], [11.25, 20.25]])
    turned = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, np.pi / 2))
    np.testing.assert_allclose(turned.to_xy(0), [10 - 0.75, 20.25])


@given(worlds_with_starts())
def test_points_and_cells_are_inverse(given_world: tuple[World, np.ndarray]) -> None:
    world = World.create(given_world[0].threat, cell_size=0.7, origin=(-3.0, 8.0, 0.6))
    cells = np.arange(world.threat.size)
    rows, cols = world.to_cells(world.to_xy(cells)).T
    np.testing.assert_array_equal(rows * world.shape[1] + cols, cells)


def test_file_round_trip(tmp_path: Path) -> None:
    world = World.create([[0.0, 0.25, np.nan]], [[0, 1]], 0.5, (1.0, 2.0, 0.3))
    world.save(tmp_path / "world.npz")
    again = load_world_file(tmp_path / "world.npz")
    np.testing.assert_array_equal(again.threat, world.threat)
    assert again.starts is not None
    assert again.starts.tolist() == [[0, 1]]
    assert (again.cell_size, again.origin, again.sha256) == (world.cell_size, world.origin, world.sha256)


def test_identity_is_the_hash_of_the_threat_bytes() -> None:
    path = FOLDER / "scattered-14x23-1000.npz"
    with np.load(path) as data:
        raw = np.ascontiguousarray(data["threat"], dtype="<f4").tobytes()
    assert load_world_file(path).sha256 == hashlib.sha256(raw).hexdigest()


def test_accessible_cells_are_those_some_robot_reaches() -> None:
    world = World.create([[0.0, np.nan, 0.2, 0.0], [0.0, np.nan, np.nan, np.nan]])
    assert world.accessible([[0, 0]]).tolist() == [[True, False, False, False], [True, False, False, False]]
    assert world.accessible([[1, 0], [0, 3]]).sum() == 4


def test_graph_has_threats_positions_and_costs() -> None:
    graph = World.create([[0.0, 0.1], [np.nan, 0.2]], cell_size=2.0).to_networkx()
    assert set(graph.nodes) == {(0, 0), (0, 1), (1, 1)}
    assert graph.nodes[0, 1]["threat"] == pytest.approx(0.1)
    assert graph.nodes[0, 0]["pos"] == (1.0, 3.0)
    assert graph.edges[(0, 0), (0, 1)]["cost"] == 4
    assert graph.edges[(0, 1), (1, 1)]["cost"] == 8
    assert graph.edges[(0, 1), (0, 0)]["cost"] == 1
    assert graph.edges[(0, 1), (1, 1)]["hazard"] == pytest.approx(-np.log(0.8), rel=1e-6)


def test_nothing_is_half_written(tmp_path: Path) -> None:
    target = tmp_path / "file.txt"
    target.write_text("before")
    with pytest.raises(RuntimeError), atomic_write(target) as out:
        out.write("half")
        raise RuntimeError
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]
