"""The largest time that a run can take: how far an interval of mean time has to reach for what was not seen."""

from __future__ import annotations

from typing import Literal

from numpy.typing import ArrayLike

from planner.mrac.problem import most_steps
from planner.mrac.unknown import unknown_of
from planner.plans.plan import Plan
from planner.settings import Settings
from planner.worlds.levels import find_levels
from planner.worlds.world import World, check_starts


def longest_mission(world: World, starts: ArrayLike, settings: Settings, given: int = 0) -> int:
    """T_max of the closed loop of robots at `starts` `[K, 2]`, in steps; `given`: steps of paths that they follow."""
    checked = check_starts(starts, world.met, world.source)
    unknown = unknown_of(world, checked, settings.levels)
    levels = find_levels(world, world.accessible(checked), settings.levels) if unknown is None else unknown.dearest
    return most_steps(settings, levels, given)


def longest_run(world: World, plan: Plan, loop: Literal["open", "closed"], known: int | None = None) -> int:
    """Steps that a run of this plan takes at most; `known`: T_max, if somebody made the closed loop already.

    Open loop: to the end of the longest path. One robot of ours that is told the map: its nominal run's, which a loss
    only cuts short. Else T_max, at which every run is cut off.
    """
    if loop == "open":
        return plan.makespan
    if len(plan.robots) == 1 and not plan.is_foreign and world.knowledge is None:
        return plan.time
    if known is not None:
        return known
    return longest_mission(world, plan.starts, plan.require(world), plan.makespan if plan.is_foreign else 0)
