"""What a tally comes to: every figure that is said of rollouts, estimated once; and outputs measured beside them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.estimators.trial import SLACK
from analysis.page.document import Chart, Series
from analysis.report.model import Pictured
from analysis.sampling import RollOut, RolloutChoices, Stage
from analysis.statistics.estimates import (
    AT_LEAST,
    MOST_DIGITS,
    Amount,
    Estimate,
    assured,
    between,
    exactly,
    losses_shown,
    mean_estimate,
    proportion,
    quantile,
    quantiles,
)
from analysis.statistics.variance_reduction import complete_chance, tally_mean
from analysis.theory.exact import OpenLoopExact
from analysis.theory.upper_bound import moves_left, within
from analysis.theory.verdicts import MEANINGS, ClosedTruth
from analysis.utils.notes import ProgressCallback
from planner.arguments import FRACTION
from planner.files import Json
from planner.formatting import Pace, Rows, html_of, in_percent, inside, text_of
from planner.plan.plan import Plan
from planner.rollouts.exact_tree import WHOLE, Tree
from planner.rollouts.tables import AllPairs
from planner.simulator.codes import Outcome
from planner.tally import Tally
from planner.world.world import World

if TYPE_CHECKING:
    from analysis.page.maps import CellLayer


# What a tally comes to: every figure that is said of rollouts, estimated once for words, tables, JSON and pictures.

ENDED = 0.999
"""Share of a closed loop's rollouts that have ended where a time axis ends."""
MOST_LISTED = 6
"""Robots of a team of which the chance that so many come home is listed for every number."""
CURVE = 121
"""Places of the curve of the chance to visit so much."""


@dataclass(frozen=True)
class Chance(Estimate):
    """A chance, from so many `rollouts`; 0: of all that can happen, and its interval is certain."""

    rollouts: int

    @staticmethod
    def known(low: float, high: float) -> Chance:
        """It is certain to lie between these."""
        return Chance((low + high) / 2, 0.0, (low, high), 0)

    @property
    def share(self) -> str:
        """In percent: "99.7 %"."""
        return f"{self.columns()[0]} %"

    def columns(self, scale: float = 100.0, most: int | None = 100) -> tuple[str, str]:
        """In percent, and its interval: ("0.3", "0.0 .. 0.9"), or ("0", "0.4 or less") where none was seen."""
        low, high = (scale * end for end in self.ci95)
        if self.rollouts == 0:
            digits, sure = min(self.digits(scale), 2), self.ci95[1] - self.ci95[0] <= SLACK
            ends = between(low, high, digits, most)
            return in_percent(self.mean, digits), "exact" if sure else f"{ends}, certain"
        seen = sampled_share(round(self.mean * self.rollouts), self.rollouts)
        if self.half_width == 0:
            return seen, "exact"
        return seen, between(low, high, max(self.digits(scale), len(seen.partition(".")[2])), most)


def sampled_share(count: int, runs: int) -> str:
    """`count` of `runs` in percent, with the decimals that the 95 % interval bears out; never rounded to 0 or 100.

    A share that these decimals cannot tell from 0 or 100 gets more of them, up to MOST_DIGITS, then "> 99.9999".
    """
    half = 100.0 * proportion(count, runs).half_width
    digits = int(np.clip(math.ceil(-math.log10(half)), 0, MOST_DIGITS))
    return inside(Fraction(100 * count, runs), 100, digits, MOST_DIGITS)


@dataclass(frozen=True)
class Losses(Estimate):
    """Robots lost of so many `robots`."""

    robots: int

    @property
    def decimals(self) -> int:
        """As many as are shown, two at most."""
        return min(self.digits(), 2)

    def columns(self, scale: float = 1.0, most: int | None = None) -> tuple[str, str]:
        """("1.87 of 5", "1.85 .. 1.89"), as of `losses_shown`."""
        return losses_shown(self, self.robots)


