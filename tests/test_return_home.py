"""Robots with a range, and robots that come home."""

import heapq
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import ANSWERS
from drawn_worlds import closed_loop, expected, open_loop, persistent
from helpers import VisitLoop, assert_same_trace, delivered, load_plan, play_both_ways
from numpy.typing import NDArray
from validate import validate

from analysis.cli.app import run as run_command
from analysis.comparison import compare, make_side, summary
from analysis.estimators.racing import deliveries, plan_best
from analysis.estimators.trial import Trial
from analysis.evaluation.evaluate import evaluate
from analysis.sampling import RolloutChoices
from analysis.search.pareto import Ladders, find_front, settings_of
from analysis.search.start_positions import find_starts
from analysis.search.team_size import find_size, make_goal
from analysis.theory.exact import open_loop_exact
from planner.errors import InputError, PlanError, ScenarioError, UsageError
from planner.make_plan import allocated_plan, confirm_plan, make_plan
from planner.mission.mission import Mission
from planner.mrac.problem import prepare
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.exact_tree import WHOLE, grow_tree
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import Doing, EventKind, Outcome
from planner.tally import Trace
from planner.world.generate import PAPER_LEVELS, Stream, ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# Robots that come home: plain code, closed forms, and the tree of all that can happen.

KINDS: list[dict[str, Any]] = [
    {"return_to": "home"},
    {"return_to": "nearest", "range": 40},
    {"return_to": "home", "deadline": 35},
    {"return_to": "home", "range": (25, 50, 70), "deadline": 55, "policy": "per_cell"},
    {"return_to": "nearest", "policy": "per_cell", "risk_cap": 0.4, "deadline": 60},
    {"return_to": "home", "policy": "per_cell", "range": 45},
    {"return_to": "nearest", "transit": "area", "range": 50},
    {"return_to": "home", "range": 30, "recharge": 4},
    {"return_to": "nearest", "deliver_every": 6, "policy": "per_cell"},
    {"return_to": "nearest", "range": (25, 40, 60), "recharge": 7, "deadline": 140}
    | {"policy": "per_cell", "robot_value": 20.0},
]


def drawn(seed: int, robots: int = 3) -> tuple[World, NDArray[np.int64]]:
    """A random map and starts anywhere in one part of it."""
    kind = ("scattered", "contiguous")[seed % 2]
    pattern = ThreatPattern(kind, 4, PAPER_LEVELS, seed)  # type: ignore[arg-type]
    world = random_world(9 + seed % 4, 8 + seed % 5, pattern, obstacles=0.2, threats=0.3)
    free = np.argwhere(world.accessible(place_starts(world, 1)[0]))
    return world, free[np.random.default_rng(seed).integers(0, len(free), robots)]


def ways(world: World, bases: list[int], entry: dict[int, int]) -> dict[int, tuple[int, int]]:
    """(cost, moves) of the way home from each cell, by the plainest search: from the bases, backwards."""
    height, width = world.shape
    found: dict[int, tuple[int, int]] = {}
    due = [(0, 0, base) for base in bases]
    while due:
        cost, moves, cell = heapq.heappop(due)
        if cell in found:
            continue
        found[cell] = cost, moves
        row, col = divmod(cell, width)
        for r, c in ((row - 1, col), (row, col - 1), (row, col + 1), (row + 1, col)):
            if 0 <= r < height and 0 <= c < width and r * width + c in entry:
                heapq.heappush(due, (cost + entry[cell], moves + 1, r * width + c))
    return found


def entries(world: World, plan: Plan) -> dict[int, int]:
    problem = prepare(world, plan.starts, plan.settings or Settings())
    return {int(cell): int(problem.costs[cell]) for cell in np.flatnonzero(problem.levels.accessible)}


