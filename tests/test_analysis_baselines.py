"""The benchmark's NumPy engine counts what the engines count; the naive program agrees with the closed form."""

from __future__ import annotations

import numpy as np
import pytest
from open_loop_reference import fixture

from analysis.bench.baselines import NumpyOpenLoop, naive_rollouts
from planner.rollouts.engine import open_loop_engine
from planner.rollouts.open_loop.compiled import compile_plan
from planner.rollouts.open_loop.engine import OpenLoop


@pytest.mark.parametrize(
    ("name", "robots"), [("contiguous-20x20-1000", 8), ("tiny-2x8-25", 5), ("scattered-14x23-1000", 1)]
)
def test_numpy_engine_equals_numba(name: str, robots: int) -> None:
    plan, world, _ = fixture(name, robots)
    compiled = compile_plan(plan, world)
    engines = [
        OpenLoop(compiled, 5, "tolerance", "numpy", NumpyOpenLoop),
        open_loop_engine(compiled, 5, "tolerance", "numba"),
    ]
    tallies = [engine.tally(77, 9001) for engine in engines]
    assert tallies[0] == tallies[1]
    singles = [engine.results(77, 500) for engine in engines]
    assert np.array_equal(singles[0].visited, singles[1].visited)
    assert np.array_equal(singles[0].outcome, singles[1].outcome)


def test_naive_program_agrees_with_the_closed_form() -> None:
    import jax

    plan, world, numbers = fixture("tiny-6x3-20", 5)
    compiled = compile_plan(plan, world)
    paths = [robot.path[: compiled.last_step + 1] for robot in plan.robots]
    (visited, survived, _, _), _ = naive_rollouts(paths, world.threat.reshape(-1), 2048)(jax.random.key(1))
    for found, meaning in ((visited, "visited"), (survived, "survived")):
        error = np.std(found) / np.sqrt(len(found))
        assert abs(np.mean(found) - numbers["open_loop_exact"][meaning]) <= 5 * error
