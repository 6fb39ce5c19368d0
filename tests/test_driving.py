"""Driving: a mission that is killed loses nothing; lines of JSON in any shape; the examples; what will come of it."""

import collections
import importlib.util
import io
import json
import os
import random
import subprocess
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import ROOT, VisitLoop, error_of
from killed_mission import small_case
from test_mission import obey

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.mission_protocol import LONGEST, Dialogue, DrivenMission
from analysis.sampling import RolloutChoices, make_singles
from planner.errors import InputError, StateError, UsageError, WorldError
from planner.files import CHECKSUM
from planner.mission.map_updates import ended
from planner.plan.plan import Plan
from planner.simulator.codes import Outcome
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

ROW = World.create(np.array([[0.0, 0.0, 0.0, 0.5, 0.0]]))
ENDINGS: dict[str, tuple[dict[str, Any], str]] = {
    "complete": ({}, "complete"), "all_robots_lost": ({}, "stopped"), "no_progress": ({"range": 2}, "stuck"),
    "step_limit": ({"max_steps": 2}, "timeout"), "deadline": ({"deadline": 2}, "timeout"),
    "not_worth_the_risk": ({"policy": "per_cell", "robot_value": 1000.0}, "called_off"),
    "ended_by_operator": ({"return_to": "home"}, "called_off"),
}  # fmt: skip
"""Settings of missions on ROW by how they end, with the word of release 0.3 for it."""


# --- killed ---


def kill_mission(kills: int, folder: Path, seed: int) -> int:
    """Kill -9 at moments all over a mission, each time it goes on: it ends as the run that nobody killed."""
    stream, file = Stream(seed, 32), folder / f"{seed}.json"
    waits = [str(stream.below(60)) for _ in range(kills)]
    command = [sys.executable, str(ROOT / "tests" / "killed_mission.py"), str(file), str(seed), *waits]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)
    assert not done.stderr and 0 < done.returncode <= kills
    world, plan = small_case(seed)
    whole = VisitLoop(plan, world).run(seed, 0)
    said = json.loads(file.read_text())
    assert said["step"] == whole.step
    assert said["visited"] == np.flatnonzero(whole.visited).tolist()
    assert [robot["status"] != "dead" for robot in said["robots"]] == whole.alive.tolist()
    assert [one for one in folder.iterdir() if one.suffix == ".json"] == [file]
    return done.returncode


def test_a_mission_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    kill_mission(12, tmp_path, 1)


@pytest.mark.slow
def test_two_hundred_kills(tmp_path: Path) -> None:
    kills, seed = 0, 100
    while kills < 200:
        (folder := tmp_path / str(seed)).mkdir()
        kills += kill_mission(100, folder, seed)
        seed += 1


# --- lines ---


def talk(robots: int = 3, seed: int = 1, state: Path | None = None) -> tuple[World, Dialogue]:
    world = random_world(8, 9, ThreatPattern("contiguous", areas=3, seed=seed), obstacles=0.2, threats=0.3)
    plan = mrac.plan(world, starts=place_starts(world, robots)[0])
    return world, Dialogue(DrivenMission(world, plan), state, lambda: {"rollouts": 0})


def say(dialogue: Dialogue, **line: Any) -> list[dict[str, Any]]:
    return list(dialogue.hear(json.dumps(line) + "\n"))