@dataclass(frozen=True)
class AtHome(Estimate):
    """Robots that are home at the end, alive. `at_least`: the chance of 0, 1, ..., K or more of them."""

    at_least: tuple[Chance, ...]

    @classmethod
    def of(cls, counts: NDArray[np.int64], certain: bool) -> Self:
        """Of a histogram `[K + 1]` of rollouts."""
        runs, more = int(counts.sum()), counts[::-1].cumsum()[::-1].tolist()
        chances = (Chance(**vars(proportion(often, runs, certain)), rollouts=runs) for often in more)
        return cls(**vars(mean_estimate(counts, 1.0, certain=certain)), at_least=tuple(chances))

    def with_tree(self, tree: Tree) -> Self:
        """The same, of all that can happen where that is known."""
        mean = tree.mean_home
        chances = tuple(Chance.known(*tree.chance_home(least)) for least in range(len(self.at_least)))
        return replace(self, **({} if mean is None else vars(exactly(mean))), at_least=chances)

    @property
    def robots(self) -> int:
        """K."""
        return len(self.at_least) - 1

    @property
    def shown(self) -> dict[int, Chance]:
        """Of the whole team first, then of ever fewer; of large teams some."""
        few = {math.ceil(x * self.robots) for x in AT_LEAST} | {1}
        shown = range(self.robots, 0, -1) if self.robots <= MOST_LISTED else sorted(few, reverse=True)
        return {least: self.at_least[least] for least in shown}

    def to_json(self) -> Json:
        chances = {str(least): chance.to_json() for least, chance in enumerate(self.at_least) if least}
        return super().to_json() | {"robots": self.robots, "at_least": chances}


@dataclass(frozen=True, eq=False)
class Covered:
    """Coverage in one meaning.

    Attributes:
        counts: int64 `[cells + 1]`, rollouts by cells covered, or masses; what a tree left, with the least it covers.
        mean: cells. certain: every run is the same.
        known: the chance to cover so many cells or more, at least and at most, of a tree; None: of rollouts.
    """

    counts: NDArray[np.int64]
    mean: Estimate
    certain: bool
    known: Callable[[int], tuple[float, float]] | None = None

    @classmethod
    def of_tree(cls, tree: Tree, meaning: str) -> Self:
        """Of all that can happen."""
        counts = getattr(tree.counts, meaning) + getattr(tree.counts, f"left_{meaning}")
        low, high = tree.covered(meaning)
        return cls(counts, exactly((low + high) / 2), False, partial(tree.chance_of, meaning))

    def in_order(self, chances: NDArray[np.float64]) -> Self:
        """Of one robot, which covers its cells in the order of their `chances` `[N]`: the n-th is that of n or more."""
        least = np.concatenate([[1.0], np.sort(chances)[::-1][: self.cells], [0.0]])
        mass = np.rint(-np.diff(least) * WHOLE).astype(np.int64)
        return replace(self, counts=mass, known=lambda cells: (float(least[cells]), float(least[cells])))

    @property
    def cells(self) -> int:
        """Accessible cells."""
        return len(self.counts) - 1

    @cached_property
    def quantiles(self) -> dict[float, float]:
        """Cells in single runs; NaN of what so few do not tell."""
        return quantiles(self.counts, 1, self.certain)

    def chance(self, cells: int) -> Chance:
        """The chance to cover so many or more."""
        if self.known is not None:
            return Chance.known(*self.known(cells))
        covered, rollouts = int(self.counts[cells:].sum()), int(self.counts.sum())
        return Chance(**vars(proportion(covered, rollouts, self.certain)), rollouts=rollouts)

    def chance_of_share(self, fraction: float) -> Chance:
        """The chance to cover that fraction of the accessible cells or more."""
        return self.chance(math.ceil(fraction * self.cells - 1e-9))

    @cached_property
    def at_least(self) -> dict[float, Chance]:
        """Of AT_LEAST."""
        return {x: self.chance_of_share(x) for x in AT_LEAST}

    @cached_property
    def curve(self) -> tuple[NDArray[np.int64], list[Chance]]:
        """Cells, and the chance to cover so many or more, from what all rollouts covered to what none did."""
        held = np.flatnonzero(self.counts)
        first, last = max(int(held[0]) - 1, 0), min(int(held[-1]) + 1, self.cells)
        at = np.unique(np.linspace(first, last, CURVE).round().astype(np.int64))
        return at, [self.chance(int(cell)) for cell in at]

    def to_json(self) -> Json:
        """Fractions of the accessible cells."""
        return self.mean.times(1.0 / self.cells).to_json() | {
            "quantiles": {f"{q:g}": value * (1.0 / self.cells) for q, value in self.quantiles.items()},
            "at_least": {f"{x:g}": chance.to_json() for x, chance in self.at_least.items()},
        }


@dataclass(frozen=True, eq=False)
class Coverage(Estimate):
    """Coverage of a loop: its mean, a fraction of the accessible cells, and how single runs scatter around it."""

    covered: Covered

    @property
    def cells(self) -> float:
        """The mean in cells."""
        return self.mean * self.covered.cells

    def quantile(self, q: float) -> float:
        """The least fraction that a share `q` of the runs does not exceed: 0.05 for what 95 % of runs reach."""
        FRACTION.check("q", q)
        return quantile(self.covered.counts, q) / self.covered.cells

    def at_least(self, fraction: float) -> Chance:
        """The chance to cover that fraction or more."""
        FRACTION.check("fraction", fraction)
        return self.covered.chance_of_share(fraction)


