"""Levels, areas, partitions and the initial allocation as invariants on random worlds."""

from __future__ import annotations

import networkx as nx
import numpy as np
from conftest import worlds_with_starts
from hypothesis import given
from hypothesis import strategies as st

from planner.mrac.areas import bisect, connected_parts, find_areas, metis_parts, wavefront_parts
from planner.mrac.make_plan import allocate, allocated, make_plan
from planner.mrac.problem import prepare
from planner.settings import Settings
from planner.world.levels import NO_LEVEL, find_levels
from planner.world.world import World


def is_connected(shape: tuple[int, int], cells: np.ndarray) -> bool:
    grid = nx.grid_2d_graph(*shape).subgraph(divmod(int(cell), shape[1]) for cell in cells)
    return nx.is_connected(grid)


@given(worlds_with_starts())
def test_every_accessible_cell_is_in_exactly_one_area(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    problem = prepare(world, starts, Settings())
    for areas in (
        find_areas(world.shape, problem.levels),
        [(area.level, area.cells) for area in allocate(problem)],
    ):
        held = np.concatenate([cells for _, cells in areas])
        np.testing.assert_array_equal(np.sort(held), np.flatnonzero(world.accessible(starts)))
        for level, cells in areas:
            assert is_connected(world.shape, cells)
            assert (problem.levels.of_cell[cells] == level).all()
            assert (np.diff(cells) > 0).all()


@given(worlds_with_starts())
def test_allocation_gives_every_robot_at_most_one_safe_area(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    given_areas = [area for area in allocate(prepare(world, starts, Settings())) if area.robot >= 0]
    assert all(area.level == 0 for area in given_areas)
    owners = [area.robot for area in given_areas]
    assert len(owners) == len(set(owners))


@given(worlds_with_starts())
def test_the_nominal_plan_is_complete(given_world: tuple[World, np.ndarray]) -> None:
    """Theorem 1."""
    world, starts = given_world
    plan = make_plan(world, starts)
    visited = np.unique(np.concatenate([robot.path for robot in plan.robots]))
    assert plan.outcome == "complete"
    np.testing.assert_array_equal(visited, np.flatnonzero(world.accessible(starts)))


@given(worlds_with_starts(most_side=9), st.integers(2, 7))
def test_parts_are_connected_and_hold_every_cell_once(given_world: tuple[World, np.ndarray], count: int) -> None:
    world, _ = given_world
    for area in connected_parts(world.shape, np.flatnonzero(world.free)):
        wanted = min(count, len(area))
        for partition in (metis_parts, wavefront_parts):
            parts = partition(world.shape, area, wanted)
            assert len(parts) == wanted
            assert all(is_connected(world.shape, part) for part in parts)
            np.testing.assert_array_equal(np.sort(np.concatenate(parts)), area)
            assert [int(part[0]) for part in parts] == sorted(int(part.min()) for part in parts)


def test_wavefront_parts_of_a_corridor_are_as_equal_as_possible() -> None:
    for length, count in ((7, 2), (12, 5), (30, 7), (9, 9)):
        sizes = [len(part) for part in wavefront_parts((1, length), np.arange(length), count)]
        assert max(sizes) - min(sizes) <= 1, (length, count, sizes)


def test_wavefront_parts_are_bisected_with_the_larger_half_of_the_parts_at_the_far_end() -> None:
    """By hand, of corridors: the far end of the lowest cell is the last one, and there the wavefront begins."""
    known = {(10, 4): [2, 3, 2, 3], (7, 3): [2, 2, 3], (11, 5): [2, 2, 2, 2, 3], (8, 5): [1, 2, 1, 2, 2]}
    for (length, count), sizes in known.items():
        parts = wavefront_parts((1, length), np.arange(length), count)
        assert [len(part) for part in parts] == sizes, (length, count)


def test_bisection_follows_the_specification() -> None:
    # 1 x 7 corridor: the far end of cell 0 is cell 6; four cells (half, rounded up) are grown from there.
    grown, rest = bisect((1, 7), np.arange(7))
    assert (grown.tolist(), rest.tolist()) == ([3, 4, 5, 6], [0, 1, 2])
    # A T: growing from the far end (the stem's foot) leaves one piece; the last layer goes in index order.
    cells = np.array([0, 1, 2, 3, 4, 7, 12])
    grown, rest = bisect((3, 5), cells)
    assert sorted([*grown.tolist(), *rest.tolist()]) == cells.tolist()
    assert len(grown) >= 4


def test_levels_are_distinct_values_of_accessible_cells() -> None:
    world = World.create([[0.1, 0.3, np.nan, 0.2]])
    levels = find_levels(world, world.accessible([[0, 0]]), 16)
    np.testing.assert_allclose(levels.values, [0, np.float32(0.1), np.float32(0.3)], rtol=0)
    assert levels.of_cell.tolist() == [1, 2, NO_LEVEL, NO_LEVEL]
    assert not levels.quantised


@given(st.lists(st.integers(0, 99).map(lambda percent: percent / 100), min_size=1, max_size=60), st.integers(2, 8))
def test_quantised_levels_keep_order_mean_and_ties(values: list[float], most: int) -> None:
    world = World.create(np.array([values]))
    levels = find_levels(world, world.free, most)
    threat = world.threat.ravel().astype(np.float64)
    assert len(levels.values) <= most
    assert (np.diff(levels.values) > 0).all()
    assert ((levels.of_cell == 0) == (threat == 0)).all()
    for level in range(1, len(levels.values)):
        np.testing.assert_allclose(levels.values[level], threat[levels.of_cell == level].mean(), rtol=1e-12)
    for p in np.unique(threat):
        assert len(np.unique(levels.of_cell[threat == p])) == 1
    order = np.argsort(threat)
    assert (np.diff(levels.of_cell[order]) >= 0).all()


def test_equal_counts() -> None:
    world = World.create(np.linspace(0.01, 0.9, 30)[None])
    levels = find_levels(world, world.free, 6)
    assert np.bincount(levels.of_cell).tolist() == [0, 6, 6, 6, 6, 6]


def test_a_team_takes_over_what_is_of_its_own_map_and_nothing_of_another_shape() -> None:
    wide, high, starts = World.create(np.zeros((4, 6))), World.create(np.zeros((6, 4))), [[0, 2], [2, 3], [0, 3]]
    assert wide.luck_sha256 == high.luck_sha256, "the same cells in a row: only the shape tells them apart"
    before, first = allocated(wide, starts, Settings())
    again, same = allocated(wide, starts[::-1], Settings(), before=before)
    other, found = allocated(high, starts, Settings(), before=before)
    assert again.paths is before.paths and other.paths is not before.paths
    assert len(same.areas) == len(first.areas) == 3
    alone = allocated(high, starts, Settings())[1]
    assert [(area.robot, *area.cells) for area in found.areas] == [(area.robot, *area.cells) for area in alone.areas]
