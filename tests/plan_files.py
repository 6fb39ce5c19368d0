"""The plan in a file, for a world, before its nominal run is compared."""

from __future__ import annotations

from pathlib import Path

from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan, read_plan_json
from planner.world.world import World


def load_plan(path: str | Path, world: World) -> Plan:
    """As `planner.plan_team.read_plan`, but a plan of today's rules alone, and nothing is planned. Raises PlanError."""
    return parse_plan(read_plan_json(path), world, str(path))
