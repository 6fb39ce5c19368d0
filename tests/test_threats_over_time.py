"""Threats that move, and threats that change with time."""

import json
from dataclasses import replace
from math import gamma
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from conftest import ANSWERS
from drawn_worlds import in_rows, moving_world
from helpers import play_both_ways
from oracle_enumeration import outcomes

from analysis.theory.exact import open_loop_exact
from planner.arguments import MAX_STEP
from planner.errors import InputError
from planner.failure_model import FailureModel
from planner.make_plan import make_plan, read_plan, read_plan_on
from planner.plan.plan import Plan, RobotPlan
from planner.plan.plan_file import read_plan_json
from planner.rollout_sampling import first_places, threat_paths
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.exact_tree import grow_tree
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import Doing
from planner.simulator.state import MOST_PASSES
from planner.simulator.thresholds import threefry2x32
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.moving_threats import FORESIGHTS, PLAN_ON, Foresight, MovingThreat
from planner.world.scenario import load_input
from planner.world.start_rule import as_before, place_starts
from planner.world.world import World, load_world_file

# Threats that move: against exact values, and those against enumeration.

KINDS: list[dict[str, Any]] = [
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.5}, {"policy": "per_cell", "robot_value": 6.0},
    {"range": 25}, {"policy": "per_cell", "range": 30}, {"transit": "area"},
]  # fmt: skip
ROLLOUTS = 20_000
SMALL = World.create([[0.0, 0.1, np.nan], [0.2, 0.0, 0.0], [np.nan, 0.3, 0.0]])


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_teams_of_more_than_a_word_and_maps_without_tables(policy: str) -> None:
    world = moving_world(8)
    plan = make_plan(world, place_starts(world, 70)[0], Settings(policy=policy))
    play_both_ways(plan, world, 2, 8, tabled=(False,))


def test_another_planners_robots_wait_and_are_met() -> None:
    world = World.create(np.zeros((3, 4))).with_moving_threats(
        [MovingThreat(0.3, 0.5), MovingThreat(0.5, 0.0, 5, (5, 6, 10, 9))]
    )
    paths = [[0, 0, 1, 1, 1, 2, 3], [8, 9, 10, 10, 11, 7]]
    plan = Plan(world.shape, world.sha256, None, tuple(RobotPlan(np.array(path)) for path in paths))
    play_both_ways(plan, world, 3, 8)


def test_rollouts_do_not_depend_on_how_they_are_run() -> None:
    world = moving_world(6)
    loop = compile_closed_loop(make_plan(world, place_starts(world, 4)[0]), world)
    whole = run_range(loop, 9, 0, 3000, threads=1)[0]
    parts = [run_range(loop, 9, *part, threads=threads)[0] for part, threads in (((0, 1700), 3), ((1700, 1300), 1))]
    assert parts[0] + parts[1] == whole
    assert np.count_nonzero(whole.visited) > 4


def test_movers_that_hit_nobody_change_no_event() -> None:
    world = moving_world(5)
    plain = replace(world, threat=world.met, uncertainty=None)
    tame = plain.with_moving_threats([replace(one, hit=0.0) for one in world.moving_threats.members])
    np.testing.assert_array_equal(tame.threat, plain.threat)
    plan = make_plan(plain, place_starts(plain, 3)[0])
    traces, counts = [], []
    for each in (plain, tame):
        loop = compile_closed_loop(plan, each)
        traces.append(trace_rollouts(loop, 2, range(20)))
        counts.append(run_range(loop, 2, 0, 500)[0].counts())
    assert traces[0] == traces[1]
    for name, values in counts[0].items():
        np.testing.assert_array_equal(values, counts[1][name], name)


def test_a_visit_is_survived_by_who_is_alive_at_the_end_of_its_step() -> None:
    """Survived visits of each cell, as a detector counts them, beside those of the traces."""
    world = moving_world(11)
    size = world.threat.size
    loop = compile_closed_loop(make_plan(world, place_starts(world, 3)[0]), world)
    counted = loop.with_cell_weights(np.ones(size, dtype=np.int64), np.ones((size, MOST_PASSES + 1), dtype=np.int64))
    found = run_range(counted, 4, 0, 40)[0].passes.reshape(size, MOST_PASSES)
    expected = np.zeros_like(found)
    for trace in trace_rollouts(loop, 4, range(40)):
        entered = np.vstack([np.full(3, True), trace.cells[1:] != trace.cells[:-1]]) & (trace.doing != Doing.DEAD)
        passes = np.bincount(trace.cells[entered], minlength=size)
        expected += np.arange(1, MOST_PASSES + 1) <= passes[:, None]
    np.testing.assert_array_equal(found, expected)