def test_orders_come_when_all_have_reported_and_are_kept_first(tmp_path: Path) -> None:
    file = tmp_path / "now.json"
    _, dialogue = talk(state=file)
    (orders,) = dialogue.begin()
    assert orders["format"] == "mrac-drive" and orders["version"] == 1 and orders["step"] == 0
    assert json.loads(file.read_text())["begun"] is False
    for order in orders["orders"][:-1]:
        assert say(dialogue, type="report", robot=order["robot"], cell=order["cell"]) == []
        assert say(dialogue, type="report", robot=order["robot"], cell=order["cell"]) == []  # said twice
    last = orders["orders"][-1]
    (after,) = say(dialogue, type="report", robot=last["robot"], cell=last["cell"], stopped=True)
    assert after["step"] == 1 and after["lost"] == [last["robot"]]
    assert json.loads(file.read_text())["step"] == 0
    assert say(dialogue, type="step", step=0) == []  # it is over already
    (again,) = say(dialogue, type="step", step=1)
    assert again["step"] == 2 and [o["cell"] for o in again["orders"]] == [o["cell"] for o in after["orders"]]
    assert say(dialogue, type="orders") == [again]
    assert say(dialogue, type="outlook") == [{"rollouts": 0, "type": "outlook", "step": 2}]
    (closed,) = say(dialogue, type="close", cells=[[7, 8]])
    assert closed["type"] == "orders"


GARBAGE = [
    "what", "[]", "3", "{}", '{"type": 3}', '{"type": "dance"}', '{"type": "report"}', "\ufffd\ufffd", "NaN",
    "{" * 5000,
    '{"type": "report", "robot": "0"}', '{"type": "report", "robot": 0, "cell": [0]}', '{"type": "close"}',
    '{"type": "report", "robot": 0, "cell": [NaN, 0]}', '{"type": "report", "robot": 0, "stopped": "yes"}',
    '{"type": "report", "robot": 0, "colour": "red"}', '{"type": "close", "cells": [[9, 99]]}',
    '{"type": "close", "cells": []}', '{"type": "close", "cells": "all"}', '{"type": "step", "step": -1}',
    '{"type": "report", "robot": 0, "moves_left": 1e3}', '{"type": "orders", "now": true}', "x" * (LONGEST + 9),
    '{"type": "report", "robot": 0, "step": [1]}', '{"type": "report", "robot": 0, "cell": [1e400, 0]}',
    '{"type": "close", "cells": [[0, 0], 3]}', '{"type": "step", "step": 1}', " " * (LONGEST + 1),
]  # fmt: skip


@pytest.mark.parametrize("line", GARBAGE, ids=range(len(GARBAGE)))
def test_a_line_that_is_wrong_changes_nothing(line: str, tmp_path: Path) -> None:
    _, dialogue = talk(state=tmp_path / "now.json")
    (before,) = dialogue.begin()
    kept = (tmp_path / "now.json").read_text()
    (said,) = dialogue.hear(line + "\n")
    assert said["type"] == "error" and said["line"] == 1 and said["error"] and "\n" not in said["error"]
    assert say(dialogue, type="orders") == [before] and (tmp_path / "now.json").read_text() == kept
    assert list(dialogue.hear(" \n")) == []


def test_orders_that_no_file_knows_are_not_given(tmp_path: Path) -> None:
    """Who says a report once more, to the mission as it was kept, gets the orders of the next step."""
    (folder := tmp_path / "share").mkdir()
    world, dialogue = talk(robots=1, state=folder / "now.json")
    (orders,) = dialogue.begin()
    report = {"type": "report", "robot": 0, "cell": orders["orders"][0]["cell"]}
    folder.rename(tmp_path / "gone")
    with pytest.raises(InputError, match=r"now\.json"):
        say(dialogue, **report)
    (tmp_path / "gone").rename(folder)  # the share is back, and the command is started again
    kept = DrivenMission.resume(folder / "now.json", world, mrac.plan(world, starts=place_starts(world, 1)[0]))
    again = Dialogue(kept, folder / "now.json", lambda: {"rollouts": 0})
    assert list(again.begin()) == [orders]
    (after,) = say(again, **report)
    assert after["step"] == 1


