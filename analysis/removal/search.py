"""Which threat to remove first: screened by the bound, simulated on common luck with planning anew; greedy for several.

Two questions, with answers that have little to do with each other. Robots that *know* that a threat is gone plan anew:
their way may lead through it, so what counts is what lies behind. Robots that do *not know* do as before: what counts
is how many of them it stops.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Doing, Progress, quiet
from analysis.removal.answer import Cleared, Clearing, Gain, Remove, Threat, Turn
from analysis.sampling import RolloutChoices
from analysis.theory.any_strategy import MOST_CELLS, any_strategy, value_bound
from analysis.theory.own_bounds import reach_chances
from analysis.theory.value import Worth
from analysis.trials.halving import Halving, check_search, screened
from analysis.trials.measured import Measured
from analysis.trials.trial import Trial, alike
from planner.arguments import argument, check_word, whole
from planner.errors import UsageError
from planner.mrac.areas import find_areas
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.rollouts.engine import choose_engine
from planner.settings import Settings
from planner.shown import counted
from planner.worlds.levels import find_levels
from planner.worlds.world import World

SIMULATED, FEWEST = 64, 8
"""Threats that are planned for anew, at most; fewer, FEWEST at least, where their maps' tables take long."""
SOLVED = 64
"""Threats up to which the screening bound is the flow programme's, a fifth of a second each on 300 cells."""
ALL_UNKNOWN = 2**18
"""Rollouts for robots that do not know, of all threats together."""
TABLES = 2**28
"""Pairs of cells of all-pairs tables that are made and kept: every map has its own."""


def threats_of(
    world: World, starts: NDArray[np.int64], levels: int, remove: Remove | None = None
) -> tuple[Remove, list[Threat], tuple[str, ...]]:
    """What kind of threat, those that robots at `starts` `[K, 2]` can reach, and notes.

    `remove`: the areas, or the sources of the scenario; None: the sources where there are several. Raises UsageError
    where there is none.
    """
    if remove is not None:
        check_word("remove", remove, ("areas", "sources"))
    things = _things_of(world, starts)
    if remove is None:
        remove = "sources" if len(things) > 1 else "areas"
    threats = things if remove == "sources" else _areas_of(world, starts, levels)
    if not threats and remove == "sources":
        problem = f"{world.source}: no polygon, point or site of its threats lies where a robot can get"
        raise UsageError(problem, fix=f"use {argument('remove', 'areas')}")
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
    progress: Progress | None = None,
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
    whole(1, len(threats), "a whole number of threats").check("count", count)
    cells = int(world.accessible(starts).sum())
    search = _Search(world, starts, settings, choices, progress, doing or quiet)
    turns: list[Turn] = []
    left, now, gain, stopped = threats, world, None, False
    try:
        for _ in range(count):
            turns.append(search.turn(now, left))
            now = turns[-1].picked.threat.cleared(now)
            left = [threat for threat in left if threat is not turns[-1].picked.threat]
        gain = search.confirm(world, now)
    except KeyboardInterrupt:
        if not turns:
            raise
        stopped = True
    return Clearing(
        world=world,
        starts=starts,
        settings=settings,
        choices=choices,
        remove=chosen,
        turns=tuple(turns),
        cells=cells,
        engine="" if search.exact else choose_engine(choices.engine).name,
        gain=gain,
        partial=stopped,
        notes=notes + _notes(len(threats), search.room) + screened(settings),
    )


def _notes(threats: int, simulated: int) -> tuple[str, ...]:
    if threats <= simulated:
        return ()
    return (f"of {threats} threats, those {simulated} by which the bound rises most were planned for anew",)


class _Search:
    """What all turns share: the team, its settings, what is rolled out, and whether all so far is `exact`."""

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        progress: Progress | None,
        doing: Doing,
    ) -> None:
        self.starts, self.settings, self.choices = starts, settings, choices
        self.progress, self.doing, self.robots = progress, doing, len(starts)
        self.cells, self.valued = int(world.accessible(starts).sum()), world.value is not None
        self.total = Worth.of(world).total if self.valued else float(self.cells)
        self.exact = True
        self.room = min(SIMULATED, max(FEWEST, TABLES // self.cells**2))

    def plan(self, world: World) -> Plan:
        """The team's plan on a map."""
        return make_plan(world, self.starts, self.settings)

    def turn(self, world: World, threats: Sequence[Threat]) -> Turn:
        """What each of `threats` is worth on `world`, and the best of them for robots that know."""
        as_is = self._anew(world)
        known = as_is.known()
        self.doing("screening")
        screens = self._screens(world, threats)
        self.doing("with the old plan")
        gains = [self._unknown(as_is, threat.cleared(world), len(threats)) for threat in threats]
        self.doing("replanned")
        order = np.argsort(-np.array(screens), kind="stable")[: self.room].tolist()
        contenders = [partial(self._anew, threats[place].cleared(world)) for place in order]
        race = Halving(contenders, self.choices.rollouts, room=self.room, exact=known is not None)
        race.run(self.progress)
        base: Measured = as_is.sample(0, self.choices.rollouts) if known is None or not race.exact else known
        self.exact &= base.exact and not any(gain.rollouts for gain in gains)
        hits = as_is.stops(base)
        options = [
            Cleared(threat, screen, float(hits[threat.cells].sum()), gain)
            for threat, screen, gain in zip(threats, screens, gains, strict=True)
        ]
        for contender, place in enumerate(order):
            low, high = (0.0, 0.0) if contender == race.best else race.behind(contender)
            behind = None if contender == race.best else (low * self.total, high * self.total)
            options[place] = replace(options[place], known=self._gain(base, race.runs[contender]), behind=behind)
        return Turn(tuple(options), order[race.best], race.rolled)

    def _anew(self, world: World) -> Trial:
        return Trial(world, self.plan(world), self.choices)

    def _gain(self, base: Measured, without: Measured) -> Gain:
        """What is won on average, in cells, robots, and value where there is any."""
        worth = without.ahead(base, "value", self.total) if self.valued else None
        rollouts = min(base.rollouts, without.rollouts)
        return Gain(without.ahead(base, "visited"), base.ahead(without, "lost"), rollouts, worth)

    def _unknown(self, as_is: Trial, truth: World, threats: int) -> Gain:
        """For robots that decide as before, and are not stopped there."""
        count = min(self.choices.rollouts, max(ALL_UNKNOWN // threats, 2))
        return self._gain(*alike([as_is, as_is.under(truth)], 0, count, 1 / threats))

    def _screens(self, world: World, threats: Sequence[Threat]) -> list[float]:
        """How much the bound for every strategy rises without each threat, in cells, or in value."""
        flow = self.cells <= MOST_CELLS and len(threats) <= SOLVED
        if self.valued:
            before = self._value_bound(world, flow)
            return [self._value_bound(threat.cleared(world), flow) - before for threat in threats]
        before = any_strategy(world, self.starts, flow).cells
        return [any_strategy(threat.cleared(world), self.starts, flow).cells - before for threat in threats]

    def _value_bound(self, world: World, flow: bool) -> float:
        """The programme with values, or the value by the chance to reach each cell."""
        if flow:
            return value_bound(world, self.starts)
        return float(Worth.of(world).value @ reach_chances(world, self.starts))

    def confirm(self, world: World, cleared: World) -> Gain:
        """What both maps come to on rollouts that had no part in the choice."""
        count = self.choices.rollouts
        base, without = alike([self._anew(world), self._anew(cleared)], count, count)
        self.exact &= base.exact
        return self._gain(base, without)
