"""Are two engines' tallies, single results or traces the same? If not: which array, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from planner.plan.plan import Plan
from planner.rollout_sampling import Luck
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.single_run import PythonLoop, Run, SingleRun, play
from planner.tally import RolloutResults, Tally, Trace
from planner.world.world import World


def play_both_ways(
    plan: Plan,
    world: World,
    seed: int,
    rollouts: int,
    *,
    first_only: bool = False,
    tabled: Sequence[bool | None] = (True, False),
) -> list[Run]:
    """Rollouts from 0 on, of the simulator as Python. The compiled one's are the same, event for event, and its counts.

    So is the last of them where `Luck`, which is written apart, says visit by visit who is lost. `tabled`: with tables
    of distances, or with searches, where the plan allows both.
    """
    python = PythonLoop(plan, world, first_only=first_only)
    runs = [python.run(seed, rollout) for rollout in range(rollouts)]
    luck = Luck(world, seed, rollouts - 1, plan.bearing)
    assert_same_trace(play(SingleRun(python.loop, seed, rollouts - 1, hit=luck.hits)).trace, runs[-1].trace, "told")
    for with_tables in tabled:
        loop = compile_closed_loop(plan, world, first_only=first_only, tabled=with_tables)
        if loop.tabled != with_tables and len(tabled) > 1:
            continue
        for mine, run in zip(trace_rollouts(loop, seed, range(rollouts)), runs, strict=True):
            assert_same_trace(mine, run.trace, world.source)
        tally, singles = run_range(loop, seed, 0, rollouts, threads=1, singles=True)
        assert singles is not None
        for name in ("time", "outcome", "bisected", "divided"):
            assert getattr(singles, name).tolist() == [getattr(run, name) for run in runs], (world.source, name)
        for name in ("visited", "survived", "alive", "home")[: None if loop.comes_home else 3]:
            assert getattr(singles, name).tolist() == [getattr(run, name).sum() for run in runs], (world.source, name)
        for name in ("visited", "survived"):
            counts = np.sum([getattr(run, name) for run in runs], axis=0)
            np.testing.assert_array_equal(getattr(tally, f"covered_{name}").ravel(), counts, f"{world.source}: {name}")
        assert tally.stops.sum() == sum(int((~run.alive).sum()) for run in runs)
    return runs


def assert_same_tally(mine: Tally, other: Tally, what: str = "") -> None:
    """The same rollouts of the same thing with the same counts; steps that hold nothing do not matter."""
    said, theirs = f"tallies differ: {what}", other.counts()
    for name, counts in mine.counts().items():
        common = min(len(counts), len(theirs[name]))
        np.testing.assert_array_equal(counts[:common], theirs[name][:common], f"{said}: {name}")
    assert (mine.key, mine.shape, mine.ids) == (other.key, other.shape, other.ids), said
    assert mine == other, said


def assert_same_results(mine: RolloutResults, other: RolloutResults, what: str = "") -> None:
    """The same ids with the same results."""
    for name in (field.name for field in fields(RolloutResults)):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"results differ: {what}: {name}")


def assert_same_trace(mine: Trace, other: Trace, what: str = "") -> None:
    """Identical, event for event; what happened is compared before what follows from it."""
    said = f"traces differ: {what}: rollout {mine.rollout}"
    for name in ("rollout", "events", "cells", "doing", "areas", "area_of", "outcome"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"{said}: {name}")
    assert mine == other, said
