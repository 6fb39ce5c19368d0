"""Figures of a tally, each estimated once; expected values and bounds; and the interface of the outputs."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.estimators.trial import SLACK, Measured, stated
from analysis.page.elements import CellLayer, Chart, Series
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
    of_all,
    proportion,
    quantile,
    quantiles,
)
from analysis.statistics.variance_reduction import complete_chance, tally_mean
from analysis.theory.exact import OpenLoopExact
from analysis.theory.upper_bound import moves_left, within
from analysis.theory.verdicts import MEANINGS, ClosedTruth
from analysis.utils.notes import ProgressCallback
from analysis.utils.tables import Column, in_percents, table_of
from planner.arguments import FRACTION
from planner.files import Json
from planner.formatting import Pace, Rows, html_of, in_percent, inside, percent, text_of
from planner.json_objects import as_json
from planner.plan.plan import Plan
from planner.rollouts.exact_tree import WHOLE, Tree
from planner.rollouts.tables import AllPairs
from planner.simulator.codes import Outcome
from planner.tally import Tally
from planner.world.world import World

# Figures of a tally: estimated once for text, tables, JSON and pictures.

ENDED = 0.999
"""Quantile of the end of closed-loop rollouts at which a time axis ends."""
MOST_LISTED = 6
"""Largest team for which the probability of every number of returned robots is listed."""
CURVE = 121
"""Points of the curve of the probability of a coverage."""


@dataclass(frozen=True)
class Chance(Estimate):
    """A probability, from `rollouts`; 0 rollouts: from all possible histories, with a certain interval."""

    rollouts: int

    @staticmethod
    def known(low: float, high: float) -> Chance:
        """A probability that certainly lies between the two values."""
        return Chance((low + high) / 2, 0.0, (low, high), 0)

    @property
    def share(self) -> str:
        """In percent: "99.7 %"."""
        return f"{self.columns()[0]} %"

    def columns(self, scale: float = 100.0, most: int | None = 100) -> tuple[str, str]:
        """In percent, and its interval: ("0.3", "0.0 .. 0.9"), or ("0", "0.4 or less") if no rollout counts."""
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
    """`count` of `runs` in percent, with the decimals of the 95 % interval; never rounded to 0 or 100.

    A share that these decimals cannot distinguish from 0 or 100 gets more of them, up to MOST_DIGITS: "> 99.9999".
    """
    half = 100.0 * proportion(count, runs).half_width
    digits = int(np.clip(math.ceil(-math.log10(half)), 0, MOST_DIGITS))
    return inside(Fraction(100 * count, runs), 100, digits, MOST_DIGITS)


@dataclass(frozen=True)
class Losses(Estimate):
    """Robots lost of `robots`."""

    robots: int

    @property
    def decimals(self) -> int:
        """Number of decimals that are shown, two at most."""
        return min(self.digits(), 2)

    def columns(self, scale: float = 1.0, most: int | None = None) -> tuple[str, str]:
        """("1.87 of 5", "1.85 .. 1.89"), as in `losses_shown`."""
        return losses_shown(self, self.robots)


@dataclass(frozen=True)
class AtHome(Estimate):
    """Robots that have returned at the end, alive. `at_least`: the probability of at least 0, 1, ..., K of them."""

    at_least: tuple[Chance, ...]
    json_keys = "robots at_least=chances"

    @classmethod
    def of(cls, counts: NDArray[np.int64], certain: bool) -> Self:
        """From a histogram `[K + 1]` of rollouts."""
        runs, more = int(counts.sum()), counts[::-1].cumsum()[::-1].tolist()
        chances = (Chance(**vars(proportion(often, runs, certain)), rollouts=runs) for often in more)
        return cls(**vars(mean_estimate(counts, 1.0, certain=certain)), at_least=tuple(chances))

    def with_tree(self, tree: Tree) -> Self:
        """The same with the tree's exact values, where they are known."""
        mean = tree.mean_home
        chances = tuple(Chance.known(*tree.chance_home(least)) for least in range(len(self.at_least)))
        return replace(self, **({} if mean is None else vars(exactly(mean))), at_least=chances)

    def columns(self, scale: float = 1.0, most: int | None = None) -> tuple[str, str]:
        """("1.87 of 5", "1.85 .. 1.89"), as in `losses_shown`."""
        return losses_shown(self, self.robots)

    @property
    def robots(self) -> int:
        """Size K of the team."""
        return len(self.at_least) - 1

    @property
    def shown(self) -> dict[int, Chance]:
        """The probabilities by number of robots, from K downwards; a selection for large teams."""
        few = {math.ceil(x * self.robots) for x in AT_LEAST} | {1}
        shown = range(self.robots, 0, -1) if self.robots <= MOST_LISTED else sorted(few, reverse=True)
        return {least: self.at_least[least] for least in shown}

    @property
    def chances(self) -> dict[int, Chance]:
        """The probability that at least 1, ..., K robots have returned."""
        return dict(enumerate(self.at_least[1:], start=1))


