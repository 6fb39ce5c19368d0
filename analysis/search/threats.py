"""Which threat to remove first, and where threats cost a team most: one after the other on common random numbers."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.racing import Halving, check_search, screened
from analysis.estimators.trial import Measured, Trial, alike
from analysis.report.answer import Searched
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate
from analysis.theory.bounds import reach_chances
from analysis.theory.exact import Worth, coverage_gradient
from analysis.theory.upper_bound import MOST_CELLS, any_strategy, value_bound
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import Numbers, argument, check_word, whole
from planner.errors import UsageError
from planner.files import Json
from planner.formatting import counted
from planner.make_plan import allocated_plan, make_plan
from planner.mrac.areas import find_areas
from planner.plan.plan import Plan
from planner.rollouts.engine import choose_engine
from planner.settings import Settings
from planner.world.levels import find_levels
from planner.world.robot_types import Sources, Thing, Things
from planner.world.world import World

# Which threat to remove first, for robots that know that it is gone; greedy for several.

# Threats, and what each costs: what `clear` takes away and what an adversary places.

EVEN = 0.05
"""Robots lost more or fewer that are called none."""


@dataclass(frozen=True, eq=False)
class Threat:
    """A connected area of danger, or a polygon, a point or a site of the scenario's threats; or a cell to threaten.

    Attributes:
        name: of the area, or as the user's file says. cells: int64 `[n]` (indices).
        p: the largest chance that a visit stops, of it alone. thing: its number in `World.sources`; None: an area.
    """

    name: str
    cells: NDArray[np.int64]
    p: float
    thing: int | None = None

    def cleared(self, world: World) -> World:
        """The map without it; where others overlap it, with theirs."""
        if self.thing is not None and world.sources is not None:
            sources = world.sources.without(self.thing)
            return replace(world, threat=sources.threat(), sources=sources)
        threat = world.threat.copy()
        threat.reshape(-1)[self.cells] = 0.0
        threat.setflags(write=False)
        return replace(world, threat=threat)

    def placed(self, world: World) -> World:
        """The map with it too, combined with what is there as its scenario says, else as independent threats.

        Its `sources` are what was placed, each to be cleared again, and the map as it was before.
        """
        sources = world.sources
        if sources is None or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
            combine = "product" if sources is None else sources.combine
            sources = Sources(combine, world.free, (np.nan_to_num(world.threat.astype(np.float64)),))
        thing = Thing(self.name, self.name, np.arange(len(self.cells)), np.full(len(self.cells), self.p))
        sources = replace(sources, layers=(*sources.layers, Things((thing,), self.cells)))
        return replace(world, threat=sources.threat(), sources=sources)


@dataclass(frozen=True)
class Gain:
    """What is won on average without a threat: `cells` visited more, `robots` lost fewer, on the same `rollouts`.

    `value`: of visited cells, more; None where nobody said what they are worth.
    """

    cells: Estimate
    robots: Estimate
    rollouts: int
    value: Estimate | None = None

    @property
    def counted(self) -> Estimate:
        """What is gone by: value where there is any, else cells."""
        return self.cells if self.value is None else self.value

    def said(self, more: str) -> str:
        """Beside the figure that is gone by: cells that are `more` or fewer, if that is value, and robots lost."""
        words = ("more", "fewer") if more == "more" else ("fewer", "more")
        cells = "" if self.value is None else f"{self.cells.more(unit=' cells', words=words)}, "
        even = max(map(abs, self.robots.ci95))
        if even < EVEN:
            return f"{cells}as many robots lost" + (f" (± {even:.1g})" if even >= EVEN / 10 else "")
        lost = self.robots if self.robots.mean >= 0 else self.robots.negated
        return f"{cells}{lost.said()} robots lost {words[self.robots.mean >= 0]}"

    def to_json(self) -> Json:
        """Cells, with value and robots beside them."""
        worth = {} if self.value is None else {"value": self.value.to_json()}
        return self.cells.to_json() | worth | {"robots": self.robots.to_json(), "rollouts": self.rollouts}


@dataclass(frozen=True, eq=False)
class Weighed:
    """A threat, and what it costs.

    Attributes:
        screen: how much higher the bound for every strategy is without it, in cells (or value); None: it was not
            asked. hits: robots lost in it a run, as things are.
        known: for robots that plan anew; None: it was not simulated. unknown: for robots that do as before.
        behind: cells (or value) that the best costs more, an interval; all of one search hold together with 95 %.
    """

    threat: Threat
    screen: float | None
    hits: float
    unknown: Gain
    known: Gain | None = None
    behind: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Turn:
    """One threat picked: all that were left `options`, `pick` the place of the one that costs most."""

    options: tuple[Weighed, ...]
    pick: int
    rolled: int

    @property
    def picked(self) -> Weighed:
        """What was picked."""
        return self.options[self.pick]

    @property
    def simulated(self) -> tuple[Weighed, ...]:
        """Those that were planned for anew, the best first."""
        rest = [one for one in self.options if one.known is not None and one is not self.picked]
        return (self.picked, *sorted(rest, key=lambda one: -one.known.counted.mean if one.known else 0.0))

    @property
    def best_unknown(self) -> Weighed:
        """The one that costs robots most that do not know."""
        return max(self.options, key=lambda one: one.unknown.counted.mean)

    def certainty(self, more: str) -> str:
        """A sentence: than how many others the pick is surely `more`, as "worth more"."""
        others = [(one.threat.name, one.behind[0] > 0) for one in self.simulated if one.behind is not None]
        if not others:
            return "There is no other."
        how = "95 %, all together" if self.rolled else "exact"
        close = [name for name, beaten in others if not beaten]
        alike = f"{', '.join(close[:4])}{' and more' if len(close) > 4 else ''}"
        rest = f"the other {len(others)}" if len(others) > 1 else "the other one"
        if len(close) == len(others):
            return f"No significant difference from {rest} ({how}): {alike}."
        if not close:
            return f"It is surely {more} than {rest} ({how})."
        beaten = len(others) - len(close)
        return f"It is surely {more} than {beaten} of {rest} ({how}); no significant difference from {alike}."


def by_cell(
    options: Sequence[Weighed], shape: tuple[int, int], gain_of: Callable[[Weighed], Gain | None]
) -> NDArray[np.float64]:
    """What the threat that a cell is in costs, the most where several overlap, `[H, W]`."""
    gains = np.zeros(shape)
    for one in options:
        gain = gain_of(one)
        if gain is not None:
            own = one.threat.cells
            gains.reshape(-1)[own] = np.maximum(gains.reshape(-1)[own], gain.counted.mean)
    return gains


# What a search for threats to clear holds: each threat, what it costs, the picks and how sure they are.

Remove = Literal["areas", "sources"]


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Weighing(Searched):
    """What the answers to both searches for threats hold; `starts`: of the team, int64 `[K, 2]`."""

    listed = "threats"

    starts: NDArray[np.int64]

    @property
    def unit(self) -> str:
        """Of what a threat costs."""
        return "cells" if self.world.value is None else "of value"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Clearing(Weighing):
    """The answer to what to clear first.

    Attributes:
        remove: what threats are: "areas", or the "sources" of the scenario.
        turns: one for each threat that is cleared.
        gain: of clearing all picks, on rollouts that had no part in the choice, ids from `choices.rollouts` on.
    """

    reported_by = "analysis.search.place_reports:clear_report"

    remove: Remove
    turns: tuple[Turn, ...]
    gain: Gain | None = None

    @property
    def picks(self) -> tuple[Threat, ...]:
        """What to clear, in this order."""
        return tuple(turn.picked.threat for turn in self.turns)

    @property
    def cleared_world(self) -> World:
        """The map without them."""
        world = self.world
        for threat in self.picks:
            world = threat.cleared(world)
        return world

    @property
    def options(self) -> tuple[Weighed, ...]:
        """All threats, as the first to be cleared."""
        return self.turns[0].options

    @cached_property
    def plan(self) -> Plan:
        """Of the map as it is."""
        return make_plan(self.world, self.starts, self.settings)

    @cached_property
    def risk_paid(self) -> NDArray[np.float64]:
        """Cells lost on average for each percent of threat more in a cell, on the plan's paths, float64 `[H, W]`."""
        return -coverage_gradient(self.plan, self.world) / 100.0


