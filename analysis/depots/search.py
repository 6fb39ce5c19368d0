"""The best starts of a team: screened by a bound and by eq. (4), the best of those simulated on common luck.

1. Every candidate: the *reach bound* `sum_c g_c` (`analysis.theory.own_bounds.reach_chances`), one search a site.
2. One depot: eq. (4) of one robot's plan from PLANNED candidates, the sites in turn, the best bound first.
   One start each: teams chosen greedily by the bound, from every site as the first.
3. The best SIMULATED of them: `analysis.halving`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.depots.answer import Place, Starts
from analysis.depots.candidates import BORDER, candidate_cells, in_turn, sites_of, spread_out
from analysis.halving import Halving, Roll, Runs, check_search, roll_of
from analysis.kit.notes import Progress
from analysis.sampling import RolloutChoices, is_certain
from analysis.theory.exact import open_loop_exact
from analysis.theory.own_bounds import best_survival
from analysis.theory.value import Worth
from analysis.valuing import most_units
from planner.errors import UsageError
from planner.kernels.tables import AllPairs
from planner.mrac.make_plan import make_plan
from planner.plans.settings import Settings
from planner.rollouts.engine import choose_engine
from planner.worlds.starts import check_robots
from planner.worlds.world import World

PLANNED, SIMULATED = 64, 48
"""Depots that eq. (4) is worked out for, and places that are simulated, at most."""
SHARED = 24
"""Of the depots simulated, how many come from the sites in turn, so that no single site takes all."""
TEAMS = 24
"""Teams of free starts that are simulated, at most."""
MOST_CHANCES = 2**27
"""Most numbers kept of all sites' chances to reach all cells, a gigabyte."""
Doing = Callable[[str], None]


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
    check_search(world, settings, choices, "a search for starts")
    say = doing or (lambda what: None)
    cells, notes = candidate_cells(world, candidates, source)
    say("screening")
    sites = sites_of(world, cells)
    reached = _reached(world, sites)
    places = _depots(world, robots, settings, sites, reached) if depot else _teams(robots, sites, reached)
    chosen = _worth_simulating(places, sites) if depot else list(range(len(places)))
    kept = AllPairs()
    contenders = [partial(_roll, world, places[place].starts, settings, choices, kept) for place in chosen]
    race = Halving(contenders, robots, choices.rollouts, valued=world.value is not None)
    again, stopped = None, False
    say("simulating")
    try:
        race.run(progress)
        say("the best on other rollouts")
        again = race.confirm(race.best)
    except KeyboardInterrupt:
        if race.rolled == 0:
            raise
        stopped = True
    known = int(world.accessible(cells[:1]).sum())
    best = chosen[race.best]
    certain = is_certain(world, make_plan(world, places[best].starts, settings))
    for contender, place in enumerate(chosen):
        if race.runs[contender] is not None:
            found = _figures(places[place], race.of(contender), world, known, certain and place == best)
            places[place] = (
                found if contender == race.best else replace(found, behind=_behind(race, contender, world, known))
            )
    return Starts(
        world=world,
        settings=settings,
        depot=depot,
        choices=choices,
        places=tuple(places),
        best=best,
        candidates=cells,
        cells=known,
        engine=choose_engine(choices.engine).name,
        rolled=race.rolled + (0 if again is None else len(again)),
        confirmed=None if again is None else _figures(places[best], again, world, known, certain),
        words=tuple(words),
        partial=stopped,
        notes=notes,
    )


def team_size(world: World, robots: int | None) -> int:
    """How many robots: as asked for, else as many as the input's starts, else its count, else 1. Raises UsageError."""
    check_robots(robots)
    named = len(world.starts) if world.starts is not None else world.team.robots or 1
    return named if robots is None else robots


def _roll(world: World, starts: NDArray[np.int64], settings: Settings, choices: RolloutChoices, kept: AllPairs) -> Roll:
    return roll_of(world, make_plan(world, starts, settings), choices, kept=kept)


def _figures(place: Place, runs: Runs, world: World, cells: int, certain: bool) -> Place:
    """A place with what its rollouts come to."""
    return replace(
        place,
        coverage=runs.coverage(cells, certain),
        value=runs.share_of_value(world.threat.size, certain),
        losses=runs.losses(len(place.starts), certain),
        rollouts=len(runs),
    )


def _behind(race: Halving, contender: int, world: World, cells: int) -> tuple[float, float]:
    most = cells if world.value is None else most_units(world.threat.size)
    low, high = race.behind(contender, most)
    return low / most, high / most


