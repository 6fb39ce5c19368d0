"""The nominal run of the compiled simulator is the readable one's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from closed_loop_worlds import survey_worlds

from planner.errors import WorldError
from planner.mrac.make_plan import allocated_plan, make_plan
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, with_nominal_run
from planner.world.features import Obstacles, with_prior
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts

ASKED: dict[str, dict[str, Any]] = {
    "complete": {}, "step_limit": {"max_steps": 9}, "no_progress": {"range": 7},
    "not_worth_the_risk": {"policy": "per_cell", "worth": 9.0, "reserve": 0.25},
}  # fmt: skip
"""By an outcome that some of the runs have."""


def nominal(plan: Plan) -> tuple[object, ...]:
    paths = [robot.path.tolist() for robot in plan.robots]
    areas = [(area.level, area.robot, area.cells.tolist()) for area in plan.areas]
    return paths, areas, plan.outcome, plan.time, plan.shares, plan.settings, plan.sha256


@pytest.mark.parametrize("outcome", ASKED)
def test_paths_and_outcome_are_those_of_the_plan(outcome: str) -> None:
    plans = []
    for one in survey_worlds()[list(ASKED).index(outcome) :: 2 * len(ASKED)]:
        asked = replace(one.settings, **ASKED[outcome])
        try:
            begun = allocated_plan(one.world, one.starts, asked)
        except WorldError as error:
            assert "too dear" in str(error)
            continue
        plans.append(make_plan(one.world, one.starts, asked))
        assert nominal(with_nominal_run(begun, compile_closed_loop(begun, one.world))) == nominal(plans[-1]), one.name
    assert outcome in {plan.outcome for plan in plans}
    assert any(plan.shares for plan in plans) and len(plans) > 20


@pytest.mark.parametrize("obstacles", ["unknown", "known"])
def test_robots_that_learn_plan_on_what_they_believe(obstacles: Obstacles) -> None:
    for seed, policy in ((3, "mrac"), (4, "per_cell")):
        true = random_world(9, 11, ThreatPattern(seed=seed))
        starts, asked = place_starts(true, 3)[0], Settings(policy=policy)
        world = with_prior(true, 0.04, obstacles, sense=2)
        begun, plan = allocated_plan(world, starts, asked), make_plan(world, starts, asked)
        loop = compile_closed_loop(begun, world)
        assert loop.learns and nominal(with_nominal_run(begun, loop)) == nominal(plan)
