"""Expected value covered, found and left (SPEC section 13).

The open loop's figures are exact. In the closed loop each rollout counts visits and survived visits of each cell up to
MOST_PASSES: `P(found in c) = sum_n P(n or more) d (1 - d)^(n - 1)`, from integer counts. Visits beyond MOST_PASSES are
known only as a mean, m for each run that makes MOST_PASSES. They add
`(1 - d)^MOST_PASSES P(MOST_PASSES or more) E[1 - (1 - d)^J]` with E[J] = m and integer J, which is largest if J is m
rounded down or up. The mean includes this largest value; the lower end of the interval includes none of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.estimators.trial import TreeTruth, mean_value, stated, units_of
from analysis.evaluation.figures import Elements, Output, Run
from analysis.page.elements import CellLayer
from analysis.sampling import make_engine_for
from analysis.statistics.estimates import TAIL, Estimate, at_least, exactly, in_unit, robots_left, tail_mean, times_to
from analysis.statistics.variance_reduction import LEAST, CommonThresholds, tally_mean
from analysis.theory.exact import CellValues, open_loop_found
from analysis.theory.upper_bound import MOST_CELLS, trimmed, value_bound
from analysis.utils.tables import make_table
from planner.arguments import argument
from planner.errors import UsageError
from planner.formatting import at_least_text, percent
from planner.rollouts.engine import run_ranges
from planner.rollouts.exact_tree import Tree
from planner.rollouts.threshold_classes import classes_by_threshold
from planner.simulator.state import MOST_PASSES
from planner.tally import Tally
from planner.world.world import World

# Value covered, found and left, and the measures of every field (SPEC section 13).


@dataclass(frozen=True)
class RouteLeft:
    """Expected value left on the route, and that of its worst cell.

    If the values are probabilities, the probability that something is left is the `risk`.
    """

    remaining: float
    worst: float
    json_keys = "remaining risk"

    @property
    def risk(self) -> tuple[float, float]:
        """Bounds of that probability: the worst cell's, and the sum, at most 1."""
        return self.worst, min(self.remaining, 1.0)


