"""The best starts of a team: screened by a bound and by eq. (4), the best of those simulated on common luck.

1. Every candidate: the *reach bound* `sum_c g_c` (`analysis.theory.own_bounds.reach_chances`), one search a site.
2. One depot: eq. (4) of one robot's plan from PLANNED candidates, the sites in turn, the best bound first.
   One start each: teams chosen greedily by the bound, from every site as the first; and the depots.
3. The best SIMULATED of them, and where the team stands now: `analysis.trials.halving`. The best depot and the starts
   of now go on to the end, and what is recommended is held against these on fresh rollouts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.depots.answer import Place, Starts
from analysis.depots.candidates import BORDER, candidate_cells, sites_of
from analysis.depots.screening import depots_of, reached_from, teams_of, worth_simulating
from analysis.kit.notes import Doing, Progress, quiet
from analysis.sampling import RolloutChoices
from analysis.statistics.estimate import Estimate
from analysis.trials.halving import Halving, check_search, screened
from analysis.trials.measured import Measured
from analysis.trials.trial import Trial
from planner.kernels.tables import AllPairs
from planner.mrac.make_plan import allocated_plan
from planner.rollouts.engine import choose_engine
from planner.settings import Settings
from planner.worlds.starts import check_robots, place_starts
from planner.worlds.world import World

ELSEWHERE = "where the team stands now reaches other cells than the candidates: it is not compared"


def find_starts(
    world: World,
    robots: int,
    settings: Settings,
    choices: RolloutChoices,
    *,
    depot: bool = False,
    candidates: ArrayLike = BORDER,
    source: object = "",
    words: Sequence[str] = (),
    progress: Progress | None = None,
    doing: Doing | None = None,
) -> Starts:
    """The best starts of so many robots in `world`, for robots that take over from each other.

    Args:
        depot: one place for all, else one each. candidates, source: as of `candidate_cells`.
        choices: rollouts of the last two that are left, the same ids for all; the best is rolled out again on others.

    An interruption (KeyboardInterrupt) while they are simulated leaves the best so far, `partial`; before the first
    was, it is raised again. Raises InputError.
    """
    choices = choices.timed(world.pace)
    check_search(world, settings, choices, "a search for starts")
    say = doing or quiet
    cells, notes = candidate_cells(world, candidates, source)
    say("screening")
    places = _places(world, robots, settings, cells, depot)
    field = _Field(world, settings, choices, places, depot)
    stopped, fresh = False, dict[int, Measured]()
    say("simulating")
    try:
        field.race.run(progress)
        say("the best on fresh rollouts")
        fresh = {place: field.race.confirm(field.contender(place)) for place in {field.best, *field.now}}
    except KeyboardInterrupt:
        if not field.race.runs:
            raise
        stopped = True
    answer = Starts(
        world=world,
        settings=settings,
        depot=depot,
        choices=choices,
        places=field.figures(),
        best=field.best,
        candidates=cells,
        cells=field.cells,
        engine="" if field.race.exact else choose_engine(choices.engine).name,
        rolled=field.race.rolled + sum(found.rollouts for found in fresh.values()),
        gain=field.gain(fresh),
        words=tuple(words),
        partial=stopped,
        notes=notes + (() if field.now else (ELSEWHERE,)) + screened(settings),
    )
    at = answer.here if answer.chosen is not answer.places[answer.best] else answer.best
    return answer if at not in fresh else replace(answer, confirmed=field.known(answer.chosen, fresh[at]))


def team_size(world: World, robots: int | None) -> int:
    """How many robots: as asked for, else as many as the input's starts, else its count, else 1. Raises UsageError."""
    check_robots(robots)
    named = len(world.starts) if world.starts is not None else world.team.robots or 1
    return named if robots is None else robots


def _places(world: World, robots: int, settings: Settings, cells: NDArray[np.int64], depot: bool) -> list[Place]:
    """What may be simulated, `entered` where they are: depots, with teams of free starts unless a `depot` is asked for.

    The last is where the team stands now, if it can reach the same cells.
    """
    sites = sites_of(world, cells)
    reached = reached_from(world, sites)
    depots = depots_of(world, robots, settings, sites, reached)
    for place in worth_simulating(depots, sites):
        depots[place] = replace(depots[place], entered=True)
    found = {} if not depot else {place.starts.tobytes(): place for place in depots}
    if not depot:
        found = {place.starts.tobytes(): place for place in depots if place.entered}
        found |= {place.starts.tobytes(): replace(place, entered=True) for place in teams_of(robots, sites, reached)}
    now = standing(world, robots)
    if not np.array_equal(world.accessible(now), world.accessible(cells[:1])):
        return list(found.values())
    known = found.pop(now.tobytes(), None) or Place(now, reached.bound(world, now))
    return [*found.values(), replace(known, entered=True, now=True)]


def standing(world: World, robots: int) -> NDArray[np.int64]:
    """Where the team stands if nobody says otherwise: the first so many starts of the input, else by its rule."""
    if world.starts is not None and len(world.starts) >= robots:
        return world.starts[:robots]
    return place_starts(world, robots, world.team.start)[0]


class _Field:
    """The places that are simulated against each other, and what is known of them.

    Attributes:
        race: of those `entered`, in the order of the places. cells: accessible.
        now: the place where the team stands, or none.
    """

    def __init__(
        self, world: World, settings: Settings, choices: RolloutChoices, places: Sequence[Place], depot: bool
    ) -> None:
        self.places = places
        self.entered = [number for number, place in enumerate(places) if place.entered]
        self.now = [number for number in self.entered if places[number].now]
        self.cells = int(world.accessible(places[0].starts).sum())
        depots = {self.contender(number) for number in self.entered if places[number].is_depot}
        hers = {self.contender(number) for number in self.now}
        self.able = depots if depot else range(len(self.entered))
        pairs = AllPairs()

        def enter(number: int) -> Trial:
            return Trial(world, allocated_plan(world, places[number].starts, settings), choices, pairs)

        self.race = Halving(
            [partial(enter, number) for number in self.entered],
            choices.rollouts,
            kept=[group for group in (depots, hers) if group],
        )

    def contender(self, place: int) -> int:
        """Its number in the race."""
        return self.entered.index(place)

    @property
    def best(self) -> int:
        """The place of the best found, of the depots where one is asked for."""
        return self.entered[self.race.best_of(self.able)]

    def known(self, place: Place, found: Measured) -> Place:
        """A place with what it comes to."""
        return replace(
            place,
            coverage=found.mean("visited", 1.0 / self.cells),
            value=found.mean("value") if found.counted == "value" else None,
            losses=found.mean("lost"),
            rollouts=found.rollouts,
        )

    def figures(self) -> tuple[Place, ...]:
        """All places, those that were simulated with their figures, and how far the best is ahead of the others."""
        found, best = list(self.places), self.contender(self.best)
        for contender, number in enumerate(self.entered):
            if contender in self.race.runs:
                behind = None if contender == best else self.race.behind(contender, best)
                found[number] = replace(self.known(found[number], self.race.runs[contender]), behind=behind)
        return tuple(found)

    def gain(self, fresh: Mapping[int, Measured]) -> Estimate | None:
        """How much more is covered from the best than from where the team stands, on fresh rollouts."""
        if not self.now or self.now[0] == self.best or self.now[0] not in fresh:
            return None
        best = fresh[self.best]
        unit = 1.0 if best.counted == "value" else 1.0 / self.cells
        return best.ahead(fresh[self.now[0]], best.counted, unit)