@dataclass(frozen=True, eq=False)
class Figures:
    """Of rollouts, as they tell; of a tree what it tells.

    Attributes:
        visited, survived: coverage. complete: the chance to visit every accessible cell.
        ends: the chances of those outcomes that some rollouts had. left: of 0, ..., K robots at the end.
        some_left: the chance that a robot is left. alive, losses: robots that are, and those that are not.
        home: robots that are home at the end; None: they need not come home.
        time: steps. assured: cells that 95 % of all runs visit, sure with 95 %; None: too few rollouts to say.
    """

    visited: Covered
    survived: Covered
    complete: Chance
    ends: dict[Outcome, Chance]
    left: list[Chance]
    some_left: Chance
    alive: Estimate
    losses: Losses
    time: Estimate
    assured: int | None
    home: AtHome | None = None

    @classmethod
    def of(cls, tally: Tally, certain: bool, longest: int | None = None, home: NDArray[np.int64] | None = None) -> Self:
        """Of a tally; `certain`: every run is the same. `longest`: steps that a run takes at most, if it is known.

        `home`: int64 `[K + 1]`, rollouts by robots home at the end, where robots come home.
        """
        runs = tally.rollouts

        def mean(figure: str, most: int | None = None) -> Estimate:
            return tally_mean(tally, figure, 1.0, most, certain)

        def chance(estimate: Estimate) -> Chance:
            return Chance(**vars(estimate), rollouts=runs)

        visited, survived = (Covered(getattr(tally, meaning), mean(meaning), certain) for meaning in MEANINGS)
        seen = {outcome: int(tally.outcomes[outcome]) for outcome in Outcome}
        return cls(
            visited=visited,
            survived=survived,
            complete=chance(complete_chance(tally, certain)),
            ends={outcome: chance(proportion(count, runs)) for outcome, count in seen.items() if count},
            left=[chance(proportion(int(count), runs)) for count in tally.alive],
            some_left=chance(proportion(runs - int(tally.alive[0]), runs)),
            alive=mean("alive"),
            losses=Losses(**vars(mean("lost")), robots=tally.robots),
            time=mean("time", longest),
            assured=assured(tally.visited),
            home=None if home is None else AtHome.of(home, certain),
        )

    def with_tree(self, tree: Tree) -> Self:
        """The same, of all that can happen where that is known."""
        counts, alive = tree.counts, tree.mean_alive
        ends = {outcome: int(counts.outcomes[outcome]) for outcome in Outcome}
        known = replace(
            self,
            visited=Covered.of_tree(tree, "visited"),
            survived=Covered.of_tree(tree, "survived"),
            complete=Chance.known(*tree.chance_complete()),
            ends={outcome: Chance.known(*tree.chance(mass)) for outcome, mass in ends.items() if mass},
            left=[Chance.known(*tree.chance(int(mass))) for mass in counts.alive],
            some_left=Chance.known(*tree.chance_left()),
            assured=tree.quantile("visited", 0.05)[0],
            home=None if self.home is None else self.home.with_tree(tree),
        )
        if alive is not None:
            robots = self.losses.robots
            known = replace(known, alive=exactly(alive), losses=Losses(**vars(exactly(robots - alive)), robots=robots))
        return known if tree.mean_time is None else replace(known, time=exactly(tree.mean_time))

    def with_means(self, visited: float, survived: float, lost: float) -> Self:
        """The same, with means that are known, NaN: not; cells, and robots lost."""
        known = {name: getattr(self, name) for name in MEANINGS}
        for name, cells in zip(MEANINGS, (visited, survived), strict=True):
            if math.isfinite(cells):
                known[name] = replace(known[name], mean=exactly(cells))
        if not math.isfinite(lost):
            return replace(self, **known)
        robots = self.losses.robots
        return replace(self, **known, alive=exactly(robots - lost), losses=Losses(**vars(exactly(lost)), robots=robots))

    def with_formulas(self, exact: OpenLoopExact, time: float | None) -> Self:
        """The same, where robots follow their own paths to the end, as far as `exact` and `time` are known."""
        robots, lost = self.losses.robots, exact.expected_losses
        if exact.survival.sum() > 0:  # however little it is
            lost = min(lost, math.nextafter(robots, 0.0))
        known = self.with_means(exact.visited, exact.survived, lost)
        if math.isfinite(exact.some_left):
            left = [Chance.known(chance, chance) for chance in exact.alive_chance.tolist()]
            known = replace(known, left=left, some_left=Chance.known(exact.some_left, exact.some_left))
        if exact.is_known and robots == 1:
            visited = known.visited.in_order(exact.visited_by_cell)
            survived = known.survived.in_order(exact.survived_by_cell)
            complete, least = visited.chance(visited.cells), quantile(visited.counts, 0.05)
            known = replace(known, visited=visited, survived=survived, complete=complete, assured=least)
        return known if time is None or not math.isfinite(time) else replace(known, time=exactly(time))

    def coverage_json(self) -> Json:
        """In both meanings."""
        return {meaning: getattr(self, meaning).to_json() for meaning in MEANINGS}