def test_draws_are_at_the_counters_that_the_spec_names() -> None:
    """Places and hits of two movers and three robots, from Threefry itself."""
    world = World.create(np.zeros((2, 3))).with_moving_threats(
        [MovingThreat(0.4, 0.3), MovingThreat(0.6, 0.0, -1, (0, 1, 4, 3))]
    )
    seed, rollout, (moves, hits) = 7, 5, (threefry2x32((7, 0), 0x48415A44, purpose) for purpose in (3, 4))
    beside = {0: (1, 3), 1: (0, 2, 4), 2: (1, 5), 3: (0, 4), 4: (1, 3, 5), 5: (2, 4)}
    weight = [cell for cell, ways in beside.items() for _ in ways]

    def drawn(key: tuple[Any, Any], counter: int) -> tuple[int, int]:
        x0, x1 = threefry2x32((int(key[0]), int(key[1])), rollout, counter)
        return int(x0), int(x1)

    walker, place = weight[drawn(moves, 0)[0] * 14 >> 32], drawn(moves, 1)[0] * 4 >> 32
    trace = PythonLoop(make_plan(world, [[0, 0], [0, 2], [1, 2]]), world).trace(seed, rollout)
    paths, alive = threat_paths(world, seed, rollout, trace.time + 1).tolist(), {0, 1, 2}
    for step, (cells, doing) in enumerate(zip(trace.cells.tolist(), trace.doing.tolist(), strict=True)):
        x0, x1 = drawn(moves, (step + 1) * 2)
        if (x0 >> 8) / 2**24 >= np.float32(0.3):
            walker = beside[walker][(x1 >> 8) * len(beside[walker]) >> 24]
        place = (place + 1) % 4
        assert paths[step] == [walker, (0, 1, 4, 3)[place]], step
        for robot in sorted(alive):
            met = [number for number, cell in enumerate(paths[step]) if cell == cells[robot]]
            words = [drawn(hits, (step * 2 + number) * 3 + robot)[0] >> 8 for number in met]
            stops = any(word / 2**24 < np.float32((0.4, 0.6)[number]) for number, word in zip(met, words, strict=True))
            assert (doing[robot] == Doing.DEAD) == stops, (step, robot)
            alive -= {robot} if stops else set()
    assert 0 < len(alive) < 3


# --- exact values ---


def alone(world: World, start: tuple[int, int] | None = None) -> Plan:
    """One robot's plan."""
    return make_plan(world, place_starts(world, 1)[0] if start is None else [start])


MOVERS = [
    [MovingThreat(0.4, 0.25)],
    [MovingThreat(1.0, 0.0, 4)],
    [MovingThreat(0.6, 0.0, 4, (4, 5, 8, 7)), MovingThreat(0.3, 0.5, 8)],
    [MovingThreat(0.5, 0.0, -1, (0, 1, 4, 3)), MovingThreat(0.5, 0.1)],
]


@pytest.mark.parametrize("movers", MOVERS)
def test_one_robot_is_known_exactly_as_enumeration_has_it(movers: list[MovingThreat]) -> None:
    world = SMALL.with_moving_threats(movers)
    whole = [(0, 0), (0, 1), (1, 1), (1, 1), (1, 0), (1, 1), (1, 2), (2, 2), (2, 1)]
    for path in (whole[:6], whole[4:], [(1, 0), (1, 1), (1, 1), (1, 1), (1, 0), (0, 0)]):
        plan = Plan(world.shape, world.sha256, None, (RobotPlan(np.array([row * 3 + col for row, col in path])),))
        exact = open_loop_exact(plan, world)
        found = exact.visited, exact.survived, float(exact.survival[0])
        grid, threats = in_rows(world)
        np.testing.assert_allclose(found, outcomes(grid, path, threats), rtol=1e-6)


@pytest.mark.parametrize(
    "seed", [0, 2, 3, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, *range(4, 50)))]
)
def test_rollouts_of_one_robot_are_at_the_exact_values(seed: int) -> None:
    """How many standard errors rollouts are off the exact values of a small world's one robot."""
    world = moving_world(seed, (0.01, 0.02, 0.04), 7)
    plan = alone(world)
    exact, n = open_loop_exact(plan, world), ROLLOUTS
    tally, singles = run_range(compile_closed_loop(plan, world), seed, 0, n, singles=True)
    expected = {"visited": exact.visited, "survived": exact.survived, "alive": float(exact.survival[0])}
    expected["time"] = exact.mean_time
    for name, mean in expected.items():
        values = getattr(singles, name)
        assert abs(values.mean() - mean) / max(values.std() / n**0.5, 1 / n) < 5, name
    by_cell = tally.covered_visited / n
    spread = np.sqrt(np.maximum(by_cell * (1 - by_cell), 1 / n) / n)
    assert np.abs((by_cell - exact.visited_by_cell) / spread).max() < 5


