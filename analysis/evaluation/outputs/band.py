"""Coverage over time of single rollouts: how far runs lie apart by the end of a step, out of those that were run.

The ids 0 .. S - 1 are run once more, one by one, keeping the step at which each cell was first visited; S depends on
how many rollouts were asked for and on the size of the plan alone, so the same seed gives the same band.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analysis.evaluation.figures import last_shown
from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.page.series import Series
from analysis.sampling import RolloutChoices
from analysis.statistics.estimate import QUANTILES
from planner.kernels.tables import AllPairs
from planner.plans.plan import Plan, RobotPlan
from planner.rollouts.blocks import run_ranges
from planner.shown import counted
from planner.threefry import FAST_COUNTER, key_of, threefry2x32, uniform
from planner.worlds.world import World

LEAST, SHARE, MOST = 100, 10, 4096
"""Rollouts run again: those asked for, but of more than LEAST only one in SHARE (never below LEAST), at most MOST."""
OPEN_WORK = 2**27
"""First entries of all robots times rollouts of the open loop: about a second's work beyond LEAST rollouts."""
STEPS = 301
"""Steps looked at, evenly from 0 to the end; every step of a shorter run."""
AT_ONCE = 2**22
"""First entries times rollouts that are held in memory at a time."""
NEVER = np.iinfo(np.int64).max
Curves = Callable[[int, int], NDArray[np.int32]]
"""`curves(start, count)`: cells visited by the end of each step looked at, `[count, G]`."""


