"""Coverage over time: quantiles of single rollouts at each step, coverage by a deadline, and the cost of turns.

The rollouts 0 .. S - 1 are run again one by one with the step of each cell's first visit. S depends only on the number
of rollouts and the size of the plan, so that equal seeds give equal quantiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import TreeTruth
from analysis.evaluation.figures import Elements, Figures, Output, Run, coverage_row, last_shown
from analysis.page.elements import Series
from analysis.sampling import RolloutChoices, make_engine_for
from analysis.statistics.estimates import QUANTILES, Estimate, mean_of, robots_text
from analysis.theory.verdicts import MEANINGS, longest_run
from analysis.utils.tables import make_table
from planner.formatting import TURNS, UNPACED, Pace, counted, percent
from planner.plan.plan import Drive, Plan, drive_of
from planner.rollouts.engine import run_ranges
from planner.rollouts.exact_tree import Tree
from planner.rollouts.tables import AllPairs
from planner.tally import Tally
from planner.world.world import World

BAND_LEAST, SHARE, BAND_MOST = 100, 10, 4096
"""Rollouts that are run again: one in SHARE of the evaluation's, at least LEAST if it has so many, at most MOST."""
OPEN_WORK = 2**27
"""Entries (first visits of all robots, times rollouts) of the open loop: a second of work beyond LEAST rollouts."""
STEPS = 301
"""Steps on the time axis, evenly from 0 to the end; every step of a shorter run."""
AT_ONCE = 2**22
"""Entries times rollouts held in memory at a time."""
NEVER = np.iinfo(np.int64).max
Curves = Callable[[int, int], NDArray[np.int32]]
"""`curves(start, count)`: cells visited by the end of each step of the axis, int32 `[count, G]`."""


