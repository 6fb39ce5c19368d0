"""Compiles the programs of the closed loop, so that processes of tests find them (`python tests/warm.py RULE`)."""

import sys
from typing import Any

from planner.make_plan import allocated_plan
from planner.rollouts.closed_loop import compile_closed_loop, nominal_loop, run_range
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.single_run import play_compiled
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts


def loop_of(rule: str, **settings: Any) -> ClosedLoop:
    """A mission of the rule."""
    world = random_world(pattern=ThreatPattern(seed=3))
    plan = allocated_plan(world, place_starts(world, 4)[0], Settings(policy=rule, **settings))
    return compile_closed_loop(plan, world)


def run_nominal(rule: str) -> None:
    """The nominal run of a plain mission, by the program that keeps its legs."""
    play_compiled(nominal_loop(loop_of(rule)))


if __name__ == "__main__":
    run_nominal(sys.argv[1])
    # A plain mission, one that searches for distances, and one with all features.
    for settings in ({}, {"transit": "area"}, {"weibull_shape": 2.0}):
        run_range(loop_of(sys.argv[1], **settings), 0, 0, 64, threads=1, singles=True)