def test_a_mover_that_stays_is_a_threat_that_stands() -> None:
    """Met once, by a robot that does not wait: in both meanings of covered."""
    plain = World.create(np.zeros((1, 6)))
    moving = plain.with_moving_threats([MovingThreat(0.25, 1.0, 3)])
    standing = World.create([[0, 0, 0, 0.25, 0, 0]])
    path = (RobotPlan(np.arange(6)),)
    one, other = (open_loop_exact(Plan(world.shape, world.sha256, None, path), world) for world in (moving, standing))
    np.testing.assert_allclose(one.visited_by_cell, other.visited_by_cell)
    np.testing.assert_allclose(one.survived_by_cell, other.survived_by_cell)


def test_movers_stay_where_they_are_in_the_long_run() -> None:
    """Who starts anywhere is at every step in a cell with the chance of `joined`, within 5 standard errors."""
    world = moving_world(9, most=5)
    walker = replace(world, threat=world.met, uncertainty=None).with_moving_threats([MovingThreat(0.3, 0.2)], "joined")
    chance, n = walker.moving_threats.chances(walker.moving_threats.members[0]).ravel(), 1500
    starts = np.bincount(first_places(walker.moving_threats, 4, range(n))[:, 0], minlength=chance.size)
    later = np.bincount([int(threat_paths(walker, 4, one, 4)[-1, 0]) for one in range(n)], minlength=chance.size)
    for counts in (starts, later):
        spread = np.sqrt(n * np.maximum(chance * (1 - chance), 1 / n))
        assert np.abs((counts - n * chance) / spread).max() < 5
    joined = 1 - (1 - np.nan_to_num(walker.met.ravel().astype(float))) * (1 - 0.3 * chance)
    np.testing.assert_allclose(np.nan_to_num(walker.threat.ravel()), joined, atol=1e-7)


def test_a_patrol_goes_round_and_is_missed_by_who_changes_places_with_it() -> None:
    world = World.create(np.zeros((2, 3))).with_moving_threats([MovingThreat(1.0, 0.0, 4, (0, 1, 4, 3))])
    assert threat_paths(world, 0, 0, 6)[:, 0].tolist() == [3, 0, 1, 4, 3, 0]
    for path, survives in (([4, 1, 4, 3], 1.0), ([3, 4], 0.0), ([5, 5, 5, 4], 0.0), ([0, 3, 4, 1], 1.0)):
        plan = Plan(world.shape, world.sha256, None, (RobotPlan(np.array(path)),))
        assert open_loop_exact(plan, world).survival[0] == survives, path


# --- files, and what is refused ---

SCENARIO = "map: {file: m.npy}\ncell_size: 1\nthreats: []\nrobots: {count: 2}\n"


def scenario(folder: Path, more: str) -> World:
    np.save(folder / "m.npy", np.where(np.isnan(SMALL.threat), np.nan, 0.0))
    (folder / "s.yaml").write_text(SCENARIO + more)
    return load_input(folder / "s.yaml")


def test_a_scenario_and_its_world_file(tmp_path: Path) -> None:
    world = scenario(
        tmp_path,
        "moving_threats:\n- {walk: 0.5, h: 0.25, count: 3}\n- {walk: 0, start: [1, 1], h: 1}\n"
        "- {patrol: [[0, 0], [0, 1], [1, 1], [1, 0]], start: [1, 1], h: 0.5}\n- {patrol: [[1, 1], [1, 2]], h: 0.5}\n",
    )
    square = MovingThreat(0.5, 0.0, 4, (0, 1, 4, 3))
    expected = (*[MovingThreat(0.25, 0.5)] * 3, MovingThreat(1.0, 0.0, 4), square, MovingThreat(0.5, 0.0, -1, (4, 5)))
    assert world.moving_threats.members == expected
    assert "4 walk and 2 patrol, and destroy a robot that they meet with probability 0.25 to 1" in repr(world)
    world.save(tmp_path / "w.npz")
    again = load_world_file(tmp_path / "w.npz")
    assert again.moving_threats.members == expected
    assert again.randomness_sha256 == world.randomness_sha256 == load_input(tmp_path / "w.npz").randomness_sha256
    both = "moving_threats: [{walk: 0.5, h: 0.25}, {patrol: [[0, 0], [0, 1]], h: 0.5}]\nplan_on: "
    assert not np.nan_to_num(scenario(tmp_path, both + "own").threat).any()
    np.testing.assert_allclose(np.nan_to_num(scenario(tmp_path, both + "patrols").threat[0]), [0.25, 0.25, 0])


