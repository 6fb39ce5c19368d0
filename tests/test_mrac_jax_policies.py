"""The JAX closed loop by policies (SPEC section 11), against the compiled simulator; one compiled shape for all."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_results, assert_same_tally
from closed_loop_worlds import first_worlds

from mrac_jax.closed_loop import jax_engine as engine_module
from mrac_jax.closed_loop.jax_engine import JaxClosedLoop
from mrac_jax.closed_loop.tables import LaneTables, lane_tables
from mrac_jax.engine import closed_loop_engine
from planner.errors import WorldError
from planner.kernels.closed_loop import ClosedLoop, compile_closed_loop, run_range
from planner.mrac.make_plan import make_plan
from planner.plans.settings import Settings
from planner.tally import RolloutResults
from planner.worlds.world import World

LANES = 64
SHAPE = (150, 8)
"""Least room for cells and robots: that of all quick worlds here."""


@pytest.fixture
def one_shape(monkeypatch: pytest.MonkeyPatch) -> None:
    def roomy(loop: ClosedLoop, least: tuple[int, int] = SHAPE) -> LaneTables:
        return lane_tables(loop, least)

    monkeypatch.setattr(engine_module, "lane_tables", roomy)


def same_runs(loop: ClosedLoop, seed: int, rollouts: int, what: str) -> RolloutResults:
    """Tally and results in JAX are the compiled simulator's; returns the results."""
    tally, results = JaxClosedLoop(loop, seed, streams=1, lanes=LANES).run(0, rollouts)
    expected, singles = run_range(loop, seed, 0, rollouts, singles=True)
    assert singles is not None
    assert_same_results(results, singles, what)
    assert_same_tally(tally, expected, what)
    return results


def test_counts_are_the_compiled_simulator_s(one_shape: None) -> None:
    shares, worlds = 0, first_worlds(36)
    for one in worlds:
        plan = make_plan(one.world, one.starts, replace(one.settings, policy="per_cell"))
        loop = compile_closed_loop(plan, one.world, first_only=one.first_only)
        results = same_runs(loop, one.seed, 100, one.name)
        shares += int(results.bisected.sum() + results.divided.sum())
    assert len({one.kind for one in worlds}) >= 18
    assert shares > 300


@pytest.mark.parametrize("limits", [{"reserve": 0.5}, {"worth": 4.0}], ids=str)
def test_what_the_lanes_do_not_follow_is_numba_s(limits: dict[str, Any]) -> None:
    world = World.create(np.array([[0.0, 0.0, 0.1, 0.1, 0.3]]))
    loop = compile_closed_loop(make_plan(world, [[0, 0]], Settings(policy="per_cell", **limits)), world)
    assert closed_loop_engine(loop, 1).name == "numba"
    with pytest.raises(WorldError, match=r"policy per_cell with .*; expected no .* --engine numba"):
        closed_loop_engine(loop, 1, "jax")