def check_rules(trace: Trace, world: World, plan: Plan, found: list[dict[int, tuple[int, int]]]) -> None:
    """What section 19 promises of a run, read off its trace; `found`: the ways home of each robot."""
    settings = plan.settings
    for robot, way in enumerate(found):
        cells, doing = trace.cells[:, robot].tolist(), trace.doing[:, robot].tolist()
        turned = [row[0] for row in trace.events.tolist() if row[1:3] == [robot, EventKind.TURNED_HOME]]
        given = settings.range[robot] if isinstance(settings.range, tuple) else settings.range
        charged = {row[0] for row in trace.events.tolist() if row[1:3] == [robot, EventKind.CHARGED]}
        moves = 0
        for step, cell in enumerate(cells):
            if step in charged:
                assert way[cell] == (0, 0) and moves > 0
                moves = 0
            moves += step > 0 and cell != cells[step - 1]
            if doing[step] == Doing.DEAD:
                break
            assert given is None or way[cell][1] <= given - moves
            assert settings.deadline is None or way[cell][1] <= settings.deadline - step
        if doing[-1] != Doing.DEAD:
            assert way[cells[-1]] == (0, 0)
        assert len(turned) <= 1 + len(charged)
        for begun in turned:
            check_way_home(trace, robot, begun, way, charged)


def check_way_home(trace: Trace, robot: int, turned: int, way: dict[int, tuple[int, int]], charged: set[int]) -> None:
    """From where it turned a robot goes home and nowhere else, and stays there, at least until it is charged."""
    cells, doing = trace.cells[:, robot].tolist(), trace.doing[:, robot].tolist()
    for step in range(turned, trace.time):
        if step + 1 in charged or doing[step] == Doing.DEAD:
            return
        before, after = cells[step], cells[step + 1]
        assert doing[step] in (Doing.RETURNING, Doing.DONE, Doing.CHARGING) and trace.areas[step, robot] == -1
        assert way[after][1] == way[before][1] - (doing[step] == Doing.RETURNING)
        assert way[after][0] <= way[before][0]


WATCHFUL: list[dict[str, Any]] = [
    {"return_to": "nearest", "policy": "watchful", "risk_cap": 0.4, "range": 45, "robot_value": 20.0},
    {"return_to": "home", "policy": "watchful", "risk_cap": 0.4, "range": 40, "recharge": 3},
    {"return_to": "nearest", "policy": "watchful", "risk_cap": 0.4, "range": 50, "steps_per_move": (1, 2, 1)},
]


def test_who_goes_first_knows_what_those_have_left_that_have_yet_to_move() -> None:
    world, starts = drawn(7, 4)
    for asked, rollout in zip(WATCHFUL[:2], (104, 3), strict=True):
        plan = make_plan(world, starts, Settings(**asked))
        trace = trace_rollouts(compile_closed_loop(plan, world), 7, [rollout])[0]
        assert_same_trace(trace, PythonLoop(plan, world).trace(7, rollout))


@pytest.mark.parametrize("number", range(len(KINDS)))
def test_who_is_alive_is_home(number: int) -> None:
    asked = KINDS[number]
    for seed in (number, number + 20):
        world, starts = drawn(seed)
        plan = make_plan(world, starts, Settings(**asked))
        entry = entries(world, plan)
        own = [[row * world.shape[1] + col] for row, col in starts.tolist()]
        bases = own if asked["return_to"] == "home" else [[base for (base,) in own]] * len(own)
        found = [ways(world, of, entry) for of in bases]
        for run in play_both_ways(plan, world, seed, 3):
            check_rules(run.trace, world, plan, found)
        loop = compile_closed_loop(plan, world)
        tally, singles = run_range(loop, seed, 0, 500, threads=1, singles=True)
        np.testing.assert_array_equal(singles.home, singles.alive)
        np.testing.assert_array_equal(tally.home, np.bincount(singles.home, minlength=len(starts) + 1))
        if "range" not in asked and "deadline" not in asked and "risk_cap" not in asked:  # Theorem 2
            assert set(np.unique(singles.outcome)) <= {Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST}


def test_ways_home_are_the_safest_and_of_these_the_shortest() -> None:
    for seed in range(8):
        world, starts = drawn(seed, 2)
        problem = prepare(world, starts, Settings(return_to="nearest", levels=4))
        entry = {int(cell): int(problem.costs[cell]) for cell in np.flatnonzero(problem.levels.accessible)}
        wanted = ways(world, problem.starts.tolist(), entry)
        onward = problem.home.onward[problem.home.of[0]]
        for cell, (cost, moves) in wanted.items():
            way = [cell]
            while onward[way[-1]] >= 0:
                way.append(onward[way[-1]])
            assert (sum(entry[passed] for passed in way[1:]), len(way) - 1) == (cost, moves)
            assert (problem.home.cost[0, cell], problem.home.moves(1, cell)) == (cost, moves)


def corridor(cells: int, p: float) -> World:
    return World.create(np.array([[0.0] + [p] * (cells - 1)]))