BOTH = "moving_threats: [{walk: 0.5, h: 0.25}, {patrol: [[0, 0], [0, 1]], h: 0.5}]\n"


def test_robots_plan_on_those_that_have_a_route_unless_something_else_is_said(tmp_path: Path) -> None:
    """In scenarios, with a note, and in Python; p of a visit and luck are the same."""
    world, said = scenario(tmp_path, BOTH), {on: scenario(tmp_path, f"{BOTH}plan_on: {on}\n") for on in PLAN_ON}
    np.testing.assert_array_equal(world.threat, said["patrols"].threat)
    np.testing.assert_array_equal(as_before(world).threat, said["joined"].threat)
    assert as_before(said["own"]) is said["own"]
    (note,) = world.notes
    assert note.startswith("`plan_on` is not given: robots plan on the moving threats that have a route (patrols)")
    assert "`plan_on: joined`" in note and "\n" not in note and not any(one.notes for one in said.values())
    lone = World.create([[0.0, np.nan, 0.0]])
    sure = lone.with_moving_threats([MovingThreat(1.0, 0.0, 2)])  # `joined` refuses it
    assert as_before(sure) is sure
    (note,) = scenario(tmp_path, "moving_threats: [{patrol: [[0, 0], [0, 1]], h: 0.5}]\n").notes
    plain = replace(world, threat=world.met, uncertainty=None, notes=())
    assert plain.with_moving_threats(world.moving_threats.members).sha256 == world.sha256
    walkers = scenario(tmp_path, "moving_threats: [{walk: 0.5, h: 0.25}]\n")
    np.testing.assert_array_equal(walkers.threat, walkers.met)


def test_a_plan_of_an_earlier_release_keeps_its_reading(tmp_path: Path) -> None:
    """Made for the map of `joined`, where `plan_on` was not given; not where it is, and not a plan of today."""
    world, file = scenario(tmp_path, BOTH), tmp_path / "plan.json"
    made = make_plan(as_before(world), [[0, 0], [2, 1]])
    file.write_text(json.dumps(made.to_json() | {"version": 1}))
    with patch("planner.plan.plan_file.read_plan_json", wraps=read_plan_json) as read:
        of, plan = read_plan_on(file, world)
    assert read.call_count == 1
    assert of.sha256 == as_before(world).sha256 == plan.sha256 != world.sha256
    assert [robot.path.tolist() for robot in plan.robots] == [robot.path.tolist() for robot in made.robots]
    assert plan.notes[-1].startswith(f"{file}: made by a release before 0.4 without `plan_on`")
    with pytest.raises(InputError, match=r'made by a release before 0.4.*make the world with plan_on="joined"'):
        read_plan(file, world)
    with pytest.raises(InputError, match="plan for another map"):
        read_plan_on(file, scenario(tmp_path, BOTH + "plan_on: own\n"))
    world = scenario(tmp_path, BOTH)
    file.write_text(json.dumps(made.to_json()))
    with pytest.raises(InputError, match="plan for another map"):
        read_plan_on(file, world)
    file.write_text(json.dumps(make_plan(world, [[0, 0], [2, 1]]).to_json()))
    with patch("planner.plan.plan_file.read_plan_json", wraps=read_plan_json) as read:
        assert read_plan_on(file, world)[0] is world
    assert read.call_count == 1


WRONG_MOVERS = [
    ("moving_threats: 3\n", r"`moving_threats` is 3; expected a list of moving threats"),
    ("moving_threats: [{h: 0.5}]\n", r"`moving_threats\[0\]` is .*either walk or patrol"),
    ("moving_threats: [{walk: 0.5}]\n", r"`moving_threats\[0\]\.h` is missing"),
    ("moving_threats: [{walk: 1.5, h: 0.5}]\n", r"`moving_threats\[0\]\.walk` is 1\.5; expected a chance to stay"),
    ("moving_threats: [{walk: 0.5, h: 2}]\n", r"`moving_threats\[0\]\.h` is 2"),
    (
        "moving_threats: [{walk: 0.5, h: 0.1, start: [9, 0]}]\n",
        r"`moving_threats\[0\]\.start` is \[9, 0\]; expected a cell",
    ),
    ("moving_threats: [{walk: 0.5, h: 0.1, start: [0, 2]}]\n", r"starts at \[0, 2\], which is no free cell"),
    ("moving_threats: [{patrol: [[0, 0], [1, 1]], h: 0.1}]\n", r"its route goes from \[0, 0\] to \[1, 1\]"),
    (
        "moving_threats: [{walk: 0, h: 0}, {patrol: [[0, 0], [0, 1], [1, 1]], h: 0.1}]\n",
        r"`moving_threats\[1\]`: its route goes from \[1, 1\] to \[0, 0\]",
    ),
    ("moving_threats: [{patrol: [[0, 0]], h: 0.1}]\n", r"two cells \[row, col\] or more"),
    ("moving_threats: [{patrol: [[0, 0], [0, 1]], start: [1, 1], h: 0.1}]\n", r"starts at \[1, 1\], off its route"),
    (
        "moving_threats: [{walk: 0.5, h: 0.5}]\nlatent_hazard: {kind: consumed, q: 0.1}\n",
        r"`moving_threats` is .*none together with latent_hazard",
    ),
    ("plan_on: own\n", r"`plan_on` is 'own'; expected none without moving_threats"),
    (
        "moving_threats: [{walk: 0.5, h: 0.5}]\nplan_on: last\n",
        r"`plan_on` is 'last'; expected patrols or joined or own",
    ),
]


