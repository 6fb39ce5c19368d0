"""An order of areas that is found: how near the optimum it comes, and that all engines follow it as they do values."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop_compare import assert_same_tally, assert_same_trace
from oracle_tree import closed_loop_exact
from plan_files import load_plan

from analysis.estimators.racing import order_areas
from analysis.sampling import RolloutChoices
from analysis.theory.flow_programme import optimum
from planner.errors import PlanError
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.rollouts.engine import closed_loop_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop
from planner.simulator.tables import AllPairs
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

BASE = Settings(policy="watchful")


def test_on_tiny_worlds_it_closes_most_of_what_the_rule_lacks_to_the_optimum() -> None:
    lacks = []
    for seed in range(1, 7):
        kind = ThreatPattern("scattered", levels=(0.04, 0.12, 0.2, 0.3, 0.4), seed=seed)
        world = random_world(4, 4, kind, obstacles=0.2, threats=0.5)
        starts = place_starts(world, 1)[0]
        most = optimum(world, starts)
        assert most is not None
        found = order_areas(world, starts, BASE, RolloutChoices(), AllPairs(), 150, lambda: True)
        covered = [closed_loop_exact(make_plan(world, starts, one), world).visited for one in (BASE, found)]
        assert covered[0] <= covered[1] + 1e-9 <= most + 2e-9
        lacks.append(most - np.array(covered))
    before, after = np.sum(lacks, axis=0)
    assert before > 0.05 and after < before / 2


def ordered(seed: int, policy: str) -> tuple[World, Plan, Plan]:
    """A world, its plan by numbers for cells, and the plan for the world in which cells are worth these."""
    world = random_world(9, 8, ThreatPattern("scattered" if seed % 2 else "contiguous", 4, seed=seed), threats=0.35)
    first = 1 + np.arange(world.threat.size) * (7 + seed) % 11
    starts, by = place_starts(world, 3)[0], Settings(policy=policy, reserve=0.5)
    plan = make_plan(world, starts, replace(by, priority=tuple(first.tolist())))
    return world, plan, make_plan(valued(world, plan), starts, by)


def valued(world: World, plan: Plan) -> World:
    assert plan.settings is not None
    return world.with_values(np.where(world.free, np.reshape(plan.settings.priority, world.shape), 0.0))


def test_cells_count_in_decisions_as_if_they_were_worth_as_much(tmp_path: Path) -> None:
    differs = 0
    for seed in range(4):
        world, plan, other = ordered(seed, ("watchful", "per_cell")[seed // 2])
        assert plan.to_json()["robots"] == other.to_json()["robots"]
        differs += plan.to_json()["robots"] != make_plan(world, plan.starts, BASE).to_json()["robots"]
        plan.save(tmp_path / "plan.json", force=True)
        loaded = load_plan(tmp_path / "plan.json", world)
        assert loaded.settings == plan.settings
        readable, compiled = ReferenceLoop(loaded, world), closed_loop_engine(compile_closed_loop(loaded, world), 3)
        by_value = closed_loop_engine(compile_closed_loop(other, valued(world, plan)), 3)
        for mine, theirs in zip(compiled.traces(range(8)), by_value.traces(range(8)), strict=True):
            assert_same_trace(mine, readable.trace(3, mine.rollout))
            assert_same_trace(mine, theirs)
    assert differs


@pytest.mark.slow
def test_jax_follows_it_too(few_lanes: None) -> None:
    for seed in range(4):
        world, plan, _ = ordered(seed, ("watchful", "per_cell")[seed // 2])
        loop = compile_closed_loop(plan, world)
        assert_same_tally(*(closed_loop_engine(loop, 3, name).tally(0, 64) for name in ("jax", "numba")))


def test_what_does_not_go_with_it_is_refused(tmp_path: Path) -> None:
    world, plan, _ = ordered(1, "watchful")
    settings = plan.settings
    assert settings is not None
    for wrong, said in (
        (replace(settings, reserve=None, policy="mrac"), "priority found by a search with --policy mrac|policy mrac"),
        (replace(settings, worth=5.0), "priority with"),
        (replace(settings, priority=(1, 2)), "priority of 2 cells; expected one number, or one for each of 72 cells"),
    ):
        with pytest.raises(PlanError, match=said):
            make_plan(world, plan.starts, wrong)
    data = plan.to_json()
    data["settings"]["priority"] = [1001, *data["settings"]["priority"][1:]]
    (tmp_path / "wrong.json").write_text(json.dumps(data))
    with pytest.raises(PlanError, match=r"wrong\.json: `settings\.priority` is"):
        load_plan(tmp_path / "wrong.json", world)