@pytest.mark.parametrize(("more", "turns_at"), [({}, 9), ({"range": 13}, 6), ({"deadline": 10}, 5), ({"range": 1}, 0)])
def test_a_corridor_by_hand(more: dict[str, int], turns_at: int) -> None:
    """From its end a robot goes as far as it can come back from: it enters 2 n - 1 dangerous cells, then its start."""
    p, world = 0.07, corridor(10, 0.07)
    plan = make_plan(world, [[0, 0]], Settings(return_to="home", **more))
    there = list(range(turns_at + 1))
    assert plan.robots[0].path.tolist() == there + there[-2::-1]
    answer = evaluate(world, plan, RolloutChoices(rollouts=2000))
    home, passed = answer.figures.home, max(2 * turns_at - 1, 0)
    assert home is not None and home.robots == 1
    assert home.mean == pytest.approx((1 - np.float32(p)) ** passed, rel=1e-6)
    assert home.at_least[1].mean == pytest.approx(home.mean) and home.at_least[0].mean == pytest.approx(1)
    assert answer.visited.cells == pytest.approx(1 + sum((1 - p) ** k for k in range(turns_at)), rel=1e-6)
    for cells in (answer.delivered.cells, answer.closed_form.delivered):
        assert cells == pytest.approx(1 + turns_at * home.mean)


def test_a_charged_robot_goes_out_again_by_hand() -> None:
    """From the middle of a corridor with nine moves: one side and back, three steps of charging, then the other."""
    p = 0.05
    world = World.create([[p] * 4 + [0.0] + [p] * 4])
    plan = make_plan(world, [[0, 4]], Settings(return_to="home", range=9, recharge=3))
    assert plan.robots[0].path.tolist() == [4, 3, 2, 1, 0, 1, 2, 3, 4, 4, 4, 4, 5, 6, 7, 8, 7, 6, 5, 4]
    assert (plan.outcome, plan.time) == ("complete", 19)
    answer = evaluate(world, plan, RolloutChoices(rollouts=2000))
    passes = (1 - float(np.float32(p))) ** np.arange(15)
    assert answer.figures.home is not None and answer.figures.home.mean == pytest.approx(passes[14], rel=1e-6)
    assert answer.visited.cells == pytest.approx(1 + passes[:4].sum() + passes[7:11].sum(), rel=1e-6)
    assert answer.closed_form.delivered == pytest.approx(1 + 4 * passes[7] + 4 * passes[14], rel=1e-6)
    without = make_plan(world, [[0, 4]], Settings(return_to="home", range=9))
    assert (without.outcome, len(np.unique(without.robots[0].path))) == ("no_progress", 5)


def trips(turns: list[int], p: float) -> float:
    """Cells delivered by trips from the start of a corridor to each of these cells and back: 2 n - 1 are dangerous."""
    passed = (1 - float(np.float32(p))) ** np.cumsum(2 * np.array(turns) - 1)
    return 1 + float(passed @ np.diff([0, *turns]))


@pytest.mark.parametrize(("asked", "turns"), [({"deliver_every": 2}, [2, 4, 6]), ({"deliver_value": 0.3}, [2, 3, 6])])
def test_a_robot_delivers_cells_or_their_value_by_hand(asked: dict[str, Any], turns: list[int]) -> None:
    """The start counts as delivered. As float64, .1 + .2 is not .3."""
    world = replace(corridor(7, 0.05), value=np.array([[9, 0.1, 0.2, 0.3, 0, 0.1, 0.2]]))
    plan = make_plan(world, [[0, 0]], Settings(return_to="home", **asked))
    assert plan.robots[0].path.tolist() == [cell for most in turns for cell in [*range(most), *range(most, 0, -1), 0]]
    answer = evaluate(world, plan, RolloutChoices(rollouts=2000))
    assert answer.delivered is not None and answer.delivered.cells == pytest.approx(trips(turns, 0.05))


def brought_by(plan: Plan, world: World) -> float:
    """Cells that it delivers, by enumeration."""
    p = np.nan_to_num(world.threat).ravel().astype(np.float64)
    return float(expected(closed_loop(plan, world), lambda chance, _, cell: chance(p[cell]))[-1])


