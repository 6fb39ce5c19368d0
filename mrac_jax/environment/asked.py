"""What a world asks of the planner's settings in an environment, and what no environment can do."""

from __future__ import annotations

from typing import Any

from planner.arguments import argument
from planner.errors import PlanError
from planner.settings import Choices, Settings
from planner.worlds.world import World


def asked_of(world: World, **given: Any) -> Settings:
    """The settings that a world asks for, with `given` in the place of its own, as `evaluate` has it.

    Raises InputError, naming the world, for what an environment's steps do not play as `evaluate` would.
    """
    settings = Choices(**given).settings(world.team.settings, world.pace, by=world.source)
    settings.check_alike("the environment")
    bearing = settings.bearing()
    unlike = {
        "plan_for": settings.plan_for != "closed",
        "wear": bearing.shape != 1,
        "susceptibility": not bearing.is_even,
        "range": settings.range is not None,
        "return_to": settings.return_to is not None,
        "deadline": settings.deadline is not None,
    }
    for name in (name for name, is_so in unlike.items() if is_so):
        fix = f"leave {argument(name)} out" + (f", and give {argument('max_steps')}" if name == "deadline" else "")
        raise PlanError(f"the environment with {argument(name)}", source=world.source, fix=fix)
    return settings
