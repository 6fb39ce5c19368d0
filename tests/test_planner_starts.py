"""The start rule `upper-left`, against a slow reading of SPEC section 8 with NetworkX and against the fixtures."""

from __future__ import annotations

import json
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

from planner.errors import UsageError
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts, starts_of
from planner.world.world import World, load_world_file

FIXTURES = Path(__file__).parent / "fixtures"


def slow_starts(world: World, robots: int) -> list[list[int]]:
    """SPEC section 8, word for word."""
    width = world.shape[1]
    free = [tuple(cell) for cell in np.argwhere(world.free).tolist()]
    grid = nx.grid_2d_graph(*world.shape).subgraph(free)
    largest = min(nx.connected_components(grid), key=lambda part: (-len(part), min(r * width + c for r, c in part)))
    least = min(world.threat[cell] for cell in largest)
    wanted = [cell for cell in largest if world.threat[cell] == least]
    first = min(wanted, key=lambda cell: (cell[0] + cell[1], cell[0] * width + cell[1]))
    distance = nx.single_source_shortest_path_length(grid, first)
    order = sorted(wanted, key=lambda cell: (distance[cell], cell[0] * width + cell[1]))
    return [list(order[i % len(order)]) for i in range(robots)]


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
def test_it_is_the_rule(seed: int, kind: str) -> None:
    world = random_world(9, 14, ThreatPattern(kind=kind, seed=seed), obstacles=0.35, threats=0.3)  # type: ignore[arg-type]
    for robots in (1, 2, 8, 60):
        starts, notes = place_starts(world, robots)
        assert starts.tolist() == slow_starts(world, robots)
        assert notes == ()


@pytest.mark.parametrize("path", sorted(FIXTURES.glob("*-*x2*-1*-k*.json")), ids=lambda path: path.stem)
def test_it_gives_the_fixtures_starts(path: Path) -> None:
    fixture = json.loads(path.read_text())
    world = load_world_file(FIXTURES / fixture["world"])
    assert place_starts(world, fixture["k"])[0].tolist() == fixture["starts"]


def test_without_a_safe_cell_the_least_dangerous_ones_and_a_note() -> None:
    threat = np.full((3, 5), 0.2, dtype=np.float32)
    threat[1, 2:4] = 0.1
    threat[0, 0] = np.nan
    starts, notes = place_starts(World.create(threat), 3)
    assert starts.tolist() == [[1, 2], [1, 3], [1, 2]]
    assert "no safe cell" in notes[0]
    assert "0.1" in notes[0]


def test_of_equal_components_the_one_with_the_lowest_index() -> None:
    threat = np.array([[np.nan, 0, np.nan, 0], [0.1, 0, np.nan, 0], [np.nan, np.nan, np.nan, 0]])
    assert place_starts(World.create(threat), 2)[0].tolist() == [[0, 1], [1, 1]]


def test_a_safe_cell_in_a_smaller_component_does_not_count() -> None:
    threat = np.array([[0, np.nan, 0.3, 0.2, 0.2]])
    starts, notes = place_starts(World.create(threat), 1)
    assert starts.tolist() == [[0, 3]]
    assert notes


@pytest.mark.parametrize("robots", [0, -1, 1025, True, 2.0, "3"])
def test_counts_that_are_none(robots: object) -> None:
    with pytest.raises(UsageError, match=r"robots=.*; expected a whole number"):
        place_starts(World.create(np.zeros((2, 3))), robots)  # type: ignore[arg-type]


def test_as_many_robots_as_a_world_has_starts_stand_there() -> None:
    """As `--robots` has it; of any other number the rule places them."""
    world = World.create(np.zeros((3, 3)), [[2, 2], [2, 1]])
    assert starts_of(world, 2, None).tolist() == starts_of(world, None, None).tolist() == [[2, 2], [2, 1]]
    assert starts_of(world, 1, None).tolist() == [[0, 0]]


def test_an_unknown_rule() -> None:
    with pytest.raises(UsageError, match="upper-left"):
        place_starts(World.create(np.zeros((2, 3))), 1, "lower-right")
