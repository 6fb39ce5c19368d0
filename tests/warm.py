"""Compiles the programs of the closed loop, so that processes of tests find them (`python tests/warm.py RULE`)."""

from __future__ import annotations

import sys
from typing import Any

from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts


def run_missions(rule: str, *settings: Any) -> None:
    """A mission of the rule with each of these settings."""
    world = random_world(pattern=ThreatPattern(seed=3))
    starts = place_starts(world, 4)[0]
    for more in settings:
        loop = compile_closed_loop(make_plan(world, starts, Settings(policy=rule, **more)), world)
        run_range(loop, 0, 0, 64, threads=1, singles=True)


if __name__ == "__main__":
    # A plain mission, one that searches for distances, and one with all features.
    run_missions(sys.argv[1], {}, {"transit": "area"}, {"weibull_shape": 2.0})