def last_shown(plan: Plan, loop: str, tally: Tally) -> int:
    """Where a time axis ends: the makespan; of a closed loop at least where 99.9 % of its rollouts have ended."""
    return plan.makespan if loop == "open" else max(plan.makespan, quantile(tally.time, ENDED))


# Expected values and bounds of an evaluated plan, as far as they are known.


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected values of the loop that was evaluated, for tables and pictures: exact ones where there are any.

    Attributes:
        visited_by_cell: float64 `[N]`, chance that each cell is visited. stops_by_cell: robots lost there.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
    """

    visited_by_cell: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]

    @property
    def visited(self) -> float:
        """Expected cells visited."""
        return float(self.visited_by_cell.sum())


@dataclass(frozen=True)
class Known:
    """Expected values that are known exactly: coverage in both meanings, robots alive at the end, steps; None: not."""

    visited: Amount | None
    survived: Amount | None
    alive: float | None
    time: float | None


LIMITS = {
    "least": "the smallest of those below that hold for this team",
    "any_strategy": "no strategy of this team exceeds it on this map (proven)",
    "ideal": "no strategy of this team exceeds it on any map with these p: ways cost nothing",
    "ideal_one": "the same for one robot, eq. (7) of the paper; a team may exceed it",
}
"""What the bounds of `Limits` mean, a line each."""


@dataclass(frozen=True, repr=False)
class Limits:
    """Expected coverage that no strategy exceeds; a single run may.

    Attributes:
        least: the least of the bounds that hold. any_strategy: the certified bound of this map; None: not worked out.
        ideal: of the team. ideal_one: of one robot, eq. (7).
    """

    least: Amount
    any_strategy: Amount | None
    ideal: Amount
    ideal_one: Amount

    def _brief(self) -> tuple[str, Rows]:
        """A line for each bound: its name, its value rounded upwards, and what it means."""
        rows = [(name, f"{_upwards(getattr(self, name))}: {meaning}") for name, meaning in LIMITS.items()]
        return "Limits: upper bounds of the mean coverage; a single mission may cover more", rows

    def __repr__(self) -> str:
        return text_of(*self._brief())

    def _repr_html_(self) -> str:
        return html_of(*self._brief())


def _upwards(bound: Amount | None) -> str:
    """A bound from above in two decimals, never less than it is but by what a float is wrong by."""
    if bound is None:
        return "not computed (bound=True computes it where it applies)"
    share, cells = (math.ceil(100 * value - 1e-9) / 100 for value in (100 * bound.mean, bound.cells))
    return f"{share:.2f} % ({cells:,.2f} cells)"


# What a range cuts off, and what a mission's state leaves: cells and robots, for the page and the picture.

TO_DO, BEFORE, BEYOND = range(3)


@dataclass(frozen=True, eq=False)
class Rest:
    """Of a plan with a range, or from a state.

    Attributes:
        kinds: int64 `[H, W]`, of accessible cells: TO_DO; BEFORE, visited in the state; BEYOND, further than any robot
            alive has moves for, there and, of robots that come home, back. returns: they come home.
        step: of the state; None: it is the whole mission.
        limited: there is a range. ended: robots at the end of theirs in the nominal run.
        pace: how long a step takes, if that is known.
    """

    kinds: NDArray[np.int64]
    returns: bool
    step: int | None
    limited: bool
    ended: int
    pace: Pace

    @property
    def title(self) -> str:
        """Of the section and the picture."""
        parts = [] if self.step is None else [f"Going on from {self.pace.step(self.step)}"]
        return ", ".join([*parts, *["what the range leaves" if parts else "What the range leaves"] * self.limited])

    @property
    def too_far(self) -> str:
        """What makes a cell too far, for sentences."""
        return "too far for any robot to visit and come home" if self.returns else "too far for the moves of any robot"


NAMES = ("to do", "visited before", "too far")
"""Of the kinds, in order."""


def rest_of(world: World, plan: Plan) -> Rest | None:
    """What is left of a plan's mission; None for a whole one of robots that can drive without end."""
    moves = moves_left(plan)
    if plan.state is None and moves is None:
        return None
    accessible = world.accessible(plan.starts)
    kinds = np.full(world.shape, TO_DO)
    if moves is not None:
        kinds[accessible & ~within(world, plan)] = BEYOND
    if plan.state is not None:
        kinds.reshape(-1)[plan.state.visited] = BEFORE
    made = [int((np.diff(robot.path) != 0).sum()) for robot in plan.robots]
    ended = 0 if moves is None else sum(own >= most for own, most in zip(made, moves, strict=True))
    step = None if plan.state is None else plan.state.step
    return Rest(kinds, plan.comes_home, step, moves is not None, ended, world.pace)


