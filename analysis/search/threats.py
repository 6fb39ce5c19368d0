"""Search for the threats whose removal gains most, and for the positions where threats cost most coverage."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import Halving, Search, check_search, screened
from analysis.estimators.trial import Measured, Trial, alike
from analysis.report.result import Searched
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate
from analysis.theory.bounds import reach_chances
from analysis.theory.exact import CellValues, coverage_gradient
from analysis.theory.upper_bound import MOST_CELLS, any_strategy, value_bound
from analysis.utils.notes import Doing, ProgressCallback
from planner.arguments import Numbers, argument, check_word, whole
from planner.errors import UsageError
from planner.formatting import counted
from planner.make_plan import make_plan
from planner.mrac.areas import find_areas
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.world.levels import find_levels
from planner.world.robot_types import Sources, Thing, Things
from planner.world.uncertain_maps import Hazard
from planner.world.world import World

# Threats and the gain of removing, or the cost of placing, each.

EVEN = 0.05
"""Differences of mean robots lost below this are reported as none."""


@dataclass(frozen=True, eq=False)
class Threat:
    """A connected area of equal threat, a polygon, point or site of the scenario, or a cell with a placed threat.

    Attributes:
        name: of the area, or as in the user's file. cells: int64 `[n]`, flat indices.
        p: largest probability that a visit destroys a robot, of this threat alone. at: its first cell, row and column.
        thing: its index in `World.sources`; None: an area.
    """

    name: str
    cells: NDArray[np.int64]
    p: float
    at: tuple[int, int]
    thing: int | None = None

    @property
    def shown_p(self) -> float:
        """The largest probability that a visit destroys a robot, of this threat alone, with nine decimals."""
        return round(self.p, 9)

    def cleared(self, world: World) -> World:
        """The map without this threat; threats that overlap it remain."""
        if isinstance(world.uncertainty, Hazard):
            return with_hazard(world, world.uncertainty, self.cells, 0.0, 1.0)
        if self.thing is not None and world.sources is not None:
            sources = world.sources.without(self.thing)
            return replace(world, threat=sources.threat(), sources=sources)
        threat = world.threat.copy()
        threat.reshape(-1)[self.cells] = 0.0
        # Worlds share arrays, so their arrays are read-only.
        threat.setflags(write=False)
        return replace(world, threat=threat)

    def placed(self, world: World) -> World:
        """The map with this threat in addition, combined by the scenario's rule, else as independent threats.

        `sources` of the new map are the placed threats, each removable, and the map as it was before. Among latent
        hazards a threat is a hazard that certainly exists, in cells without another.
        """
        if isinstance(world.uncertainty, Hazard):
            return with_hazard(world, world.uncertainty, self.cells, 1.0, self.p)
        sources = world.sources
        if sources is None or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
            combine = "product" if sources is None else sources.combine
            sources = Sources(combine, world.free, (np.nan_to_num(world.threat.astype(np.float64)),))
        thing = Thing(self.name, self.name, np.arange(len(self.cells)), np.full(len(self.cells), self.p))
        sources = replace(sources, layers=(*sources.layers, Things((thing,), self.cells)))
        return replace(world, threat=sources.threat(), sources=sources)


def with_hazard(world: World, hazard: Hazard, cells: NDArray[np.int64], q: float, h: float) -> World:
    """The map with other latent hazards in some cells."""
    exists, destroys = hazard.q.copy(), hazard.h.copy()
    exists.reshape(-1)[cells], destroys.reshape(-1)[cells] = q, h
    other = replace(hazard, q=exists, h=destroys)
    return replace(world, threat=other.threat, uncertainty=other)


@dataclass(frozen=True)
class Gain:
    """Mean gain of removing a threat: `cells` visited more and `robots` lost fewer, on the same `rollouts`.

    `value`: visited value, more; None: the map has no values.
    """

    cells: Estimate
    robots: Estimate
    rollouts: int
    value: Estimate | None = None
    json_keys = "*cells value? robots rollouts"

    @property
    def counted(self) -> Estimate:
        """The gain that is compared: value if the map has values, else cells."""
        return self.cells if self.value is None else self.value

    def describe(self, more: str) -> str:
        """The other gains, for reports: cells `more` or fewer, if value is compared, and robots lost."""
        words = ("more", "fewer") if more == "more" else ("fewer", "more")
        cells = "" if self.value is None else f"{self.cells.more(unit=' cells', words=words)}, "
        even = max(map(abs, self.robots.ci95))
        if even < EVEN:
            return f"{cells}the same losses" + (f" (± {even:.1g})" if even >= EVEN / 10 else "")
        lost = self.robots if self.robots.mean >= 0 else self.robots.negated
        return f"{cells}{lost.describe()} robots lost {words[self.robots.mean >= 0]}"


@dataclass(frozen=True, eq=False)
class ThreatCost:
    """A threat with its cost.

    Attributes:
        screen: rise of the policy-independent upper bound without the threat, in cells (or value); None: not computed.
        hits: mean robots lost in it per rollout, on the present map.
        known: gain if the team replans; None: not simulated. unknown: gain if the team keeps its plan.
        behind: interval of the best threat's lead in cells (or value); simultaneous 95 % intervals in one search.
    """

    threat: Threat
    screen: float | None
    hits: float
    unknown: Gain
    known: Gain | None = None
    behind: tuple[float, float] | None = None
    json_keys = "threat.name threat.cells p=threat.shown_p screen hits known unknown behind"


@dataclass(frozen=True, eq=False)
class Turn:
    """Selection of one threat: the remaining threats `options`, and `pick`, the index of the one that costs most."""

    options: tuple[ThreatCost, ...]
    pick: int
    rolled: int
    json_keys = "name=picked.threat.name picked.known picked.unknown"

    @property
    def picked(self) -> ThreatCost:
        """The selected threat."""
        return self.options[self.pick]

    @property
    def simulated(self) -> tuple[ThreatCost, ...]:
        """The threats that were simulated with replanning, the selected first, then by gain."""
        rest = [one for one in self.options if one.known is not None and one is not self.picked]
        return (self.picked, *sorted(rest, key=lambda one: -one.known.counted.mean if one.known else 0.0))

    @property
    def best_unknown(self) -> ThreatCost:
        """The threat with the largest gain if the team keeps its plan."""
        return max(self.options, key=lambda one: one.unknown.counted.mean)

    def certainty(self, more: str) -> str:
        """A sentence on the number of threats that the selected one is significantly `more` than, as "worse"."""
        others = [(one.threat.name, one.behind[0] > 0) for one in self.simulated if one.behind is not None]
        if not others:
            return "There is no other threat."
        how = "simultaneous 95 %" if self.rolled else "exact"
        close = [name for name, beaten in others if not beaten]
        alike = f"{', '.join(close[:4])}{' and more' if len(close) > 4 else ''}"
        rest = f"the other {len(others)}" if len(others) > 1 else "the other one"
        if len(close) == len(others):
            return f"No significant difference from {rest} ({how}): {alike}."
        if not close:
            return f"It is significantly {more} than {rest} ({how})."
        beaten = len(others) - len(close)
        return f"It is significantly {more} than {beaten} of {rest} ({how}); no significant difference from {alike}."


def by_cell(
    options: Sequence[ThreatCost], shape: tuple[int, int], gain_of: Callable[[ThreatCost], Gain | None]
) -> NDArray[np.float64]:
    """The gain of the threat in each cell, the largest where several overlap, `[H, W]`."""
    gains = np.zeros(shape)
    for one in options:
        gain = gain_of(one)
        if gain is not None:
            own = one.threat.cells
            gains.reshape(-1)[own] = np.maximum(gains.reshape(-1)[own], gain.counted.mean)
    return gains


# Results of the search for threats to remove.

Remove = Literal["areas", "sources"]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class ThreatResult(Searched):
    """Common fields of the results of both searches for threats; `starts`: of the team, int64 `[K, 2]`."""

    listed = "threats"

    starts: NDArray[np.int64]

    @property
    def unit(self) -> str:
        """Unit of gains and costs, for reports."""
        return "cells" if self.world.value is None else "of value"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Clearing(ThreatResult):
    """The result of `clear`.

    Attributes:
        remove: kind of threats: connected "areas", or the "sources" of the scenario.
        turns: one for each removed threat.
        gain: of removing all selected threats, on fresh rollouts, ids from `choices.rollouts` on.
    """

    reported_by = "analysis.search.place_reports:clear_report"

    remove: Remove
    turns: tuple[Turn, ...]
    gain: Gain | None = None
    json_keys = """
        remove threats=options pick=picked_names gain=gain.cells gain.first_rollout=first_fresh
        value_gain?=gain.value robots_gain=gain.robots turns
    """

    @property
    def picked_names(self) -> list[str]:
        """Names of the threats to remove, in order."""
        return [threat.name for threat in self.picks]

    @property
    def picks(self) -> tuple[Threat, ...]:
        """The threats to remove, in order."""
        return tuple(turn.picked.threat for turn in self.turns)

    @property
    def cleared_world(self) -> World:
        """The map without the selected threats."""
        world = self.world
        for threat in self.picks:
            world = threat.cleared(world)
        return world

    @property
    def options(self) -> tuple[ThreatCost, ...]:
        """All threats, as the first to be removed."""
        return self.turns[0].options

    @cached_property
    def plan(self) -> Plan:
        """The plan for the present map."""
        return make_plan(self.world, self.starts, self.settings)

    @cached_property
    def risk_paid(self) -> NDArray[np.float64]:
        """Cells lost on average for each percent of threat added to a cell, on the plan's paths, float64 `[H, W]`."""
        return -coverage_gradient(self.plan, self.world) / 100.0


