"""Teams whose robots differ, drawn anew, and what is asked of every one: engines agree, and all is as enumerated."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace, followed
from numpy.typing import NDArray

from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.simulator.exact_tree import WHOLE, grow_tree
from planner.tally import Outcome, Trace
from planner.world.generate import PAPER_LEVELS, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.robot_types import checked_types
from planner.world.world import World


def drawn(seed: int, robots: int = 3) -> tuple[World, NDArray[np.int64], tuple[str, ...]]:
    """A random map of two sources of threats, three types of robots, and starts anywhere in one part of it."""
    rng = np.random.default_rng(seed)
    kind = ("scattered", "contiguous")[seed % 2]
    size = (9 + seed % 4, 8 + seed % 5)
    one, other = (ThreatPattern(kind, 4, PAPER_LEVELS[:3], 2 * seed + more) for more in (0, 1))  # type: ignore[arg-type]
    world = random_world(*size, one, obstacles=0.15, threats=0.2)
    second = np.nan_to_num(random_world(*size, other, obstacles=0.0, threats=0.3).threat).astype(np.float64)
    first, factors = np.nan_to_num(world.threat).astype(np.float64), rng.choice([0.0, 0.3, 1.0, 2.0], (3, 2))
    by_type = [1 - (1 - a * first) * (1 - b * second) for a, b in factors]
    world = World.create(np.where(world.free, 1 - (1 - first) * (1 - second), np.nan))
    world = replace(world, types=checked_types(("a", "b", "c"), np.array(by_type), world.free, "drawn"))
    free = np.argwhere(world.accessible(place_starts(world, 1)[0]))
    types = tuple(rng.choice(["a", "b", "c"], robots).tolist())
    return world, free[rng.integers(0, len(free), robots)], types


def assert_engines_agree(plan: Plan, world: World, seed: int, rollouts: int) -> list[Trace]:
    """Rollouts of both, event for event, and what they have covered; the compiled one's with tables and without.

    Robots of several types have tables always.
    """
    assert plan.settings is not None
    readable = ReferenceLoop(plan, world)
    runs, known = zip(*(followed(readable, seed, rollout) for rollout in range(rollouts)), strict=True)
    for tabled in (True,) if plan.settings.types else (True, False):
        loop = compile_closed_loop(plan, world, tabled=tabled)
        for mine, trace in zip(trace_rollouts(loop, seed, range(rollouts)), known, strict=True):
            assert_same_trace(mine, trace)
        _, singles = run_range(loop, seed, 0, rollouts, threads=1, singles=True)
        assert singles is not None
        assert singles.visited.tolist() == [run.visited.sum() for run in runs]
        assert singles.survived.tolist() == [run.survived.sum() for run in runs]
        assert singles.alive.tolist() == [run.alive.sum() for run in runs]
    return list(known)


def assert_as_enumerated(plan: Plan, world: World, wanted: dict[str, Counter[Any]]) -> None:
    """The tree's chances are those that were enumerated."""
    tree = grow_tree(compile_closed_loop(plan, world), 0.0, 10**7)
    assert tree is not None
    for name in ("visited", "survived", "time", "alive"):
        counts = getattr(tree.counts, name)
        found = {value: count / WHOLE for value, count in enumerate(counts.tolist()) if count}
        assert found == pytest.approx(dict(wanted[name]), abs=1e-9), name
    ends = {Outcome(n).word: count / WHOLE for n, count in enumerate(tree.counts.outcomes.tolist()) if count}
    assert ends == pytest.approx(dict(wanted["outcome"]), abs=1e-9)