@pytest.mark.parametrize(("more", "said"), WRONG_MOVERS)
def test_a_wrong_mover_is_one_line(tmp_path: Path, more: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        scenario(tmp_path, more)
    assert "\n" not in str(error.value)


def test_what_would_be_certain_or_does_not_fit_is_refused(tmp_path: Path) -> None:
    lone = World.create([[0.0, np.nan, 0.0]])
    with pytest.raises(InputError, match=r"makes p 1 at \[0, 2\].*make it an obstacle"):
        lone.with_moving_threats([MovingThreat(1.0, 0.0, 2)], "joined")
    world = moving_world(1)
    world.save(tmp_path / "w.npz")
    arrays = dict(np.load(tmp_path / "w.npz"))
    for name, value in (("movers_start", arrays["movers_start"][:-1]), ("movers_length", arrays["movers_length"] + 1)):
        np.savez(tmp_path / "bad.npz", **(arrays | {name: value}))
        with pytest.raises(InputError, match="do not fit each other"):
            load_world_file(tmp_path / "bad.npz")


def test_loops_and_engines_that_have_no_movers_say_so() -> None:
    world = moving_world(1)
    plan = make_plan(world, place_starts(world, 2)[0])
    with pytest.raises(InputError, match="seed1: the open loop cannot include moving threats"):
        make_engine(plan, world, Rolling("open"))
    with pytest.raises(InputError, match=r"engine=.jax. with moving threats"):
        make_engine(plan, world, Rolling(), "jax")
    assert make_engine(plan, world, Rolling()).name == "numba"


# Threats that change with time (docs/spec.md, section 16).

N = np.nan
POLICIES = (
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.5}, {"policy": "frontier"},
    {"policy": "per_cell", "robot_value": 3.0}, {"policy": "watchful"}, {"weibull_shape": 3.0}, {"range": 12},
)  # fmt: skip


def changing(number: int, stream: Stream) -> tuple[World, np.ndarray]:
    """A small map, up to three others that follow, starts."""
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    free = np.array([stream.below(5) > 0 for _ in range(height * width)]).reshape(height, width)
    free.flat[stream.below(height * width)] = True
    levels, maps, begins = np.array([0.0, 0.0, 0.0, 0.1, 0.3]), [], [0]
    for _ in range(2 + stream.below(3)):
        drawn = levels[[stream.below(5) for _ in range(height * width)]].reshape(height, width)
        maps.append(np.where(free, np.where(stream.below(3) > 0, drawn, maps[-1] if maps else 0), np.nan))
        begins.append(begins[-1] + 1 + stream.below(6))
    world = World.create(maps[0]).with_phases(list(zip(begins[1:], maps[1:], strict=False)), FORESIGHTS[number % 3])
    places = np.argwhere(free)
    return world, places[[stream.below(len(places)) for _ in range(1 + stream.below(5))]]


# --- how a run ends ---


@pytest.mark.parametrize("policy", ["per_cell", "watchful", "frontier"])
def test_a_team_waits_for_a_danger_that_is_announced_to_end(policy: str) -> None:
    """`0 .5 0 0`, one robot that is worth 4 cells, all safe from step f on: it goes on at f, and covers all.

    Where f is after the last step, T_max = 8 * 2 * 4 + 64 = 128, it waits until then.
    """
    world = World.create([[0, 0.5, 0, 0]])
    for f in (1, 2, 3, 4, 5, 9, 125, 128, 500):
        timed = world.with_phases([(f, np.zeros((1, 4)))])
        plan = make_plan(timed, [[0, 0]], Settings(policy=policy, robot_value=4.0))
        done = f + 3 <= 128  # it is allocated the area in step f, and moves in the three steps after it
        assert (plan.outcome, plan.time) == (("complete", f + 3) if done else ("step_limit", 128)), f
        loop = compile_closed_loop(plan, timed)
        tally = run_range(loop, f, 0, 64, threads=1)[0]
        assert tally.alive.tolist() == [0, 64]
        assert tally.visited.tolist() == [64 * (n == (4 if done else 1)) for n in range(5)]
        play_both_ways(plan, timed, f, 4)
        tree = grow_tree(loop, 0.0, 10**6)
        assert tree is not None and tree.mean_alive == 1.0