def test_auto_delivers_most_of_the_numbers_that_it_tries(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """By the enumeration of tiny worlds, and in a corridor by hand."""
    chosen, settings = [], Settings(return_to="home")
    for number in (0, 1, 2, 6, 8):
        world, starts = tiny(number)
        tried = [replace(settings, deliver_every=most) for most in deliveries(world, np.array(starts), settings)]
        best = plan_best(world, np.array(starts), settings, None, "deliver_every")
        got, *others = (brought_by(plan, world) for plan in [best, *(make_plan(world, starts, one) for one in tried)])
        assert got == pytest.approx(max(others)) and best.settings is not None
        chosen.append(best.settings.deliver_every)
    assert None in chosen and any(chosen)
    (tmp_path / "c.csv").write_text("0,.2,.2,.2,.2,.2\n")
    by_hand = {most: trips([*range(most, 5, most), 5], 0.2) for most in (1, 2, 3, 5)}
    most = max(by_hand, key=lambda one: by_hand[one])
    words = ["evaluate", str(tmp_path / "c.csv"), "--return-to", "home", "--deliver-every", "auto", "--rollouts", "64"]
    assert run_command([*words, "--json"]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["plan"]["settings"]["deliver_every"] == most
    assert found["coverage"]["delivered"]["mean"] == pytest.approx(by_hand[most] / 6)
    assert (
        f"deliver every {most}, {(by_hand[most] - by_hand[5]) / 6 * 100:.2f} points (exact) more delivered than mrac"
        in said.err
    )


@pytest.mark.parametrize("number", [0, 1, 2, 3, 4, 7])
def test_the_exact_tree_knows_who_comes_home(number: int) -> None:
    world = World.create(
        [[0, 0.1, 0.1, 0], [0, np.nan, 0, 0.3], [0.2, 0, 0, np.nan], [0.2, 0.1, 0, 0.3]], [[0, 0], [0, 3], [2, 1]]
    )
    asked = KINDS[number]
    plan = make_plan(world, world.starts, Settings(**{**asked, "density": 1.5}))
    tree = grow_tree(compile_closed_loop(plan, world), 0.0, 10**6)
    assert tree is not None and not tree.left
    chances = tree.counts.home / WHOLE
    if "policy" not in asked:  # who is alive is at home
        np.testing.assert_allclose(chances, ANSWERS["home_trees"][str(number)], atol=1e-9)
    sampled = run_range(compile_closed_loop(plan, world), 5, 0, 20_000)[0].home / 20_000
    assert (np.abs(sampled - chances) <= 5 * np.sqrt(chances * (1 - chances) / 20_000) + 1e-9).all()


def test_open_loop_paths_end_at_home(tmp_path: Any) -> None:
    world, starts = drawn(3)
    plan = make_plan(world, starts, Settings(return_to="home", range=60))
    assert plan.ends_home() and plan.ends_home(0)
    away = next(step for step, cell in enumerate(plan.robots[0].path) if cell != plan.robots[0].path[0])
    assert not plan.ends_home(away)
    cut = compare(*(make_side(world, plan, RolloutChoices(loop="open", rollouts=64, deadline=away)) for _ in range(2)))
    assert "home" not in cut.figures and make_side(world, plan, RolloutChoices(loop="open")).comes_home
    plan.save(tmp_path / "plan.json")
    assert load_plan(tmp_path / "plan.json", world).settings == plan.settings
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=4096))
    assert answer.figures.home.mean == answer.figures.alive.mean


NO_WAY_HOME = [
    ({"return_to": ((0, 99),)}, "outside the map"), ({"return_to": ((0, 3),)}, "cannot reach a base"),
    ({"return_to": ((0, 1),), "range": 1}, None), ({"return_to": ((0, 2),), "range": 1}, "2 moves from its base"),
    ({"return_to": "base"}, "home"), ({"return_to": ()}, "home"), ({"return_to": "home", "recharge": 3}, "range"),
]  # fmt: skip


@pytest.mark.parametrize(("more", "said"), NO_WAY_HOME)
def test_what_cannot_come_home_is_refused(more: dict[str, Any], said: str | None) -> None:
    world = World.create([[0, 0, 0, np.nan, 0]])
    if said is None:
        make_plan(world, [[0, 0]], Settings(**more))
        return
    with pytest.raises(InputError, match=said):
        make_plan(world, [[0, 0]], Settings(**more))


def test_what_does_not_know_the_way_home_says_so() -> None:
    world, starts = drawn(1)
    with pytest.raises(InputError, match="return_to"):
        plan_team(world, starts, Settings(return_to="home", plan_for="open_loop"))