@dataclass(frozen=True, eq=False)
class Value(Output):
    """Value covered, found and left, of an evaluation. Axis `N` = H * W cells.

    Attributes:
        world: the map. cell_values: of its cells.
        covered, found: expected value of the cells visited, and of what is found.
        covered_by_cell, found_by_cell: float64 `[N]`, chance that the cell is visited, that what is in it is found.
        remainder: of `found`, not counted by visit. most: expected value that no strategy exceeds, or None.
        tally: of the evaluation. losses: expected robots lost. robots_left: P(at least 1, ..., K are left at the end).
    """

    world: World
    cell_values: CellValues
    covered: Estimate
    found: Estimate
    covered_by_cell: NDArray[np.float64]
    found_by_cell: NDArray[np.float64]
    remainder: float
    most: float | None
    tally: Tally
    losses: Estimate
    robots_left: list[Estimate]
    json_keys = """
        total=cell_values.total covered found left remainder any_strategy=most
        search.containment=containment search.detection=detection search.success=success
        clearance.cleared=cleared clearance.remaining=left.mean clearance.route=route_left
        square_metres per_robot_lost robots_left time_to cvar
    """

    @property
    def left(self) -> Estimate:
        """Expected value that is not found: the total of all free cells minus `found`."""
        total, (low, high) = self.cell_values.total, self.found.ci95
        return Estimate(total - self.found.mean, self.found.se, (total - high, total - low))

    @property
    def left_by_cell(self) -> NDArray[np.float64]:
        """float64 `[N]`: expected value left in each cell."""
        return self.cell_values.value * (1.0 - self.found_by_cell)

    @property
    def scale(self) -> float:
        """Factor that turns values into probabilities: 1 if they add up to at most 1, else one over their sum."""
        return 1.0 if self.cell_values.total <= 1 + 1e-6 else 1.0 / self.cell_values.total

    @property
    def detection(self) -> float | None:
        """Probability of detection: found divided by covered; None if nothing was covered."""
        return self.found.mean / self.covered.mean if self.covered.mean > 0 else None

    @property
    def containment(self) -> float:
        """Probability that the object is in a covered cell."""
        return self.covered.mean * self.scale

    @property
    def success(self) -> float:
        """Probability that the object is found."""
        return self.found.mean * self.scale

    @property
    def cleared(self) -> float:
        """The share of the value that is found."""
        return self.found.mean / self.cell_values.total

    @property
    def route_left(self) -> RouteLeft | None:
        """The value left on the route; None without a route."""
        if self.world.team.route is None:
            return None
        rows, cols = self.world.team.route.T
        left = self.left_by_cell[np.unique(rows * self.world.shape[1] + cols)]
        return RouteLeft(float(left.sum()), float(left.max()))

    @property
    def cvar(self) -> dict[float, float]:
        """Mean coverage of the worst share TAIL of the runs, a fraction of the accessible cells (CVaR)."""
        return {TAIL: tail_mean(self.tally.visited) / self.tally.accessible}

    @property
    def time_to(self) -> dict[float, int | None]:
        """The first step by whose end each share of the cells is visited on average; None: never."""
        return times_to(self.tally)

    @property
    def per_robot_lost(self) -> dict[str, float | None]:
        """Area and value covered, divided by the expected losses; None without losses."""
        amounts, lost = {"square_metres": self.square_metres, "value": self.covered.mean}, self.losses.mean
        return {name: amount / lost if lost > 0 else None for name, amount in amounts.items()}

    @property
    def square_metres(self) -> float:
        """Expected area visited, m2."""
        return float(self.covered_by_cell.sum()) * self.world.cell_size**2

    @classmethod
    def check(cls, asked: bool, world: World) -> None:
        world.require_certain_map("the value covered and found", ", or `value`, `detect` and `route`")

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        cell_values, tally, most = CellValues.of(run.world), run.last.tally, None
        bounded = not run.choices.first_only and run.world.uncertainty is None and run.plan.state is None
        bounded = bounded and run.plan.failure_model.is_plain
        if bounded and tally.accessible <= MOST_CELLS:
            most = value_bound(trimmed(run.world, run.plan), run.plan.starts)
        tree = run.closed if isinstance(run.closed, TreeTruth) else None
        if run.choices.loop == "open" or (run.closed is not None and tree is None and not run.certain):
            if run.world.uncertainty is not None:
                problem = "the value found in the open loop of an uncertain map is not known exactly"
                raise UsageError(problem, fix=f"use {argument('loop', 'closed')}")
            visited, found = run.exact.visited_by_cell, open_loop_found(run.plan, run.world)
            covered, known = (exactly(float(cell_values.value @ chance)) for chance in (visited, found))
            lost = exactly(run.exact.expected_losses)
            alive = [exactly(float(chance)) for chance in at_least(run.exact.alive_chance)]
            yield cls(run.world, cell_values, covered, known, visited, found, 0.0, most, tally, lost, alive)
            return
        if tree is not None and tree.masses is not None and cell_values.is_plain:
            n, chances = tree.masses.rollouts, (tree.masses.covered_visited, tree.masses.covered_survived)
            visited, found = (of / n for of in chances)
            found = cell_values.detect * found
            covered, known = (exactly(float(cell_values.value @ chance)) for chance in (visited, found))
            yield cls(run.world, cell_values, covered, known, visited, found, 0.0, most, tally, *_left(tree.tree))
            return
        run.doing("value covered and found")
        units = Units.of(cell_values)
        counted, columns = units.roll_out(run)
        found, rest = found_chances(counted, cell_values)
        covered, known = (units.estimate(column, run.certain, tally.robots, run.choices.seed) for column in columns)
        (low, high), total = known.ci95, cell_values.total
        # `rest` is an upper limit of the omitted visits: the lower end of the interval excludes it.
        least = low + rest if run.certain else low
        known = Estimate(min(known.mean + rest, total), known.se, (min(least, total), min(high + rest, total)))
        if run.certain:
            covered = exactly(float(cell_values.value @ (counted.covered_visited / counted.rollouts)))
        visited, lost = counted.covered_visited / counted.rollouts, tally_mean(tally, "lost", certain=run.certain)
        alive = robots_left(tally, run.certain)
        if tree is not None:
            lost, alive = _left(tree.tree)
            if tree.masses is not None:
                visited = tree.masses.covered_visited / tree.masses.rollouts
                covered = exactly(float(cell_values.value @ visited))
        yield cls(run.world, cell_values, covered, known, visited, found, rest, most, tally, lost, alive)

    def elements(self) -> Elements:
        beyond = (
            f"visits beyond the {MOST_PASSES}th of a cell find at most {self.remainder:.3g}: the mean includes it, "
            "the lower end of the interval does not"
        )
        means = self.cell_values.total, self.covered.mean, self.found.mean, self.left.mean
        lead = "Of {} in all, {} are covered and {} found on average; {} are left.".format(*map(amount, means))
        return Elements(
            leads=[lead], tables=[value_table(self)], notes=[beyond] * (self.remainder > 0),
            layers={"left.png": self.layer},
        )  # fmt: skip

    def layer(self) -> CellLayer:
        """The expected value left in each cell."""
        about = (
            f"Value times the probability that it is not found. {self.left.mean:.4g} of {self.cell_values.total:.4g}."
        )
        left = self.left_by_cell.reshape(self.world.shape)
        return CellLayer("Value left", about, left, "losses", root=True, blocks="sum", short="Left")


# The value output as a sentence and as a table.


def amount(value: float) -> str:
    """A value with four significant digits, or two decimals from 100 on."""
    return f"{value:,.2f}" if abs(value) >= 100 else f"{value:.4g}"


def value_table(value: Value) -> Table:
    """Value covered, found and left first, then the other figures."""
    rows = [*_value_rows(value), *_other_rows(value)]
    return make_table(("", "expected", "95 % interval"), "Value of the cells", rows)