# The search that `clear` and `attack` share: which of many threats costs a team most, in two directions.
#
# `clear` asks what each threat costs that is there, `attack` what each would cost that is not. Two questions in both,
# with answers that have little to do with each other. Robots that *know* plan anew: their way may lead through where
# the
# threat was, or round where it is, so what counts is what lies behind. Robots that do *not know* do as before: what
# counts is how many of them it stops.

FEWEST = 8
"""Threats that are planned for anew at least, however long their maps' tables take."""
SOLVED = 64
"""Threats up to which the screening bound is the flow programme's, a fifth of a second each on 300 cells."""
ALL_UNKNOWN = 2**18
"""Rollouts for robots that do not know, of all threats together."""
TABLES = 2**28
"""Pairs of cells of all-pairs tables that are made and kept: every map has its own."""


class Search:
    """What all turns share: the team, its settings, what is rolled out, and whether all so far is `exact`.

    `room`: threats that are planned for anew.
    """

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        progress: ProgressCallback | None,
        doing: Doing,
        *,
        most: int,
        placing: bool = False,
    ) -> None:
        """`most`: threats that are planned for anew, if their maps' tables find room. `placing`: they are not there."""
        self.starts, self.settings, self.choices, self.placing = starts, settings, choices, placing
        self.progress, self.doing, self.robots = progress, doing, len(starts)
        self.cells, self.valued = int(world.accessible(starts).sum()), world.value is not None
        self.total = Worth.of(world).total if self.valued else float(self.cells)
        self.exact = True
        self.room = min(most, max(FEWEST, TABLES // self.cells**2))

    def asked(self, world: World) -> dict[str, Any]:
        """What an answer says of it (`answer.Weighing`)."""
        engine = "" if self.exact else choose_engine(self.choices.engine).name
        return {"world": world, "starts": self.starts, "settings": self.settings, "choices": self.choices,
                "cells": self.cells, "engine": engine}  # fmt: skip

    def anew(self, world: World) -> Trial:
        """The team's plan on a map, before its nominal run."""
        return Trial(world, allocated_plan(world, self.starts, self.settings), self.choices)

    def other(self, world: World, threat: Threat) -> World:
        """The map without a threat that is there, or with one that is not."""
        return threat.placed(world) if self.placing else threat.cleared(world)

    def turn(self, world: World, threats: Sequence[Threat], screening: bool = True) -> Turn:
        """What each of `threats` costs on `world`, and the one that costs robots most that know.

        `screening`: they are screened even where all find room.
        """
        as_is = self.anew(world)
        known = as_is.known()
        order, screens = self.screened(world, threats, screening)
        self.doing("with the old plan")
        gains = [self._unknown(as_is, self.other(world, threat), len(threats)) for threat in threats]
        self.doing("replanned")
        contenders = [partial(self.anew, self.other(world, threats[place])) for place in order]
        race = self.race(contenders, exact=known is not None)
        base: Measured = as_is.sample(0, self.choices.rollouts) if known is None or not race.exact else known
        self.exact &= base.exact and not any(gain.rollouts for gain in gains)
        hits = as_is.stops(base)
        options = [
            Weighed(threat, screen, float(hits[threat.cells].sum()), gain)
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
        """Places of the threats that find room, those first that cost the bound most; what they cost it, if asked."""
        if not always and len(threats) <= self.room:
            return list(range(len(threats))), [None] * len(threats)
        self.doing("screening")
        screens = self._screens(world, threats)
        return np.argsort(-np.array(screens), kind="stable")[: self.room].tolist(), screens

    def race(
        self, contenders: Sequence[Callable[[], Trial]], *, exact: bool = True, kept: Sequence[Collection[int]] = ()
    ) -> Halving:
        """The contenders on common luck, run; the best of them is the one whose threat costs most."""
        race = Halving(contenders, self.choices.rollouts, room=self.room, kept=kept, exact=exact, least=self.placing)
        race.run(self.progress)
        self.exact &= race.exact
        return race

    def gain(self, base: Measured, other: Measured) -> Gain:
        """What is won without it on average, in cells, robots, and value where there is any."""
        there, gone = (other, base) if self.placing else (base, other)
        worth = gone.ahead(there, "value", self.total) if self.valued else None
        rollouts = min(base.rollouts, other.rollouts)
        return Gain(gone.ahead(there, "visited"), there.ahead(gone, "lost"), rollouts, worth)

    def _unknown(self, as_is: Trial, truth: World, threats: int) -> Gain:
        """For robots that decide as before."""
        count = min(self.choices.rollouts, max(ALL_UNKNOWN // threats, 2))
        return self.gain(*alike([as_is, as_is.under(truth)], 0, count, 1 / threats))

    def _screens(self, world: World, threats: Sequence[Threat]) -> list[float]:
        """What each threat costs the bound for every strategy, in cells, or in value."""
        flow = self.cells <= MOST_CELLS and len(threats) <= SOLVED
        bound, sign = self._value_bound if self.valued else self._bound, -1.0 if self.placing else 1.0
        before = bound(world, flow)
        return [sign * (bound(self.other(world, threat), flow) - before) for threat in threats]

    def _bound(self, world: World, flow: bool) -> float:
        return any_strategy(world, self.starts, flow, ways=False).cells

    def _value_bound(self, world: World, flow: bool) -> float:
        """The programme with values, or the value by the chance to reach each cell."""
        if flow:
            return value_bound(world, self.starts, ways=False)
        return float(Worth.of(world).value @ reach_chances(world, self.starts))

    def confirm(self, trials: Sequence[Trial]) -> list[Gain]:
        """What the others cost against the first, on rollouts that had no part in the choice."""
        count = self.choices.rollouts
        base, *others = alike(trials, count, count)
        self.exact &= base.exact
        return [self.gain(base, other) for other in others]


SIMULATED = 64
"""Threats that are planned for anew, at most."""


def threats_of(
    world: World, starts: NDArray[np.int64], levels: int, remove: Remove | None = None
) -> tuple[Remove, list[Threat], tuple[str, ...]]:
    """What kind of threat, those that robots at `starts` `[K, 2]` can reach, and notes.

    `remove`: the areas, or the sources of the scenario; None: the sources where there are several. Raises UsageError
    where there is none.
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
    return remove, threats, _apart(world, remove, things)


def _apart(world: World, remove: Remove, things: Sequence[Threat]) -> tuple[str, ...]:
    """What is left as it is."""
    if remove == "areas" or world.sources is None:
        return ()
    beyond = len(world.sources.things) - len(things)
    return (f"{counted(beyond, 'threat')} of the scenario threaten no cell that a robot can reach",) if beyond else ()


def _things_of(world: World, starts: NDArray[np.int64]) -> list[Threat]:
    """The polygons, points and sites of a scenario that threaten a cell of theirs, as the scenario orders them."""
    sources = world.sources
    if sources is None or not np.array_equal(sources.threat(), world.threat, equal_nan=True):
        return []  # a world that was changed since it was loaded
    reached, threats = world.accessible(starts).reshape(-1), []
    for number, name in enumerate(sources.names):
        p = np.where(reached, sources.alone(number), 0.0)
        if p.any():
            threats.append(Threat(name, np.flatnonzero(p), float(p.max()), number))
    return threats


def _areas_of(world: World, starts: NDArray[np.int64], levels: int) -> list[Threat]:
    """The connected dangerous areas that robots at `starts` `[K, 2]` can reach: level by level, then by lowest cell."""
    found = find_levels(world, world.accessible(starts), levels)
    areas = [(level, cells) for level, cells in find_areas(world.shape, found) if level > 0]
    return [Threat(f"area {number}", cells, float(found.values[level])) for number, (level, cells) in enumerate(areas)]


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
    """The threat whose removal gains robots that know of it most cells; `count` of them, one after the other.

    `choices`: rollouts of the last two threats that are left, the same ids for all. An interruption (KeyboardInterrupt)
    leaves the picks so far, `partial`; before the first, it is raised again. `remove`: as of `threats_of`. Raises
    InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for what to clear")
    chosen, threats, notes = threats_of(world, starts, settings.levels, remove)
    whole(1, len(threats), "a whole number of threats").check("remove", count)
    search = Search(world, starts, settings, choices, progress, doing or quiet, most=SIMULATED)
    turns: list[Turn] = []
    left, now, gain, stopped = threats, world, None, False
    try:
        for _ in range(count):
            turns.append(search.turn(now, left))
            now = turns[-1].picked.threat.cleared(now)
            left = [threat for threat in left if threat is not turns[-1].picked.threat]
        (gain,) = search.confirm([search.anew(world), search.anew(now)])
    except KeyboardInterrupt:
        if not turns:
            raise
        stopped = True
    return Clearing(
        **search.asked(world),
        remove=chosen,
        turns=tuple(turns),
        gain=gain,
        partial=stopped,
        notes=notes + _notes(len(threats), search.room) + screened(settings),
    )


def _notes(threats: int, simulated: int) -> tuple[str, ...]:
    if threats <= simulated:
        return ()
    return (f"of {counted(threats, 'threat')}, those {simulated} by which the bound rises most were planned for anew",)


# Where threats cost a team most: one after the other on common luck, then each moved while that costs more.

# What a search for the worst places of threats holds: those for robots that know, those for robots that do not.


@dataclass(frozen=True, eq=False)
class Placed:
    """Threats that were placed, and what they cost on rollouts that had no part in the choice; None: interrupted.

    `known`: robots that know of them and plan anew. `hidden`: robots that do as on the map without them.
    """

    threats: tuple[Threat, ...]
    known: Gain | None = None
    hidden: Gain | None = None


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Attack(Weighing):
    """The answer.

    Attributes:
        p: the chance that a visit of a threat stops. turn: what one threat costs in each cell.
        known, hidden: the worst found for robots that know of them, and for robots that do not.
    """

    reported_by = "analysis.search.place_reports:attack_report"

    p: float
    turn: Turn
    known: Placed
    hidden: Placed

    @property
    def known_world(self) -> World:
        """The map with the threats that robots know of; each is one of its `sources`."""
        return with_all(self.world, self.known.threats)

    @property
    def hidden_world(self) -> World:
        """What robots meet that do not know: `world.with_true_map(answer.hidden_world)`."""
        return with_all(self.world, self.hidden.threats)


def with_all(world: World, threats: Sequence[Threat]) -> World:
    """The map with all of them placed."""
    for threat in threats:
        world = threat.placed(world)
    return world


MOST_PLACES = 512
"""Cells that are looked at: of larger maps those where a little more danger costs the plan's own paths most."""
ROUNDS = 2
"""Times that every threat is taken up again at most; a move makes it worse for the team or is none."""
CHANCE = Numbers(1e-6, 1 - 2**-25, below=True, said="a chance, 1e-6 or more and below 1")


@dataclass
class _Adversary:
    """Who places threats against robots of one kind.

    Attributes:
        make: what robots do on a map. screens: whether cells are screened by the bound where not all find room.
        picks: the threats placed so far.
    """

    search: Search
    world: World
    places: Sequence[Threat]
    make: Callable[[World], Trial]
    screens: bool
    picks: list[Threat] = field(default_factory=list)

    def place(self, count: int) -> None:
        """`count` threats, greedily; then each is taken up again and put down where it costs most."""
        while len(self.picks) < count:
            self.picks.append(self._worst(self.picks, None))
        for _ in range(ROUNDS if count > 1 else 0):
            before = list(self.picks)
            for number, pick in enumerate(before):
                self.picks[number] = self._worst(self.picks[:number] + self.picks[number + 1 :], pick)
            if all(one is other for one, other in zip(before, self.picks, strict=True)):
                break

    def _worst(self, others: Sequence[Threat], now: Threat | None) -> Threat:
        """The worst place beside others; `now`, where it stands, unless another one is worse on the same luck."""
        world = with_all(self.world, others)
        left = [place for place in self.places if place not in others]
        order = list(range(len(left)))
        if self.screens:
            order = self.search.screened(world, left, always=False)[0]
        held = [] if now is None else [left.index(now)]
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
    """The cells in which `count` threats of chance `p` cost robots most that know of them, and that do not.

    `choices`: rollouts of the last two places that are left, the same ids for all. An interruption (KeyboardInterrupt)
    leaves the threats so far, `partial`; before the first, it is raised again. Raises InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for the worst places of threats")
    CHANCE.check("p", p)
    search = Search(world, starts, settings, choices, progress, doing or quiet, most=MOST_PLACES, placing=True)
    as_is = search.anew(world)
    places, notes = places_of(world, starts, settings, float(p))
    whole(1, len(places), "a whole number of threats").check("add", count)
    turn = search.turn(world, places, screening=False)
    known = _Adversary(search, world, places, search.anew, True, [turn.picked.threat])
    hidden = _Adversary(search, world, places, as_is.under, False)
    ends, stopped = (Placed(()), Placed(())), False
    try:
        known.place(count)
        hidden.place(count)
        ends = _confirmed(search, as_is, known.picks, hidden.picks)
    except KeyboardInterrupt:
        ends, stopped = (Placed(tuple(known.picks)), Placed(tuple(hidden.picks))), True
    return Attack(
        **search.asked(world),
        p=float(p),
        turn=turn,
        known=ends[0],
        hidden=ends[1],
        partial=stopped,
        notes=notes + (screened(settings) if len(places) > search.room else ()),
    )


def places_of(
    world: World, starts: NDArray[np.int64], settings: Settings, p: float
) -> tuple[list[Threat], tuple[str, ...]]:
    """A threat for every cell that robots at `starts` `[K, 2]` can reach and none starts in; notes.

    Raises UsageError where there is none.
    """
    free = world.accessible(starts)
    free[tuple(starts.T)] = False
    cells = np.flatnonzero(free)
    if not len(cells):
        raise UsageError(f"{world.source}: no cell that a robot can reach is left to threaten", expected="a larger map")
    notes: tuple[str, ...] = ()
    if len(cells) > MOST_PLACES:
        costs = -coverage_gradient(make_plan(world, starts, settings), world).reshape(-1)[cells]
        notes = (f"of {len(cells):,} cells, those {MOST_PLACES} where more danger costs the plan's paths most",)
        cells = np.sort(cells[np.argsort(-costs, kind="stable")[:MOST_PLACES]])
    places = zip(*np.divmod(cells, world.shape[1]), cells, strict=True)
    return [Threat(f"cell [{row}, {col}]", np.array([cell]), p) for row, col, cell in places], notes


def _confirmed(
    search: Search, as_is: Trial, known: Sequence[Threat], hidden: Sequence[Threat]
) -> tuple[Placed, Placed]:
    """Both placements, with what each costs robots of both kinds."""
    worlds = [with_all(as_is.world, threats) for threats in (known, hidden)]
    one, other, met, unseen = search.confirm([as_is, *map(search.anew, worlds), *map(as_is.under, worlds)])
    return Placed(tuple(known), one, met), Placed(tuple(hidden), other, unseen)
