"""Which places are worth simulating: screened by a bound, depots by eq. (4) of one robot too, teams chosen greedily."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.depots.answer import Place
from analysis.depots.candidates import in_turn, spread_out
from analysis.theory.exact import open_loop_exact
from analysis.theory.own_bounds import best_survival
from analysis.theory.value import Worth
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.worlds.world import World

PLANNED, SIMULATED = 64, 48
"""Depots that eq. (4) is worked out for, and depots that are simulated, at most."""
SHARED = 24
"""Of the depots simulated, how many come from the sites in turn, so that no single site takes all."""
TEAMS = 24
"""Teams of free starts that are simulated, at most."""
MOST_CHANCES = 2**27
"""Most numbers kept of all sites' chances to reach all cells, a gigabyte."""


class Reached(NamedTuple):
    """Of a robot at each site, the most that can be made of the chance to visit each accessible cell, `[S, A]`.

    `value`: of those cells `[A]`; None: they count alike.
    """

    chances: NDArray[np.float64]
    value: NDArray[np.float64] | None

    def bound(self, world: World, starts: NDArray[np.int64]) -> float:
        """The bound of a team that starts anywhere, `[K, 2]`."""
        missed = 1.0 - best_survival(world, starts)[:, np.flatnonzero(world.accessible(starts))]
        return float(self.sum(1.0 - np.prod(missed, axis=0)))

    def sum(self, of_cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Over the last axis, cells by their value."""
        total: NDArray[np.float64] = of_cells.sum(axis=-1) if self.value is None else of_cells @ self.value
        return total


def reached_from(world: World, sites: Sequence[NDArray[np.int64]]) -> Reached:
    accessible = np.flatnonzero(world.accessible(sites[0][:1]))
    if len(sites) * len(accessible) > MOST_CHANCES:
        most = MOST_CHANCES // len(accessible)
        problem = f"candidates in {len(sites):,} places with danger between them"
        raise UsageError(problem, expected=f"at most {most:,} on this map", fix="name fewer")
    chances = np.concatenate([best_survival(world, site[:1])[:, accessible] for site in sites])
    return Reached(chances, None if world.value is None else world.value.reshape(-1)[accessible])


def depots_of(
    world: World,
    robots: int,
    settings: Settings,
    sites: Sequence[NDArray[np.int64]],
    reached: Reached,
) -> list[Place]:
    """Every candidate as a depot, the best bound first; those that are planned for have eq. (4)."""
    bounds = reached.sum(1.0 - (1.0 - reached.chances) ** robots)
    order = np.argsort(-bounds, kind="stable").tolist()
    ordered = [sites[site] for site in order]
    planned = {}
    for cell in islice(in_turn(ordered), PLANNED):
        alone = make_plan(world, cell[None], settings.alone)
        known = open_loop_exact(alone, world)
        own = known.visited if world.value is None else float(Worth.of(world).value @ known.visited_by_cell)
        planned[tuple(cell.tolist())] = own
    return [
        Place(np.tile(cell, (robots, 1)), float(bounds[site]), planned.get(tuple(cell.tolist())))
        for site, cells in zip(order, ordered, strict=True)
        for cell in cells
    ]


def worth_simulating(places: Sequence[Place], sites: Sequence[NDArray[np.int64]]) -> list[int]:
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


def teams_of(robots: int, sites: Sequence[NDArray[np.int64]], reached: Reached) -> list[Place]:
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


def _greedily(robots: int, first: int, reached: Reached) -> list[int]:
    """Sites: `first`, then each time the one that adds most to the bound."""
    chances, worth = reached.chances, 1.0 if reached.value is None else reached.value
    team, missed = [first], 1.0 - chances[first]
    while len(team) < robots:
        team.append(int(np.argmax(chances @ (missed * worth))))
        missed = missed * (1.0 - chances[team[-1]])
    return team


def _bound(reached: Reached, team: Sequence[int]) -> float:
    return float(reached.sum(1.0 - np.prod(1.0 - reached.chances[list(team)], axis=0)))