def test_the_rest_of_a_line_that_is_too_long_is_no_line(tmp_path: Path) -> None:
    World.create(np.zeros((2, 3)), [[0, 0]]).save(tmp_path / "map.npz")
    close, pads = b'{"type": "close", "cells": [[0, 1]]}', (LONGEST, LONGEST + 1, LONGEST + 2, 3 * LONGEST)
    said = subprocess.run(
        [sys.executable, "-m", "mrac_jax", "drive", "map.npz"], cwd=tmp_path, capture_output=True, check=True,
        input=b"".join(b" " * pad + close + b'\n{"type": "orders"}\n' for pad in pads),
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    ).stdout.splitlines()  # fmt: skip
    begun, *answers = map(json.loads, said)
    assert [(error["type"], error["line"]) for error in answers[::2]] == [("error", line) for line in (1, 3, 5, 7)]
    assert answers[1::2] == [begun] * len(pads)


def test_where_there_is_no_outlook_that_is_said_before_any_order(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "m.npy", np.array([[0.0, 0.1, 0.1]]))
    (tmp_path / "m.yaml").write_text("map: m.npy\nlatent_hazard: {kind: consumed}\n")
    assert run(["drive", str(tmp_path / "m.yaml"), "--outlook"]) == 2
    said = capfd.readouterr()
    assert not said.out and "leave `latent_hazard`" in said.err


def test_a_mission_that_is_over_says_the_time_of_the_run() -> None:
    world, dialogue = talk(robots=1)
    plan = mrac.plan(world, starts=place_starts(world, 1)[0])
    time, singles = plan.time, make_singles(world, plan, RolloutChoices())(0, 64)
    assert dialogue.mission.outlook(rollouts=64).steps.mean == singles.time.mean()
    said = list(dialogue.begin())[-1]
    while said["type"] == "orders":
        (order,) = said["orders"]
        said = say(dialogue, type="report", robot=0, cell=order["cell"])[-1]
    assert said["type"] == "end" and said["step"] == time


def test_without_reports_to_read_nothing_is_driven(tmp_path: Path) -> None:
    World.create(np.zeros((2, 3)), [[0, 0]]).save(tmp_path / "map.npz")
    command = f'exec "{sys.executable}" -m mrac_jax drive map.npz <&-'
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})  # fmt: skip
    assert done.returncode == 2 and done.stderr.startswith("error: standard input is closed") and not done.stdout


# --- fleets ---


