"""A better order of areas on a map: what a cell of each counts for, found by trying (SPEC section 11, `priority`).

A rule prices areas one by one; which of them had better come first, because of what lies behind it or of who else is
near, a number for each says. Moves of a few numbers at a time, of larger areas more often, are kept where the team
covers no less: exactly where a tree tells it at once, else on common luck.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.trials.trial import Trial
from planner.kernels.loop import ClosedLoop
from planner.kernels.tables import AllPairs, by_price
from planner.mrac.make_plan import allocated
from planner.mrac.problem import Problem, worth_of
from planner.plans.plan import Plan
from planner.settings import MOST_PRIORITY, Settings
from planner.worlds.world import World

ROLLOUTS = 512
"""Of each order that is tried, where its tree takes too long."""
AT_ONCE = 0.01
"""The share of the seconds for a tree in which an order has to be known exactly."""
FINE = 8
"""Numbers are whole powers of 2 ** (1 / FINE)."""
FURTHEST = 5
"""A move multiplies by 2 ** (2 ** n / FINE), or divides, n below this: from 1.1 to 4 times."""


def can_order(settings: Settings) -> bool:
    """Whether the policy goes by prices, and nothing is refused for its price."""
    return settings.rule.by_price and settings.worth is None


def order_areas(
    world: World,
    starts: NDArray[np.int64],
    settings: Settings,
    choices: RolloutChoices,
    kept: AllPairs,
    tries: int,
    in_time: Callable[[], bool],
) -> Settings:
    """The settings with the best `priority` of so many tries, or of those that were `in_time`."""
    alike = replace(settings, priority=(MOST_PRIORITY,) * world.threat.size)
    problem, plan = allocated(world, starts, alike)
    base = Trial(world, plan, choices, kept)
    loop, draw, areas = base.loop, np.random.default_rng(choices.seed), len(plan.areas)
    assert loop is not None
    exact = base.known(AT_ONCE) is not None
    size = np.sqrt([len(area.cells) for area in plan.areas])
    best, most = np.zeros(areas, dtype=np.int64), _covered(base, exact)
    for _ in range(tries):
        if not in_time():
            break
        tried = best.copy()
        for area in draw.choice(areas, size=int(draw.integers(1, 4)), p=size / size.sum()):
            tried[area] += int(draw.choice((-1, 1))) << int(draw.integers(FURTHEST))
        counted = Trial(world, plan, choices, loop=_counting(loop, problem, _priority(plan, tried)))
        covered = _covered(counted, exact)
        if covered >= most:
            best, most = tried, covered
    return replace(settings, priority=tuple(_priority(plan, best).tolist()))


def _priority(plan: Plan, powers: NDArray[np.int64]) -> NDArray[np.int64]:
    """What each cell counts, int64 `[N]`, the powers `[areas]` of the areas at t = 0 given."""
    found = np.full(plan.shape[0] * plan.shape[1], MOST_PRIORITY, dtype=np.int64)
    shares = np.rint(MOST_PRIORITY * 2.0 ** ((powers - powers.max()) / FINE)).astype(np.int64)
    for area, share in zip(plan.areas, np.maximum(shares, 1), strict=True):
        found[area.cells] = share
    return found


def _counting(loop: ClosedLoop, problem: Problem, priority: NDArray[np.int64]) -> ClosedLoop:
    """The loop of robots that count cells so."""
    assert loop.policy is not None
    value = worth_of(problem.world, problem.levels.accessible, tuple(priority.tolist()))
    assert value is not None
    t = loop.tables
    ranks = by_price(replace(problem, value=value), t.area_cost, loop.cells, t.order, t.begin, t.level)
    return replace(loop, tables=t._replace(**ranks), policy=loop.policy._replace(value=value[loop.cells]))


def _covered(trial: Trial, exact: bool) -> float:
    """The share that is covered (or of all value); of one that is not known as the others are, less than any."""
    if not exact:
        return trial.sample(0, ROLLOUTS).share
    known = trial.known(2 * AT_ONCE)
    return -1.0 if known is None else known.share
