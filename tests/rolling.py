"""Short ways for tests to roll out a compiled plan or a closed loop through the one engine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from planner.rollouts import engine as engines
from planner.rollouts.engine import Chunk, closed_loop_engine, open_loop_engine
from planner.rollouts.names import EngineName
from planner.rollouts.open_loop import CompiledPlan
from planner.simulator.loop import ClosedLoop
from planner.tally import RolloutResults, Tally


def run_chunks(
    compiled: CompiledPlan, *, seed: int, count: int, engine: EngineName = "auto", **how: Any
) -> Iterator[Chunk]:
    """The open loop, chunk by chunk; `how`: as in `planner.rollouts.engine.run_chunks`."""
    return engines.run_chunks(open_loop_engine(compiled, seed, engine), count, **how)


def run_closed_chunks(
    loop: ClosedLoop, *, seed: int, count: int, engine: EngineName = "auto", **how: Any
) -> Iterator[Chunk]:
    """The closed loop, chunk by chunk; `how`: as in `planner.rollouts.engine.run_chunks`."""
    return engines.run_chunks(closed_loop_engine(loop, seed, engine), count, **how)


def rollouts(compiled: CompiledPlan, *, seed: int, count: int, **how: Any) -> Tally:
    """The tally of so many rollouts of the open loop; `how`: as in `run_chunks`."""
    *_, last = run_chunks(compiled, seed=seed, count=count, **how)
    return last.tally


def rollout_results(
    compiled: CompiledPlan, *, seed: int, count: int, start: int = 0, engine: EngineName = "auto"
) -> RolloutResults:
    """Every single rollout of the open loop."""
    return open_loop_engine(compiled, seed, engine).results(start, count)