@dataclass(frozen=True, eq=False)
class Covered:
    """Coverage in one meaning (visited or survived).

    Attributes:
        counts: int64 `[cells + 1]`, rollouts by cells covered. Of a tree: masses; unexplored histories count with the
            least that they cover.
        mean: cells. certain: all runs are equal.
        known: bounds of the probability to cover at least n cells, from a tree; None: sampled.
    """

    counts: NDArray[np.int64]
    mean: Estimate
    certain: bool
    known: Callable[[int], tuple[float, float]] | None = None
    json_keys = "*share quantiles=quantile_shares at_least=known_at_least"

    @classmethod
    def of_tree(cls, tree: Tree, meaning: str) -> Self:
        """From an exact tree."""
        counts = getattr(tree.counts, meaning) + getattr(tree.counts, f"left_{meaning}")
        mean = stated(tree.covered(meaning), 1.0, len(counts) - 1.0)
        return cls(counts, mean, False, partial(tree.chance_of, meaning))

    def in_order(self, chances: NDArray[np.float64]) -> Self:
        """For one robot with coverage probabilities `[N]`: it covers its cells in descending order of them.

        The n-th largest probability is therefore that of covering at least n cells.
        """
        least = np.concatenate([[1.0], np.sort(chances)[::-1][: self.cells], [0.0]])
        mass = np.rint(-np.diff(least) * WHOLE).astype(np.int64)
        return replace(self, counts=mass, known=lambda cells: (float(least[cells]), float(least[cells])))

    @property
    def cells(self) -> int:
        """Number of accessible cells."""
        return len(self.counts) - 1

    @cached_property
    def quantiles(self) -> dict[float, float]:
        """Quantiles in cells; NaN if the rollouts are too few."""
        return quantiles(self.counts, 1, self.certain)

    def chance(self, cells: int) -> Chance:
        """The probability to cover at least so many cells."""
        if self.known is not None:
            return Chance.known(*self.known(cells))
        covered, rollouts = int(self.counts[cells:].sum()), int(self.counts.sum())
        return Chance(**vars(proportion(covered, rollouts, self.certain)), rollouts=rollouts)

    def chance_of_share(self, fraction: float) -> Chance:
        """The probability to cover at least this fraction of the accessible cells."""
        # 1e-9: rounding must not raise a whole number of cells to the next one.
        return self.chance(math.ceil(fraction * self.cells - 1e-9))

    @cached_property
    def at_least(self) -> dict[float, Chance]:
        """The probability to cover each fraction of AT_LEAST."""
        return {x: self.chance_of_share(x) for x in AT_LEAST}

    @cached_property
    def curve(self) -> tuple[NDArray[np.int64], list[Chance]]:
        """Cells, and the probability to cover at least so many, over the range of the counts."""
        held = np.flatnonzero(self.counts)
        first, last = max(int(held[0]) - 1, 0), min(int(held[-1]) + 1, self.cells)
        at = np.unique(np.linspace(first, last, CURVE).round().astype(np.int64))
        return at, [self.chance(int(cell)) for cell in at]

    @property
    def known_at_least(self) -> dict[float, Chance] | None:
        """The probability to cover each fraction of AT_LEAST; None if only the mean is known."""
        return self.at_least if self.counts.any() else None

    @property
    def share(self) -> Estimate:
        """The mean, a fraction of the accessible cells."""
        return self.mean.times(1.0 / self.cells)

    @property
    def quantile_shares(self) -> dict[float, float]:
        """Quantiles, fractions of the accessible cells; NaN if the rollouts are too few."""
        return {q: value * (1.0 / self.cells) for q, value in self.quantiles.items()}


