"""The rules behind `mrac-jax size`: when a team is enough, which teams are looked at, and which cannot be enough.

Pure functions of counts and numbers; what rolls out is `analysis.design.size`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.intervals import is_at_least
from planner.worlds.world import World

FEW = 32
"""So many teams below the one found are all looked at; of more, the search halves the gap first."""


class TeamVerdict(StrEnum):
    """What is known of one team."""

    ENOUGH = "enough"
    NOT_ENOUGH = "not enough"
    UNDECIDED = "undecided"
    IMPOSSIBLE = "impossible"
    """Not enough whatever the strategy: shown without rollouts."""


def judge_team(interval: tuple[float, float], wanted: float) -> TeamVerdict:
    """Enough if the whole interval lies at or above `wanted`, not enough if it lies below, else undecided."""
    verdicts = {True: TeamVerdict.ENOUGH, False: TeamVerdict.NOT_ENOUGH, None: TeamVerdict.UNDECIDED}
    return verdicts[is_at_least(interval, wanted)]


def smallest_enough(first: int, most: int, verdict_of: Callable[[int], TeamVerdict]) -> int | None:
    """The smallest team found to be enough among `first .. most`, or None; `verdict_of` is asked once for each team.

    Coverage need not grow with the team, so neither end of the search relies on it where that can be afforded: teams
    of `first + 0, 1, 2, 4, 8, ...` are looked at until one is enough (or `most` is reached); then all smaller ones
    that were passed over, in increasing order, if they are at most FEW. Of more, the gap below the team found is
    halved until at most FEW are in it, which are all looked at; those passed over elsewhere are not.
    """
    known: dict[int, bool] = {}

    def enough(robots: int) -> bool:
        if robots not in known:
            known[robots] = verdict_of(robots) is TeamVerdict.ENOUGH
        return known[robots]

    below, found = first - 1, None
    for robots in _strides(first, most):
        if enough(robots):
            found = robots
            break
        below = robots
    passed_over = [k for k in range(first, found or most) if k not in known]
    if len(passed_over) > FEW:
        if found is None:
            return None
        while found - below - 1 > FEW:
            middle = (below + found) // 2
            below, found = (below, middle) if enough(middle) else (middle, found)
        passed_over = list(range(below + 1, found))
    return next((robots for robots in passed_over if enough(robots)), found)


def _strides(first: int, most: int) -> Iterator[int]:
    yield first
    stride = 1
    while first + stride < most:
        yield first + stride
        stride *= 2
    if most > first:
        yield most


@dataclass(frozen=True, eq=False)
class Ideals:
    """Upper bounds for every strategy, by team: entry k - 1 is that of k robots, axis `most`.

    Attributes:
        coverage: float64, expected cells visited as a fraction of `cells`.
        chance: float64, chance to visit at least `needed` cells.
    """

    coverage: NDArray[np.float64]
    chance: NDArray[np.float64]


def team_ideals(world: World, starts: NDArray[np.int64], cells: int, needed: int, last_step: int | None) -> Ideals:
    """The ideals of the first 1, 2, ..., K robots of `starts` `[K, 2]` (row, col), for both meanings of "covered".

    The expectation is that of `analysis.theory.bounds.ideal_team`; its terms are chances, so they bound the chance too:
    who visits `needed` cells has lost fewer than k robots on `needed - 1` different cells before, at best on the least
    dangerous. By the end of step T, k robots have entered at most k (T + 1) cells.

    Args:
        cells: of which coverage is a fraction. needed: cells to visit. last_step: T, or None.
    """
    labels = world.components
    own = labels[starts[:, 0], starts[:, 1]]
    coverage, chance = np.zeros(len(starts)), np.zeros(len(starts))
    for robots in range(1, len(starts) + 1):
        if own[robots - 1] not in own[: robots - 1]:  # a part of the map that no robot before it can reach
            threat = world.threat[np.isin(labels, own[:robots])].astype(np.float64)
            expected, reached = ideals_of(threat, len(starts), needed)
        coverage[robots - 1], chance[robots - 1] = expected[robots - 1], reached[robots - 1]
    if last_step is not None:
        entries = np.arange(1, len(starts) + 1) * (last_step + 1.0)
        coverage, chance = np.minimum(coverage, entries), np.where(entries < needed, 0.0, chance)
    return Ideals(np.minimum(coverage / cells, 1.0), np.minimum(chance, 1.0))


def ideals_of(threat: NDArray[np.float64], most: int, needed: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(expected cells visited, chance to visit `needed` cells) at best by 1, 2, ..., `most` robots, float64 `[most]`.

    `threat`: float64 `[accessible]`, the accessible cells' p. One pass over the dangerous cells for all teams.
    """
    dangerous = np.sort(threat[threat > 0])
    safe = len(threat) - len(dangerous)
    total = np.full(most, float(safe))
    chance = np.full(most, 1.0 if needed <= safe else 0.0)
    hits = np.zeros(most)  # chance of so many hits on the cells so far
    hits[0] = 1.0
    for number, p in enumerate(dangerous, start=safe + 1):
        alive = np.cumsum(hits)
        total += alive
        if number == needed:
            chance = alive
        shifted = hits[:-1] * p
        hits *= 1.0 - p
        hits[1:] += shifted
    return total, chance
