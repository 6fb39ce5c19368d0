"""Range: robots that make so many moves and then stay (SPEC section 13); the readable simulator is the oracle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from validate import validate

from analysis.sampling import RolloutChoices
from analysis.search.team_size import find_size, make_goal
from analysis.theory.exact import open_loop_exact
from planner.errors import InputError, PlanError, ScenarioError, UsageError
from planner.mrac.make_plan import confirm_plan, make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan_team import plan_team
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import Doing, EventKind, Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.scenario import load_input
from planner.world.world import World

LIMITS: tuple[dict[str, Any], ...] = (
    {},
    {"policy": "per_cell"},
    {"policy": "per_cell", "reserve": 0.3},
    {"policy": "per_cell", "worth": 12.0, "reserve": 0.5},
)


def moves(path: np.ndarray) -> int:
    return int(np.count_nonzero(np.diff(path)))


def small(seed: int, robots: int, given: Any = None, **more: Any) -> tuple[World, Plan]:
    pattern = ThreatPattern("contiguous" if seed % 2 else "scattered", areas=3, seed=seed)
    world = random_world(8 + seed % 3, 9, pattern, obstacles=0.2, threats=0.35)
    return world, make_plan(world, place_starts(world, robots)[0], Settings(range=given, **more))


def test_a_corridor_by_hand() -> None:
    """Two robots from the ends of nine safe cells: the short one stays after two moves, the other does its rest."""
    world = World.create(np.zeros((1, 9)))
    plan = make_plan(world, [[0, 0], [0, 8]], Settings(range=(2, 100)))
    assert plan.robots[0].path.tolist() == [0, 1, 2]
    assert sorted(set(plan.robots[1].path.tolist())) == [3, 4, 5, 6, 7, 8]
    assert plan.outcome == "complete"
    assert not validate(plan, world)
    alone = make_plan(world, [[0, 0]], Settings(range=5))
    assert alone.robots[0].path.tolist() == [0, 1, 2, 3, 4, 5]
    assert (alone.outcome, alone.time) == ("no_progress", 7)
    assert open_loop_exact(alone, world).visited == 6


@pytest.mark.parametrize("more", LIMITS, ids=["mrac", "per_cell", "reserve", "worth"])
def test_compiled_runs_are_the_readable_ones(more: dict[str, Any]) -> None:
    ended = 0
    for seed in range(6):
        robots = 1 + seed % 4
        for given in (1, 9, tuple(range(5, 5 + 9 * robots, 9))):
            world, plan = small(seed, robots, given, **more)
            loop, reference = compile_closed_loop(plan, world, tabled=seed > 0), ReferenceLoop(plan, world)
            for trace in trace_rollouts(loop, seed, range(4)):
                assert trace == reference.trace(seed, trace.rollout), (seed, given, trace.rollout)
                most = np.broadcast_to(given, robots)
                for robot in range(robots):
                    assert moves(trace.cells[:, robot]) <= most[robot]
                stays = trace.events[trace.events[:, 2] == EventKind.RANGE_ENDED]
                ended += len(stays)
                for step, robot in stays[:, :2].tolist():
                    assert moves(trace.cells[: step + 1, robot]) == most[robot]
                    assert (trace.doing[step:, robot] == Doing.DONE).all()
    assert ended > 40


def test_what_is_left_is_reallocated() -> None:
    world, plan = small(1, 3, (12, 400, 400))
    _, free = small(1, 3)
    assert plan.outcome == free.outcome == "complete"
    assert moves(plan.robots[0].path) == 12 < moves(free.robots[0].path)
    assert not validate(plan, world)


def test_enough_moves_are_no_limit_and_a_limit_is_part_of_the_identity() -> None:
    world, free = small(3, 3)
    _, same = small(3, 3, 10_000)
    for a, b in zip(free.robots, same.robots, strict=True):
        np.testing.assert_array_equal(a.path, b.path)
    loops = [compile_closed_loop(plan, world) for plan in (free, same)]
    singles = [run_range(loop, 5, 0, 64, singles=True)[1] for loop in loops]
    assert singles[0] is not None and singles[1] is not None
    np.testing.assert_array_equal(singles[0].visited, singles[1].visited)
    assert loops[0].identity != loops[1].identity


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_nominal_plans_with_a_range_are_sound_and_survive_their_file(policy: str) -> None:
    outcomes = set()
    for seed in range(8):
        for given in (3, 20, 60):
            world, plan = small(seed, 1 + seed % 4, given, policy=policy)
            assert not validate(plan, world), (seed, given)
            back = confirm_plan(parse_plan(plan.to_json(), world, "file"), world, "file")
            assert back.settings == plan.settings
            outcomes.add(plan.outcome)
    assert outcomes >= {"complete", "no_progress"}


def test_the_validator_counts_moves() -> None:
    world, plan = small(1, 2, 30)
    tight = Plan(**{**vars(plan), "settings": Settings(range=20)})
    assert {"range"} <= {found.rule for found in validate(tight, world)}


def test_paths_for_the_open_loop_end_with_the_range() -> None:
    world, _ = small(1, 2)
    starts = place_starts(world, 2)[0]
    plan = plan_team(world, starts, Settings(plan_for="open", effort=200, range=(7, 15)))
    assert all(moves(robot.path) <= most for robot, most in zip(plan.robots, (7, 15), strict=True))


def test_size_knows_the_range() -> None:
    world = World.create(np.zeros((1, 12)), starts=[[0, 0]] * 6)
    answer = find_size(world, Settings(range=3), make_goal(0.9, None, False, "visited", 6), RolloutChoices())
    assert answer.robots is None
    answer = find_size(world, Settings(range=11), make_goal(0.9, None, False, "visited", 6), RolloutChoices())
    assert answer.robots == 1
    with pytest.raises(UsageError, match="teams of other sizes"):
        find_size(world, Settings(range=(3, 4)), make_goal(0.9, None, False, "visited", 6), RolloutChoices())


def test_the_outcome_is_stuck_with_everybody_alive() -> None:
    world, plan = small(2, 2, 4)
    _, singles = run_range(compile_closed_loop(plan, world.with_starts(plan.starts)), 1, 0, 32, singles=True)
    assert singles is not None
    whole = singles.alive == 2
    assert whole.any()
    assert (singles.outcome[whole] == Outcome.NO_PROGRESS).all()
    assert singles.visited[whole].max() <= 10


def test_bad_ranges(tmp_path: Any) -> None:
    world, _ = small(1, 2)
    starts = place_starts(world, 2)[0]
    for wrong in (0, -3, 2.5, "many", (), (3, 0), True):
        with pytest.raises(PlanError, match="range"):
            make_plan(world, starts, Settings(range=wrong))  # type: ignore[arg-type]
    with pytest.raises(PlanError, match=f"^{world.source}: range of 3 robots for a team of 2"):
        make_plan(world, starts, Settings(range=(1, 2, 3)))
    world.save(tmp_path / "w.npz")
    for text in ("0", "[3, 0]", "[]", "1.5", "far"):
        (tmp_path / "s.yaml").write_text(f"map: w.npz\nrobots: {{count: 2, range: {text}}}\n")
        with pytest.raises(ScenarioError, match=r"robots\.range"):
            load_input(tmp_path / "s.yaml")
    (tmp_path / "s.yaml").write_text("map: w.npz\nrobots: {count: 2, range: [30, 4]}\n")
    assert load_input(tmp_path / "s.yaml").team.settings == {"range": (30, 4)}
    with pytest.raises(InputError):
        load_input(tmp_path / "missing.yaml")