class _Reached(NamedTuple):
    """Of a robot at each site, the most that can be made of the chance to visit each accessible cell, `[S, A]`.

    `value`: of those cells `[A]`; None: they count alike.
    """

    chances: NDArray[np.float64]
    value: NDArray[np.float64] | None

    def sum(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Over the last axis, cells by their value."""
        total: NDArray[np.float64] = of_cells.sum(axis=-1) if self.value is None else of_cells @ self.value
        return total


def _reached(world: World, sites: Sequence[NDArray[np.int64]]) -> _Reached:
    accessible = np.flatnonzero(world.accessible(sites[0][:1]))
    if len(sites) * len(accessible) > MOST_CHANCES:
        most = MOST_CHANCES // len(accessible)
        problem = f"candidates in {len(sites):,} places with danger between them"
        raise UsageError(problem, expected=f"at most {most:,} on this map", fix="name fewer")
    chances = np.concatenate([best_survival(world, site[:1])[:, accessible] for site in sites])
    return _Reached(chances, None if world.value is None else world.value.reshape(-1)[accessible])


def _depots(
    world: World,
    robots: int,
    settings: Settings,
    sites: Sequence[NDArray[np.int64]],
    reached: _Reached,
) -> list[Place]:
    """Every candidate as a depot, the best bound first; those that are planned for have eq. (4)."""
    bounds = reached.sum(1.0 - (1.0 - reached.chances) ** robots)
    order = np.argsort(-bounds, kind="stable").tolist()
    ordered = [sites[site] for site in order]
    planned, own_range = {}, settings.range
    one = replace(settings, range=own_range[0] if isinstance(own_range, tuple) else own_range)
    for cell in islice(in_turn(ordered), PLANNED):
        alone = make_plan(world, cell[None], one)
        known = open_loop_exact(alone, world)
        own = known.visited if world.value is None else float(Worth.of(world).value @ known.visited_by_cell)
        planned[tuple(cell.tolist())] = own
    return [
        Place(np.tile(cell, (robots, 1)), float(bounds[site]), planned.get(tuple(cell.tolist())))
        for site, cells in zip(order, ordered, strict=True)
        for cell in cells
    ]


def _worth_simulating(places: Sequence[Place], sites: Sequence[NDArray[np.int64]]) -> list[int]:
    """Which depots are simulated: SHARED from the sites in turn, then those whose nearest planned one is best.

    Eq. (4) hardly differs within a site; depots that it does not tell apart are spread out.
    """
    at = {tuple(place.starts[0].tolist()): number for number, place in enumerate(places)}
    expected = np.full(len(places), -np.inf)
    leaders = []
    for site in sites:
        numbers = np.array([at[tuple(cell.tolist())] for cell in site])
        known = numbers[[places[number].one_robot is not None for number in numbers]]
        if len(known):
            values = np.array([places[number].one_robot for number in known])
            near = np.array([[np.abs(places[n].starts[0] - places[m].starts[0]).sum() for m in known] for n in numbers])
            expected[numbers] = values[near.argmin(axis=1)]
            leaders.append(known[np.argsort(-values, kind="stable")])
    leaders.sort(key=lambda numbers: (-expected[numbers[0]], numbers[0]))
    chosen = [int(number) for number in islice(in_turn(leaders), SHARED)]
    for value in np.unique(expected[np.isfinite(expected)])[::-1]:
        alike = np.setdiff1d(np.flatnonzero(expected == value), chosen)
        if len(alike) and len(chosen) < SIMULATED:
            spread = spread_out(np.array([places[number].starts[0] for number in alike]))
            chosen += [at[tuple(cell.tolist())] for cell in spread[: SIMULATED - len(chosen)]]
    return chosen


def _teams(robots: int, sites: Sequence[NDArray[np.int64]], reached: _Reached) -> list[Place]:
    """Teams with a start each: the rest chosen greedily by the bound after every site as the first; and all at one.

    The bound is submodular, so a greedy team's is at least 1 - 1/e of the best one's. It does not tell the cells of a
    site apart: there are several teams of the same sites, at other cells of theirs.
    """
    alone = np.argsort(-reached.sum(reached.chances), kind="stable").tolist()
    chosen = [_greedily(robots, first, reached) for first in alone[:TEAMS]] + [[site] * robots for site in alone[:2]]
    ways = sorted({tuple(sorted(way)): None for way in chosen}, key=lambda way: -_bound(reached, way))
    found: dict[bytes, Place] = {}
    for turn in range(TEAMS):
        for way in ways:
            starts = np.array([sites[site][(way[:place].count(site) + turn) % len(sites[site])]
                               for place, site in enumerate(way)])  # fmt: skip
            if len(found) < TEAMS:
                found.setdefault(starts.tobytes(), Place(starts, _bound(reached, way)))
    return list(found.values())


def _greedily(robots: int, first: int, reached: _Reached) -> list[int]:
    """Sites: `first`, then each time the one that adds most to the bound."""
    chances, worth = reached.chances, 1.0 if reached.value is None else reached.value
    team, missed = [first], 1.0 - chances[first]
    while len(team) < robots:
        team.append(int(np.argmax(chances @ (missed * worth))))
        missed = missed * (1.0 - chances[team[-1]])
    return team


def _bound(reached: _Reached, team: Sequence[int]) -> float:
    return float(reached.sum(1.0 - np.prod(1.0 - reached.chances[list(team)], axis=0)))