def test_a_run_goes_on_from_its_state_as_if_it_had_not_stopped() -> None:
    """On the way home, too, and once all are called: the rest is the uncut run's; both engines run the same rest."""
    returning = 0
    for number, seed in ((0, 4), (2, 5), (5, 7)):
        world, starts = drawn(seed)
        plan = make_plan(world, starts, Settings(**KINDS[number]))
        whole = VisitLoop(plan, world)
        for rollout in range(2):
            trace = whole.trace(0, rollout)
            for step in {4, trace.time // 2, trace.time - 5, trace.time - 1}:
                state = whole.state_at(step, 0, rollout)
                if state is None:
                    continue
                read = parse_state(state.to_json(), world, "state")
                rest = allocated_plan(world, read.starts, Settings(**KINDS[number]), read)
                assert set(read.delivered.tolist()) == delivered(trace, plan.bases, step + 1)
                run = VisitLoop(rest, world).begin(0, rollout)
                again = run.play().trace
                assert run.raw.marks["delivered"] == len(delivered(trace, plan.bases))
                np.testing.assert_array_equal(again.cells[step:], trace.cells[step:])
                assert again.outcome == trace.outcome
                compiled = compile_closed_loop(rest, world, tabled=seed % 2 == 0)
                assert_same_trace(trace_rollouts(compiled, 0, [rollout])[0], PythonLoop(rest, world).trace(0, rollout))
                returning += any(robot.status == "returning" for robot in read.robots)
    assert returning > 3


def driven(mission: Mission, steps: int) -> list[str]:
    """What the orders were for, of so many steps in which everybody does what it is told, nobody is lost."""
    said = []
    for _ in range(steps):
        for order in mission.orders().values():
            said.append(order.why)
            mission.report(order.robot, cell=order.cell)
        mission.advance()
    return said


def test_an_operator_ends_a_driven_mission_and_a_new_battery_sends_out_again() -> None:
    world = corridor(12, 0.01)
    mission = Mission(world, make_plan(world, [[0, 0]], Settings(return_to="home", range=8)))
    assert "return" not in driven(mission, 5) and set(driven(mission, 4)) == {"return"}
    assert mission.outcome is None and 0 in mission._fleet.turned
    mission.report(0, cell=(0, 0), moves_left=24)
    assert set(driven(mission, 4)) == {"hold", "travel"}
    mission.call_off()
    assert set(driven(mission, 3)) == {"return"}
    while mission.outcome is None:
        driven(mission, 1)
    assert mission.outcome == Outcome.ENDED_BY_OPERATOR and mission._fleet.cell(0) == 0


def test_who_is_cut_off_from_home_goes_on_and_stays_where_it_ends(tmp_path: Any) -> None:
    world = corridor(8, 0.01)
    mission = Mission(world, make_plan(world, [[0, 0]], Settings(return_to="home")))
    driven(mission, 4)
    mission.close([[0, 1]])
    mission.save(tmp_path / "now.json")
    mission = Mission.resume(tmp_path / "now.json", world, make_plan(world, [[0, 0]], Settings(return_to="home")))
    while mission.outcome is None:
        driven(mission, 1)
    assert mission.outcome == Outcome.COMPLETE and mission._fleet.cell(0) == 7


def test_worth_counts_the_way_home() -> None:
    """Seven safe cells beyond a danger p = .2: V = 15 robots' cells of n = 10 make theta 3, so that C = 17 is less than
    7 theta, and more with the 11 by which the way home gets dearer.
    """
    world, visited = World.create([[0.0, 0.0, 0.2, *[0.0] * 7]]), {}
    for to in (None, "home"):
        for robot_value in (5.0, 15.0, 20.0):
            plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", robot_value=robot_value, return_to=to))
            visited[to, robot_value] = len(np.unique(plan.robots[0].path))
    assert visited == {(None, 5.0): 10, (None, 15.0): 10, (None, 20.0): 2} | {
        ("home", 5.0): 10, ("home", 15.0): 2, ("home", 20.0): 2,
    }  # fmt: skip


@pytest.mark.parametrize("metric", ["visited", "delivered"])
def test_the_settings_of_a_front_are_missions_that_end_at_home(metric: str) -> None:
    world, starts = drawn(7)
    settings, choices = Settings(return_to="nearest"), RolloutChoices(rollouts=256, exact="never", metric=metric)
    ladders = Ladders(risk_caps=(), robot_values=(), landmarks=(0.5,))
    front = find_front(world, starts, settings, choices, ladders=ladders)
    ended = [point for point in front.points if point.setting.deadline is not None]
    assert len(ended) == 2 and any("base" in note for note in front.notes)
    for point in ended:
        plan = make_plan(world, starts, settings_of(settings, point.setting))
        tally, singles = run_range(compile_closed_loop(plan, world), 0, 0, 256, singles=True)
        assert singles is not None and singles.time.max() <= (point.setting.deadline or 0)
        np.testing.assert_array_equal(singles.home, singles.alive)
        mean = (getattr(tally, metric) @ np.arange(len(tally.visited))) / 256 / tally.accessible
        assert point.coverage.mean == pytest.approx(mean, abs=1e-9)


def test_robots_know_the_deadline_of_an_answer() -> None:
    """By a deadline `evaluate` answers as for a plan with that deadline; who does not know it is still away then."""
    world, starts = drawn(7)
    blind = make_plan(world, starts, Settings(return_to="home"))
    choices = RolloutChoices(rollouts=256, exact="never", deadline=30)
    told = evaluate(world, blind, choices, band=False, advice=False)
    knows = evaluate(
        world, make_plan(world, starts, Settings(return_to="home", deadline=30)), replace(choices, deadline=None)
    )
    assert told.tally == knows.tally and told.plan.settings == knows.plan.settings
    np.testing.assert_array_equal(told.plan.robots[0].path, knows.plan.robots[0].path)
    np.testing.assert_array_equal(told.tally.home, told.tally.alive)
    cut_off, _ = run_range(compile_closed_loop(blind, world).truncated_at(30), 0, 0, 256)
    assert cut_off.home @ np.arange(4) < told.tally.home @ np.arange(4)
    trial = Trial(world, blind, choices)
    assert trial.sample(0, 256).tally.visited.tolist() == told.tally.visited.tolist()
    far = make_plan(world, starts, Settings(return_to=(tuple(map(int, starts[0])),)))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="moves from its base"):
        evaluate(world, far, replace(choices, deadline=1))


