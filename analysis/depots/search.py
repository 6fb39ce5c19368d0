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
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.depots.answer import Place, Starts
from analysis.depots.candidates import BORDER, candidate_cells, in_turn, sites_of, spread_out
from analysis.halving import BY_CELLS, Halving, Roll, Runs, check_search, roll_of
from analysis.kit.notes import Progress
from analysis.sampling import RolloutChoices, is_certain
from analysis.theory.exact import open_loop_exact
from analysis.theory.own_bounds import best_survival
from mrac_jax.engine import choose_engine
from planner.arguments import argument, is_whole
from planner.errors import UsageError
from planner.kernels.tables import AllPairs
from planner.mrac.make_plan import make_plan
from planner.plans.settings import Settings
from planner.worlds.world import MAX_ROBOTS, World

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
    candidates: Any = BORDER,
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
    chances = _chances(world, sites)
    places = _depots(world, robots, settings, sites, chances) if depot else _teams(robots, sites, chances)
    chosen = _worth_simulating(places, sites) if depot else list(range(len(places)))
    kept = AllPairs()
    contenders = [partial(_roll, world, places[place].starts, settings, choices, kept) for place in chosen]
    race = Halving(contenders, robots, choices.rollouts)
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
            places[place] = _simulated(places[place], race, contender, known, robots, certain and place == best)
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
        confirmed=None if again is None else _figures(again, known, robots, certain),
        words=tuple(words),
        partial=stopped,
        notes=notes + ((BY_CELLS,) if world.value is not None else ()),
    )


def team_size(world: World, robots: int | None) -> int:
    """How many robots: as asked for, else as many as the input's starts, else its count, else 1. Raises UsageError."""
    if robots is not None and not is_whole(robots, 1, MAX_ROBOTS):
        raise UsageError(argument("robots", robots), expected=f"a whole number, 1 to {MAX_ROBOTS}")
    named = len(world.starts) if world.starts is not None else world.team.robots or 1
    return named if robots is None else robots


def _roll(world: World, starts: NDArray[np.int64], settings: Settings, choices: RolloutChoices, kept: AllPairs) -> Roll:
    return roll_of(world, make_plan(world, starts, settings), choices, kept=kept)


def _figures(runs: Runs, cells: int, robots: int, certain: bool) -> tuple[Any, Any]:
    """(coverage, losses)."""
    return runs.coverage(cells, certain), runs.losses(robots, certain)


def _simulated(place: Place, race: Halving, contender: int, cells: int, robots: int, certain: bool) -> Place:
    runs = race.of(contender)
    coverage, losses = _figures(runs, cells, robots, certain)
    low, high = race.behind(contender, cells)
    behind = None if contender == race.best else (low / cells, high / cells)
    return Place(place.starts, place.screen, place.one_robot, coverage, losses, len(runs), behind)


def _chances(world: World, sites: Sequence[NDArray[np.int64]]) -> NDArray[np.float64]:
    """Of a robot at each site, the most that can be made of the chance to visit each accessible cell, `[S, A]`."""
    accessible = np.flatnonzero(world.accessible(sites[0][:1]))
    if len(sites) * len(accessible) > MOST_CHANCES:
        most = MOST_CHANCES // len(accessible)
        problem = f"candidates in {len(sites):,} places with danger between them"
        raise UsageError(problem, expected=f"at most {most:,} on this map", fix="name fewer")
    return np.concatenate([best_survival(world, site[:1])[:, accessible] for site in sites])


def _depots(
    world: World,
    robots: int,
    settings: Settings,
    sites: Sequence[NDArray[np.int64]],
    chances: NDArray[np.float64],
) -> list[Place]:
    """Every candidate as a depot, the best bound first; those that are planned for have eq. (4)."""
    bounds = (1.0 - (1.0 - chances) ** robots).sum(axis=1)
    order = np.argsort(-bounds, kind="stable").tolist()
    ordered = [sites[site] for site in order]
    planned, own_range = {}, settings.range
    one = replace(settings, range=own_range[0] if isinstance(own_range, tuple) else own_range)
    for cell in islice(in_turn(ordered), PLANNED):
        alone = make_plan(world, cell[None], one)
        planned[tuple(cell.tolist())] = open_loop_exact(alone, world).visited
    return [
        Place(np.tile(cell, (robots, 1)), float(bounds[site]), planned.get(tuple(cell.tolist())))
        for site, own in zip(order, ordered, strict=True)
        for cell in own
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


def _teams(robots: int, sites: Sequence[NDArray[np.int64]], chances: NDArray[np.float64]) -> list[Place]:
    """Teams with a start each: the rest chosen greedily by the bound after every site as the first; and all at one.

    The bound is submodular, so a greedy team's is at least 1 - 1/e of the best one's. It does not tell the cells of a
    site apart: there are several teams of the same sites, at other cells of theirs.
    """
    alone = np.argsort(-chances.sum(axis=1), kind="stable").tolist()
    chosen = [_greedily(robots, first, chances) for first in alone[:TEAMS]] + [[site] * robots for site in alone[:2]]
    ways = sorted({tuple(sorted(way)): None for way in chosen}, key=lambda way: -_bound(chances, way))
    found: dict[bytes, Place] = {}
    for turn in range(TEAMS):
        for way in ways:
            starts = np.array([sites[site][(way[:place].count(site) + turn) % len(sites[site])]
                               for place, site in enumerate(way)])  # fmt: skip
            if len(found) < TEAMS:
                found.setdefault(starts.tobytes(), Place(starts, _bound(chances, way)))
    return list(found.values())


def _greedily(robots: int, first: int, chances: NDArray[np.float64]) -> list[int]:
    """Sites: `first`, then each time the one that adds most to the bound."""
    team, missed = [first], 1.0 - chances[first]
    while len(team) < robots:
        team.append(int(np.argmax(chances @ missed)))
        missed = missed * (1.0 - chances[team[-1]])
    return team


def _bound(chances: NDArray[np.float64], team: Sequence[int]) -> float:
    return float((1.0 - np.prod(1.0 - chances[list(team)], axis=0)).sum())