def test_a_team_ends_once_nothing_that_is_announced_changes_the_map() -> None:
    """The last phase that changes a level counts, on cells that robots can reach, and while a robot can move."""
    base = np.array([[0, 0.5, 0, np.nan, 0]])

    def ends(phases: list[tuple[int, list[float]]], **more: Any) -> tuple[str, int]:
        maps = [(at, np.array([p])) for at, p in phases]
        plan = make_plan(
            World.create(base).with_phases(maps), [[0, 0]], Settings(policy="per_cell", robot_value=4.0, **more)
        )
        return plan.outcome, plan.time

    assert ends([(9, [0, 0.5, 0, N, 0.3])]) == ("not_worth_the_risk", 2)  # out of reach
    assert ends([(4, [0, 0.4, 0, N, 0]), (9, [0, 0.4, 0, N, 0.3])]) == (
        "not_worth_the_risk",
        5,
    )  # the last that counts: 4
    assert ends([(4, [0, 0.4, 0, N, 0]), (9, [0, 0, 0, N, 0])]) == ("complete", 11)
    assert ends([(3, [0, 0, 0, N, 0]), (9, [0, 0.5, 0, N, 0])]) == ("complete", 5)
    timed = World.create([[0, 0, 0.5]]).with_phases([(9, np.zeros((1, 3)))])
    spent = make_plan(timed, [[0, 0]], Settings(policy="per_cell", range=1))
    assert (spent.outcome, spent.time) == ("no_progress", 3)  # nobody can move any more


def test_robots_that_come_home_wait_for_it_too() -> None:
    """As above, and then home: B, C, D at f + 1 to f + 3, back at f + 6; by a deadline that is before f nothing."""
    world = World.create([[0, 0.5, 0, 0]])
    for f, deadline, end in (
        (5, None, ("complete", 11)), (4, 10, ("complete", 10)), (4, 9, ("deadline", 9)), (20, 10, ("deadline", 10)),
    ):  # fmt: skip
        timed = world.with_phases([(f, np.zeros((1, 4)))])
        settings = Settings(policy="per_cell", robot_value=4.0, return_to="home", deadline=deadline)
        plan = make_plan(timed, [[0, 0]], settings)
        assert (plan.outcome, plan.time) == end
        loop = compile_closed_loop(plan, timed)
        play_both_ways(plan, timed, f, 1)
        assert run_range(loop, f, 0, 8, threads=1)[0].home.tolist() == [0, 8]


# --- what is expected ---

TINY = [
    [(0, [[0, 0.3, 0], [0, 0.2, 0]]), (3, [[0.3, 0, 0], [0, 0, 0.2]])],
    [(0, [[0, 0, 0.4], [N, 0, 0], [0, 0.4, 0]]),
     (2, [[0.4, 0, 0], [N, 0, 0.1], [0, 0, 0.1]]), (5, [[0, 0, 0], [N, 0, 0], [0, 0, 0]])],
    [(0, [[0, 0, 0, 0, 0]]), (4, [[0.5, 0.5, 0.5, 0.5, 0]])],
    [(0, [[0.2, 0.2, 0.2], [0.2, N, 0.2], [0, 0.2, 0]]), (1, [[0, 0.2, 0], [0.3, N, 0.3], [0, 0.2, 0.3]])],
]  # fmt: skip


def tiny(number: int, plan_on: Foresight) -> World:
    (_, first), *later = TINY[number]
    return World.create(first).with_phases([(begin, np.array(p)) for begin, p in later], plan_on)


@pytest.mark.parametrize("plan_on", FORESIGHTS)
@pytest.mark.parametrize("number", range(len(TINY)))
@pytest.mark.parametrize("wide", [False, True])
def test_teams_come_to_what_enumeration_has(number: int, plan_on: Foresight, wide: bool) -> None:
    world = tiny(number, plan_on)
    free = [tuple(cell) for cell in np.argwhere(world.free).tolist()]
    starts = [free[0], free[-1] if wide else free[0]]
    plan = make_plan(world, starts)
    expected = ANSWERS["phases"][f"{number} {plan_on} {wide}"]
    loop = compile_closed_loop(plan, world)
    tree, singles = grow_tree(loop, 0.0, 10**6), run_range(loop, 3, 0, 40_000, singles=True)[1]
    found = (tree.covered("visited")[0], tree.mean_alive, tree.covered("survived")[0])
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    for name, mean in zip(("visited", "alive", "survived"), expected, strict=True):
        values = getattr(singles, name)
        assert abs(values.mean() - mean) < 5 * max(values.std() / 200, 1e-4), name


