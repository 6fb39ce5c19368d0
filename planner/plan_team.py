"""The plan that settings ask for, MRAC's nominal run for the closed loop or paths for the open one; or a file's."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from planner.arguments import POSITIVE, argument
from planner.errors import UsageError
from planner.mrac.make_plan import confirm_plan, make_plan
from planner.plans.plan import Plan
from planner.plans.plan_file import load_plan
from planner.settings import Settings
from planner.worlds.world import World


def read_plan(path: str | Path, world: World) -> Plan:
    """The plan in a file for `world`: one that `Plan.save` wrote, or the paths of another planner.

    Raises PlanError, naming robot, step or area, for what is no plan, belongs to another map or cannot be driven.
    """
    return confirm_plan(load_plan(path, world), world, str(path))


def plan_team(world: World, starts: ArrayLike, settings: Settings | None = None, seconds: float | None = None) -> Plan:
    """The plan for robots at `starts` `[K, 2]`, for the loop of `settings.plan_for`; `seconds`: for its search at most.

    Raises WorldError, PlanError, UsageError.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    if settings is None or settings.plan_for == "closed":
        if seconds is not None:
            raise UsageError(f"{argument('seconds', seconds)} is for plans for the open loop", fix="leave it out")
        return make_plan(world, starts, settings)
    from planner.open_loop.make_plan import make_open_loop_plan

    return make_open_loop_plan(world, starts, settings, seconds)