@dataclass(frozen=True, eq=False)
class Band(Output):
    """Quantiles of visited coverage (cells) over time, from the first rollouts; for charts.

    Axis `G`: steps on the time axis. The last step is the end of the longest rollout.

    Attributes:
        steps: int64 `[G]`. low, median, high: int64 `[G]`, the 5 %, 50 % and 95 % quantiles by the end of that step.
        rollouts: sample size. accessible: number of accessible cells.
    """

    steps: NDArray[np.int64]
    low: NDArray[np.int64]
    median: NDArray[np.int64]
    high: NDArray[np.int64]
    rollouts: int
    accessible: int

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        if run.choices.loop == "open" and run.world.uncertainty is not None:
            return  # the open loop on uncertain maps has no single rollouts
        run.doing("coverage over time")
        world, plan, choices, tally = run.world, run.plan, run.choices, run.last.tally
        longest = int(np.flatnonzero(tally.time).max(initial=0))
        looked_at = np.linspace(0, last_shown(plan, choices.loop, tally), STEPS).round().astype(np.int64)
        marks = [longest] if choices.deadline is None else [longest, choices.deadline]
        steps = np.unique(np.append(looked_at, marks))
        count = min(tally.rollouts, max(BAND_LEAST, tally.rollouts // SHARE), BAND_MOST)
        if run.certain:  # all rollouts are equal: no compilation is needed
            known = np.cumsum(tally.new_visited)[np.minimum(steps, len(tally.new_visited) - 1)] // tally.rollouts
            yield cls(steps, known, known, known, count, tally.accessible)
            return
        if choices.loop == "open":
            count = min(count, max(BAND_LEAST, OPEN_WORK // sum(len(np.unique(robot.path)) for robot in plan.robots)))
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

    def elements(self) -> Elements:
        middle, low, high = (100 * values / self.accessible for values in (self.median, self.low, self.high))
        name = f"median of {counted(self.rollouts, 'rollout')}"
        return Elements(curves=[Series(name, self.steps, middle, low, high, kind="step", colour=4, dashed=True)])


def closed_loop_curves(
    world: World, plan: Plan, choices: RolloutChoices, steps: NDArray[np.int64], kept: AllPairs
) -> Curves:
    """Curves of the closed loop from the compiled simulator; all engines give the same rollouts."""
    from planner.rollouts.closed_loop import compile_closed_loop, new_cells

    loop = compile_closed_loop(plan, world, first_only=choices.first_only, kept=kept)

    def curves(start: int, count: int) -> NDArray[np.int32]:
        out = np.empty((count, len(steps)), dtype=np.int32)
        for place, new in enumerate(new_cells(loop, choices.seed, start, count)):
            out[place] = np.cumsum(new)[np.minimum(steps, len(new) - 1)]
        return out

    return curves


def open_loop_curves(world: World, plan: Plan, choices: RolloutChoices, steps: NDArray[np.int64]) -> Curves:
    """Curves of the open loop, from the step at which each robot is lost."""
    firsts = [np.unique(robot.path, return_index=True) for robot in plan.robots]
    robot = np.concatenate([np.full(len(cells), number) for number, (cells, _) in enumerate(firsts)])
    cell, entered = (np.concatenate([first[part] for first in firsts]) for part in (0, 1))
    order = np.argsort(cell, kind="stable")
    robot, entered = robot[order], entered[order]
    cell_begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    seen_at = np.searchsorted(steps, entered).astype(np.int32)  # first step of the axis by which the cell is visited

    def few(start: int, count: int) -> NDArray[np.int32]:
        ids = np.arange(start, start + count, dtype=np.uint32)
        stops = np.stack([_stops(plan, k, world, choices.seed, ids) for k in range(len(plan.robots))], axis=1)
        # A robot visits a cell if it is lost there, but not afterwards.
        at = np.where(entered <= stops[:, robot], seen_at, len(steps))
        first = np.minimum.reduceat(at, cell_begins, axis=1)
        bins = len(steps) + 1
        counts = np.bincount((first + bins * np.arange(count)[:, None]).ravel(), minlength=count * bins)
        return np.cumsum(counts.reshape(count, bins)[:, :-1], axis=1, dtype=np.int32)

    def curves(start: int, count: int) -> NDArray[np.int32]:
        size = max(1, AT_ONCE // len(entered))
        return np.concatenate([few(at, min(size, start + count - at)) for at in range(start, start + count, size)])

    return curves


def _stops(plan: Plan, robot: int, world: World, seed: int, ids: NDArray[np.uint32]) -> NDArray[np.int64]:
    """The step at which the robot is lost in each rollout, int64 `[B]`; NEVER if it is not."""
    steps = plan.robots[robot].entered
    # A robot is lost at the first entry where its cumulative hazard reaches its failure threshold.
    hazard = np.cumsum(world.exposures[0][plan.robots[robot].path[steps]])
    thresholds = plan.failure_model.thresholds(seed, ids, robot + 1)[:, robot]
    return np.append(steps, NEVER)[np.searchsorted(hazard, thresholds, side="left")]


# Coverage by a deadline: the same rollouts, truncated at the end of a step.


@dataclass(frozen=True, eq=False)
class Deadline(Output):
    """Coverage by the end of step `steps`.

    Attributes:
        tally: of the truncated rollouts. exact: the open loop's expected cells visited and survived by then.
        certain: all runs are equal. pace: length of a step, if known.
        losses: expected robots lost by then, if `exact` belongs to the evaluated loop; else None.
        over: every run has ended by then, and the figures equal those of whole runs. tree: the exact tree, or None.
    """

    steps: int
    tally: Tally
    exact: tuple[float, float]
    certain: bool = False
    pace: Pace = UNPACED
    losses: float | None = None
    over: bool = False
    tree: Tree | None = None
    late = False
    json_keys = """
        steps figures.visited figures.survived delivered?=figures.delivered figures.losses
        exact.open_loop=known_coverage
    """

    @classmethod
    def measure(cls, asked: int, run: Run) -> Iterator[Self]:
        run.doing(f"rollouts up to the deadline, step {asked:,}")
        choices = replace(run.choices, rollouts=run.last.tally.rollouts, precision=None)
        for stage in run.roll_out(choices, asked):
            tally = stage.tally
            run.progress(tally.rollouts, choices.rollouts, stage.seconds)
        own = run.choices.loop == "open" or (run.closed is not None and not isinstance(run.closed, TreeTruth))
        over = longest_run(run.world, run.plan, run.choices.loop) <= asked
        tree = run.closed.tree if over and isinstance(run.closed, TreeTruth) else None
        lost = run.exact.losses_by(asked) if own else None
        yield cls(asked, tally, run.exact.by_deadline(asked), run.certain, run.world.pace, lost, over, tree)

    @cached_property
    def figures(self) -> Figures:
        """Figures of these rollouts; exact values if they are known."""
        found = Figures.of(self.tally, self.certain)
        if self.tree is not None:
            return found.with_tree(self.tree)
        return found if self.losses is None else found.with_means(*self.exact, self.losses)

    @property
    def known_coverage(self) -> dict[str, float]:
        """The open loop's expected cells by then, by meaning."""
        return dict(zip(MEANINGS, self.exact, strict=True))

    def elements(self) -> Elements:
        if self.over:
            return Elements(marks=[(self.steps, "deadline")], settings={"deadline": self.pace.step(self.steps)})
        found, cells = self.figures, self.tally.accessible
        mean, known = found.visited.mean.mean / cells, found.visited.mean.half_width == 0
        reached = percent(mean, 2) + " (exact)" if known else percent(mean)
        lost = robots_text(found.losses.mean, self.tally.robots, found.losses.decimals)
        by = f"by step {self.steps}{self.pace.also(self.steps)}"
        return Elements(
            opens=[f"By {self.pace.step(self.steps)}: {reached} visited, {lost} lost on average."],
            rows=[
                coverage_row(f"{meaning} {by}", getattr(found, meaning), cells, exact)
                for meaning, exact in self.known_coverage.items()
            ],
            marks=[(self.steps, "deadline")],
            settings={"deadline": self.pace.step(self.steps)},
        )


# The distance that the robots drive, their turns, and the mission time with turns; from whole runs.

TURNING_LEAST, TURNING_MOST, WORK = 100, 1000, 2_000_000
"""Rollouts that are run in full: fewest, most; WORK: robot steps that take negligible time."""
FINE = 1000
"""Times with turns are integers in units of 1 / FINE step."""


@dataclass(frozen=True, eq=False)
class Turning(Output):
    """Moves and turns of the robots, in a run of the evaluated loop and in the run without losses.

    Attributes:
        turn: cost of a quarter turn, steps. nominal: of the plan. rollouts: number of rollouts run in full.
        moves, turns: sums over all robots. time: steps, including turns. pace: length of a step, if known.
    """

    turn: float
    nominal: Drive
    rollouts: int
    moves: Estimate
    turns: Estimate
    time: Estimate
    pace: Pace = UNPACED
    json_keys = "cost=turn rollouts moves quarter_turns=turns time nominal=without_losses"

    @classmethod
    def check(cls, asked: object, world: World) -> None:
        TURNS.check("turn", asked)

    @classmethod
    def measure(cls, asked: float, run: Run) -> Iterator[Self]:
        plan, choices = run.plan, replace(run.choices, deadline=None)
        most = int(np.clip(WORK // ((plan.makespan + 1) * len(plan.robots)), TURNING_LEAST, TURNING_MOST))
        count = min(run.last.tally.rollouts, most)
        run.doing(f"turns of {counted(count, 'rollout')}")
        traces = make_engine_for(run.world, plan, choices).traces(range(count))
        drives = [drive_of(trace.cells.T) for trace in traces]
        steps = longest_run(run.world, plan, choices.loop)

        def mean(values: list[int], most: float, unit: float = 1.0) -> Estimate:
            return mean_of(*np.unique(values, return_counts=True), unit, int(most), run.certain)

        robots = len(plan.robots)
        yield cls(
            asked,
            drive_of(robot.path for robot in plan.robots),
            count,
            mean([int(one.moves.sum()) for one in drives], robots * steps),
            mean([int(one.turns.sum()) for one in drives], 2 * robots * steps),
            mean([round(FINE * one.time(asked)) for one in drives], FINE * steps * (1 + 2 * asked), 1 / FINE),
            run.world.pace,
        )

    @property
    def without_losses(self) -> dict[str, float]:
        """Moves, turns and time of the run without losses."""
        moves, turns = (int(of.sum()) for of in (self.nominal.moves, self.nominal.turns))
        return {"moves": moves, "quarter_turns": turns, "time": self.nominal.time(self.turn)}

    def elements(self) -> Elements:
        """A table with a row for each quantity, and a note."""
        (moves, turns, time), cost = self.without_losses.values(), counted(float(self.turn), "step")
        rows = [
            ("moves", *self.moves.columns(), f"{moves:,}"),
            ("quarter turns", *self.turns.columns(), f"{turns:,}"),
            *(
                (f"time with turns, {unit}", *self.time.columns(scale), f"{scale * time:,.1f}")
                for unit, scale in {"steps": 1.0, "minutes": self.pace.minutes}.items()
                if scale
            ),
        ]
        table = make_table(("", "mean", "95 % interval", "no losses"), "Moves and turns of the robots", rows)
        note = (
            f"A quarter turn costs {cost}; the mean is of the first {counted(self.rollouts, 'rollout')}. "
            "Turns lengthen only the time in this table."
        )
        return Elements(tables=[table], notes=[note], settings={"a quarter turn": cost})