@pytest.mark.parametrize("number", range(len(TINY)))
def test_given_paths_are_known_exactly(number: int) -> None:
    world = tiny(number, "first")
    paths = [robot.path for robot in make_plan(world, np.argwhere(world.free)[[0, -1]]).robots]
    paths[0] = np.insert(paths[0], 1, [paths[0][0]] * 2)  # it waits
    plan = Plan(world.shape, world.sha256, None, tuple(map(RobotPlan, paths)))
    expected = ANSWERS["phases_of_paths"][str(number)]
    exact = open_loop_exact(plan, world)
    np.testing.assert_allclose((exact.visited, exact.survival.sum(), exact.survived), expected, rtol=1e-6)
    values = make_engine(plan, world, Rolling("open"), "numba").results(0, 40_000)
    for name, mean in zip(("visited", "alive", "survived"), expected, strict=True):
        of = getattr(values, name)
        assert abs(of.mean() - mean) < 5 * max(of.std() / 200, 1e-4), name


def test_who_wears_bears_what_each_phase_brings() -> None:
    """One robot of wear 3 on a path: S = exp(-(E / s)**3) of the exposure E of its visits, each in its phase."""
    world = tiny(2, "now")
    exact = open_loop_exact(make_plan(world, [[0, 0]], Settings(weibull_shape=3.0)), world)
    borne = -np.log1p(-np.float64(np.float32(0.5)))  # it enters [0, 4] at step 4, safe in both; nothing before
    assert exact.survival[0] == 1.0 and borne > 0
    back = Plan(world.shape, world.sha256, None, (RobotPlan(np.array([0, 1, 2, 3, 2, 1])),), failures=FailureModel(3.0))
    scale = round(2**20 / gamma(1 + 1 / 3)) / 2**20
    assert open_loop_exact(back, world).survival[0] == pytest.approx(np.exp(-((2 * borne / scale) ** 3)), rel=1e-4)


# --- what changes nothing ---


def test_phases_that_change_nothing_change_no_run() -> None:
    for seed in range(4):
        world = random_world(9, 9, ThreatPattern(seed=seed))
        assert world.with_phases([(0, world)]).uncertainty is None
        starts, _ = place_starts(world, 3)
        settings = Settings(policy=("mrac", "per_cell")[seed % 2])
        other = np.where(world.free, 0.3, np.nan)
        for phases in ([(5, world), (9, world)], [(MAX_STEP, other)]):
            timed = world.with_phases(phases, "first")
            plans = [make_plan(one, starts, settings) for one in (world, timed)]
            assert plans[0].to_json() == plans[1].to_json()
            loops = [compile_closed_loop(plan, one) for plan, one in zip(plans, (world, timed), strict=True)]
            counts = [run_range(loop, 1, 0, 2000)[0].counts() for loop in loops]
            assert all(np.array_equal(counts[0][name], counts[1][name]) for name in counts[0])
            assert loops[0].identity != loops[1].identity
        alike = world.with_phases([(5, world)])
        runs = [trace_rollouts(compile_closed_loop(plans[0], one), 1, range(8)) for one in (world, alike)]
        assert runs[0] == runs[1]


def test_no_count_depends_on_threads_or_chunks() -> None:
    world = random_world(9, 9, ThreatPattern(seed=3))
    timed = world.with_phases([(20, np.roll(np.nan_to_num(world.threat), 3, axis=1) + 0 * world.threat)])
    loop = compile_closed_loop(make_plan(timed, place_starts(timed, 4)[0]), timed)
    whole = run_range(loop, 9, 0, 6000, threads=2)[0]
    assert run_range(loop, 9, 0, 1700, threads=1)[0] + run_range(loop, 9, 1700, 4300, threads=1)[0] == whole


# --- files, and what is refused ---

SCENARIO_PHASES = "map: m.npy\nthreats: [{raster: a.npy}]\nphases:\n- {from: 4, threats: [{raster: b.npy}]}\n"


def scenario_phases(folder: Path, text: str) -> World:
    grid = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.save(folder / "m.npy", grid)
    for name, p in (("a", [[0.1, 0, 0], [0, 0, 0]]), ("b", [[0, 0, 0], [0, 0.2, 0.3]])):
        np.save(folder / f"{name}.npy", np.array(p))
    (folder / "s.yaml").write_text(text)
    return load_input(folder / "s.yaml")