# What an output of `evaluate` is: measured beside rollouts that were done, then only written down.


@dataclass(frozen=True, eq=False)
class Run:
    """The rollouts that were done, for an output to measure more in.

    Attributes:
        world, plan, choices: what was rolled out. last: where it stands. roll_out: rolls it out again.
        exact: the open loop's expected values. closed: the closed loop's where they are known exactly, else None.
        certain: every run is the same. kept: tables for other plans of this map.
        progress, doing: told how far it has come, and in words what begins.
    """

    world: World
    plan: Plan
    choices: RolloutChoices
    last: Stage
    roll_out: RollOut
    exact: OpenLoopExact
    closed: ClosedTruth | None
    certain: bool
    kept: AllPairs
    progress: ProgressCallback
    doing: Callable[[str], None]


class Row(NamedTuple):
    """A row of the table of coverage, in percent: the open loop's exact value, and what stands in the other columns."""

    name: str
    exact: str
    shown: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Blocks:
    """What an output adds to the report of an evaluation, which every medium shows.

    Attributes:
        opens: sentences right after the headline. alternatives: what other settings achieve, after them. leads: then.
        rows: of the table of coverage. tables: below it. notes: below all of them.
        curves, marks: of the chart of coverage over time, in percent of the accessible cells, and its upright lines.
        below: charts below the answer. layers: of the maps cell by cell, each a picture by this name.
        pictures, files: as of `Report`. settings: what was asked for.
    """

    opens: Sequence[str] = ()
    alternatives: Sequence[str] = ()
    leads: Sequence[str] = ()
    rows: Sequence[Row] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    curves: Sequence[Series] = ()
    marks: Sequence[tuple[float, str]] = ()
    below: Sequence[Chart] = ()
    layers: Mapping[str, Callable[[], CellLayer]] = field(default_factory=dict)
    pictures: Mapping[str, Callable[[], Pictured]] = field(default_factory=dict)
    files: Mapping[str, Callable[[], str | bytes]] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)


class Output(ABC):
    """What was found of one output. A subclass states `measure`, its value in JSON, and its blocks of the report."""

    own_rollouts = True
    """It rolls out more, so that it is left out after an interruption."""
    late = True
    """The summary and the tables of coverage and chances do without it: they are shown before it is measured."""

    @classmethod
    def check(cls, asked: Any, world: World) -> None:
        """Raise UsageError for what cannot be measured in this world, before anything is rolled out."""
        return

    @classmethod
    @abstractmethod
    def measure(cls, asked: Any, run: Run) -> Iterator[Self]:
        """What is found, whole or, for a start, in part; each replaces the one before. `asked`: the option's value."""

    def as_json(self) -> object:
        """Its value in the JSON object; None: it is not in it."""
        return None

    def blocks(self) -> Blocks:
        """What it adds to the report."""
        return Blocks()


def coverage_row(name: str, covered: Covered, of: int, exact: float) -> Row:
    """Coverage in percent of `of` cells, beside the open loop's `exact` cells."""
    unit = 100.0 / of
    runs = (in_percent(cells / of, 1) for cells in covered.quantiles.values())
    return Row(name, in_percent(exact / of, 2), (*covered.mean.columns(unit, 100), *runs))


def known_words(value: float, form: str = "{:.2f}") -> str:
    """A number that is known; nothing where it is not (NaN)."""
    return "" if math.isnan(value) else form.format(value)
