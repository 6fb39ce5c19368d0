"""The search for far targets against the plain search: the same target, cost and path, ties included."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from planner.mrac.paths import BLOCKED, NOT_WANTED, SafestPaths, find_safe_parts, neighbour_table


def random_costs(rng: np.random.Generator, shape: tuple[int, int]) -> NDArray[np.int64]:
    """Obstacles, and dangers in patches; some of their costs differ by less than a walk over safe cells."""
    n = shape[0] * shape[1]
    dear = rng.choice([n, n + 3, 2 * n, 7 * n], size=shape)
    patches = np.kron(rng.random((-(-shape[0] // 3), -(-shape[1] // 3))), np.ones((3, 3)))[: shape[0], : shape[1]]
    danger = (patches < rng.choice([0.3, 0.7])) ^ (rng.random(shape) < rng.choice([0.05, 0.2]))
    costs = np.where(danger, dear, 1)
    return np.where(rng.random(shape) < rng.choice([0.0, 0.15, 0.3]), BLOCKED, costs).ravel()


def random_question(
    rng: np.random.Generator, costs: NDArray[np.int64]
) -> tuple[int, NDArray[np.int32], NDArray[np.bool_] | None]:
    """(source, rank of targets of one cost, cells that a path may enter)."""
    free = np.flatnonzero(costs != BLOCKED)
    alike = np.flatnonzero(costs == costs[rng.choice(free)])
    targets = rng.choice(alike, size=min(len(alike), int(rng.choice([1, 3, 20]))), replace=False)
    rank = np.full(len(costs), NOT_WANTED, dtype=np.int32)
    rank[targets] = rng.integers(0, 3, len(targets))
    inside = None if rng.random() < 0.7 else rng.random(len(costs)) < 0.9
    return int(rng.choice(free)), rank, inside


@pytest.mark.parametrize("wide", [0, 5, 1_000])
def test_a_far_search_finds_what_a_plain_search_finds(wide: int) -> None:
    rng, found, far = np.random.default_rng(7), 0, 0
    for _ in range(100):
        shape = (int(rng.integers(1, 19)), int(rng.integers(2, 19)))
        costs = random_costs(rng, shape)
        if not (costs != BLOCKED).any():
            continue
        neighbours = neighbour_table(shape, costs != BLOCKED)
        plain, guided = SafestPaths(neighbours, costs, near=costs.size), SafestPaths(neighbours, costs, near=0)
        guided._parts = find_safe_parts(neighbours, costs, wide)
        for _ in range(10):
            source, rank, inside = random_question(rng, costs)
            expected = plain.nearest(source, rank, inside)
            assert guided.nearest(source, rank, inside) == expected
            far += guided._found is not None
            if expected is not None:
                found += 1
                way = plain.path(source, expected.cell, inside)
                assert guided.path(source, expected.cell, inside).tolist() == way.tolist()
    assert found > 100 and far > 100
