"""The simulator as Python and the compiled one are the same, event for event, whatever the mission."""

import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import FunctionType
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from closed_loop_worlds import survey_worlds
from drawn_worlds import drawn_mission
from helpers import play_both_ways
from numba.core.dispatcher import Dispatcher
from test_planner_policies import LIMITED, dearest_rule

import mrac_jax as mrac
from planner.errors import InputError, PlanError, WorldError
from planner.make_plan import allocated_plan, make_plan
from planner.rollouts.closed_loop import compile_closed_loop, with_nominal_run
from planner.rollouts.single_run import PythonLoop
from planner.simulator import jit, step
from planner.simulator.codes import Doing, EventKind
from planner.simulator.jit import NAME, interpreted
from planner.simulator.offers import CellOffer
from planner.world.uncertain_maps import Hazard
from planner.world.world import World


def same_both_ways(number: int) -> Counter[str]:
    """Three rollouts of a drawn mission, and its nominal run; what happened in them."""
    world, starts, settings = drawn_mission(number)
    begun = allocated_plan(world, starts, settings)
    try:
        quick = with_nominal_run(begun, compile_closed_loop(begun, world))
    except InputError as error:
        assert settings.transit == "area" and ("require" in str(error) or "does not support" in str(error))
        return Counter(("refused",))
    with patch("planner.rollouts.runners.has_program", lambda *_: False):
        plan = make_plan(world, starts, settings)
    by_either = [[one.outcome, one.time, one.shares, [r.path.tolist() for r in one.robots]] for one in (quick, plan)]
    assert by_either[0] == by_either[1] and quick.sha256 == plan.sha256, number
    # Of a large map a compiled program makes the plan; its source is what runs here.
    python = patch("planner.rollouts.runners.run_group_tasks", interpreted("rollouts").run_group_tasks)
    with python, patch("planner.make_plan.LARGE", 0), np.errstate(over="ignore"):
        assert make_plan(world, starts, settings).to_json() == plan.to_json(), number
    learns = isinstance(world.uncertainty, Hazard) and world.uncertainty.learn
    runs = play_both_ways(plan, world, number, 3, first_only=number % 4 == 3 and not learns)
    seen = Counter((f"nominal {plan.outcome}", *(run.outcome.word for run in runs)))
    for run in runs:
        seen.update(EventKind(kind).name for kind in run.trace.events[:, 2])
        seen.update(Doing(doing).name for doing in np.unique(run.trace.doing))
    return seen


RARE = [24, 38, 42, 64, 67, 94, 97, 116, 126, 134, 135, 144]
"""Missions in which happens what few drawn ones have: batteries are charged, robots return, plans end early."""


@pytest.mark.parametrize("numbers", [[*range(8), *RARE], pytest.param(range(2000), marks=pytest.mark.slow)], ids=len)
def test_drawn_missions(numbers: list[int]) -> None:
    seen = sum((same_both_ways(number) for number in numbers), Counter[str]())
    assert {kind.name for kind in EventKind} | {doing.name for doing in Doing} - {"FOLLOWING"} <= seen.keys()
    ends = {"complete", "no_progress", "not_worth_the_risk"}
    assert ends | {f"nominal {end}" for end in {*ends, "deadline"}} | {"all_robots_lost", "step_limit"} <= seen.keys()
    assert seen["refused"] < len(numbers) / 6


@pytest.mark.parametrize("every", [12, pytest.param(4, marks=pytest.mark.slow)])
def test_the_survey_of_worlds_by_all_rules(every: int) -> None:
    """Mazes, halls, strips, and all other kinds of the survey: limits on a team, orders, and legs inside in turn."""
    counts, differ = np.zeros(len(EventKind), dtype=np.int64), 0
    for number, one in enumerate(survey_worlds()[::every]):
        limits: dict[str, Any] = [{}, *LIMITED][number % 10]
        transit: Any = ("grid", "area")[number // 10 % 2]
        order: Any = ("nearest", "boustrophedon", "rows", "columns")[number % 4]
        asked = replace(one.settings, transit=transit, in_area=order, **limits)
        try:
            plan = make_plan(one.world, one.starts, asked)
        except WorldError as error:
            assert "too expensive" in str(error)
            continue
        (run,) = play_both_ways(plan, one.world, 5, 1, first_only=one.first_only)
        assert (run.trace.events[:, 2] != EventKind.REFUSED).all() or "robot_value" in limits
        counts += np.bincount(run.trace.events[:, 2], minlength=len(EventKind))
        if order != "nearest":
            usual = make_plan(one.world, one.starts, replace(asked, in_area="nearest"))
            differ += any(not np.array_equal(a.path, b.path) for a, b in zip(plan.robots, usual.robots, strict=True))
    assert min(counts[kind] for kind in (EventKind.LOOKED_AGAIN, EventKind.SHARED, EventKind.REFUSED)) > 3
    assert differ >= 2


def test_it_is_loaded_once_and_changes_nothing_that_is_compiled() -> None:
    found = interpreted("step")
    assert found is interpreted("step") is sys.modules[f"{NAME}.step"] is not step
    assert isinstance(found.advance, FunctionType) and isinstance(step.advance, Dispatcher)
    assert interpreted("jit").INTERPRETED and not jit.INTERPRETED and interpreted("jit").kernel is not jit.kernel


# What compiled programs do not follow: a user's own function.


def test_a_rule_of_the_user_s_own(tmp_path: Path) -> None:
    world = World.create([[0.3, 0.0, 0.0, 0.1]])
    plan = mrac.plan(world, starts=[[0, 1]], policy=dearest_rule)
    assert plan.robots[0].path.tolist() == [1, 2, 1, 0, 1, 2, 3]
    assert mrac.plan(world, starts=[[0, 1]]).robots[0].path.tolist() == [1, 2, 3, 2, 1, 0]
    function = mrac.plan(world, starts=[[0, 1]], policy=lambda offer: -offer.level)
    assert function.robots[0].path.tolist() == plan.robots[0].path.tolist()
    assert PythonLoop(function, world).run(1, 0).visited.any()
    for own in (plan, function):
        with pytest.raises(PlanError, match=r"own rule .* cannot be saved"):
            own.save(tmp_path / "plan.json")
        assert mrac.evaluate(world, own, rollouts=64, loop="open").tally.rollouts == 64
    with pytest.raises(InputError, match=r"do not support the user.s own rule"):
        mrac.evaluate(world, function, rollouts=64)


def farthest_first(offer: CellOffer) -> tuple[int, int]:
    return -offer.cost, offer.cell


@pytest.mark.parametrize("transit", ["grid", "area"])
def test_an_in_area_order_of_the_user_s_own_is_followed_or_refused(transit: Any, tmp_path: Path) -> None:
    world = World.create(np.zeros((1, 5)))
    plan = mrac.plan(world, starts=[[0, 1]], transit=transit, in_area=farthest_first)
    assert plan.robots[0].path.tolist() == [1, 2, 3, 4, 3, 2, 1, 0]
    assert PythonLoop(plan, world).run(1, 0).trace.cells[:, 0].tolist() == plan.robots[0].path.tolist()
    with pytest.raises(PlanError, match="in-area order of the user's own cannot be saved"):
        plan.save(tmp_path / "plan.json")
    with pytest.raises(InputError, match="do not support an in-area order"):
        compile_closed_loop(plan, world)
    same = mrac.plan(world, starts=[[0, 1]], transit=transit, in_area=lambda offer: (offer.cost, offer.cell))
    assert same.robots[0].path.tolist() == mrac.plan(world, starts=[[0, 1]]).robots[0].path.tolist()