# Teams that come home, by everything that can happen to them.

HOMES: list[dict[str, Any]] = [
    {"return_to": "home"},
    {"return_to": "nearest"},
    {"return_to": "home", "range": 6},
    {"return_to": "nearest", "deadline": 7},
    {"return_to": "home", "range": 9, "deadline": 8},
    {"return_to": "nearest", "range": 5, "recharge": 2, "deadline": 30},
    {"return_to": ((0, 0),), "range": 8, "recharge": 1, "deadline": 24},
]
DANGERS = 3


def tiny(number: int) -> tuple[World, list[tuple[int, int]]]:
    """2 x 3 to 3 x 3 cells, three dangerous ones at most, two or three robots; every fourth map has a second phase."""
    stream = Stream(number, 1919)
    shape = (2 + stream.below(2), 3)
    p = np.zeros(shape, dtype=np.float32)
    for _ in range(DANGERS):
        p.flat[stream.below(p.size)] = (0.1, 0.3)[stream.below(2)]
    if stream.below(3) == 0:
        p.flat[1 + stream.below(p.size - 1)] = np.nan
    world = World.create(p)
    if number % 4 == 3:
        later = np.where(np.isnan(p), np.nan, np.roll(np.nan_to_num(p), 1 + stream.below(p.size))).astype(np.float32)
        world = world.with_phases([(2 + stream.below(4), later)])
    free = np.argwhere(world.components == world.components[0, 0])
    return world, [tuple(free[stream.below(len(free))].tolist()) for _ in range(2 + stream.below(2))]