@dataclass(frozen=True, eq=False)
class Coverage(Estimate):
    """Coverage of a loop: mean, a fraction of the accessible cells, and the distribution over single runs."""

    covered: Covered

    @property
    def cells(self) -> float:
        """The mean in cells."""
        return self.mean * self.covered.cells

    def quantile(self, q: float) -> float:
        """The `q` quantile of coverage over runs, a fraction of the cells: 95 % of runs reach `quantile(0.05)`."""
        FRACTION.check("q", q)
        return quantile(self.covered.counts, q) / self.covered.cells

    def at_least(self, fraction: float) -> Chance:
        """The probability to cover at least that fraction of the accessible cells."""
        FRACTION.check("fraction", fraction)
        return self.covered.chance_of_share(fraction)


def in_table(title: str, exact: Callable[[OpenLoopExact], str] = lambda known: "", scaled: str = "") -> Json:
    """Metadata of a field of `Figures` that has a row in the table and a key in the JSON object.

    Args:
        title: of its row. exact: the open loop's exact value as text.
        scaled: title of a second row in minutes, of a time where the length of a step is known.
    """
    return {"title": title, "exact": exact, "scaled": scaled}


def exact_losses(known: OpenLoopExact) -> str:
    """The expected number of robots lost in the open loop, as text."""
    lost, robots = known.expected_losses, len(known.survival)
    return "" if math.isnan(lost) else f"{of_all(lost, robots)} of {robots}"