def example(name: str) -> types.ModuleType:
    path = ROOT / "docs" / "examples" / f"{name}.py"
    assert len(path.read_text().splitlines()) <= 100
    spec = importlib.util.spec_from_file_location(f"example_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def drive_here(fleet: Any, dialogue: Dialogue) -> dict[str, Any]:
    """As the example's `drive`, without a pipe."""
    said = list(dialogue.begin())
    while said[-1]["type"] != "end":
        after: list[dict[str, Any]] = []
        for answer in fleet.carry_out(said[-1]):
            after += dialogue.hear(json.dumps(answer))
        said = [line for line in after if line["type"] != "error"] or said
    return said[-1]


def test_clean_reports_cover_what_the_closed_loop_covers() -> None:
    """All robots report at once, so who acts later in a step learns of a loss a step later: next to no difference."""
    fleets, world, plan = example("fleet"), *small_case(3)
    found = []
    for seed in range(14):
        dialogue = Dialogue(DrivenMission(world, plan), None, dict)
        found.append(drive_here(fleets.Fleet(world, 0.0, seed), dialogue)["covered"])
    closed = mrac.evaluate(world, plan, rollouts=8192, bound=False, advice=False, band=False, exact="never").visited
    error = np.std(found, ddof=1) / np.sqrt(len(found))
    assert abs(np.mean(found) - closed.mean) < 5 * np.hypot(error, closed.se)


def test_lost_late_and_doubled_reports_end_a_mission_all_the_same() -> None:
    fleets, ends = example("fleet"), set()
    for seed in range(6):
        world, dialogue = talk(seed=seed)
        end = drive_here(fleets.Fleet(world, 0.2, seed), dialogue)
        assert 0 < end["covered"] <= 1
        ends.add(end["outcome"])
    assert {"complete", "all_robots_lost"} <= ends


def test_the_fleet_drives_the_command_through_a_pipe(tmp_path: Path) -> None:
    world = World.create(np.array([[0, 0, 0.3, 0], [0, np.nan, 0, 0]]), [[0, 0], [1, 0]])
    world.save(tmp_path / "map.npz")
    end = example("fleet").drive(str(tmp_path / "map.npz"), 2, 0.1, 5, "--state", str(tmp_path / "now.json"))
    assert end["outcome"] in ("complete", "all_robots_lost") and (tmp_path / "now.json").exists()


def said_to(file: Path | None, *, steps: bool, killed: int = 0) -> tuple[dict[str, Any], dict[str, Any]]:
    """Orders by step and robot, and the end, as said to robots that answer each line, late and unasked.

    Their luck is of the step and the robot. `steps`: they say which they answer. `killed`: after every so many lines
    the process is another, and what was said to it and not heard is lost: more lines than a step has robots.
    """
    seen: dict[str, Any] = {}
    _, talking = talk(state=file)
    said, lines = collections.deque(talking.begin()), 0
    while (told := said.popleft())["type"] != "end":
        for order in told["orders"]:
            seen[f"{told['step']} {order['robot']}"] = order["cell"]
            stopped = random.Random(f"{told['step']} {order['robot']}").random() < 0.05
            report = {"type": "report", "robot": order["robot"], "cell": order["cell"], "stopped": stopped}
            said += say(talking, **report, **({"step": told["step"]} if steps else {}))
            lines += 1
            if killed and lines % killed == 0 and file is not None:
                world, _ = talk()
                plan = mrac.plan(world, starts=place_starts(world, 3)[0])
                talking = Dialogue(DrivenMission.resume(file, world, plan), file, dict)
                said = collections.deque(talking.begin())
                break
    return seen, told


@pytest.mark.parametrize("killed", [0, 4, 7])
def test_who_answers_each_line_is_never_a_line_behind(killed: int, tmp_path: Path) -> None:
    """Nobody need say of which step a report is; after a crash the orders of a step are those before it."""
    right = said_to(None, steps=True)
    assert right[1]["lost"]
    assert said_to(tmp_path / "now.json", steps=False, killed=killed) == right


class Stub:
    """Stands for whatever a library would give: every attribute is another, every call returns one."""

    def __init__(self, *given: Any, **more: Any) -> None:
        self.__dict__.update(more)

    def __getattr__(self, name: str) -> Any:
        found = Stub()
        setattr(self, name, found)
        return found

    def __call__(self, *given: Any, **more: Any) -> Any:
        return Stub()


def test_the_ros_node_reports_cells_and_sends_goals(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With a stub of the interfaces where ROS is not installed: two robots drive to the end, one slowly."""
    sent: list[tuple[int, Any]] = []
    clock = [0.0]

    class Moment:
        def __init__(self) -> None:
            self.at = clock[0]

        def __sub__(self, other: Any) -> Stub:
            return Stub(nanoseconds=(self.at - other.at) * 1e9)

    class Node(Stub):
        def get_clock(self) -> Stub:
            return Stub(now=Moment)

    class Client(Stub):
        def __init__(self, node: Any, kind: Any, name: str) -> None:
            super().__init__()
            self.robot = int(name.split("/")[1].removeprefix("robot_"))

        def send_goal_async(self, goal: Any) -> None:
            sent.append((self.robot, goal))

    class Action:
        class Goal(Stub):
            pass

    modules = {
        "rclpy": {}, "rclpy.action": {"ActionClient": Client}, "rclpy.node": {"Node": Node},
        "geometry_msgs": {}, "geometry_msgs.msg": {"PoseStamped": Stub, "PoseWithCovarianceStamped": Stub},
        "nav2_msgs": {}, "nav2_msgs.action": {"NavigateToPose": Action},
    }  # fmt: skip
    for name, holds in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(holds)
        monkeypatch.setitem(sys.modules, name, module)
    world = World.create(np.zeros((2, 4)), [[0, 0], [1, 0]], cell_size=0.5)
    world.save(tmp_path / "map.npz")
    command = [sys.executable, "-m", "mrac_jax", "drive", str(tmp_path / "map.npz")]
    node = example("ros_node").Driver(world, 2, command)
    until, done, cells, missed = time.monotonic() + 120, 0, set(), []
    while len(cells) < 8 and time.monotonic() < until:
        if done == len(sent):
            time.sleep(0.01)
            continue
        robot, goal = sent[done]
        done += 1
        assert goal.pose.header.frame_id == "map"
        place = goal.pose.pose.position
        cell = tuple(world.to_cells([place.x, place.y]).tolist())
        if robot == 1 and node.step in (1, 2):  # it stays where it is, and the others are not to wait for ever
            missed.append(cell)
            clock[0] += 21
            node.look_round()
            continue
        node.pose(robot, goal)
        cells.add(cell)
    with node.mission:
        node.mission.kill()
        node.listener.join()
    assert len(cells) == 8 and len(missed) == 2 and missed[0] == missed[1] and not node.lost


def end_of(dialogue: Dialogue, ending: str, step: int = 2) -> dict[str, Any]:
    """The last line of a mission on ROW whose robot is lost, or ended by its operator, in `step`, if at all."""
    (said,) = dialogue.begin()
    while said["type"] != "end":
        if ending == "ended_by_operator" and said["step"] == step:
            ending, (said,) = "", say(dialogue, type="call_off")
        lost = ending == "all_robots_lost" and said["step"] == step
        (said,) = say(dialogue, type="report", robot=0, cell=said["orders"][0]["cell"], stopped=lost)
    return said


def kept_in(file: Path) -> dict[str, Any]:
    """What a state file holds, to be changed."""
    return {name: value for name, value in json.loads(file.read_text()).items() if name != CHECKSUM}


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_last_line_says_why_a_mission_ended(tmp_path: Path, ending: str) -> None:
    """No mission that its operator did not end says so; files of 0.3, which knew fewer words, are read."""
    file, (settings, before) = tmp_path / "now.json", ENDINGS[ending]
    plan = mrac.plan(ROW, starts=[[0, 0]], **settings)
    said = end_of(Dialogue(DrivenMission(ROW, plan), file, dict), ending)
    assert said["outcome"] == ending
    kept = kept_in(file)
    assert kept["ended"]["outcome"] == ending
    kept["ended"]["outcome"] = before
    file.write_text(json.dumps(kept))
    again = ended(file, ROW, plan)
    assert again is not None and {"type": "end", **again} == said


def test_a_state_file_with_an_unknown_outcome_is_refused(tmp_path: Path) -> None:
    file, plan = tmp_path / "now.json", mrac.plan(ROW, starts=[[0, 0]])
    end_of(Dialogue(DrivenMission(ROW, plan), file, dict), "complete")
    for wrong in ("abandoned", 3):
        kept = kept_in(file)
        kept["ended"]["outcome"] = wrong
        file.write_text(json.dumps(kept))
        with pytest.raises(StateError, match=rf"`ended.outcome` is {wrong!r}.*all_robots_lost"):
            ended(file, ROW, plan)


@pytest.mark.parametrize(("robot_value", "ending"), [(None, "ended_by_operator"), (1000.0, "not_worth_the_risk")])
def test_who_ended_a_mission_on_its_way_home_is_kept(tmp_path: Path, robot_value: float | None, ending: str) -> None:
    """What ended it first stays the reason, across a file too."""
    file, policy = tmp_path / "now.json", {"policy": "per_cell", "robot_value": robot_value} if robot_value else {}
    plan = mrac.plan(ROW, starts=[[0, 0]], return_to="home", **policy)
    mission, operator = DrivenMission(ROW, plan), robot_value is None
    while mission._fleet.over is None:
        obey(mission)
        if operator and mission.step == 3:
            mission.call_off()
    assert mission.outcome is None
    mission.call_off()
    mission.save(file)
    kept = kept_in(file)
    assert kept["over"] == ending
    for word in (ending, "called_off"):
        file.write_text(json.dumps(kept | {"over": word}))
        again = DrivenMission.resume(file, ROW, plan)
        assert again.rest().outcome == ending
        while again.outcome is None:
            obey(again)
        assert again.outcome.word == ending


def test_rollouts_of_a_mission_that_its_operator_ended_say_so() -> None:
    mission = DrivenMission(ROW, mrac.plan(ROW, starts=[[0, 0]], return_to="home"))
    for _ in range(3):
        obey(mission)
    mission.call_off()
    (found,) = mission._roll_out([{}], 8, None, 0)
    assert set(found.outcome.tolist()) == {Outcome.ENDED_BY_OPERATOR} and set(found.visited.tolist()) == {3}


def test_a_mission_that_has_ended_says_so_again(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    world, file = World.create(np.zeros((2, 3)), [[0, 0]]), tmp_path / "now.json"
    world.save(tmp_path / "map.npz")
    dialogue = Dialogue(DrivenMission(world, mrac.plan(world)), file, dict)
    (said,) = dialogue.begin()
    (said,) = say(dialogue, type="close", cells=[[1, 2]])
    while said["type"] != "end":
        (said,) = say(dialogue, type="report", robot=0, cell=said["orders"][0]["cell"])
    command = ["drive", str(tmp_path / "map.npz"), "--state", str(file)]
    assert run(command) == 0 and json.loads(capfd.readouterr().out) == said and said["outcome"] == "complete"
    World.create(np.zeros((2, 4)), [[0, 0]]).save(tmp_path / "map.npz", force=True)
    assert "another map" in error_of(capfd, *command)


def test_a_mission_of_another_team_is_not_gone_on_with(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    world, plan = mrac.load("example:paper"), mrac.plan(mrac.load("example:paper"), 3)
    file, mission = tmp_path / "now.json", DrivenMission(world, plan)
    drive = ["drive", "example:paper", "--state", str(file), "--robots"]
    mission.save(file)
    # The last line: a slow machine says before it that a plan is made.
    assert error_of(capfd, *drive, "2") == (
        f"error: {file}: holds a mission of 3 robots; expected one of 2, as planned; give the robots of the mission"
    )
    assert run(["evaluate", "example:paper", "--state", str(file)]) == 2
    assert "whose first step is not over; expected a mission under way; leave it out" in capfd.readouterr().err
    mission.advance()
    mission.save(file)
    kept = file.read_bytes()
    assert error_of(capfd, *drive, "2") == f"error: --robots 2 contradicts the 3 robots of {file}; leave it out"
    assert file.read_bytes() == kept


def test_a_plan_file_is_driven_by_itself_where_its_map_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO()))
    (depot := tmp_path / "depot").mkdir()
    (depot / "plans").mkdir()
    world = World.create(np.zeros((2, 3)), [[0, 0]])
    world.save(depot / "map.npz")
    assert run(["plan", str(depot / "map.npz"), "--out", str(depot / "plans" / "plan.json")]) == 0
    assert json.loads((depot / "plans" / "plan.json").read_text())["world"]["source"] == "../map.npz"
    depot.rename(there := tmp_path / "there")
    file = there / "plans" / "plan.json"
    capfd.readouterr()
    assert run(["drive", str(file)]) == 0
    assert json.loads(capfd.readouterr().out)["orders"][0]["cell"] == [0, 0]
    assert run(["evaluate", str(file), "--rollouts", "16", "--json", "--no-advice"]) == 0
    assert json.loads(capfd.readouterr().out)["coverage"]["visited"]["mean"] == 1
    (there / "map.npz").rename(moved := there / "other.npz")
    assert "its map is not at" in (said := error_of(capfd, "drive", str(file))) and "--plan" in said
    assert run(["drive", str(moved), "--plan", str(file)]) == 0
    World.create(np.zeros((2, 4)), [[0, 0]]).save(there / "map.npz", force=True)
    assert "another map" in error_of(capfd, "drive", str(file))
    mrac.plan(world).save(file, force=True)  # of a world that is no file
    assert "does not say where" in error_of(capfd, "drive", str(file))
    mrac.plan(mrac.load("example:paper"), 2).save(file, force=True)
    capfd.readouterr()
    assert run(["drive", str(file)]) == 0 and json.loads(capfd.readouterr().out)["step"] == 0
    file.write_text("{}")
    assert "holds no map" in error_of(capfd, "drive", str(file))


# --- what will come ---


def outlooked(seed: int = 3, steps: int = 12) -> tuple[World, Plan, DrivenMission]:
    world, plan = small_case(seed)
    mission = mrac.drive(world, plan)
    for _ in range(steps):
        obey(mission)
    return world, plan, mission


def test_the_outlook_is_the_evaluation_of_the_state() -> None:
    world, _, mission = outlooked()
    seen = mission.outlook(rollouts=4096)
    answer = mrac.evaluate(world, state=mission.state, rollouts=4096, bound=False, advice=False, exact="never")
    assert seen.rollouts == 4096
    assert abs(seen.covered.mean - answer.visited.mean) < 5 * seen.covered.se
    assert abs(seen.lost.mean - answer.losses.mean) < 5 * seen.lost.se + 1e-9
    assert seen.covered.ci95[0] >= mission.covered and seen.steps.mean > 0
    assert seen.to_json()["complete"]["mean"] == seen.complete.mean
    assert mission.outlook(seconds=0.05).rollouts >= 512
    whole = make_singles(world, mission.rest(), RolloutChoices())(0, 4096)  # with its nominal run, the same
    assert seen.covered.mean == whole.visited.mean() / mission.accessible
    assert seen.lost.mean == 3 - len(mission.lost) - whole.alive.mean()


def test_what_if_is_on_common_luck() -> None:
    _, _, mission = outlooked()
    off = mission.what_if(call_off=True, rollouts=1024)
    assert off.then.lost.mean == 0 and off.then.covered.mean == pytest.approx(mission.covered)
    assert off.covered.mean == pytest.approx(mission.covered - off.now.covered.mean)
    fewer = mission.what_if(without=[0], rollouts=1024)
    assert fewer.covered.mean <= 0 and fewer.now.covered.mean == off.now.covered.mean
    other = mission.what_if(policy="per_cell", robot_value=8.0, rollouts=1024)
    assert other.lost.mean <= 0 and other.to_json()["difference"]["lost"]["mean"] == other.lost.mean
    for more in ({"without": [0]}, {"policy": "per_cell"}):
        with pytest.raises(UsageError, match="both call_off and changes"):
            mission.what_if(call_off=True, **more)
    same = mission.what_if(rollouts=256)
    assert same.covered.mean == same.lost.mean == 0


def test_who_is_called_off_before_setting_out_is_home() -> None:
    world = random_world(8, 9, ThreatPattern("contiguous", areas=3, seed=1), obstacles=0.2, threats=0.3)
    mission = mrac.drive(world, mrac.plan(world, starts=place_starts(world, 3)[0], return_to="home"))
    off = mission.what_if(call_off=True, rollouts=512)
    assert off.then.home is not None and off.then.home.mean == 3 and off.then.lost.mean == 0
    assert off.now.home is not None and off.now.home.mean < 3


def test_what_has_no_outlook_says_so() -> None:
    world, plan, mission = outlooked()
    with pytest.raises(UsageError, match="rollouts"):
        mission.outlook(rollouts=0)
    with pytest.raises(StateError, match="robot 7"):
        mission.what_if(without=[7])
    there = world.with_latent_hazard("persistent", np.nan_to_num(world.threat), 0.9)
    with pytest.raises(WorldError):
        mrac.drive(there, mrac.plan(there, starts=plan.starts)).outlook()
    while mission.outcome is None:
        mission.report(0, stopped=True)
        mission.report(1, stopped=True)
        mission.report(2, stopped=True)
        mission.advance()
    with pytest.raises(UsageError, match="over"):
        mission.outlook()
