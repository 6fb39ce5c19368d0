"""Safest paths against NetworkX on random worlds: costs, ties, tables and searches, overflow."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
from conftest import NAMES, load_fixture, worlds_with_starts
from hypothesis import given

from planner.errors import WorldError
from planner.mrac.paths import BLOCKED, UNREACHED, SafestPaths, TabledPaths, entry_costs, neighbour_table, to_networkx
from planner.simulator.paths import all_pairs, to_areas
from planner.world.levels import find_levels
from planner.world.world import World


def both_paths(world: World, starts: np.ndarray, risk: str = "paper") -> tuple[SafestPaths, TabledPaths]:
    costs = entry_costs(find_levels(world, world.accessible(starts), 16), risk)  # type: ignore[arg-type]
    neighbours = neighbour_table(world.shape, costs != BLOCKED)
    return SafestPaths(neighbours, costs), TabledPaths(neighbours, costs)


def safest_path_by_ties(graph: nx.DiGraph, source: tuple[int, int], target: tuple[int, int]) -> list[tuple[int, int]]:
    """SPEC section 3's path from NetworkX's distances: walk back by the lowest-index predecessor."""
    distance = nx.single_source_dijkstra_path_length(graph, source, weight="cost")
    walk = [target]
    while walk[-1] != source:
        here = walk[-1]
        best = [u for u in graph.predecessors(here) if distance[u] + graph.edges[u, here]["cost"] == distance[here]]
        walk.append(min(best))
    return walk[-2::-1]


@given(worlds_with_starts(most_side=6))
def test_costs_and_paths_are_networkx(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    graph, width = to_networkx(world), world.shape[1]
    levels = find_levels(world, world.accessible(starts), 16)
    # The graph's costs run over all free cells; the planner's over the accessible ones, whose p_min may be larger.
    costs = entry_costs(levels, "paper")
    for _, (row, col), data in graph.edges(data=True):
        data["cost"] = int(costs[row * width + col])
    source = tuple(int(i) for i in starts[0])
    expected = nx.single_source_dijkstra_path_length(
        graph.subgraph(nx.node_connected_component(graph.to_undirected(), source)), source, weight="cost"
    )
    for paths in both_paths(world, starts):
        cost = paths.to_all(source[0] * width + source[1])
        found = {divmod(int(c), width): int(cost[c]) for c in np.flatnonzero(cost >= 0)}
        assert found == expected
        target = max(expected)
        walk = safest_path_by_ties(graph, source, target)
        cells = paths.path(source[0] * width + source[1], target[0] * width + target[1])
        assert [divmod(int(c), width) for c in cells] == walk


@given(worlds_with_starts())
def test_nearest_is_least_cost_then_rank_then_index(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    levels = find_levels(world, world.accessible(starts), 16)
    source = int(starts[0, 0] * world.shape[1] + starts[0, 1])
    for level in range(len(levels.values)):
        members = np.flatnonzero(levels.of_cell == level)
        rank = np.full(world.threat.size, -1, dtype=np.int32)
        rank[members] = members[::-1] % 3
        for paths in both_paths(world, starts):
            cost = paths.to_all(source)
            reachable = [int(c) for c in members if cost[c] >= 0]
            best = min(((int(cost[c]), int(rank[c]), c) for c in reachable), default=None)
            found = paths.nearest(source, rank)
            assert (None if found is None else (found.cost, found.cell)) == (best and (best[0], best[2]))
            if len(members):  # an area is connected: all of it can be reached, or nothing
                asked = np.array(reachable) if reachable else members
                assert paths.cost_to(source, asked) == (UNREACHED if best is None else best[0])


def test_tables_and_searches_agree_on_large_worlds() -> None:
    for name in [name for name in NAMES if name.startswith("scattered") and name.endswith("k2")]:
        fixture = load_fixture(name)
        searched, tabled = both_paths(fixture.world, fixture.starts)
        source = int(fixture.starts[0, 0] * fixture.world.shape[1] + fixture.starts[0, 1])
        np.testing.assert_array_equal(searched.to_all(source), tabled.to_all(source))
        for target in np.flatnonzero(tabled.costs != BLOCKED):
            if tabled.to_all(source)[target] >= 0:
                np.testing.assert_array_equal(searched.path(source, target), tabled.path(source, target))


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith("k2")][:6])
def test_the_compiled_tables_are_the_readable_ones(name: str) -> None:
    """All pairs, first hops by the tie rule, the nearest cells, and areas, on a map in two parts."""
    cells = load_fixture(name).world.threat.copy()
    cells[:, 9] = np.nan
    world = World.create(cells)
    _, tabled = both_paths(world, np.argwhere(world.free))
    kept = np.flatnonzero(tabled.costs != BLOCKED)
    near = neighbour_table(world.shape, tabled.costs != BLOCKED)[kept]
    near = np.where(near < 0, -1, np.searchsorted(kept, near)).astype(np.int32)
    cost, hop, ranked = all_pairs(near, tabled.costs[kept], np.dtype(np.int32), np.dtype(np.uint16))
    expected = np.array([tabled.to_all(source)[kept] for source in kept.tolist()])
    assert (expected < 0).any()
    np.testing.assert_array_equal(cost, expected)
    for place in range(0, len(kept), 9):
        ways = np.flatnonzero(expected[place] > 0).tolist()
        firsts = [tabled.path(int(kept[place]), int(kept[target]))[0] for target in ways]
        assert hop[ways, place].tolist() == np.searchsorted(kept, firsts).tolist()
        assert not np.delete(hop[:, place], ways).any()
    for row, of_row in zip(ranked, expected, strict=True):
        order = np.lexsort((np.arange(len(kept)), of_row))
        order = order[of_row[order] >= 0][: len(row)]
        assert row.tolist() == [*order, *[len(kept)] * (len(row) - len(order))]
    begin, order = np.array([0, 3, 40, len(kept)]), np.random.default_rng(1).permutation(len(kept))
    order = np.concatenate([np.sort(part) for part in np.split(order, begin[1:-1])]).astype(np.int32)
    to_area, entered = to_areas(cost, np.dtype(np.uint16), order, begin.astype(np.int32))
    for area, cells_of in enumerate(np.split(order, begin[1:-1])):
        assert to_area[:, area].tolist() == expected[:, cells_of].min(axis=1).tolist()
        assert entered[:, area].tolist() == cells_of[expected[:, cells_of].argmin(axis=1)].tolist()


def test_a_search_kept_inside_does_not_answer_for_the_open_grid() -> None:
    world = World.create(np.zeros((2, 3)))
    searched, tabled = both_paths(world, np.array([[0, 0]]))
    rank = np.array([-1, -1, 0, -1, -1, -1], dtype=np.int32)
    below = np.array([True, False, True, True, True, True])
    for paths in (searched, tabled):
        assert paths.nearest(0, rank, below) == (2, 4)
        assert paths.path(0, 2).tolist() == [1, 2]
        assert paths.path(0, 2, below).tolist() == [3, 4, 5, 2]


def test_one_dangerous_cell_outweighs_every_safe_one() -> None:
    levels = find_levels(World.create([[0.0, 0.1, 0.25]]), np.ones((1, 3), bool), 16)
    assert entry_costs(levels, "paper").tolist() == [
        1,
        3,
        int(np.floor(3 * np.float64(np.float32(0.25)) / np.float64(np.float32(0.1)) + 0.5)),
    ]
    log = entry_costs(levels, "log")
    assert log.tolist() == [1, 3, int(np.floor(3 * np.log(0.75) / np.log1p(-np.float64(np.float32(0.1))) + 0.5))]


def test_costs_that_could_overflow_are_refused() -> None:
    threat = np.full((300, 300), 0.9)
    threat[0, 0], threat[0, 1] = 1e-20, 0.0
    world = World.create(threat)
    with pytest.raises(WorldError, match="too large for 64 bits"):
        entry_costs(find_levels(world, world.free, 16), "paper")