@dataclass(frozen=True, eq=False)
class Band(Output):
    """Quantiles of visited coverage (cells) over time, over the first of the rollouts, ids from 0; for the pictures.

    Axis `G` = steps looked at; the last one is where the longest of all rollouts ends.

    Attributes:
        steps: int64 `[G]`. low, median, high: int64 `[G]`, the 5 %, 50 % and 95 % quantiles by the end of that step.
        rollouts: how many were sampled at each step. accessible: cells.
    """

    steps: NDArray[np.int64]
    low: NDArray[np.int64]
    median: NDArray[np.int64]
    high: NDArray[np.int64]
    rollouts: int
    accessible: int

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        if run.choices.loop == "open" and run.world.doubt is not None:
            return  # its robots are not drawn one by one
        run.doing("coverage over time")
        world, plan, choices, tally = run.world, run.plan, run.choices, run.last.tally
        longest = int(np.flatnonzero(tally.time).max(initial=0))
        looked_at = np.linspace(0, last_shown(plan, choices.loop, tally), STEPS).round().astype(np.int64)
        marks = [longest] if choices.deadline is None else [longest, choices.deadline]
        steps = np.unique(np.append(looked_at, marks))
        count = min(tally.rollouts, max(LEAST, tally.rollouts // SHARE), MOST)
        if run.certain:  # no code is compiled to find one curve twice
            known = np.cumsum(tally.new_visited)[np.minimum(steps, len(tally.new_visited) - 1)] // tally.rollouts
            yield cls(steps, known, known, known, count, tally.accessible)
            return
        if choices.loop == "open":
            count = min(count, max(LEAST, OPEN_WORK // sum(len(np.unique(robot.path)) for robot in plan.robots)))
            curves = open_loop_curves(world, plan, choices, steps)
        else:
            curves = closed_loop_curves(world, plan, choices, steps, run.kept)
        found, seconds = [], 0.0
        for start, size, part, took in run_ranges(curves, 0, count, unit=1):
            found.append(part)
            seconds += took
            run.progress(start + size, count, seconds)
        places = [math.ceil(q * count - 1e-9 * count) - 1 for q in QUANTILES]  # as `statistics.estimate.quantile`
        low, median, high = np.partition(np.concatenate(found), places, axis=0)[places].astype(np.int64)
        yield cls(steps, low, median, high, count, tally.accessible)

    def blocks(self) -> Blocks:
        middle, low, high = (100 * values / self.accessible for values in (self.median, self.low, self.high))
        name = f"median of {counted(self.rollouts, 'rollout')}"
        return Blocks(curves=[Series(name, self.steps, middle, low, high, kind="step", colour=4, dashed=True)])


def closed_loop_curves(
    world: World, plan: Plan, choices: RolloutChoices, steps: NDArray[np.int64], kept: AllPairs
) -> Curves:
    """Of the closed loop, by the compiled simulator whatever the engine: they agree rollout for rollout."""
    from planner.kernels.closed_loop import compile_closed_loop, new_cells

    loop = compile_closed_loop(plan, world, first_only=choices.first_only, kept=kept, luck=choices.luck)

    def curves(start: int, count: int) -> NDArray[np.int32]:
        out = np.empty((count, len(steps)), dtype=np.int32)
        for place, new in enumerate(new_cells(loop, choices.seed, start, count)):
            out[place] = np.cumsum(new)[np.minimum(steps, len(new) - 1)]
        return out

    return curves


def open_loop_curves(world: World, plan: Plan, choices: RolloutChoices, steps: NDArray[np.int64]) -> Curves:
    """Of the open loop, from the step at which each robot is stopped; each kind of luck draws differently."""
    firsts = [np.unique(robot.path, return_index=True) for robot in plan.robots]
    robot = np.concatenate([np.full(len(cells), number) for number, (cells, _) in enumerate(firsts)])
    cell, entered = (np.concatenate([first[part] for first in firsts]) for part in (0, 1))
    order = np.argsort(cell, kind="stable")
    robot, entered = robot[order], entered[order]
    cell_begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    seen_at = np.searchsorted(steps, entered).astype(np.int32)  # the first step looked at by whose end it is visited
    stop_of = {"tolerance": _tolerance_stops, "fast": _fast_stops, "step": _step_stops}[choices.drawn]

    def few(start: int, count: int) -> NDArray[np.int32]:
        ids = np.arange(start, start + count, dtype=np.uint32)
        stops = np.stack([stop_of(plan, k, world, choices.seed, ids) for k in range(len(plan.robots))], axis=1)
        at = np.where(entered <= stops[:, robot], seen_at, len(steps))
        first = np.minimum.reduceat(at, cell_begins, axis=1)
        bins = len(steps) + 1
        counts = np.bincount((first + bins * np.arange(count)[:, None]).ravel(), minlength=count * bins)
        return np.cumsum(counts.reshape(count, bins)[:, :-1], axis=1, dtype=np.int32)

    def curves(start: int, count: int) -> NDArray[np.int32]:
        size = max(1, AT_ONCE // len(entered))
        return np.concatenate([few(at, min(size, start + count - at)) for at in range(start, start + count, size)])

    return curves


def _dangerous(robot: RobotPlan, world: World) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Steps at which the robot enters a dangerous cell, and the threats there."""
    steps = robot.entered
    threat = world.threat.reshape(-1)[robot.path[steps]]
    return steps[threat > 0], threat[threat > 0]


def _fast_stops(plan: Plan, robot: int, world: World, seed: int, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The step at which the robot is stopped in each rollout, `[B]`, NEVER where it is not: one draw a rollout."""
    from planner.rollouts.open_loop.compiled import survival_thresholds

    steps, threat = _dangerous(plan.robots[robot], world)
    _, words = threefry2x32(key_of(seed), ids, np.uint32(FAST_COUNTER - robot))
    falling = -survival_thresholds(threat).astype(np.int64)
    passed = np.searchsorted(falling, -words.astype(np.int64), side="left")  # thresholds above the word
    return np.append(steps, NEVER)[passed]


def _tolerance_stops(plan: Plan, robot: int, world: World, seed: int, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The same by the robot's tolerance."""
    steps = plan.robots[robot].entered
    borne = np.cumsum(world.exposures[0][plan.robots[robot].path[steps]])
    tolerances = plan.bearing.tolerances(seed, ids, robot + 1)[:, robot]
    return np.append(steps, NEVER)[np.searchsorted(borne, tolerances, side="left")]


def _step_stops(plan: Plan, robot: int, world: World, seed: int, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The same by one draw for each dangerous entry, some entries of those still going at a time."""
    steps, threat = _dangerous(plan.robots[robot], world)
    stops, going = np.full(len(ids), NEVER), np.arange(len(ids))
    for at in range(0, len(steps), 64):
        now = slice(at, at + 64)
        hit = uniform(seed, ids[going, None], steps[now], robot) < threat[now]
        hurt = hit.any(axis=1)
        stops[going[hurt]] = steps[now][hit[hurt].argmax(axis=1)]
        going = going[~hurt]
    return stops