@pytest.mark.parametrize("number", range(28))
def test_all_that_can_happen_to_teams_that_come_home(number: int) -> None:
    """The tree says, and rollouts come to, what a simulator written from the rules alone found by enumeration."""
    world, starts = tiny(number)
    plan = make_plan(world, starts, Settings(**HOMES[number % len(HOMES)]))
    visited, alive, *home, survived = ANSWERS["home"][str(number)]
    loop = compile_closed_loop(plan, world)
    tree = grow_tree(loop, 0.0, 10**6)
    assert tree is not None and not tree.left
    np.testing.assert_allclose(
        (*tree.covered("visited"), *tree.covered("survived")), [visited] * 2 + [survived] * 2, rtol=1e-6
    )
    np.testing.assert_allclose(tree.mean_alive, alive, rtol=1e-6)
    np.testing.assert_allclose(tree.counts.home / WHOLE, home, atol=1e-7)
    tally = run_range(loop, number, 0, 4096, threads=1)[0]
    error = np.sqrt(np.array(home) * (1 - np.array(home)) / 4096)
    assert (np.abs(tally.home / 4096 - home) <= 5 * error + 1e-9).all()
    play_both_ways(plan, world, number, 4)
    if world.phases is not None or number > 9:
        return
    p = np.nan_to_num(world.threat).ravel().astype(np.float64)
    brought = brought_by(plan, world)
    assert tree.covered("delivered") == pytest.approx((brought, brought)) and brought < visited
    *_, brought = expected(open_loop(plan, world), lambda chance, _, cell: chance(p[cell]))
    assert open_loop_exact(plan, world).delivered == pytest.approx(brought)
    hidden = world.with_latent_hazard("persistent", np.where(world.free, 0.5, np.nan), 2 * world.threat)
    plan = replace(make_plan(hidden, starts, Settings()), robots=plan.robots, settings=plan.settings)
    *_, brought = expected(open_loop(plan, world), persistent(np.where(p > 0, 0.5, 0.0), 2 * p))
    assert open_loop_exact(plan, hidden).delivered == pytest.approx(brought)


def test_teams_compared_by_cells_delivered() -> None:
    """From the left one robot delivers its cell, and three more with chance .25, of four."""
    world, choices = World.create([[0, 0.5, 0, 0]]), RolloutChoices(rollouts=4096, metric="delivered")
    home = Settings(return_to="home")
    size = find_size(world, home, make_goal(0.4, None, False, "delivered", 2), choices)
    assert size.robots == 1 and size.points[0].coverage is not None
    assert size.points[0].coverage.mean == pytest.approx(1.75 / 4)
    found = find_starts(world, 1, home, choices, depot=True, candidates=[[0, 0], [0, 2]])
    assert found.starts.tolist() == [[0, 2]]  # from there only the first cell is beyond the threat
    far, near = (make_side(world, make_plan(world, [start], home), choices) for start in ([0, 0], [0, 2]))
    answer = compare(far, near)
    assert answer.figures[-1] == "delivered" and "delivers" in summary(answer) and answer.ahead > answer.behind == 0
    assert answer.mean(far, "delivered") == pytest.approx(1.75 / 4, abs=0.02)
    one, two = (run_range(compile_closed_loop(far.plan, world), 0, start, 9)[0] for start in (0, 9))
    assert (one + two).delivered.sum() == 18
    assert not len((one + replace(two, delivered=two.delivered[:0])).delivered)  # of a store that lacks them


# Range: robots that make so many moves and then stay (SPEC section 12).

LIMITS: tuple[dict[str, Any], ...] = (
    {},
    {"policy": "per_cell"},
    {"policy": "per_cell", "risk_cap": 0.3},
    {"policy": "per_cell", "robot_value": 12.0, "risk_cap": 0.5},
)


def moves(path: np.ndarray) -> int:
    return int(np.count_nonzero(np.diff(path)))


def small(seed: int, robots: int, given: Any = None, **more: Any) -> tuple[World, Plan]:
    pattern = ThreatPattern("contiguous" if seed % 2 else "scattered", areas=3, seed=seed)
    world = random_world(8 + seed % 3, 9, pattern, obstacles=0.2, threats=0.35)
    return world, make_plan(world, place_starts(world, robots)[0], Settings(range=given, **more))


def test_a_corridor_by_hand_range() -> None:
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


@pytest.mark.parametrize("more", LIMITS, ids=["mrac", "per_cell", "risk_cap", "robot_value"])
def test_robots_stay_where_their_moves_end(more: dict[str, Any]) -> None:
    ended = 0
    for seed in range(6):
        robots = 1 + seed % 4
        for given in (1, 9, tuple(range(5, 5 + 9 * robots, 9))):
            world, plan = small(seed, robots, given, **more)
            for trace in trace_rollouts(compile_closed_loop(plan, world, tabled=seed > 0), seed, range(4)):
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
    plan = plan_team(world, starts, Settings(plan_for="open_loop", effort=200, range=(7, 15)))
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
