"""Plans for the open loop, and the closed loop of another planner's paths."""

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import ANSWERS
from drawn_worlds import tiny_world
from helpers import answer_of, error_of, load_plan, paths_of, play_both_ways
from numpy.typing import NDArray
from oracle_enumeration import best_of_one_robot
from validate import validate

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.theory.exact import CellValues, open_loop_exact
from analysis.theory.flow_programme import optimum
from planner.errors import PlanError, UsageError
from planner.make_plan import make_plan
from planner.mrac.problem import ready_loop
from planner.open_loop import make_open_loop_plan, plan_team
from planner.plan.plan import Plan, RobotPlan
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.single_run import SingleRun
from planner.settings import Settings
from planner.simulator.codes import Doing, EventKind, Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# Plans for the open loop: exact, reproducible, drivable, never worse than the nominal plan, near the optimum.


def planned(world: World, starts: object, effort: int = 2000, **settings: object) -> Plan:
    return plan_team(world, starts, Settings(plan_for="open_loop", effort=effort, **settings))  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(12))
def test_one_robot_gets_the_optimum_of_tiny_worlds(seed: int) -> None:
    """One robot learns nothing that would help it: the best path is as good as the best strategy."""
    world = tiny_world(seed, 3, 4)
    best = optimum(world, [[0, 0]])
    assert open_loop_exact(planned(world, [[0, 0]], 50_000), world).visited == pytest.approx(best, abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_one_robot_gets_the_most_value_of_tiny_worlds(seed: int) -> None:
    world = tiny_world(seed, 2, 4)
    values = np.random.default_rng(seed).choice([0, 1, 5, 20.5], size=(2, 4))
    values[0, 1] = 7.0
    world = world.with_values(values)
    plan = planned(world, [[0, 0]], 20_000)
    found = float(CellValues.of(world).value @ open_loop_exact(plan, world).visited_by_cell)
    assert found == pytest.approx(best_of_one_robot(world), abs=1e-9)
    assert plan.notes[0].startswith(f"planned for the open loop: {found:.2f} of value expected, ")


def test_teams_go_where_the_value_is_and_equal_values_change_nothing() -> None:
    world = random_world(12, 12, ThreatPattern("contiguous", seed=3), obstacles=0.2, threats=0.3)
    starts = place_starts(world, 2)[0]
    east = np.where(np.arange(12) >= 6, 20.0, 1.0) * np.ones((12, 1))
    valued, plain = world.with_values(east), planned(world, starts)
    values = CellValues.of(valued).value
    by_value, by_cells = (
        float(values @ open_loop_exact(plan, world).visited_by_cell) for plan in (planned(valued, starts), plain)
    )
    assert by_value > 1.02 * by_cells
    alike = planned(world.with_values(3.0), starts)
    assert all(np.array_equal(one.path, other.path) for one, other in zip(alike.robots, plain.robots, strict=True))


@pytest.mark.parametrize("seed", range(6))
def test_drivable_complete_below_the_optimum_and_never_worse_than_the_nominal_plan(seed: int) -> None:
    """Also with nearly certain losses, dangerous starts, no evaluations, robots in two parts, and cut off."""
    world = tiny_world(seed, 3, 4, wall=0.999)
    for effort, starts in ((0, [[0, 0]]), (300, [[0, 0], [0, 1]])):
        plan = planned(world, starts, effort)
        assert not validate(plan, world)
        assert set(np.concatenate([robot.path for robot in plan.robots])) == set(
            np.flatnonzero(~np.isnan(world.threat))
        )
        value, nominal = (open_loop_exact(some, world).visited for some in (plan, make_plan(world, starts)))
        assert value >= nominal - 1e-9
        assert value <= (optimum(world, starts) or np.inf) + 1e-9
        cut = planned(world, starts, effort, max_steps=5)
        assert max(len(robot.path) for robot in cut.robots) <= 6
        nominal = open_loop_exact(make_plan(world, starts, Settings(max_steps=5)), world).visited
        assert open_loop_exact(cut, world).visited >= nominal - 1e-9
    parts = World.create([[0.0, 0.1, np.nan, 0.2, 0.0]])
    assert open_loop_exact(planned(parts, [[0, 0], [0, 4]]), parts).visited == pytest.approx(4)


@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
def test_clearly_better_than_the_nominal_plan_and_the_same_again(kind: str) -> None:
    world = random_world(pattern=ThreatPattern(kind=kind, seed=1))  # type: ignore[arg-type]
    starts = place_starts(world, 4)[0]
    plan, again = planned(world, starts, 8_000), planned(world, starts, 8_000)
    cells = int(world.accessible(starts).sum())
    value, none, nominal = (
        open_loop_exact(some, world).visited for some in (plan, planned(world, starts, 0), make_plan(world, starts))
    )
    assert nominal + 0.02 * cells < none
    assert none + 0.02 * cells < value
    assert plan.notes[0].startswith(f"planned for the open loop: {value:.2f} cells expected, {nominal:.2f} with")
    assert all(np.array_equal(a.path, b.path) for a, b in zip(plan.robots, again.robots, strict=True))


def test_two_robots_answer_each_other() -> None:
    """Each alone would go through the same safer door; as a team they go through one each."""
    world = World.create([[0.0, 0.0, 0.0, 0.3, 0.0], [np.nan, 0.0, np.nan, np.nan, np.nan], [0.0, 0.0, 0.0, 0.4, 0.0]])
    plan, p, q = planned(world, [[1, 1], [1, 1]]), float(np.float32(0.3)), float(np.float32(0.4))
    after_p, after_q = 1 - p, 1 - q
    first = 1 - (1 - after_p) * (1 - after_q * after_q * after_p)
    second = 1 - (1 - after_q) * (1 - after_p * after_p * after_q)
    best = open_loop_exact(plan, world).visited
    assert best == pytest.approx(9 + first + second)


def test_robots_that_bear_more_or_less_get_the_same_paths() -> None:
    """No decision knows of it; one number a robot was refused, of a robot by itself."""
    world, starts = tiny_world(3, 4, 4), [[0, 0], [0, 0]]
    found = planned(world, starts, hazard_multiplier=(1.0, 3.0))
    for robot, plain in zip(found.robots, planned(world, starts).robots, strict=True):
        assert np.array_equal(robot.path, plain.path)


def test_a_saved_plan_is_one_of_paths_that_knows_what_it_is_for(tmp_path: Path) -> None:
    world = tiny_world(3, 3, 4)
    plan = planned(world, [[0, 0]])
    plan.save(tmp_path / "plan.json")
    found = load_plan(tmp_path / "plan.json", world)
    assert (plan.plan_for, plan.outcome, plan.is_external, plan.time) == (
        "open_loop",
        "end_of_paths",
        True,
        plan.makespan,
    )
    assert (found.plan_for, found.notes, found.time) == ("open_loop", plan.notes, plan.time)
    assert "Plan for the open loop: 1 robot on" in repr(found)
    data = json.loads((tmp_path / "plan.json").read_text())
    assert data["settings"] is None and data.pop("checksum")
    (tmp_path / "wrong.json").write_text(json.dumps(data | {"plan_for": "war"}))
    with pytest.raises(PlanError, match="`plan_for` is 'war'"):
        load_plan(tmp_path / "wrong.json", world)
    answer = mrac.evaluate(world, found, rollouts=64).to_json()
    assert (answer["plan_for"], answer["loop"]) == ("open_loop", "open")
    assert mrac.plan(world, plan_for="open_loop", effort=5).plan_for == "open_loop"


def test_what_does_not_go_together_is_refused() -> None:
    world = tiny_world(3, 3, 4)
    with pytest.raises(PlanError, match="plan_for is open_loop in a plan with areas"):
        make_plan(world, [[0, 0]], Settings(plan_for="open_loop"))
    with pytest.raises(UsageError, match="seconds=1 is for plans for the open loop"):
        mrac.plan(world, seconds=1)
    for wrong in (0, float("nan"), "1"):
        with pytest.raises(UsageError, match="seconds"):
            mrac.plan(world, plan_for="open_loop", seconds=wrong)  # type: ignore[arg-type]
    big = World.create(np.full((80, 80), 0.1))
    with pytest.raises(PlanError, match=r"6400 dangerous cells .* too many"):
        planned(big, [[0, 0]])


def test_seconds_end_the_search_and_that_is_said() -> None:
    world = random_world(pattern=ThreatPattern(seed=1))
    settings = Settings(plan_for="open_loop", effort=10**9)
    plan = make_open_loop_plan(world, place_starts(world, 2)[0], settings, seconds=0.05)
    assert plan.notes[1] == "the search ended before its 1,000,000,000 evaluations: its time limit was reached"


BAD_INPUT = [
    (["evaluate", "--effort", "9"], "--effort 9 with --plan-for closed_loop"),
    (["plan", "--seconds", "9"], "--seconds 9 is for plans for the open loop"),
    (["plan", "--plan-for", "both"], "--plan-for 'both'; expected closed_loop or open_loop"),
]


@pytest.mark.parametrize(("words", "said"), BAD_INPUT)
def test_bad_input_is_one_line(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in error_of(capsys, words[0], "example:paper", *words[1:])


def test_every_command_that_plans_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tiny_world(3, 3, 4).save(tmp_path / "map.npz")
    options = [str(tmp_path / "map.npz"), "--plan-for", "open_loop", "--effort", "10"]
    for command in (["evaluate", "--rollouts", "64"], ["check"], ["compare", "--rollouts", "64", "--b.effort", "20"]):
        assert run([command[0], *options, *command[1:], "--json"]) == 0
        assert '"plan_for": "open_loop"' in capsys.readouterr().out
    assert run(["size", *options, "--target", "0.5", "--rollouts", "64", "--most", "2", "--json"]) == 0
    assert run(["record", options[0], *options[1:], "--ids", "0", str(tmp_path / "run.mcap")]) in (0, 2)


def test_scenarios_name_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As the option does, which goes before; who needs robots that take over says so."""
    tiny_world(3, 3, 4).save(tmp_path / "map.npz")
    scenario = tmp_path / "map.yaml"
    scenario.write_text("map: {file: map.npz}\nplan_for: open_loop\n")
    asked = ([str(scenario)], [str(tmp_path / "map.npz"), "--plan-for", "open_loop"])
    told = [answer_of(capsys, "evaluate", *words, "--rollouts", "64", "--effort", "10") for words in asked]
    assert (told[0]["plan_for"], told[0]["loop"]) == ("open_loop", "open") and told[0]["best"] == told[1]["best"]
    closed = answer_of(capsys, "evaluate", str(scenario), "--plan-for", "closed_loop", "--rollouts", "64")
    assert closed["loop"] == "closed"
    assert run(["size", str(scenario), "--target", "0.5", "--rollouts", "64", "--most", "2", "--json"]) == 0
    capsys.readouterr()
    for command in (["starts", "--rollouts", "64"], ["studio"]):
        assert "plan_for is open_loop in " in error_of(capsys, command[0], str(scenario), *command[1:])
    scenario.write_text("map: {file: map.npz}\nplan_for: both\n")
    assert "`plan_for` is 'both'; expected closed_loop or open_loop" in error_of(capsys, "evaluate", str(scenario))


# The closed loop of another planner's paths: who follows them, and what becomes of the cells of a stopped robot.

SEED = 20261122


def paths_plan(world: World, *paths: list[int]) -> Plan:
    """Another planner's plan: these cells."""
    robots = tuple(RobotPlan(np.array(path, dtype=np.int64)) for path in paths)
    return Plan(world.shape, world.sha256, None, robots, outcome="end_of_paths")


def wanderings(world: World, robots: int, steps: int, rng: np.random.Generator) -> Plan:
    """Paths that wander, wait now and then, cross each other, and leave cells out."""
    height, width = world.shape
    safe = np.flatnonzero(world.threat.ravel() == 0)

    def beside(cell: int) -> list[int]:
        row, col = divmod(cell, width)
        near = [(row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)]
        inside = [r * width + c for r, c in near if 0 <= r < height and 0 <= c < width]
        return [cell, *(other for other in inside if not np.isnan(world.threat.ravel()[other]))]

    paths = []
    for _ in range(robots):
        path = [int(rng.choice(safe))]
        while len(path) <= steps:
            path.append(int(rng.choice(beside(path[-1]))))
        paths.append(path)
    return paths_plan(world, *paths)


def map_of(seed: int) -> World:
    return random_world(5, 7, ThreatPattern(areas=4, levels=(0.05, 0.2, 0.4), seed=seed), threats=0.4, obstacles=0.1)


def run_by_hand(plan: Plan, world: World, hits: set[tuple[int, int]]) -> SingleRun:
    """The run in which just these (robot, step) are stopped."""
    loop = compile_closed_loop(plan, world, interpreted=True)
    return SingleRun(loop, hit=lambda robot, step, cell: (robot, step) in hits).play()


def routes(run: SingleRun) -> list[list[int]]:
    return [path.tolist() for path in paths_of(run)]


def test_without_a_hit_paths_are_followed_and_what_they_leave_out_is_done_after_them() -> None:
    world = World.create(np.zeros((2, 4)))
    plan = paths_plan(world, [0, 0, 1, 1, 2], [7])
    run = run_by_hand(plan, world, set())
    # robot 1, at its path's end from the start, takes the cells on nobody's path: first 3, beside it
    mine, other = routes(run)
    assert mine[:5] == [0, 0, 1, 1, 2] and other[:2] == [7, 3]
    assert run.outcome is Outcome.COMPLETE and run.visited.all()


def test_what_a_stopped_robot_leaves_is_taken_by_who_is_done_first() -> None:
    world = World.create([[0.0, 0.5, 0.0, 0.0, 0.0, 0.0]])
    plan = paths_plan(world, [0, 1, 2, 3], [5, 4])
    run = run_by_hand(plan, world, {(0, 1)})
    assert routes(run) == [[0, 1], [5, 4, 3, 2]]
    assert [area.cells.tolist() for area in run.notes.made] == [[2, 3]]
    assert run.outcome is Outcome.COMPLETE and run.alive.tolist() == [False, True]


def test_a_robot_on_its_given_path_neither_shares_nor_gives_way() -> None:
    world = World.create(np.zeros((3, 6)))
    whole = [0, 1, 2, 3, 4, 5, 11, 10, 9, 8, 7, 6, 12, 13, 14, 15, 16]
    run = run_by_hand(paths_plan(world, whole, [17]), world, set())
    assert routes(run) == [whole, [17]]
    assert not (run.trace.events[:, 2] == EventKind.SHARED).any()


def test_the_cells_left_are_cut_by_level_and_connection() -> None:
    world = World.create([[0.0, 0.1, 0.1, 0.0, 0.2, 0.0, 0.0]])
    plan = paths_plan(world, [0, 1, 2, 3, 4, 5], [6])
    run = run_by_hand(plan, world, {(0, 1)})
    assert [(area.level, area.cells.tolist()) for area in run.notes.made] == [(0, [3]), (0, [5]), (1, [2]), (2, [4])]


@pytest.mark.parametrize("seed", range(12))
def test_the_compiled_simulator_follows_event_for_event(seed: int) -> None:
    rng, world = np.random.default_rng(seed), map_of(seed)
    plan = wanderings(world, int(rng.integers(1, 5)), int(rng.integers(0, 25)), rng)
    play_both_ways(plan, world, SEED, 12, first_only=seed % 3 == 0)


def test_every_rollout_covers_what_it_covers_open_loop_and_more() -> None:
    gained: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
    for seed in range(8):
        world = map_of(seed)
        plan = wanderings(world, 3, 20, np.random.default_rng(seed))
        alone = make_engine(plan, world, Rolling("open", seed=SEED), "numba").results(0, 500)
        closed = make_engine(plan, world, Rolling("closed", seed=SEED), "numba").results(0, 500)
        gained = np.concatenate([gained, closed.visited - alone.visited])
    assert gained.min() >= 0
    assert np.median(gained) > 0


def test_sampled_values_are_those_of_enumeration() -> None:
    world = World.create([[0.0, 0.3, 0.0], [0.2, 0.0, 0.5], [0.0, 0.4, 0.0]])
    plan, exact = paths_plan(world, [0, 1, 2, 5], [6, 3, 3, 4]), ANSWERS["external_paths"]
    count = 40_000
    results = run_range(compile_closed_loop(plan, world), SEED, 0, count, singles=True)[1]
    for name in ("visited", "time", "alive"):
        sampled = getattr(results, name)
        assert abs(sampled.mean() - exact[name]) <= 5 * sampled.std() / np.sqrt(count)
    chances = np.bincount(results.visited, minlength=10) / count
    assert np.abs(chances - exact["visited_chance"]).max() < 5 * 0.5 / np.sqrt(count)


def test_the_plan_need_not_name_its_map_but_must_not_name_another() -> None:
    world, other = map_of(1), map_of(2)
    plan = wanderings(world, 2, 9, np.random.default_rng(1))
    assert ready_loop(Plan(plan.shape, "", None, plan.robots, outcome="end_of_paths"), world)[1]
    with pytest.raises(PlanError, match="another map"):
        compile_closed_loop(plan, other)


def test_every_kind_of_event_comes_about() -> None:
    kinds, doing = set[int](), set[int]()
    for seed in range(8):
        world = map_of(seed)
        plan = wanderings(world, 3, 12, np.random.default_rng(seed))
        for trace in trace_rollouts(compile_closed_loop(plan, world), SEED, range(20)):
            kinds.update(trace.events[:, 2].tolist())
            doing.update(trace.doing.ravel().tolist())
    assert {EventKind.HIT, EventKind.REALLOCATED, EventKind.ALLOCATED, EventKind.SHARED, EventKind.COMPLETED} <= kinds
    assert doing == set(Doing) - {Doing.IDLE, Doing.RETURNING, Doing.CHARGING}