def _value_rows(value: Value) -> Iterator[tuple[str, str, str]]:
    figures = {
        "value of all free cells": exactly(value.cell_values.total),
        "value covered (visited)": value.covered,
        "value found": value.found,
        "value left": value.left,
    }
    for name, estimate in figures.items():
        low, high = map(amount, estimate.ci95)
        yield name, amount(estimate.mean), "exact" if estimate.half_width == 0 else f"{low} .. {high}"
    if value.route_left is not None:
        yield "value left on the route", amount(value.route_left.remaining), ""


def _other_rows(value: Value) -> Iterator[tuple[str, str, str]]:
    robots = value.tally.robots
    if value.most is not None:
        yield "no strategy covers more on average (proven)", amount(value.most), ""
    yield "ground visited, m2", amount(value.square_metres), ""
    for name, ratio in zip(("m2", "value"), value.per_robot_lost.values(), strict=True):
        yield f"{name} covered per robot lost", "no robot is lost" if ratio is None else amount(ratio), ""
    for least in sorted({1, -(-robots // 2), robots}):
        mean, interval = value.robots_left[least - 1].columns(100, 100)
        yield f"chance that {at_least_text(least, robots)} left", f"{mean} %", in_unit(interval)
    for share, step in value.time_to.items():
        when = "never" if step is None else f"{step:,}{value.world.pace.also(step)}"
        yield f"steps to {100 * share:g} % of the cells, on average", when, ""
        if step is None:
            break
    yield f"coverage in the worst {100 * TAIL:g} % of runs (CVaR)", percent(value.cvar[TAIL], 2), ""


def _left(tree: Tree) -> tuple[Estimate, list[Estimate]]:
    """Robots lost, and the probabilities that at least 1, ..., K survive, from an exact tree."""
    robots, (least, most) = len(tree.counts.alive) - 1, tree.alive()
    chances = (stated(tree.chance(int(mass)), 1.0, 1.0) for mass in at_least(tree.counts.alive))
    return stated((robots - most, robots - least), 1.0, robots), list(chances)


@dataclass(frozen=True, eq=False)
class Units:
    """Values as integers (`analysis.estimators.trial`).

    Attributes:
        cell_values: value of the cells. covered: int64 `[N]`. found: int64 `[N, MOST_PASSES + 1]`, by survived visits.
    """

    cell_values: CellValues
    covered: NDArray[np.int64]
    found: NDArray[np.int64]

    @classmethod
    def of(cls, cell_values: CellValues) -> Self:
        """The integer contribution of each cell to the sums of a rollout."""
        share = units_of(cell_values)
        missed = (1.0 - cell_values.detect[:, None]) ** np.arange(MOST_PASSES + 1)
        return cls(
            cell_values, np.rint(share).astype(np.int64), np.rint(share[:, None] * (1.0 - missed)).astype(np.int64)
        )

    def roll_out(self, run: Run) -> tuple[Tally, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """Rerun the evaluation's ids: a tally with survived visits, and units covered and found, int64 `[B]` each."""
        engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept).with_cell_weights(
            self.covered, self.found
        )
        tally, parts, seconds, count = None, [], 0.0, run.last.tally.rollouts
        for start, size, (part, singles), took in run_ranges(engine.run, 0, count, unit=engine.least):
            tally, seconds = part if tally is None else tally + part, seconds + took
            parts.append((singles.value_covered, singles.value_found))
            run.progress(start + size, count, seconds)
        assert tally is not None
        covered, found = (np.concatenate(column) for column in zip(*parts, strict=True))
        return tally, (covered, found)

    def estimate(self, column: NDArray[np.int64], certain: bool, robots: int, seed: int) -> Estimate:
        """The mean of units `[B]` of rollouts 0 .. B - 1, as a value; `seed`: of their failure thresholds."""
        count, controls = len(column), None
        if count >= LEAST:
            controls = CommonThresholds.of(robots, classes_by_threshold(seed, 0, count, robots), column, column)
        return mean_value(column, self.cell_values.total, len(self.covered), certain, controls)


def found_chances(tally: Tally, cell_values: CellValues) -> tuple[NDArray[np.float64], float]:
    """P(found in c), float64 `[N]`, from counts of survived visits; and the largest error of the expected value."""
    at_least = tally.passes.reshape(-1, MOST_PASSES) / tally.rollouts
    counts, missed = tally.passes.reshape(-1, MOST_PASSES), 1.0 - cell_values.detect
    further = np.maximum(tally.visits - tally.stops - counts.sum(axis=1), 0) / np.maximum(counts[:, -1], 1)
    # E[1 - missed**J] for integer J with mean `further` is largest if J is one of its two neighbours.
    whole = np.floor(further)
    left = 1.0 - missed**whole * (1.0 - (further - whole) * cell_values.detect)
    rest = missed**MOST_PASSES * at_least[:, -1] * left
    return cell_values.detect * _weighted(at_least, missed) + rest, float(cell_values.value @ rest)


def _weighted(at_least: NDArray[np.float64], missed: NDArray[np.float64]) -> NDArray[np.float64]:
    """`sum_n at_least[c, n] missed[c]^n`, float64 `[N]`."""
    total = np.zeros(len(missed))
    for column in at_least.T[::-1]:
        total = column + missed * total
    return total