@dataclass(frozen=True, eq=False, kw_only=True)
class Figures:
    """Figures of rollouts, or of an exact tree; a new one is a field and its value in `of`.

    Attributes:
        visited, survived: coverage. delivered: of cells delivered (SPEC section 19), None: not counted; teams in the
            open loop have its mean alone. complete: probability to visit every accessible cell.
        ends: probabilities of the outcomes that occurred. left: of 0, ..., K robots alive at the end.
        some_left: probability that a robot survives. alive, losses: robots alive and robots lost at the end.
        home: robots that have returned at the end; None: they need not return.
        time: steps. assured: cells that 95 % of all runs visit, with 95 % confidence; None: too few rollouts.
    """

    visited: Covered
    survived: Covered
    delivered: Covered | None
    complete: Chance = field(metadata=in_table("chance to visit every cell"))
    ends: dict[Outcome, Chance]
    left: list[Chance]
    some_left: Chance = field(metadata=in_table("chance that a robot survives", lambda of: in_percent(of.some_left, 2)))
    alive: Estimate
    losses: Losses = field(metadata=in_table("robots lost", exact_losses))
    home: AtHome | None = field(metadata=in_table("robots back at base"))
    time: Estimate = field(
        metadata=in_table("time, steps", lambda of: known_text(of.mean_time, "{:,.1f}"), "time, minutes")
    )
    assured: int | None

    @classmethod
    def of(cls, tally: Tally, certain: bool, longest: int | None = None, home: NDArray[np.int64] | None = None) -> Self:
        """From a tally.

        Args:
            tally: the counts. certain: all runs are equal. longest: most steps of a run, if known.
            home: int64 `[K + 1]`, rollouts by number of returned robots, if robots return to base.
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
            delivered=Covered(tally.delivered, mean("delivered"), certain) if len(tally.delivered) else None,
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
        """The same with the tree's exact values, where they are known."""
        counts, alive = tree.counts, tree.mean_alive
        ends = {outcome: int(counts.outcomes[outcome]) for outcome in Outcome}
        known = replace(
            self,
            visited=Covered.of_tree(tree, "visited"),
            survived=Covered.of_tree(tree, "survived"),
            delivered=Covered.of_tree(tree, "delivered") if len(counts.delivered) else None,
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
        """The same with known means; cells and robots, NaN if unknown."""
        known = {name: getattr(self, name) for name in MEANINGS}
        for name, cells in zip(MEANINGS, (visited, survived), strict=True):
            if math.isfinite(cells):
                known[name] = replace(known[name], mean=exactly(cells))
        if not math.isfinite(lost):
            return replace(self, **known)
        robots = self.losses.robots
        return replace(self, **known, alive=exactly(robots - lost), losses=Losses(**vars(exactly(lost)), robots=robots))

    def with_delivered(self, exact: OpenLoopExact) -> Self:
        """The same with the exact number of cells delivered by robots that follow their own paths, if it is known."""
        if not math.isfinite(exact.delivered):
            return self
        found = self.delivered or Covered(np.zeros_like(self.visited.counts), exactly(0.0), False)
        found = replace(found, mean=exactly(exact.delivered))
        alone = self.losses.robots == 1
        return replace(self, delivered=found.in_order(exact.delivered_by_cell) if alone else found)

    def with_formulas(self, exact: OpenLoopExact, time: float | None) -> Self:
        """The same with the exact values of robots that follow their own paths; `time`: steps, or None."""
        robots, lost = self.losses.robots, exact.expected_losses
        if exact.survival.sum() > 0:  # some robot may survive, even if rounding hides it
            lost = min(lost, math.nextafter(robots, 0.0))
        known = self.with_delivered(exact).with_means(exact.visited, exact.survived, lost)
        if math.isfinite(exact.some_left):
            left = [Chance.known(chance, chance) for chance in exact.alive_chance.tolist()]
            known = replace(known, left=left, some_left=Chance.known(exact.some_left, exact.some_left))
        if exact.is_known and robots == 1:
            visited = known.visited.in_order(exact.visited_by_cell)
            survived = known.survived.in_order(exact.survived_by_cell)
            complete, least = visited.chance(visited.cells), quantile(visited.counts, 0.05)
            known = replace(known, visited=visited, survived=survived, complete=complete, assured=least)
        return known if time is None or not math.isfinite(time) else replace(known, time=exactly(time))

    @property
    def coverage(self) -> dict[str, Covered]:
        """Coverage by meaning."""
        return {meaning: getattr(self, meaning) for meaning in self.meanings}

    @property
    def meanings(self) -> tuple[str, ...]:
        """Names of the fields of coverage that are known."""
        return MEANINGS if self.delivered is None else (*MEANINGS, "delivered")


def last_shown(plan: Plan, loop: str, tally: Tally) -> int:
    """Last step of a time axis: the makespan; of a closed loop at least the ENDED quantile of the rollouts' ends."""
    return plan.makespan if loop == "open" else max(plan.makespan, quantile(tally.time, ENDED))


# Expected values and bounds of an evaluated plan, where they are known.


@dataclass(frozen=True, eq=False)
class Expected:
    """Expected values of the evaluated loop, for tables and pictures: exact if known, else means of rollouts.

    Attributes:
        visited_by_cell: float64 `[N]`, probability that each cell is visited. stops_by_cell: robots lost there.
        visited_curve, survived_curve: float64 `[T + 1]`, expected cells covered by the end of each step.
    """

    visited_by_cell: NDArray[np.float64]
    stops_by_cell: NDArray[np.float64]
    visited_curve: NDArray[np.float64]
    survived_curve: NDArray[np.float64]

    @property
    def visited(self) -> float:
        """Expected number of cells visited."""
        return float(self.visited_by_cell.sum())


@dataclass(frozen=True)
class Known:
    """Exact expected values: coverage in both meanings, robots alive at the end, steps; None: not known."""

    visited: Amount | None
    survived: Amount | None
    alive: float | None
    time: float | None


LIMITS = {
    "least": "the smallest of the bounds below that hold for this team",
    "any_strategy": "policy-independent upper bound for this team on this map (proven)",
    "ideal": "upper bound for this team on any map with these p: moves cost nothing",
    "ideal_one": "the same for one robot, eq. (7) of the paper; a team may exceed it",
}
"""Meanings of the bounds of `Limits`, a line each."""


@dataclass(frozen=True, repr=False)
class Limits:
    """Upper bounds of the expected coverage for every strategy; a single run may exceed them.

    Attributes:
        least: the smallest valid bound. any_strategy: the certified bound for this map; None: not computed.
        ideal: for the team. ideal_one: for one robot, eq. (7).
    """

    least: Amount
    any_strategy: Amount | None
    ideal: Amount
    ideal_one: Amount

    def _brief(self) -> tuple[str, Rows]:
        """A line for each bound: its name, its value rounded up, and its meaning."""
        rows = [(name, f"{_upwards(getattr(self, name))}: {meaning}") for name, meaning in LIMITS.items()]
        return "Limits: upper bounds of the mean coverage; a single mission may cover more", rows

    def __repr__(self) -> str:
        return text_of(*self._brief())

    def _repr_html_(self) -> str:
        return html_of(*self._brief())


def _upwards(bound: Amount | None) -> str:
    """An upper bound in two decimals, rounded up except for rounding errors of floats."""
    if bound is None:
        return "not computed (bound=True computes it where it applies)"
    # 1e-9: rounding errors must not raise the bound by a hundredth.
    share, cells = (math.ceil(100 * value - 1e-9) / 100 for value in (100 * bound.mean, bound.cells))
    return f"{share:.2f} % ({cells:,.2f} cells)"


# The effect of a range and of a mission state on cells and robots, for the page and the picture.

TO_DO, BEFORE, BEYOND = range(3)


@dataclass(frozen=True, eq=False)
class Rest:
    """The remaining mission of a plan with a range, or from a state.

    Attributes:
        kinds: int64 `[H, W]`, of accessible cells: TO_DO; BEFORE, visited in the state; BEYOND, too far for the moves
            of any robot alive (with the way back if robots return). returns: robots return to base.
        step: of the state; None: the whole mission.
        limited: there is a range. ended: robots that use up their range in the nominal run.
        pace: length of a step, if known.
    """

    kinds: NDArray[np.int64]
    returns: bool
    step: int | None
    limited: bool
    ended: int
    pace: Pace

    @property
    def title(self) -> str:
        """Title of the section and of the picture."""
        parts = [] if self.step is None else [f"Resumed from {self.pace.step(self.step)}"]
        return ", ".join([*parts, *["cells within range" if parts else "Cells within range"] * self.limited])

    @property
    def too_far(self) -> str:
        """The reason why a cell is too far, for sentences."""
        return "too far for any robot to visit and return" if self.returns else "too far for the moves of any robot"


NAMES = ("to visit", "visited before", "too far")
"""Names of the kinds, in order."""


def rest_of(world: World, plan: Plan) -> Rest | None:
    """The remaining mission of a plan; None for a whole mission without a range."""
    moves = moves_left(plan)
    if plan.state is None and moves is None:
        return None
    accessible = world.accessible(plan.starts)
    kinds = np.full(world.shape, TO_DO)
    if moves is not None:
        kinds[accessible & ~within(world, plan)] = BEYOND
    if plan.state is not None:
        kinds.reshape(-1)[plan.state.visited] = BEFORE
    # Waits are not moves, and do not use up the range.
    made = [int((np.diff(robot.path) != 0).sum()) for robot in plan.robots]
    ended = 0 if moves is None else sum(own >= most for own, most in zip(made, moves, strict=True))
    step = None if plan.state is None else plan.state.step
    return Rest(kinds, plan.comes_home, step, moves is not None, ended, world.pace)


# The interface of the outputs of `evaluate`: measured after the rollouts, then only reported.


@dataclass(frozen=True, eq=False)
class Run:
    """The rollouts of an evaluation, as the input of an output.

    Attributes:
        world, plan, choices: the input of the rollouts. last: their last stage. roll_out: runs more of them.
        exact: expected values of the open loop. closed: those of the closed loop if known exactly, else None.
        certain: all runs are equal. kept: tables that other plans of this map reuse.
        progress, doing: receive the number of rollouts done, and the name of each stage.
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
    """A row of the table of coverage, in percent: name, the open loop's exact value, the other columns."""

    name: str
    exact: str
    shown: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Elements:
    """The elements that an output adds to the report of an evaluation.

    Attributes:
        opens: sentences after the summary. alternatives: sentences on other settings. leads: sentences after these.
        rows: of the table of coverage. tables: after it. notes: after all tables.
        curves, marks: of the chart of coverage over time, in percent of the accessible cells, and its vertical lines.
        below: charts after the answer. layers: further maps by cell, each with a picture of this name.
        pictures, files: as in `Report`. settings: the requested values.
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
    """Base class of the outputs: a subclass defines `measure`, its JSON value, and its elements of the report."""

    own_rollouts = True
    """It needs more rollouts, and is skipped after an interruption."""
    late = True
    """It is measured after the summary and the tables of coverage and probabilities were shown."""

    @classmethod
    def check(cls, asked: Any, world: World) -> None:
        """Raise UsageError if it cannot be measured in this world, before any rollout."""
        return

    @classmethod
    @abstractmethod
    def measure(cls, asked: Any, run: Run) -> Iterator[Self]:
        """Yield the output, possibly first in part; each replaces the one before. `asked`: the option's value."""

    def to_json(self) -> object:
        """Its value in the JSON object, by the keys that its class declares; None: omitted."""
        return as_json(self) if hasattr(self, "json_keys") else None

    def elements(self) -> Elements:
        """Its elements of the report."""
        return Elements()


# Teams on common random numbers with the evaluated team: the same figures, table and sentence for all of them.


def team_table(title: str, teams: Mapping[str, Measured], *more: Column) -> Table:
    """A row for each team by name; `more`: columns after its coverage."""
    columns = (
        Column("team", lambda name: name),
        in_percents("visited %", lambda name: teams[name].coverage, "95 %"),
        *more,
        Column("lost", lambda name: teams[name].losses),
        Column("steps", lambda name: f"{teams[name].time.mean:.1f}"),
    )
    return table_of(columns, teams, title)


def against(subject: str, found: Measured, team: Measured) -> str:
    """ "With a known map: 82.0 % visited, 4.1 points ± 0.2 (95 %) more than this team."."""
    more = found.covers_more(team).more(100, " points", ("more", "less"))
    return f"{subject}: {percent(found.coverage.mean)} visited, {more} than this team."


def coverage_row(name: str, covered: Covered, of: int, exact: float) -> Row:
    """A row of coverage in percent of `of` cells, with the open loop's `exact` number of cells."""
    unit = 100.0 / of
    runs = (in_percent(cells / of, 1) for cells in covered.quantiles.values())
    return Row(name, in_percent(exact / of, 2), (*covered.mean.columns(unit, 100), *runs))


def known_text(value: float, form: str = "{:.2f}") -> str:
    """A known number as text; "" for NaN."""
    return "" if math.isnan(value) else form.format(value)