# The search of `clear` and `attack`: for each of many threats, the change in coverage with and without it.
#
# Both commands compute two quantities that are nearly unrelated. If the team knows and *replans*, paths lead through a
# removed threat or around a placed one; the gain depends on the cells behind it. If the team *keeps its plan*, the gain
# depends on the number of robots that are lost in it.

FEWEST = 8
"""Least number of threats simulated with replanning, whatever the size of their maps' distance tables."""
SOLVED = 64
"""Number of threats up to which the screening bound is the flow programme's: 0.2 s each on 300 cells."""
ALL_UNKNOWN = 2**18
"""Rollouts of all threats together if the team keeps its plan."""
TABLES = 2**28
"""Pairs of cells in the stored distance tables: every map has its own table."""


class ThreatSearch(Search):
    """State that all selections share; `most`: number of threats that are simulated with replanning."""

    def __init__(self, *given: Any, most: int, placing: bool = False) -> None:
        """`given`: as of `Search`. `most`: its upper limit; memory for distance tables may lower it.

        `placing`: see `other`.
        """
        super().__init__(*given)
        self.placing, self.valued = placing, self.world.value is not None
        self.total = CellValues.of(self.world).total if self.valued else float(self.cells)
        # Every map has its own distance table of cells**2 entries.
        self.most = min(most, max(FEWEST, TABLES // self.cells**2))

    def anew(self, world: World) -> Trial:
        """A trial of a new plan for a map, before its nominal run."""
        return self.trial(world=world)

    def other(self, world: World, threat: Threat) -> World:
        """The map without a present threat, or with a threat to be placed."""
        return threat.placed(world) if self.placing else threat.cleared(world)

    def turn(self, world: World, threats: Sequence[Threat], screening: bool = True) -> Turn:
        """The cost of each of `threats` on `world`, and the one that costs most if the team replans.

        `screening`: compute the screening bound even if all threats are simulated.
        """
        as_is = self.anew(world)
        known = as_is.known()
        order, screens = self.screened(world, threats, screening)
        self.doing("with the old plan")
        gains = [self._unknown(as_is, self.other(world, threat), len(threats)) for threat in threats]
        self.doing("replanned")
        contenders = [partial(self.anew, self.other(world, threats[place])) for place in order]
        race = self.race(contenders, exact=known is not None)
        # Exact and sampled figures must not be paired: the difference would not be on common random numbers.
        base: Measured = as_is.sample(0, self.choices.rollouts) if known is None or not race.exact else known
        self.exact &= base.exact and not any(gain.rollouts for gain in gains)
        hits = as_is.stops(base)
        options = [
            ThreatCost(threat, screen, float(hits[threat.cells].sum()), gain)
            for threat, screen, gain in zip(threats, screens, gains, strict=True)
        ]
        for contender, place in enumerate(order):
            low, high = (0.0, 0.0) if contender == race.best else race.behind(contender)
            behind = None if contender == race.best else (low * self.total, high * self.total)
            options[place] = replace(options[place], known=self.gain(base, race.runs[contender]), behind=behind)
        return Turn(tuple(options), order[race.best], race.rolled)

    def screened(
        self, world: World, threats: Sequence[Threat], always: bool
    ) -> tuple[list[int], Sequence[float | None]]:
        """Indices of the threats to simulate, by decreasing cost to the upper bound; and these costs, if computed."""
        if not always and len(threats) <= self.most:
            return list(range(len(threats))), [None] * len(threats)
        self.doing("screening")
        screens = self._screens(world, threats)
        return np.argsort(-np.array(screens), kind="stable")[: self.most].tolist(), screens

    def race(
        self, contenders: Sequence[Callable[[], Trial]], *, exact: bool = True, kept: Sequence[Collection[int]] = ()
    ) -> Halving:
        """Simulated comparison of the contenders on common random numbers; the best costs most as a threat."""
        race = Halving(contenders, self.choices.rollouts, room=self.most, kept=kept, exact=exact, least=self.placing)
        race.run(self.progress)
        self.exact &= race.exact
        return race

    def gain(self, base: Measured, other: Measured) -> Gain:
        """Mean gain of removing the threat: cells, robots, and value if the map has values."""
        # Both directions report the gain of the map without the threat.
        there, gone = (other, base) if self.placing else (base, other)
        value = gone.ahead(there, "value", self.total) if self.valued else None
        rollouts = min(base.rollouts, other.rollouts)
        return Gain(gone.ahead(there, "visited"), there.ahead(gone, "lost"), rollouts, value)

    def _unknown(self, as_is: Trial, truth: World, threats: int) -> Gain:
        """Gain if the team keeps its plan."""
        # The rollouts of all threats together are limited, as each threat needs its own true map.
        count = min(self.choices.rollouts, max(ALL_UNKNOWN // threats, 2))
        return self.gain(*alike([as_is, as_is.with_threat(truth)], 0, count, 1 / threats))

    def _screens(self, world: World, threats: Sequence[Threat]) -> list[float]:
        """Cost of each threat to the policy-independent upper bound, in cells or in value."""
        flow, sign = self.cells <= MOST_CELLS and len(threats) <= SOLVED, -1.0 if self.placing else 1.0

        def bound(drawn: World) -> float:
            world = replace(drawn, uncertainty=None)  # latent hazards count as independent visits
            if not self.valued:
                return any_strategy(world, self.starts, flow, ways=False).cells
            if flow:
                return value_bound(world, self.starts, ways=False)
            return float(CellValues.of(world).value @ reach_chances(world, self.starts))

        before = bound(world)
        return [sign * (bound(self.other(world, threat)) - before) for threat in threats]

    def confirm(self, trials: Sequence[Trial]) -> list[Gain]:
        """Gains of the other trials against the first, on fresh rollouts."""
        count = self.choices.rollouts
        base, *others = alike(trials, count, count)
        self.exact &= base.exact
        return [self.gain(base, other) for other in others]


SIMULATED = 64
"""Largest number of threats simulated with replanning."""


def threats_of(
    world: World, starts: NDArray[np.int64], levels: int, remove: Remove | None = None
) -> tuple[Remove, list[Threat], tuple[str, ...]]:
    """The kind of threats, those in reach of robots at `starts` `[K, 2]`, and notes.

    `remove`: areas, or sources of the scenario; None: sources if there are several. Raises UsageError if there is none.
    """
    if remove is not None:
        check_word("unit", remove, ("areas", "sources"))
    things = _things_of(world, starts)
    if remove is None:
        remove = "sources" if len(things) > 1 else "areas"
    threats = things if remove == "sources" else _areas_of(world, starts, levels)
    if not threats and remove == "sources":
        problem = f"{world.source}: no polygon, point or site of its threats lies where a robot can get"
        raise UsageError(problem, fix=f"use {argument('unit', 'areas')}")
    if not threats:
        raise UsageError(f"{world.source}: no cell that a robot can reach is dangerous", expected="a threat to clear")
    beyond = 0 if remove == "areas" or world.sources is None else len(world.sources.things) - len(things)
    out_of_reach = f"{counted(beyond, 'threat')} of the scenario lie out of reach of the robots"
    return remove, threats, (out_of_reach,) if beyond else ()


def _things_of(world: World, starts: NDArray[np.int64]) -> list[Threat]:
    """The polygons, points and sites of a scenario that threaten an accessible cell, in the scenario's order."""
    sources = world.sources
    if sources is None or world.uncertainty or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
        return []  # the threats were changed after loading, so `sources` is out of date
    reached, threats = world.accessible(starts).reshape(-1), []
    for number, name in enumerate(sources.names):
        p = np.where(reached, sources.alone(number), 0.0)
        if p.any():
            cells = np.flatnonzero(p)
            threats.append(Threat(name, cells, float(p.max()), divmod(int(cells[0]), world.shape[1]), number))
    return threats


def _areas_of(world: World, starts: NDArray[np.int64], levels: int) -> list[Threat]:
    """The connected areas of equal threat that robots at `starts` `[K, 2]` can reach: by level, then by lowest cell."""
    found = find_levels(world.threat, world.accessible(starts), levels)
    areas = [(level, cells) for level, cells in find_areas(world.shape, found) if level > 0]
    return [
        Threat(f"area {number}", cells, float(found.values[level]), divmod(int(cells[0]), world.shape[1]))
        for number, (level, cells) in enumerate(areas)
    ]


def find_clearing(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    count: int = 1,
    remove: Remove | None = None,
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
) -> Clearing:
    """The threat whose removal gains most if the team replans; `count` of them, greedily.

    Args:
        choices: rollouts of the two finalists, the same ids for all threats. remove: see `threats_of`.

    Returns:
        The result. After an interruption (KeyboardInterrupt): the selections so far, `partial`.

    Raises:
        InputError: no threat, or an argument out of range.
        KeyboardInterrupt: before the first selection.
    """
    check_search(world, settings, choices, "a search for threats to remove")
    chosen, threats, notes = threats_of(world, starts, settings.levels, remove)
    whole(1, len(threats), "a whole number of threats").check("remove", count)
    search = ThreatSearch(world, starts, settings, choices, progress, doing, most=SIMULATED)
    turns: list[Turn] = []
    left, now = threats, world
    gain: Gain | None = None
    with search.stoppable(lambda: turns):
        for _ in range(count):
            # Greedy: each removal is evaluated on the map without the earlier ones.
            turns.append(search.turn(now, left))
            now = turns[-1].picked.threat.cleared(now)
            left = [threat for threat in left if threat is not turns[-1].picked.threat]
        (gain,) = search.confirm([search.anew(world), search.anew(now)])
    search.notes += notes
    if len(threats) > search.most:
        kept = f"the {search.most} with most effect on the upper bound were replanned"
        search.notes.append(f"of {counted(len(threats), 'threat')}, {kept}")
    search.notes += screened(settings, world)
    return Clearing(**search.fields(), starts=starts, remove=chosen, turns=tuple(turns), gain=gain)


# Placement of threats: greedy, then each is moved while that costs more. Once for informed, once for uninformed robots.


@dataclass(frozen=True, eq=False)
class Placed:
    """Placed threats, and their cost on fresh rollouts; None: interrupted.

    `known`: the team knows the threats and replans. `hidden`: the team keeps the plan for the map without them.
    """

    threats: tuple[Threat, ...]
    known: Gain | None = None
    hidden: Gain | None = None
    json_keys = "cells loss.known=known loss.hidden=hidden"

    @property
    def cells(self) -> list[tuple[int, int]]:
        """The cells of the threats, row and column."""
        return [threat.at for threat in self.threats]


@dataclass(frozen=True, eq=False)
class CellCost:
    """The cost of a threat in a cell `[row, col]`."""

    cost: ThreatCost
    json_keys = "cell=cost.threat.at hidden=cost.unknown cost.screen cost.known cost.behind"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Attack(ThreatResult):
    """The result of `attack`.

    Attributes:
        p: probability that a visit of a placed threat destroys a robot. turn: cost of one threat in each cell.
        known, hidden: the worst placement found if the team knows the threats, and if it does not.
    """

    reported_by = "analysis.search.place_reports:attack_report"

    p: float
    turn: Turn
    known: Placed
    hidden: Placed
    json_keys = """
        p known known.first_rollout=first_fresh hidden hidden.first_rollout=first_fresh threats=listed_cells
    """

    @property
    def listed_cells(self) -> tuple[CellCost, ...]:
        """The cost of one threat in each cell."""
        return tuple(map(CellCost, self.turn.options))

    @property
    def known_world(self) -> World:
        """The map with the placement for informed robots; each threat is one of its `sources`."""
        return with_all(self.world, self.known.threats)

    @property
    def hidden_world(self) -> World:
        """What robots meet that do not know: `world.with_true_map(answer.hidden_world)`."""
        return with_all(self.world, self.hidden.threats)


def with_all(world: World, threats: Sequence[Threat]) -> World:
    """The map with all threats placed."""
    for threat in threats:
        world = threat.placed(world)
    return world


MOST_PLACES = 512
"""Largest number of searched cells; on larger maps those where added threat costs the plan's paths most."""
ROUNDS = 2
"""Largest number of rounds in which every threat may move; a threat moves only if that costs more."""
CHANCE = Numbers(1e-6, 1 - 2**-25, below=True, text="a chance, 1e-6 or more and below 1")


@dataclass
class _Adversary:
    """Greedy placement of threats against one kind of robot.

    Attributes:
        make: the team's trial on a map. screens: whether cells are screened by the bound if not all are simulated.
        picks: the threats placed so far.
    """

    search: ThreatSearch
    world: World
    places: Sequence[Threat]
    make: Callable[[World], Trial]
    screens: bool
    picks: list[Threat] = field(default_factory=list)

    def place(self, count: int) -> None:
        """Place `count` threats greedily; then remove each in turn and place it again where it costs most."""
        while len(self.picks) < count:
            self.picks.append(self._worst(self.picks, None))
        for _ in range(ROUNDS if count > 1 else 0):
            before = list(self.picks)
            for number, pick in enumerate(before):
                self.picks[number] = self._worst(self.picks[:number] + self.picks[number + 1 :], pick)
            # A round without a move is a local optimum.
            if all(one is other for one, other in zip(before, self.picks, strict=True)):
                break

    def _worst(self, others: Sequence[Threat], now: Threat | None) -> Threat:
        """The worst place in addition to `others`; ties keep `now`, the present one."""
        world = with_all(self.world, others)
        left = [place for place in self.places if place not in others]
        order = list(range(len(left)))
        if self.screens:
            order = self.search.screened(world, left, always=False)[0]
        held = [] if now is None else [left.index(now)]
        # The present place is always compared, also if the bound screens it out.
        order += [place for place in held if place not in order]
        self.search.doing("replanned" if self.screens else "with the old plan")
        race = self.search.race(
            [partial(self._meet, world, left[place]) for place in order], kept=[{order.index(place)} for place in held]
        )
        best = race.best
        for kept in (order.index(place) for place in held):
            best = kept if race.runs[kept].share <= race.runs[best].share else best
        return left[order[best]]

    def _meet(self, world: World, threat: Threat) -> Trial:
        return self.make(threat.placed(world))


def threats_search(
    remove: int | None, add: int | None, unit: Remove | None, p: float | None
) -> Callable[..., Clearing | Attack]:
    """The search of `threats`: `find_clearing` of `remove` threats, or `find_attack` of `add`. Raises UsageError."""
    if (remove is None) == (add is None):
        raise UsageError(f"threats needs {argument('remove')} or {argument('add')}", expected="one of them")
    name, unused = ("p", p) if add is None else ("unit", unit)
    if unused is not None:
        problem = f"{argument(name, unused)} with {argument('remove' if add is None else 'add')}"
        raise UsageError(problem, fix="leave it out")
    if add is None:
        return partial(find_clearing, count=remove or 0, remove=unit)
    return partial(find_attack, count=add, p=0.2 if p is None else p)


def find_attack(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    *,
    count: int = 1,
    p: float = 0.2,
    progress: ProgressCallback | None = None,
    doing: Doing | None = None,
) -> Attack:
    """The cells in which `count` threats of probability `p` cost most, for informed and for uninformed robots.

    Args:
        choices: rollouts of the two finalists, the same ids for all places.

    Returns:
        The result. After an interruption (KeyboardInterrupt): the threats so far, `partial`.

    Raises:
        InputError: no cell for a threat, or an argument out of range.
        KeyboardInterrupt: before the first threat was placed.
    """
    check_search(world, settings, choices, "a search for the worst places of threats")
    CHANCE.check("p", p)
    search = ThreatSearch(world, starts, settings, choices, progress, doing, most=MOST_PLACES, placing=True)
    as_is = search.anew(world)
    places, notes = places_of(world, starts, settings, float(p))
    whole(1, len(places), "a whole number of threats").check("add", count)
    turn = search.turn(world, places, screening=False)
    # The search over single threats already gives the first one.
    known = _Adversary(search, world, places, search.anew, True, [turn.picked.threat])
    hidden = _Adversary(search, world, places, as_is.with_threat, False)
    ends: tuple[Placed, Placed] | None = None
    with search.stoppable(lambda: True):
        known.place(count)
        hidden.place(count)
        ends = _confirmed(search, as_is, known.picks, hidden.picks)
    one, other = ends or (Placed(tuple(known.picks)), Placed(tuple(hidden.picks)))
    search.notes += notes + (screened(settings, world) if len(places) > search.most else ())
    return Attack(**search.fields(), starts=starts, p=float(p), turn=turn, known=one, hidden=other)


def places_of(
    world: World, starts: NDArray[np.int64], settings: Settings, p: float
) -> tuple[list[Threat], tuple[str, ...]]:
    """A threat for every cell that robots at `starts` `[K, 2]` can reach and in which none starts; notes.

    Raises UsageError if there is none.
    """
    free = world.accessible(starts)
    # A threat in a start cell could not be avoided by any plan.
    free[tuple(starts.T)] = False
    if world.uncertainty is not None:
        free &= world.threat == 0  # a cell has one latent hazard
    cells = np.flatnonzero(free)
    if not len(cells):
        raise UsageError(f"{world.source}: no accessible cell is left for a threat", expected="a larger map")
    notes: tuple[str, ...] = ()
    if len(cells) > MOST_PLACES:
        # The gradient is exact for the open loop and needs one pass, so it screens all cells.
        costs = -coverage_gradient(make_plan(world, starts, settings), world).reshape(-1)[cells]
        notes = (f"of {len(cells):,} cells, the {MOST_PLACES} where added threat costs the plan's paths most",)
        cells = np.sort(cells[np.argsort(-costs, kind="stable")[:MOST_PLACES]])
    places = zip(*np.divmod(cells, world.shape[1]), cells, strict=True)
    return [Threat(f"cell [{row}, {col}]", np.array([cell]), p, (row, col)) for row, col, cell in places], notes


def _confirmed(
    search: ThreatSearch, as_is: Trial, known: Sequence[Threat], hidden: Sequence[Threat]
) -> tuple[Placed, Placed]:
    """Both placements, with their cost to both kinds of robots."""
    worlds = [with_all(as_is.world, threats) for threats in (known, hidden)]
    one, other, met, unseen = search.confirm([as_is, *map(search.anew, worlds), *map(as_is.with_threat, worlds)])
    return Placed(tuple(known), one, met), Placed(tuple(hidden), other, unseen)
