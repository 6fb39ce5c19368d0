"""The plan that settings ask for, MRAC's nominal run for the closed loop or paths for the open one; or a file's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from planner.arguments import POSITIVE, argument
from planner.errors import PlanError, UsageError
from planner.make_plan import confirm_plan, make_plan
from planner.plan.plan import FORMAT, Plan
from planner.plan.plan_file import parse_plan, read_plan_json
from planner.settings import Settings
from planner.world.features import BEFORE, as_before, rules_of
from planner.world.world import World

KEPT_READING = (
    "made by a release before 0.4 without `plan_on`, so robots plan on all moving threats here (`plan_on: joined`)"
)


def read_plan(path: str | Path, world: World) -> Plan:
    """The plan in a file for `world`: one that `Plan.save` wrote, or the paths of another planner.

    Raises PlanError, naming robot, step or area, for what is no plan, belongs to another map or cannot be driven.
    """
    of, plan = read_plan_on(path, world)
    if of is not world:
        problem = "made by a release before 0.4, which planned on all moving threats where `plan_on` was not given"
        raise PlanError(problem, source=path, fix='make the world with plan_on="joined", or make the plan anew')
    return plan


def read_plan_on(path: str | Path, world: World) -> tuple[World, Plan]:
    """The plan in a file, and the world that it is for: `world`, or that as releases before 0.4 made it.

    So a plan of such a release keeps its reading of a scenario that does not say what robots plan on among moving
    threats; its notes say so. Raises PlanError.
    """
    source, before, data = str(path), as_before(world), read_plan_json(path)
    if before is not world and _of_version_1(data, before.sha256):
        plan = confirm_plan(parse_plan(data, before, source), before, source)
        return before, replace(plan, notes=(*plan.notes, f"{source}: {KEPT_READING}"))
    plan = parse_plan(data, world, source)
    try:
        return world, confirm_plan(plan, world, source)
    except PlanError as error:
        same = plan.settings is None or rules_of(world, plan.settings, closed=False) == BEFORE
        if same or not _of_version_1(data, world.sha256):
            raise
        expected = f"{error.expected}; release 0.4 changed the rules for phases and for several types of robots"
        raise PlanError(error.problem, source=source, expected=expected, fix=error.fix) from error


def _of_version_1(data: object, sha256: str) -> bool:
    """Whether a file's JSON is a plan by a release before 0.4, for the map with this hash."""
    if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") != 1:
        return False
    named = data.get("world")
    return isinstance(named, dict) and named.get("sha256") == sha256


def plan_team(world: World, starts: ArrayLike, settings: Settings | None = None, seconds: float | None = None) -> Plan:
    """The plan for robots at `starts` `[K, 2]`, for the loop of `settings.plan_for`; `seconds`: for its search at most.

    Raises WorldError, PlanError, UsageError.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    if settings is None or settings.plan_for == "closed_loop":
        if seconds is not None:
            raise UsageError(f"{argument('seconds', seconds)} is for plans for the open loop", fix="leave it out")
        return make_plan(world, starts, settings)
    from planner.open_loop import make_open_loop_plan

    return make_open_loop_plan(world, starts, settings, seconds)
