"""The result of a plan: exact if its tree is small enough, else sampled. Searches use only this module for results.

A search compares like with like: all results are exact, or all are on the same rollouts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices, knowing_deadline, make_engine_for
from analysis.statistics.estimates import (
    QUANTILES,
    ROUNDING,
    Estimate,
    chance_interval,
    exactly,
    mean_interval,
    mean_of,
    proportion,
)
from analysis.statistics.variance_reduction import LEAST, CommonThresholds, Paired, difference, estimate_of, tally_mean
from analysis.theory.exact import CellValues, OpenLoopExact, open_loop_exact
from analysis.theory.verdicts import MEANINGS, ClosedTruth, Truth, as_stated, exact_truth
from analysis.utils.progress import announce_compilation
from planner.errors import PlanError
from planner.plan.plan import Plan, is_certain
from planner.rollouts.closed_loop import compile_closed_loop, tally_from
from planner.rollouts.engine import Engine, closed_loop_engine, run_chunks, run_with_threshold_sums
from planner.rollouts.exact_tree import CHEAP, WHOLE, Tree, grow_tree
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.tables import UNITS, AllPairs
from planner.rollouts.threshold_classes import classes_by_threshold
from planner.simulator.jit import INTERPRETED
from planner.simulator.state import MOST_PASSES, Counts
from planner.tally import RolloutResults, Tally
from planner.world.world import World

# The closed loop without rollouts: by formulas where they are exact, else by the tree of all possible histories.

SLACK = 1e-4
"""Largest uncertainty of a mean, a fraction of the cells, that counts as exact."""
EFFORT = 3e8
"""Histories of a tree times cells that take about a second; a fixed amount of work, the same on every machine."""
AS_PYTHON = 1000
"""A history takes that much longer where the simulator runs as Python (`NUMBA_DISABLE_JIT=1`)."""
LARGE = 8
"""Robots above which a history takes longer: by their number, and by its cube if they return to base (64: 366 times) or
have a limited radio range (35: 40 times)."""
MOST_CELLS = 5_000
"""Largest map, in cells, whose tables for a tree are computed."""


@dataclass(frozen=True)
class TreeTruth(ClosedTruth):
    """Exact figures of the closed loop from a tree.

    Attributes:
        tree: of all possible histories, or almost all. masses: probabilities in the form of a tally; None: too much of
            the probability is unexplored.
    """

    tree: Tree = field(kw_only=True)
    masses: Tally | None = field(kw_only=True)

    @property
    def is_all(self) -> bool:
        """Whether rollouts add nothing: the unexplored probability is negligible."""
        return self.masses is not None and self.time is not None

    @property
    def further(self) -> dict[str, Any]:
        tree, robots, (least, most) = self.tree, len(self.tree.counts.alive) - 1, self.tree.alive()
        return {
            "losses": _as_json(robots - most, robots - least),
            "complete": _as_json(*tree.chance_complete()),
            "delivered": _as_json(*tree.covered("delivered")) if len(tree.counts.delivered) else None,
            "quantiles": {
                figure: {f"{q:g}": _as_json(*tree.quantile(figure, q)) for q in QUANTILES} for figure in MEANINGS
            },
            "histories": tree.histories,
            "cut": tree.cut / WHOLE,
            "mass_cut": tree.left,
            "seconds": tree.seconds,
        }


def closed_truth(
    plan: Plan,
    world: World,
    exact: OpenLoopExact,
    choices: RolloutChoices,
    kept: AllPairs | None = None,
    fine_seconds: float = 0.0,
) -> ClosedTruth | None:
    """Figures of the closed loop within SLACK of the cells, or a tenth of the precision; None: the tree is too large.

    `exact`: of the open loop. `kept`: cache of all-pairs tables. `fine_seconds`: as in `tree_of`.
    """
    known = exact_truth(plan, world, exact, choices.first_only)
    if choices.exact == "never" or is_certain(world, plan) or (known is not None and not fine_seconds):
        return known
    # A tenth of the precision makes the tree's uncertainty negligible.
    slack = min(SLACK, (choices.precision or 1.0) / 10)
    loop = _loop_of(plan, world, choices.first_only, kept)
    tree = None if loop is None else tree_of(loop, choices.exact_seconds, slack, fine_seconds)
    return known if loop is None or tree is None else _truth_of(tree, loop, plan, world)


def _loop_of(plan: Plan, world: World, first_only: bool, kept: AllPairs | None) -> ClosedLoop | None:
    """The loop of which a tree is grown; None: it has no tree, or one that is too large."""
    has_tree = world.uncertainty is None or world.phases is not None
    if not has_tree or int(world.accessible(plan.starts).sum()) > MOST_CELLS:
        return None
    try:
        return compile_closed_loop(plan, world, first_only=first_only, kept=kept)
    except PlanError:  # a rule that is not compiled
        return None


def tree_of(loop: ClosedLoop, seconds: float, slack: float = SLACK, fine_seconds: float = 0.0) -> Tree | None:
    """The tree of a closed loop with at most `slack` of the cells unknown; None: it would take more than `seconds`.

    A tree of a single history (no danger, or one robot) is always grown.

    `fine_seconds`: time within which a tree is grown until the unexplored probability is negligible.
    """
    cells = loop.accessible
    slower = max(loop.robots / LARGE, 1.0) ** (3 if loop.comes_home or len(loop.tables.reach) else 1)
    slower *= AS_PYTHON if INTERPRETED else 1
    a_second = EFFORT / cells / slower if cells <= MOST_CELLS else 0.0
    most, cheap = (max(int(time * a_second), 2) for time in (seconds, fine_seconds))
    return grow_tree(loop, slack * cells, most, max(cheap, CHEAP))


def _truth_of(tree: Tree, loop: ClosedLoop, plan: Plan, world: World) -> TreeTruth:
    bounds = tree.covered("visited"), tree.covered("survived"), tree.chance_left()
    visited, survived, some_left = (Truth((low + high) / 2, low, high, "tree") for low, high in bounds)
    stated = as_stated(plan, world, tree.counts.outcomes / WHOLE, "tree")
    counts = [Counts(*map(np.copy, tree.counts))]  # copied, because `tally_from` adds in place
    masses = tally_from(loop, 0, 0, WHOLE, counts) if tree.left <= SLACK else None
    alive, time = tree.mean_alive, tree.mean_time
    return TreeTruth(visited, survived, some_left, stated, 0, alive, time, tree=tree, masses=masses)


def _as_json(low: float, high: float) -> float | list[float]:
    """A value, or its certain lower and upper bounds."""
    return low if low == high else [low, high]


# Value covered in each rollout, in integers, which add exactly: rounding is 1e-12 of the total a cell.


def units_of(cell_values: CellValues) -> NDArray[np.float64]:
    """Units of each cell before rounding, float64 `[N]`."""
    return np.asarray(cell_values.value / cell_values.total * UNITS)


def weigh(engine: Engine, world: World) -> Engine:
    """The same engine; a closed loop with values also sums the units of visited cells: `value_covered`."""
    if world.value is None:
        return engine
    covered = np.rint(units_of(CellValues.of(world))).astype(np.int64)
    return engine.with_cell_weights(covered, np.zeros((len(covered), MOST_PASSES + 1), dtype=np.int64))


def mean_value(
    column: NDArray[np.int64], total: float, cells: int, certain: bool, controls: CommonThresholds | None = None
) -> Estimate:
    """The mean of units `[B]`, as a value of the `total` of so many cells; `certain`: all rollouts are equal.

    `controls`: the rollouts by class of S, for the control variate (`analysis.statistics.variance_reduction`).
    """
    values, often = np.unique(column, return_counts=True)
    unit, most = total / UNITS, UNITS + cells  # the largest sum over so many cells after rounding
    if controls is None or certain:
        found = mean_of(values, often, unit, most, certain)
    else:
        x = controls.x.astype(np.float64)
        found = estimate_of(values, often, controls.by_class, x, controls.robots, unit, most)
    rounding = 0.0 if certain else cells / 2 * unit  # the units of each cell are rounded
    mean = min(found.mean, total)
    return Estimate(mean, found.se, (max(found.ci95[0] - rounding, 0.0), min(found.ci95[1] + rounding, total)))


# The result of a plan, exact or sampled, with one interface.
#
# `Known` holds a tree of all possible histories (`planner.rollouts.exact_tree`), `Sampled` a number of rollouts. Means
# of both are `Estimate`s. A difference of two is exact, or on common random numbers. Only this module distinguishes the
# two.

Between = tuple[float, float]
"""Certain lower and upper bounds of a figure."""


class _Compared:
    """What the two kinds of result share: coverage, losses and time of a team, and the figure that is compared."""

    metric: str
    json_keys = "coverage losses time"

    if TYPE_CHECKING:
        mean: Callable[..., Estimate]
        ahead: Callable[..., Estimate]
        largest: Callable[[str], float]

        @property
        def valued(self) -> bool: ...

    @property
    def counted(self) -> str:
        """The figure that is compared: visited value if the map has values, else cells."""
        return "value" if self.valued and self.metric == "visited" else self.metric

    @property
    def coverage(self) -> Estimate:
        """Mean visited coverage, a fraction of the accessible cells."""
        return self.mean("visited", 1.0 / self.largest("visited"))

    @property
    def losses(self) -> Estimate:
        """Mean number of robots lost."""
        return self.mean("lost")

    @property
    def time(self) -> Estimate:
        """Mean number of steps."""
        return self.mean("time")

    def covers_more(self, base: Measured) -> Estimate:
        """Mean visited coverage minus that of `base`, a fraction of the accessible cells."""
        return self.ahead(base, "visited", 1.0 / self.largest("visited"))


@dataclass(frozen=True, eq=False)
class Known(_Compared):
    """Exact figures: "visited" and "survived" cells, robots "alive" and "lost", "time" in steps, share of "value".

    Attributes:
        tree: of all possible histories (`Tree`); None: the open loop (`KnownPaths`). metric: the coverage that is
            compared. value: bounds of the visited share of the value; None: the map has no values.
    """

    tree: Any
    value: Between | None = None
    metric: str = "visited"
    rollouts = 0
    exact = certain = True

    @property
    def valued(self) -> bool:
        """Whether the map has values."""
        return self.value is not None

    @property
    def share(self) -> float:
        """Mean share of all cells, or of all value, that is visited."""
        low, high = self.between(self.counted)
        return (low + high) / 2 / self.largest(self.counted)

    def between(self, figure: str) -> Between:
        """Bounds of the mean; they differ only by the unexplored probability."""
        if figure == "value":
            assert self.value is not None
            return self.value
        if figure == "lost":
            low, high = self.tree.alive()
            return self.largest("lost") - high, self.largest("lost") - low
        return {"alive": self.tree.alive, "time": self.tree.time}.get(figure, lambda: self.tree.covered(figure))()

    def mean(self, figure: str, unit: float = 1.0, most: int | None = None) -> Estimate:
        """A mean, times `unit`."""
        return stated(self.between(figure), unit, self.largest(figure))

    def bounds(self, figure: str, alpha: float) -> Between:
        """Bounds of the mean, for any error probability `alpha`."""
        return self.between(figure)

    def chance(self, figure: str, needed: int) -> Estimate:
        """The probability that at least `needed` cells are "visited" or "survived"."""
        return stated(self.chance_bounds(figure, needed, 0.0), 1.0, 1.0)

    def chance_bounds(self, figure: str, needed: int, alpha: float) -> Between:
        """Bounds of that probability."""
        return self.tree.chance_of(figure, needed)

    def ahead(self, base: Measured, figure: str, unit: float = 1.0) -> Estimate:
        """The difference of a figure from that of `base`, which is exact too, times `unit`."""
        assert isinstance(base, Known)
        (low, high), (least, most), reach = self.between(figure), base.between(figure), self.largest(figure)
        apart = (low - most, high - least)
        if abs(sum(apart)) <= apart[1] - apart[0] + ROUNDING * reach:  # not distinguishable
            apart = (min(apart[0], 0.0), -min(apart[0], 0.0)) if apart[1] > apart[0] else (0.0, 0.0)
        return stated(apart, unit, 2 * reach)

    def by_step(self) -> NDArray[np.float64]:
        """Mean share of the cells visited by the end of each step, float64 `[T + 1]`."""
        return np.cumsum(self.tree.counts.new) / WHOLE / self.largest("visited")

    def largest(self, figure: str) -> float:
        """The largest possible value of a figure in a run."""
        axis = {"lost": "alive", "survived": "visited", "delivered": "visited"}.get(figure, figure)
        return 1.0 if axis == "value" else len(getattr(self.tree.counts, axis)) - 1.0


@dataclass(frozen=True, eq=False)
class KnownPaths(Known):
    """Exact means of the open loop, with their largest values, by figure; chances of a coverage are not known."""

    figures: Mapping[str, tuple[float, float]] = field(kw_only=True)

    def between(self, figure: str) -> Between:
        return self.figures[figure][0], self.figures[figure][0]

    def largest(self, figure: str) -> float:
        return self.figures[figure][1]


def stated(between: Between, unit: float, most: float) -> Estimate:
    """Exact if the bounds are within SLACK of `most`, else an estimate with the bounds as its interval."""
    low, high = between
    mean = (low + high) / 2 * unit
    return exactly(mean) if high - low <= SLACK * most else Estimate(mean, 0.0, (low * unit, high * unit))


@dataclass(frozen=True, eq=False)
class Sampled(_Compared):
    """The same figures from rollouts, with the control variate in the closed loop.

    Attributes:
        tally, results: of the rollouts; results may be omitted if nothing is compared. seed: of a closed loop, or None.
        valued: the map has values. certain: all rollouts are equal. seconds: computing time. metric: as in `Known`.
    """

    tally: Tally
    results: RolloutResults | None = None
    seed: int | None = None
    valued: bool = False
    certain: bool = False
    seconds: float = 0.0
    metric: str = "visited"
    exact = False

    def __add__(self, other: Sampled) -> Sampled:
        assert self.results is not None
        assert other.results is not None
        both = RolloutResults.join([self.results, other.results])
        return replace(self, tally=self.tally + other.tally, results=both, seconds=0.0)

    @property
    def rollouts(self) -> int:
        """Number of rollouts."""
        return self.tally.rollouts

    @cached_property
    def share(self) -> float:
        """As in `Known`, the sample mean."""
        return float(self.column(self.counted).mean()) / self.largest(self.counted)

    def column(self, figure: str) -> NDArray[np.int64]:
        """A figure of each rollout, int64 `[n]`; value in UNITS."""
        assert self.results is not None
        own = {"value": "value_covered", "lost": "alive"}.get(figure, figure)
        found = getattr(self.results, own).astype(np.int64)
        return self.tally.robots - found if figure == "lost" else found

    def mean(self, figure: str, unit: float = 1.0, most: int | None = None) -> Estimate:
        """A mean, times `unit`, with its interval; `most`: of time, the longest possible run."""
        if figure != "value":
            return tally_mean(self.tally, figure, unit, most, self.certain)
        column, cells = self.column(figure), len(self.tally.covered_visited)
        return mean_value(column, unit, cells, self.certain, self._controls(column))

    def bounds(self, figure: str, alpha: float) -> Between:
        """Bounds of the mean with error probability `alpha`, for any distribution (`mean_interval`)."""
        if self.certain:
            return self.mean(figure).ci95
        return mean_interval(self.tally.alive[::-1] if figure == "lost" else getattr(self.tally, figure), alpha)

    def chance(self, figure: str, needed: int) -> Estimate:
        """As in `Known`."""
        return proportion(self._often(figure, needed), self.rollouts, self.certain)

    def chance_bounds(self, figure: str, needed: int, alpha: float) -> Between:
        """Bounds of that probability with error probability `alpha`."""
        if self.certain:
            return self.chance(figure, needed).ci95
        return chance_interval(self._often(figure, needed), self.rollouts, alpha)

    def _often(self, figure: str, needed: int) -> int:
        return int(getattr(self.tally, figure)[needed:].sum())

    def ahead(self, base: Measured, figure: str, unit: float = 1.0) -> Estimate:
        """The difference of a figure from that of `base` on the rollouts of both, times `unit`."""
        assert isinstance(base, Sampled)
        n = min(self.rollouts, base.rollouts)
        less, more = base.column(figure)[:n], self.column(figure)[:n]
        one = unit / UNITS if figure == "value" else unit
        return difference(
            Paired.of(less, more), one, one, self.largest(figure) * one, self.certain and base.certain,
            self._controls(less, more),
        ).estimate  # fmt: skip

    def by_step(self) -> NDArray[np.float64]:
        """As in `Known`."""
        return np.cumsum(self.tally.new_visited) / (self.rollouts * self.tally.accessible)

    def largest(self, figure: str) -> float:
        """As in `Known`; of value, in UNITS."""
        return float({"value": UNITS, "lost": self.tally.robots}.get(figure, self.tally.accessible))

    def _controls(self, *columns: NDArray[np.int64]) -> CommonThresholds | None:
        """Sums of one or two columns by class of S; None for few rollouts and for the open loop."""
        n = len(columns[0])
        if self.seed is None or n < LEAST:
            return None
        return CommonThresholds.of(self.tally.robots, self._classes[:n], columns[0], columns[-1])

    @cached_property
    def _classes(self) -> NDArray[np.int64]:
        assert self.results is not None
        assert self.seed is not None
        return classes_by_threshold(self.seed, self.results.start, self.rollouts, self.tally.robots)


Measured = Known | Sampled
"""The result of a plan, exact or sampled."""


class Trial:
    """A plan in a world; gives its exact or sampled results up to the deadline of the choices."""

    def __init__(
        self,
        world: World,
        plan: Plan,
        choices: RolloutChoices,
        kept: AllPairs | None = None,
        loop: ClosedLoop | None = None,
    ) -> None:
        """`kept`: cache of all-pairs tables. `loop`: replaces the loop of the plan. Raises InputError."""
        if loop is None:
            plan = knowing_deadline(world, plan, choices, nominal=False)
        self.world, self.plan, self.choices = world, plan, choices
        self.certain = choices.loop == "open" and is_certain(world, plan, "open")
        self._known: Known | None = None
        self._looked = -1.0
        self._last: tuple[tuple[int, int], Sampled | None] = ((0, 0), None)
        self.loop = None
        if choices.loop == "closed":
            announce_compilation(plan)
            self.loop = loop or compile_closed_loop(plan, world, first_only=choices.first_only, kept=kept)

    @cached_property
    def _whole(self) -> Engine:
        if self.loop is None:
            return make_engine_for(self.world, self.plan, self.choices)
        return closed_loop_engine(self.loop, self.choices.seed, self.choices.engine)

    @cached_property
    def engine(self) -> Engine:
        """The engine, truncated at the deadline; in the closed loop it also sums visited value."""
        engine = self._whole if self.loop is None else weigh(self._whole, self.world)
        return engine if self.choices.deadline is None else engine.truncated_at(self.choices.deadline)

    def truncated_at(self, step: int | None) -> Trial:
        """The same trial, truncated at the end of `step`."""
        return Trial(self.world, self.plan, replace(self.choices, deadline=step), loop=self.loop)

    def with_threat(self, truth: World) -> Trial:
        """The same decisions, with the threats of `truth`, a map of the same cells."""
        return Trial(truth, self.plan, self.choices, loop=self.loop and self.loop.with_threat(truth))

    def known(self, share: float = 1.0) -> Known | None:
        """The exact result; None if it needs more than this `share` of the choices' exact seconds."""
        if self._known is None and share > self._looked:
            self._known, self._looked = self._exactly(self.choices.exact_seconds * share), share
        return self._known

    @cached_property
    def open_loop(self) -> OpenLoopExact | None:
        """The open loop's exact values by the deadline; None in the closed loop."""
        end = self.choices.deadline
        plan = self.plan if end is None else self.plan.truncated_at(end)
        return None if self.choices.loop == "closed" else open_loop_exact(plan, self.world)

    def stops(self, found: Measured) -> NDArray[np.float64]:
        """Expected number of robots lost in each cell, float64 `[N]`."""
        if isinstance(found, Sampled):
            return found.tally.stops / found.rollouts
        if self.open_loop is not None:
            return self.open_loop.stops_by_cell
        assert self.loop is not None
        return self.loop.on_grid(found.tree.counts.stops / WHOLE)

    def _exactly(self, seconds: float) -> Known | None:
        loop, end, cell_values, exact = self.loop, self.choices.deadline, CellValues.of(self.world), self.open_loop
        if exact is not None and not exact.is_known:
            raise PlanError("the open loop's exact values are not known for this team", fix="use fewer robots")
        if exact is not None:
            share = float(exact.visited_by_cell @ cell_values.value / cell_values.total)
            cells, robots = float(self.world.accessible(self.plan.starts).sum()), float(len(exact.survival))
            figures = {
                "visited": (exact.visited, cells), "survived": (exact.survived, cells), "alive": (exact.alive, robots),
                "lost": (exact.expected_losses, robots), "time": (exact.mean_time, len(exact.time_chance) - 1.0),
                "value": (share, 1.0),
            }  # fmt: skip
            value = None if self.world.value is None else (share, share)
            return KnownPaths(None, value, self.choices.metric, figures=figures)
        assert loop is not None
        tree = tree_of(loop if end is None else loop.truncated_at(end), seconds)
        if tree is None or (seconds == 0 and tree.counts.stops.any()):  # only if no robot can be lost
            return None
        if self.world.value is None:
            return Known(tree, metric=self.choices.metric)
        low, high = (
            float(chance @ cell_values.value[loop.cells]) / cell_values.total for chance in tree.cells("visited")
        )
        return Known(tree, (low, high), self.choices.metric)

    def sample(self, start: int, count: int) -> Sampled:
        """Rollouts `start .. start + count - 1` with single results; the last sample is cached."""
        asked, found = self._last
        if found is None or asked != (start, count):
            engine, seed = self.engine, self._threshold_seed
            ran = engine.run(start, count) if seed is None else run_with_threshold_sums(engine, seed, start, count)
            found = self._sampled(*ran)
            self._last = (start, count), found
        return found

    def roll(self, start: int, count: int, marks: Iterable[int]) -> Iterator[Sampled]:
        """Yield the sample after every chunk, also at the `marks`; single results only if the map has values."""
        parts: list[RolloutResults] = []
        valued = self._valued
        for chunk in run_chunks(
            self.engine, count, start=start, checkpoints=marks, results=valued, by_threshold=self._threshold_seed
        ):
            parts += [chunk.results] if valued and chunk.results is not None else []
            yield self._sampled(chunk.tally, RolloutResults.join(parts) if parts else None, chunk.seconds)

    def _sampled(self, tally: Tally, results: RolloutResults | None, seconds: float = 0.0) -> Sampled:
        how = self._threshold_seed, self._valued, self.certain, seconds, self.choices.metric
        return Sampled(tally, results, *how)

    @property
    def _threshold_seed(self) -> int | None:
        return None if self.loop is None else self.choices.seed

    @property
    def _valued(self) -> bool:
        return self.loop is not None and self.world.value is not None


def alike(trials: Sequence[Trial], start: int, count: int, share: float = 1.0) -> Sequence[Measured]:
    """Comparable results of trials: all exact, or all on the same rollouts.

    `share`: as in `Trial.known`.
    """
    known: list[Measured] = []
    for trial in trials:
        found = trial.known(share)
        if found is None:
            return [trial.sample(start, count) for trial in trials]
        known.append(found)
    return known
