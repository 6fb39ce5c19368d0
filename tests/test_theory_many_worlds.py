"""The bound for every strategy against the best strategy there is, on worlds so small that it can be found."""

from __future__ import annotations

import numpy as np
import pytest
from test_theory_any_strategy import tiny_world

from analysis.theory.flow_programme import contract, optimum
from analysis.theory.upper_bound import flow_bound


@pytest.mark.slow
def test_the_programme_is_never_below_the_optimum_on_10000_worlds() -> None:
    for seed in range(10_000):
        world = tiny_world(seed, 2, 5) if seed % 2 else tiny_world(seed, 3, 3)
        starts = [[0, 0]] * (1 + seed % 3 // 2)
        best, bound = optimum(world, starts), flow_bound(contract(world, np.array(starts)))
        assert best is None or best <= bound, seed