def test_a_scenario_and_its_world_file_phases(tmp_path: Path) -> None:
    for plan_on, planned in (("now", [0.1, 0, 0]), ("first", [0.1, 0, 0]), ("worst", [0.1, 0.2, 0.3])):
        world = scenario_phases(tmp_path, SCENARIO_PHASES + f"plan_on: {plan_on}\n")
        assert world.phases is not None and world.phases.begins.tolist() == [0, 4]
        shown = world.threat[[0, 1, 1], [0, 1, 2]]
        np.testing.assert_allclose(shown, planned, rtol=1e-6)
        world.save(tmp_path / "w.npz", force=True)
        again = load_world_file(tmp_path / "w.npz")
        assert again.randomness_sha256 == world.randomness_sha256 == load_input(tmp_path / "w.npz").randomness_sha256
        assert "threats that change at step 4; " in repr(again)
    whole = scenario_phases(
        tmp_path, SCENARIO_PHASES.replace("threats: [{raster: a.npy}]\n", "").replace("from: 4", "from: 0")
    )
    assert whole.uncertainty is None and whole.threat[1, 2] == np.float32(0.3)
    arrays = dict(np.load(tmp_path / "w.npz"))
    for name, value in (("phases_from", np.array([1, 4])), ("phases_threat", arrays["phases_threat"][:1])):
        np.savez(tmp_path / "bad.npz", **(arrays | {name: value}))
        with pytest.raises(InputError, match="do not fit each other"):
            load_world_file(tmp_path / "bad.npz")


WRONG_PHASES = [
    ("from: 4", "from: -1", r"`phases`: phases\[0\]\.from is -1; expected a step, 0 to"),
    ("from: 4", "from: 1.5", r"phases\[0\]\.from is 1\.5; expected a step"),
    ("from: 4", "from: 0", r"`phases` begin at step 0, where `threats` are to hold; leave `threats` out"),
    ("from: 4", "step: 4", r"phases\[0\]"),
    ("phases:\n", "phases:\n- {from: 9, threats: []}\n", r"phases\[1\]\.from is 4; expected a step, 10 to .* order"),
    ("threats: [{raster: b.npy}]", "threats: 3", r"`phases\[0\]\.threats` is 3; expected a list of sources"),
    ("{raster: b.npy}", "{raster: c.npy}", r"`phases\[0\]\.threats\[0\]\.raster`"),
    ("phases:\n- {from: 4, threats: [{raster: b.npy}]}\n", "phases: []\n", r"`phases` is \[\]; expected a list of"),
    ("map: m.npy", "map: m.npy\nplan_on: last", r"`plan_on` is 'last'; expected now or first or worst"),
    ("map: m.npy", "map: m.npy\nmoving_threats: [{walk: 1, h: 0.1}]", r"`phases` is .*none together with moving"),
    ("map: m.npy", "map: m.npy\nprior_map: {p: 0.1}", r"uncertainty: threats that change at step 4"),
]


@pytest.mark.parametrize(("old", "new", "said"), WRONG_PHASES)
def test_a_wrong_phase_is_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in SCENARIO_PHASES
    with pytest.raises(InputError, match=said) as error:
        scenario_phases(tmp_path, SCENARIO_PHASES.replace(old, new))
    assert "\n" not in str(error.value)


def test_maps_and_loops_that_do_not_fit_are_refused() -> None:
    world = tiny(1, "now")
    plain = replace(world, threat=world.met, uncertainty=None)
    with pytest.raises(InputError, match=r"phases\[0\] has other obstacles at \[1, 0\]"):
        plain.with_phases([(3, np.zeros((3, 3)))])
    with pytest.raises(InputError, match=r"phases\[0\] is dict; expected pairs \(step, threats\)"):
        World.create(np.zeros((2, 2))).with_phases([{"from": 4, "threats": []}])  # type: ignore[list-item]
    with pytest.raises(InputError, match=r"phases\[0\] has shape \[2, 3\]"):
        plain.with_phases([(3, np.zeros((2, 3)))])
    with pytest.raises(InputError, match="together with another uncertainty"):
        world.with_phases([(3, plain)])
    with pytest.raises(InputError, match=r"threats known in advance.*use `plan_on: first` or `worst`"):
        make_plan(world, [[0, 0]], Settings(radio=4.0))
    with pytest.raises(InputError, match=r"`transit=\"area\"`, legs that stay.*use `plan_on: first` or `worst`"):
        make_plan(world, [[0, 0]], Settings(transit="area"))
    with pytest.raises(InputError, match=r"engine=.jax. with threats that change"):
        make_engine(make_plan(world, [[0, 0]]), world, Rolling(), "jax")
