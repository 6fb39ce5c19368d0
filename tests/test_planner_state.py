"""State files: a mission cut at a step, saved and gone on with ends as the uncut one (SPEC section 12)."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from oracle_tree import closed_loop_exact
from rolling import VisitLoop
from test_planner_mission import SETTINGS as DRIVEN
from test_planner_mission import case

import mrac_jax as mrac
from analysis.recording.frames import make_frames
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import open_loop_exact
from planner.errors import InputError, PlanError, StateError, UsageError
from planner.mrac.make_plan import confirm_plan, make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan.state import MissionState
from planner.plan.state_file import load_state, parse_state
from planner.rollouts.open_loop import compile_plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, new_cells, run_range, trace_rollouts
from planner.world.world import World

LEFT_OUT = {"mrac, deadline", "per_cell, log", "wear", "home", "nearest, deadline", "own rule"}
SETTINGS = {name: more for name, more in DRIVEN.items() if name not in LEFT_OUT}
STEPS = (0, 3, 11, 25)
"""Where rollouts are cut, every other one of them each."""


def rest_of(world: World, state: MissionState, **more: Any) -> Plan:
    """The plan of the rest, by way of both files."""
    read = parse_state(json.loads(json.dumps(state.to_json())), world, "file")
    made = make_plan(world, read.starts, Settings(**more), state=read)
    return confirm_plan(parse_plan(json.loads(json.dumps(made.to_json())), world, "file"), world, "file")


@pytest.mark.parametrize("more", SETTINGS.values(), ids=list(SETTINGS))
def test_a_rollout_goes_on_as_if_it_had_not_been_cut(more: dict[str, Any]) -> None:
    cuts = 0
    for seed in range(3):
        world, plan = case(seed, **more)
        whole = VisitLoop(plan, world)  # a state has no thresholds, so that rests draw them anew
        for rollout in range(2 if seed == 2 else 1):
            uncut = whole.run(seed, rollout)
            for step in STEPS[(seed + rollout) % 2 :: 2]:
                state = whole.state_at(step, seed, rollout)
                if state is None:
                    assert uncut.time <= step
                    continue
                cuts += 1
                rest = rest_of(world, state, **more)
                run = VisitLoop(rest, world).run(seed, rollout)
                assert (run.outcome, run.time) == (uncut.outcome, uncut.time)
                for name in ("visited", "survived", "alive"):
                    np.testing.assert_array_equal(getattr(run, name), getattr(uncut, name))
                for before, after in zip(uncut.paths, run.paths, strict=True):
                    np.testing.assert_array_equal(before[step + 1 :], after[step + 1 :])
                readable = ReferenceLoop(rest, world)
                run = readable.run(seed, rollout)
                loop = compile_closed_loop(rest, world, tabled=seed != 1)
                tally, singles = run_range(loop, seed, rollout, 4, singles=True, threads=1)
                assert singles is not None
                found = [int(getattr(singles, name)[0]) for name in ("visited", "survived", "time", "alive", "outcome")]
                assert found == [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum(), run.outcome]
                for trace in trace_rollouts(loop, seed, (rollout, rollout + 1)):
                    assert trace == readable.trace(seed, trace.rollout), (seed, rollout, step)
                    frames = make_frames(trace, state)
                    at = trace.rollout - rollout
                    assert (frames.visited[-1], frames.survived[-1]) == (singles.visited[at], singles.survived[at])
                    assert frames.visited[step] == len(state.visited)
                assert tally.new_visited.sum() == tally.visited @ np.arange(len(tally.visited))
                assert tally.new_survived.sum() == tally.survived @ np.arange(len(tally.survived))
                assert new_cells(loop, seed, rollout, 1)[0].sum() == run.visited.sum()
    assert cuts > 4


def by_hand(world: World, plan: Plan, visited: list[int]) -> dict[str, Any]:
    width = world.shape[1]
    robots: list[dict[str, Any]] = [{"cell": [int(row), int(col)]} for row, col in plan.starts]
    robots[0] = {"cell": robots[0]["cell"], "status": "dead"}
    return {
        "format": "mrac-state",
        "version": 1,
        "world": {"shape": list(world.shape), "sha256": world.sha256},
        "step": 20,
        "visited": [list(divmod(cell, width)) for cell in visited],
        "robots": robots,
    }


def test_a_state_by_hand_is_allocated_anew() -> None:
    """The rest of a row of ten safe cells, six of them done: one robot is lost, the other covers four."""
    world = World.create(np.zeros((1, 10)))
    starts = make_plan(world, [[0, 4], [0, 5]])
    state = parse_state(by_hand(world, starts, [0, 1, 2, 3, 4, 5]), world, "hand.json")
    plan = make_plan(world, state.starts, state=state)
    assert set(plan.robots[1].path[20:].tolist()) == {5, 6, 7, 8, 9}
    assert set(plan.robots[0].path.tolist()) == {4}
    assert (plan.outcome, plan.time) == ("complete", 24)
    exact = open_loop_exact(plan, world)
    assert exact.visited == 10
    assert exact.survived == 10
    assert exact.alive_chance.tolist() == [0, 1, 0]


def test_where_areas_are_given_anew_nobody_has_waited_or_is_held() -> None:
    """Cut off: stuck after two quiet steps, whatever came before. With areas: as if nobody had been held from any."""
    world = World.create([[0.0, 0.0, np.nan, 0.5, 0.0]])
    said = by_hand(world, make_plan(world, [[0, 3], [0, 0]]), [0, 1, 3])
    states = [parse_state(said | {"quiet": quiet}, world, "hand.json") for quiet in (0, 1)]
    assert [make_plan(world, state.starts, state=state).time for state in states] == [22, 22]
    world, plan = case(10)
    said = by_hand(world, plan, sorted({int(row * 9 + col) for row, col in plan.starts})) | {"held": [1, 2]}
    rest = rest_of(world, parse_state(said, world, "hand.json"), **SETTINGS["worth"])
    assert rest.state is not None and [robot.status for robot in rest.state.robots] == ["dead", *["traveling"] * 3]
    assert not any(robot.held for robot in rest.state.robots)


def test_expected_values_of_the_rest_are_the_enumerated_ones() -> None:
    """One robot left: the closed form, the tree of all hits, and 20,000 rollouts agree."""
    threat = np.zeros((3, 4))
    threat[1, 1:3], threat[2, 3] = 0.3, 0.2
    world = World.create(threat)
    state = parse_state(by_hand(world, make_plan(world, [[0, 1], [0, 0]]), [0, 1, 2, 5]), world, "hand.json")
    plan = make_plan(world, state.starts, state=state)
    exact, tree = open_loop_exact(plan, world), closed_loop_exact(plan, world)
    assert exact.visited == pytest.approx(tree.visited, abs=1e-9)
    assert exact.survived == pytest.approx(tree.survived, abs=1e-9)
    assert exact.visited_curve[0] == 4
    tally, _ = run_range(compile_closed_loop(plan, world), 3, 0, 20_000, threads=1)
    counts = np.arange(len(tally.visited))
    mean = tally.visited @ counts / 20_000
    spread = np.sqrt(tally.visited @ (counts - mean) ** 2 / 20_000 / 20_000)
    assert abs(mean - exact.visited) < 5 * spread
    bounds = all_bounds(plan, world)
    assert exact.visited <= bounds.ideal_team <= 12
    assert bounds.theorem3_visited is None


def test_the_door(tmp_path: Path) -> None:
    world, plan = case(1)
    state = ReferenceLoop(plan, world).state_at(11, 4, 2)
    assert state is not None
    state.save(tmp_path / "state.json")
    answers = [
        mrac.evaluate(world, state=given, rollouts=500, band=False) for given in (state, str(tmp_path / "state.json"))
    ]
    assert answers[0].visited.mean == answers[1].visited.mean
    assert answers[0].visited.mean * answers[0].tally.accessible >= len(state.visited)
    assert answers[0].limit is None
    with pytest.raises(UsageError, match="both a plan and a state"):
        mrac.evaluate(world, 4, state=state)
    with pytest.raises(UsageError, match="deadline"):
        mrac.evaluate(world, state=state, rollouts=10, deadline=11)
    with pytest.raises(StateError, match="step before the last"):
        mrac.plan(world, state=state, max_steps=11)


def test_the_open_loop_does_not_go_on_and_says_so() -> None:
    world, plan = case(1)
    state = ReferenceLoop(plan, world).state_at(3, 0, 0)
    assert state is not None
    rest = make_plan(world, state.starts, state=state)
    with pytest.raises(PlanError, match="use loop='closed'"):
        compile_plan(rest, world)


def _set(*path: Any) -> Callable[[dict[str, Any]], None]:
    *way, key, value = path

    def change(data: dict[str, Any]) -> None:
        at: Any = data
        for step in way:
            at = at[step]
        at[key] = value

    return change


def _busy(data: dict[str, Any], key: str, value: Any) -> None:
    robot = next(robot for robot in data["robots"] if robot["status"] in ("traveling", "covering"))
    robot[key] = value


BAD: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "another format": (_set("format", "mrac-plan"), "no state of a mission"),
    "another version": (_set("version", 2), "version 1"),
    "another map": (_set("world", "sha256", "0" * 64), "state of another map"),
    "another shape": (_set("world", "shape", [3, 3]), "state of another map"),
    "negative step": (_set("step", -1), "`step` is -1"),
    "no visited": (lambda data: data.pop("visited"), "`visited` is missing"),
    "no robots": (_set("robots", []), r"`robots` is \[\]"),
    "no cell": (lambda data: data["robots"][0].pop("cell"), r"`robots\[0\].cell` is missing"),
    "unknown status": (_set("robots", 1, "status", "asleep"), "status` is 'asleep'"),
    "lost and moving": (lambda data: _busy(data, "status", "dead"), "both lost and moving"),
    "off the map": (_set("visited", [100_000]), "no cell of the map"),
    "negative cell": (_set("robots", 0, "cell", -1), "no cell of the map"),
    "a cell twice": (_set("visited", [[0, 0], [0, 0]]), "twice|obstacle"),
    "a jump": (lambda data: _busy(data, "ahead", [0, 40]), "jumps|obstacle"),
    "nothing ahead": (lambda data: _busy(data, "ahead", []), "nothing is ahead"),
    "not its area": (lambda data: _busy(data, "area", 999), "not its own|another or none"),
    "overlap": (lambda data: data["areas"][0].update(cells=data["areas"][1]["cells"]), "areas"),
    "unassigned but visited": (lambda data: _swap(data, "completed", "unassigned"), "visited cells alone"),
    "completed but not visited": (lambda data: _swap(data, "unassigned", "completed"), "is completed, and its cell"),
    "held nobody": (_set("held", [17]), "held"),
    "quiet too long": (_set("quiet", 2), "`quiet` is 2"),
    "survived more than visited": (lambda data: data.update(visited=data["visited"][:-1]), "not visited"),
    "all lost": (lambda data: [one.update(status="dead", area=-1, ahead=[]) for one in data["robots"]], "dead"),
}


def _swap(data: dict[str, Any], old: str, new: str) -> None:
    next(area for area in data["areas"] if area["state"] == old)["state"] = new


@pytest.mark.parametrize("name", BAD)
def test_bad_states(name: str) -> None:
    world, plan = case(3)
    state = ReferenceLoop(plan, world).state_at(25, 1, 1)
    assert state is not None
    data = json.loads(json.dumps(state.to_json()))
    parse_state(data, world, "state.json")
    change, expected = BAD[name]
    change(data)
    with pytest.raises(StateError, match=expected) as found:
        parse_state(data, world, "state.json")
    assert str(found.value).startswith("state.json: ")


def test_an_obstacle_a_wrong_level_and_no_file(tmp_path: Path) -> None:
    world, plan = case(3)
    blocked = int(np.flatnonzero(np.isnan(world.threat.ravel()))[0])
    with pytest.raises(StateError, match="an obstacle"):
        parse_state(by_hand(world, plan, [blocked]), world, "state.json")
    state = ReferenceLoop(plan, world).state_at(3, 0, 0)
    assert state is not None
    data = state.to_json()
    data["areas"][0]["level"] += 1
    with pytest.raises(StateError, match=r"level.* give the settings of the plan that was driven, levels among"):
        make_plan(world, state.starts, state=parse_state(data, world, "state.json"))
    with pytest.raises(StateError, match=r"robot 0 is .* after 7 moves"):
        data = state.to_json()
        data["robots"][0]["moves"] = 7
        make_plan(world, state.starts, Settings(range=6), state=parse_state(data, world, "state.json"))
    world, plan = case(3, policy="per_cell")
    state = ReferenceLoop(plan, world).state_at(8, 0, 0)
    assert state is not None
    with pytest.raises(StateError, match=r"not by policy mrac.* plan that was driven, policy among them"):
        make_plan(world, state.starts, state=state)
    with pytest.raises(InputError, match=r"missing\.json"):
        load_state(tmp_path / "missing.json", world)
