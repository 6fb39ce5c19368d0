"""The plan for settings, closed-loop (MRAC's nominal run) or open-loop (paths); or the plan in a file."""

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
from planner.world.start_rule import BEFORE, as_before, rules_of
from planner.world.world import World

KEPT_READING = (
    "made by a release before 0.4 without `plan_on`, so robots plan on all moving threats here (`plan_on: joined`)"
)


def read_plan(path: str | Path, world: World) -> Plan:
    """Read a plan for a world: `mrac-plan`, or an external plan.

    Args:
        path: the file.
        world: the map.

    Raises:
        PlanError: names robot, step or area if it is no plan, is for another map or cannot be driven.
    """
    of, plan = read_plan_on(path, world)
    if of is not world:
        problem = "made by a release before 0.4, which planned on all moving threats where `plan_on` was not given"
        raise PlanError(problem, source=path, fix='make the world with plan_on="joined", or make the plan again')
    return plan


def read_plan_on(path: str | Path, world: World) -> tuple[World, Plan]:
    """The plan in a file and its world: `world`, or the same as releases before 0.4 made it.

    So an older plan keeps its reading of a scenario without `plan_on` for moving threats; its notes say so.

    Args:
        path: the file.
        world: the map.

    Raises:
        PlanError: as in `read_plan`.
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
    """Whether a file's JSON is a plan of a release before 0.4 for the map with this hash."""
    if not isinstance(data, dict) or data.get("format") != FORMAT or data.get("version") != 1:
        return False
    named = data.get("world")
    return isinstance(named, dict) and named.get("sha256") == sha256


def plan_team(world: World, starts: ArrayLike, settings: Settings | None = None, seconds: float | None = None) -> Plan:
    """Make the plan for the loop of `settings.plan_for`.

    Args:
        world: the map.
        starts: `[K, 2]`, (row, col).
        settings: of the planner; None: the defaults.
        seconds: time limit of the search for an open-loop plan.

    Raises:
        WorldError, PlanError, UsageError: an invalid input.
    """
    POSITIVE.check("seconds", seconds, optional=True)
    if settings is None or settings.plan_for == "closed_loop":
        if seconds is not None:
            raise UsageError(f"{argument('seconds', seconds)} is for plans for the open loop", fix="leave it out")
        return make_plan(world, starts, settings)
    from planner.open_loop import make_open_loop_plan

    return make_open_loop_plan(world, starts, settings, seconds)
