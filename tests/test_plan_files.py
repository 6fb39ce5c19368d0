"""Plan files: paths, deadlines, waypoints, settings, times."""

import copy
import csv
import json
import math
from collections.abc import Callable
from dataclasses import asdict, fields, replace
from fractions import Fraction
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER
from helpers import answer_of, load_plan
from test_planner_open_loop import paths_plan
from validate import validate

import mrac_jax as mrac
import planner.plan.reading
from analysis.cli.app import run
from analysis.cli.options import COMMANDS, Given
from analysis.comparison import compare, make_side
from analysis.evaluation.evaluate import evaluate
from analysis.recording.container import open_log
from analysis.recording.contents import read_rollouts
from analysis.report.result import with_minutes
from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import Team, run_key
from analysis.sweeps.results import outcomes_of, select
from analysis.sweeps.spec import PLANNER
from analysis.sweeps.store import Store
from planner.arguments import COMMAND_LINE
from planner.errors import InputError, MapError, PlanError, RenamedWarning, UsageError
from planner.files import LONG_BYTES, read_csv_grid
from planner.formatting import UNITS, UNPACED, Pace, seconds_of
from planner.make_plan import confirm_plan, make_plan, read_plan
from planner.open_loop import plan_team
from planner.plan.plan import Area, Leg, Plan, RobotPlan, headings, waypoints_csv
from planner.settings import AGAIN, SETTINGS, Choices, Settings
from planner.simulator.codes import Outcome
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World, load_world_file

# Plan files: what was saved is read back, other planners' paths are taken, and everything else is refused by name.

# 2 x 4: column 2 is dangerous, [1, 0] an obstacle. Robot 0 covers the left part, then helps robot 1 with the middle.
WORLD = World.create([[0.0, 0.0, 0.2, 0.0], [np.nan, 0.0, 0.2, 0.0]], source="small.npz")


def cells(*indices: int) -> np.ndarray:
    return np.array(indices, dtype=np.int64)


def own_plan() -> Plan:
    robots = (
        RobotPlan(cells(0, 1, 5, 6), (Leg("cover", 0, 0, 0, 3), Leg("cover", 4, 1, 3, 4))),
        RobotPlan(cells(7, 3, 2), (Leg("cover", 1, 0, 0, 2), Leg("cover", 3, 1, 2, 3))),
    )
    areas = (Area(0, 0, cells(0, 1, 5)), Area(0, 1, cells(3, 7)), Area(1, -1, cells(2, 6)))
    added = (Area(1, -1, cells(2)), Area(1, -1, cells(6)))
    settings = Settings(levels=7, density=3.5, risk="log", transit="area", max_steps=99)
    return Plan(WORLD.shape, WORLD.sha256, settings, robots, areas, added, "complete", 3, 1, source=WORLD.source)


def plans_equal(one: Plan, other: Plan) -> bool:
    """Equal in every field, arrays by value and type."""
    names = {item.name for item in fields(Plan)} - {"robots", "areas", "areas_added"}
    arrays = [
        [robot.path for robot in plan.robots] + [area.cells for area in plan.areas + plan.areas_added]
        for plan in (one, other)
    ]
    rest = [
        (
            [robot.legs for robot in plan.robots],
            [(area.level, area.robot) for area in plan.areas],
            [(area.level, area.robot) for area in plan.areas_added],
            [getattr(plan, name) for name in sorted(names)],
        )
        for plan in (one, other)
    ]
    same = (np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(*arrays, strict=True))
    return rest[0] == rest[1] and all(same)


def written(tmp_path: Path, data: Any) -> Path:
    path = tmp_path / "plan.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    return path


def refused(path: Path, world: World = WORLD) -> str:
    with pytest.raises(PlanError) as caught:
        load_plan(path, world)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{path}: ")
    assert len(message) < 400 + len(str(path))
    return message


# --- what is accepted ---


def test_a_saved_plan_is_read_back_in_every_field(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    own_plan().save(path)
    assert plans_equal(load_plan(path, WORLD), own_plan())
    assert not plans_equal(load_plan(path, WORLD), replace(own_plan(), shares=2))


def test_the_planners_plans_survive_the_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    for count in range(1, 9):
        threat = rng.choice([0, 0, 0, 0.1, 0.3, np.nan], size=(5, 9))
        threat[0, :] = 0
        world = World.create(threat)
        plan = make_plan(world, [[0, col] for col in range(count)])
        plan.save(tmp_path / "plan.json", force=True)
        assert plans_equal(load_plan(tmp_path / "plan.json", world), plan)


def test_a_plan_of_version_1_is_read_where_its_rules_are_todays(tmp_path: Path) -> None:
    """Also of phases, if its paths follow by the rules of today; else one line says that these changed."""
    plain = World.create([[0, 0.5, 0, 0]])
    ends = plain.with_phases([(4, np.zeros((1, 4)))])
    calm = plain.with_phases([(1, np.zeros((1, 4)))])
    for world, robot_value in ((plain, None), (plain, 4.0), (calm, 4.0)):
        made = make_plan(world, [[0, 0]], Settings(policy="per_cell", robot_value=robot_value))
        again = read_plan(written(tmp_path, made.to_json() | {"version": 1}), world)
        assert made.to_json()["version"] == 2
        plans_equal(again, made)
    data = make_plan(ends, [[0, 0]], Settings(policy="per_cell", robot_value=4.0)).to_json()
    path = {"robots": [{"path": [[0, 0]], "legs": []}], "nominal": {"outcome": "called_off", "time": 2, "shares": 0}}
    for version, more in ((1, "; release 0.4 changed the rules for phases"), (2, "")):
        with pytest.raises(PlanError, match="the path of robot 0") as error:
            read_plan(written(tmp_path, data | path | {"version": version}), ends)
        assert ("release 0.4" in str(error.value)) is bool(more) and more in str(error.value)
        assert "make the plan again" in str(error.value) and "\n" not in str(error.value)


def test_without_nominal_the_end_of_the_run_is_worked_out(tmp_path: Path) -> None:
    """SPEC's plan file has no `nominal`: that key is this project's own addition."""
    data = own_plan().to_json()
    del data["nominal"]
    assert plans_equal(load_plan(written(tmp_path, data), WORLD), replace(own_plan(), shares=0))
    data["robots"][0]["path"].pop()
    data["robots"][0]["legs"].pop()
    assert load_plan(written(tmp_path, data), WORLD).outcome == "step_limit"


OUTCOMES_OF_0_3 = [
    ("complete", "complete"),
    ("stuck", "no_progress"),
    ("timeout", "step_limit"),
    ("called_off", "not_worth_the_risk"),
]


@pytest.mark.parametrize(("before", "now"), OUTCOMES_OF_0_3)
def test_outcomes_of_0_3_are_read_and_written_by_their_names_of_today(tmp_path: Path, before: str, now: str) -> None:
    data = own_plan().to_json()
    data["nominal"]["outcome"] = before
    plan = load_plan(written(tmp_path, data), WORLD)
    assert plan.outcome == plan.to_json()["nominal"]["outcome"] == now
    data["settings"]["deadline"] = 9
    assert load_plan(written(tmp_path, data), WORLD).outcome == ("deadline" if before == "timeout" else now)


def test_another_planners_paths_are_taken_with_a_note_on_cells_left_out(tmp_path: Path) -> None:
    data = {"format": "coverage-plan/1", "map": "x", "paths": [[[0, 0], [0, 1], [0, 1], [1, 1]], [[1, 3], [1, 3]]]}
    plan = load_plan(written(tmp_path, data), WORLD)
    assert plan.is_external
    assert (plan.outcome, plan.time, plan.shares, plan.areas, plan.areas_added) == ("end_of_paths", 3, 0, (), ())
    assert [robot.path.tolist() for robot in plan.robots] == [[0, 1, 1, 5], [7, 7]]
    assert all(robot.path.dtype == np.int64 and robot.legs == () for robot in plan.robots)
    assert plan.notes == ("accessible cells on no path: 3 (the first: [0, 2])",)
    assert (plan.shape, plan.sha256) == (WORLD.shape, WORLD.sha256)


def test_other_forms_of_a_plan_are_taken(tmp_path: Path) -> None:
    """Own notes, settings left out, paths without a note where none is due, a bare list, a byte order mark."""
    data = own_plan().to_json() | {"notes": ["made on a Monday"], "settings": {"density": 2}}
    plan = load_plan(written(tmp_path, data), WORLD)
    assert (plan.notes, plan.settings) == (("made on a Monday",), Settings(density=2.0))
    whole = [[0, 0], [0, 1], [1, 1], [1, 2], [0, 2], [0, 3], [1, 3]]
    row = World.create([[0.0, np.nan, 0.0]])
    for paths, world, time in (([whole], WORLD, 6), ([[[0, 0]]], row, 0)):
        plan = load_plan(written(tmp_path, {"paths": paths}), world)
        assert (plan.notes, plan.time) == ((), time)
    named, bare = (load_plan(written(tmp_path, data), WORLD) for data in ({"paths": [whole[:2]]}, [whole[:2]]))
    named.save(tmp_path / "saved.json")
    (tmp_path / "mark.json").write_text(json.dumps({"paths": [whole[:2]]}), encoding="utf-8-sig")
    for plan in (bare, load_plan(tmp_path / "saved.json", WORLD), load_plan(tmp_path / "mark.json", WORLD)):
        assert plans_equal(plan, named)


def test_given_paths_and_a_scenario_that_says_more_of_its_robots(tmp_path: Path) -> None:
    WORLD.save(tmp_path / "w.npz")
    (tmp_path / "s.yaml").write_text("map: w.npz\nrobots: {count: 1, range: 2, hazard_multiplier: 3}\ndeadline: 4\n")
    world = load_input(tmp_path / "s.yaml")
    path = [[0, 0], [0, 1], [1, 1], [1, 2], [0, 2], [0, 3], [1, 3]]
    plan = load_plan(written(tmp_path, {"paths": [path]}), world)
    assert plan.failure_model.hazard_multiplier == 3 and len(plan.robots[0].path) == 7
    unkept = f"ignored from {world.source}: range and deadline"
    assert plan.notes == (f"robots follow external paths to their end; {unkept}",)
    own = plan_team(world, [[0, 0]], Settings(plan_for="open_loop", range=2, effort=0))
    own.save(tmp_path / "own.json")
    assert not any("whatever" in note for note in load_plan(tmp_path / "own.json", world).notes)


# --- what is refused: files ---


def test_files_that_are_no_plan(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "none.json")
    assert "is a folder" in refused(tmp_path)
    assert "line 2, column 1" in refused(written(tmp_path, '{"paths":\n'))
    assert "nested too deeply" in refused(written(tmp_path, "[" * 200_000))
    assert "cannot be read as JSON" in refused(written(tmp_path, '{"paths": [[[' + "9" * 5000 + ", 0]]]}"))
    path = written(tmp_path, "")
    path.write_bytes(b"\xff\xfe{}")
    assert "cannot be read as JSON" in refused(path)


def test_a_huge_file_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planner.plan.plan_file, "MAX_PLAN_BYTES", 100)
    message = refused(written(tmp_path, own_plan().to_json()))
    assert "bytes" in message and "at most 100" in message


def test_what_could_not_be_read_back_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_plan().save(tmp_path / "plan.json")
    size = (tmp_path / "plan.json").stat().st_size
    monkeypatch.setattr(planner.plan.plan, "MAX_PLAN_BYTES", size - 1)
    with pytest.raises(PlanError, match=f"would be {size} bytes.*at most {size - 1}"):
        own_plan().save(tmp_path / "other.json")
    assert not (tmp_path / "other.json").exists()


BARE_LISTS = [
    ([[0, 0], [0, 1]], "put it in a list: [[[row, col], ...]]"),
    ([[[0, 0], [0, 9]]], "`[0][1]` is [0, 9], off the map"),
    ([3, 4], "`[0]` is 3; expected at least the start: [[row, col], ...]"),
    ([{"path": [[0, 0]]}], "expected at least the start: [[row, col], ...]"),
]


@pytest.mark.parametrize(("data", "said"), BARE_LISTS)
def test_other_bare_lists_are_refused_with_the_right_hint(tmp_path: Path, data: Any, said: str) -> None:
    assert said in refused(written(tmp_path, data))


@pytest.mark.parametrize("data", [[], None, 3, "paths", {}, {"format": "mrac-world"}, {"path": [[[0, 0]]]}])
def test_json_that_is_no_plan(tmp_path: Path, data: Any) -> None:
    assert "expected" in refused(written(tmp_path, json.dumps(data)))


# --- what is refused: paths ---


WRONG_PATHS = [
    ([], ["`paths` is []"]), ({}, ["`paths` is {}"]), (None, ["`paths` is None"]),
    ([[]], ["[0]`", "[]", "at least the start"]), ([[[0, 0]], []], ["[1]`"]),
    ([[[0, 0]], "north"], ["[1]`", "'north'"]),
    ([[[0, 0]], [[0, 3], [0, 4]]], ["[1][1]`", "[0, 4]", "off the map", "col 0..3"]),
    ([[[0, 0], [-1, 0]]], ["[0][1]`", "[-1, 0]", "off the map", "row 0..1"]),
    ([[[0, 10**30]]], ["[0][0]`", "off the map"]), ([[[0, 0], [1, 0]]], ["[0][1]`", "[1, 0]", "obstacle"]),
    ([[[0, 0], [0, 1], [1, 2]]], ["[0]` jumps", "at step 2", "[0, 1]", "[1, 2]"]),
    ([[[0, 3], [1, 3], [1, 1]]], ["[0]` jumps", "at step 2", "[1, 3]", "[1, 1]"]),
    ([[[0, 0], [0.0, 1.0]]], ["[0][1]`", "[0.0, 1.0]", "[row, col]"]),
    ([[[0, 0], [0, True]]], ["[0][1]`", "[0, True]"]), ([[[0, 0], [0, float("nan")]]], ["[0][1]`", "[0, nan]"]),
    ([[[0, 0], [0, "1"]]], ["[0][1]`", "[0, '1']"]), ([[[0, 0], [0, None]]], ["[0][1]`", "[0, None]"]),
    ([[[0, 0], [0, 1, 0]]], ["[0][1]`", "[0, 1, 0]"]), ([[[0, 0], 1]], ["[0][1]`", "is 1,"]),
    ([[[0, 0], [[0, 0], [0, 0]]]], ["[0][1]`"]), ([[[0, 0], {"row": 0, "col": 1}]], ["[0][1]`", "row"]),
    ([[0, 0]], ["[0][0]`"]),
]  # fmt: skip


@pytest.mark.parametrize(("paths", "words"), WRONG_PATHS)
def test_paths_that_cannot_be_driven(tmp_path: Path, paths: Any, words: list[str]) -> None:
    files = [{"paths": paths}]
    if isinstance(paths, list) and paths:
        files.append(own_plan().to_json() | {"robots": [{"path": path, "legs": []} for path in paths]})
    for file in files:
        message = refused(written(tmp_path, file)).replace(".path", "")
        assert all(word in message for word in words), message


def test_limits_of_the_random_number_counter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "at most 1024" in refused(written(tmp_path, {"paths": [[[0, 0]]] * 1025}))
    assert len(load_plan(written(tmp_path, {"paths": [[[0, 0]]] * 1024}), WORLD).robots) == 1024
    monkeypatch.setattr(planner.plan.reading, "MAX_STEP", 5)
    assert "`paths[0]` has 6 steps" in refused(written(tmp_path, {"paths": [[[0, 0]] * 7]}))
    assert load_plan(written(tmp_path, {"paths": [[[0, 0]] * 6]}), WORLD).time == 0


# --- what is refused: the project's own format ---


def change(*keys: Any, to: Any = None, remove: bool = False) -> Callable[[dict[str, Any]], None]:
    def plant(data: dict[str, Any]) -> None:
        place: Any = data
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = to
        if remove:
            del place[keys[-1]]

    return plant


without = partial(change, remove=True)
LEG, AREA, ADDED = ("robots", 1, "legs", 0), ("areas", 1), ("areas_added", 0)
FAULTS: list[tuple[Callable[[dict[str, Any]], None], list[str]]] = [
    (change("format", to="mrac-plans"), ["'mrac-plans'", '"mrac-plan"']),
    (change("version", to=3), ["`version` is 3", "version 1 to 2", "update"]),
    (change("version", to=0), ["`version` is 0"]), (change("version", to=True), ["`version` is True"]),
    (change("version", to="1"), ["`version` is '1'"]), (without("version"), ["`version` is missing"]),
    (without("world"), ["`world` is missing"]), (change("world", to=[2, 4]), ["`world` is [2, 4]", "keys"]),
    (change("world", "shape", to=[4, 2]), ["plan for another map", "[4, 2]", "[2, 4]", "small.npz"]),
    (change("world", "shape", to=[2.0, 4.0, 1]), ["plan for another map"]),
    (change("world", "shape", to="2x4"), ["another map: 2x4 cells"]),
    (change("world", "sha256", to="ab" * 32), ["plan for another map", "abababababab", WORLD.sha256[:12]]),
    (change("world", "sha256", to=None), ["another map", "sha256 None"]),
    (change("robots", to=[]), ["`robots` is []"]), (change("robots", 1, to=[[0, 3]]), ["robots[1]"]),
    (without("robots", 1, "path"), ["`robots[1].path` is missing"]),
    (without("robots", 1, "legs"), ["`robots[1].path` has no legs"]),
    (change("robots", 1, "legs", to={}), ["`robots[1].legs` is {}", "a list"]),
    (change(*LEG, to=[0, 1]), ["`robots[1].legs[0]` is [0, 1]"]),
    (change(*LEG, "kind", to="fly"), ["`robots[1].legs[0].kind` is 'fly'", "travel or cover"]),
    (change(*LEG, "kind", to=1), ["legs[0].kind` is 1"]),
    (change(*LEG, "area", to=5), ["legs[0].area` is 5", "0 to 4"]),
    (change(*LEG, "area", to=-1), ["legs[0].area` is -1"]),
    (change(*LEG, "level", to=1), ["legs[0].level` is 1", "0, that of area 1"]),
    (change(*LEG, "level", to=0.5), ["legs[0].level` is 0.5"]),
    (change(*LEG, "stop", to=4), ["legs[0].stop` is 4", "1 to 3"]),
    (change(*LEG, "start", to=-1), ["legs[0].start` is -1"]),
    (change(*LEG, "start", to=2), ["legs[0].stop` is 2", "after its start, 3 to 3"]),
    (change(*LEG, "start", to=False), ["legs[0].start` is False"]),
    (without(*LEG, "stop"), ["legs[0].stop` is missing"]), (change("settings", to=[]), ["`settings` is []"]),
    (change("settings", "level", to=3), ["unknown key `settings.level`", "did you mean 'levels'"]),
    (change("settings", "levels", to=0), ["levels` is 0"]),
    (change("settings", "levels", to=2.5), ["levels` is 2.5"]),
    (change("settings", "density", to=float("inf")), ["density` is inf"]),
    (change("settings", "density", to=10**400), ["density` is 1000"]),
    (change("settings", "density", to=float("nan")), ["density` is nan"]),
    (change("settings", "density", to=0), ["density` is 0"]),
    (change("settings", "density", to=False), ["density` is False"]),
    (change("settings", "risk", to="none"), ["risk` is 'none'", "log"]),
    (change("settings", "transit", to=["grid"]), ["transit"]),
    (change("settings", "max_steps", to=-1), ["max_steps` is -1"]),
    (change("settings", "max_steps", to=2**22), ["max_steps` is 4194304"]),
    (change("settings", to=None), ["`areas` is [", "no settings"]), (without("areas"), ["`areas` is missing"]),
    (without("areas_added"), ["`areas_added` is missing"]), (change(*AREA, to=3), ["`areas[1]` is 3"]),
    (change(*AREA, "level", to=-1), ["`areas[1].level` is -1"]),
    (change(*AREA, "level", to=7), ["`areas[1].level` is 7", "0..6"]),
    (change(*AREA, "robot", to=2), ["`areas[1].robot` is 2", "0..1"]),
    (change(*AREA, "robot", to=-2), ["`areas[1].robot` is -2"]),
    (change(*AREA, "robot", to=None), ["`areas[1].robot` is None"]),
    (change(*AREA, "cells", to=[]), ["`areas[1].cells` is []"]),
    (change(*AREA, "cells", to=[3, 8]), ["`areas[1].cells[1]` is 8", "0..7"]),
    (change(*AREA, "cells", to=[3, -1]), ["`areas[1].cells[1]` is -1"]),
    (change(*AREA, "cells", to=[3, 7.0]), ["`areas[1].cells[1]` is 7.0"]),
    (change(*AREA, "cells", to=[3, True]), ["`areas[1].cells[1]` is True"]),
    (change(*AREA, "cells", to=[3, 4]), ["`areas[1].cells[1]`", "[1, 0]", "obstacle"]),
    (change(*AREA, "cells", to=[3, 7, 3]), ["`areas[1].cells`", "[0, 3]", "twice"]),
    (change(*AREA, "cells", to=[3]), ["[1, 3]", "in 0 areas"]),
    (change(*AREA, "cells", to=[2, 3, 7]), ["[0, 2]", "in 2 areas"]),
    (change(*ADDED, "cells", to=[9]), ["`areas_added[0].cells[0]` is 9"]),
    (change("nominal", to=3), ["`nominal` is 3"]),
    (change("nominal", "outcome", to="stopped"), ["`nominal.outcome` is 'stopped'", "complete"]),
    (change("nominal", "outcome", to="all_robots_lost"), ["`nominal.outcome` is 'all_robots_lost'", "no_progress"]),
    (change("nominal", "time", to=2), ["`nominal.time` is 2", "the last move or a later one, 3 to"]),
    (change("nominal", "time", to=10**30), ["time"]),
    (change("nominal", "shares", to=-1), ["`nominal.shares` is -1"]),
    (change("notes", to="one"), ["`notes` is 'one'"]), (change("notes", to=[1]), ["`notes[0]` is 1"]),
]  # fmt: skip


@pytest.mark.parametrize(("plant", "words"), FAULTS, ids=[" ".join(words)[:40] for _, words in FAULTS])
def test_faults_in_our_own_format(tmp_path: Path, plant: Callable[[dict[str, Any]], None], words: list[str]) -> None:
    data = copy.deepcopy(own_plan().to_json())
    plant(data)
    message = refused(written(tmp_path, data))
    assert all(word in message for word in words), message


def test_areas_out_of_reach_are_refused(tmp_path: Path) -> None:
    world = World.create([[0.0, np.nan, 0.0]])
    areas = (Area(0, 0, cells(0)), Area(0, -1, cells(2)))
    robot = RobotPlan(cells(0), (Leg("cover", 0, 0, 0, 1),))
    Plan(world.shape, world.sha256, Settings(), (robot,), areas).save(tmp_path / "plan.json")
    assert "cell [0, 2] is in 1 areas" in refused(tmp_path / "plan.json", world)


def test_area_cells_are_sorted_on_reading(tmp_path: Path) -> None:
    data = own_plan().to_json()
    data["areas"][0]["cells"] = [5, 0, 1]
    assert plans_equal(load_plan(written(tmp_path, data), WORLD), own_plan())


def test_reading_a_large_text_file_is_announced_before_it_takes_seconds(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    small, large = tmp_path / "small.csv", tmp_path / "large.csv"
    small.write_text("0,0\n")
    large.write_text("0,0\n" * (LONG_BYTES // 4 + 1))
    read_csv_grid(small, 2**23)
    assert not caplog.messages
    with pytest.raises(MapError, match="more than 2 cells"):
        read_csv_grid(large, 2)
    assert caplog.messages == [f"reading {large} (8 MB), which takes a while ..."]


# A plan that ends the mission at a step: its file says so, and all that is made of it keeps to it.

WORLD_DEADLINE = str(FOLDER / "contiguous-14x23-1000.npz")
ENDS = 30


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(Path(WORLD_DEADLINE))


def planned(world: World, deadline: int | None = None, robots: int = 4) -> Plan:
    return make_plan(world, place_starts(world, robots)[0], Settings(policy="per_cell", deadline=deadline))


def test_the_paths_are_those_of_the_whole_plan_up_to_the_deadline(world: World) -> None:
    whole, ended = planned(world), planned(world, ENDS)
    assert whole.makespan > ENDS and ended.time == ENDS and ended.outcome == "deadline"
    for long, short in zip(whole.robots, ended.robots, strict=True):
        np.testing.assert_array_equal(long.path[: ENDS + 1], short.path)
    assert not validate(ended, world)


def test_the_file_holds_it_and_reads_it_back(world: World, tmp_path: Path) -> None:
    ended = planned(world, ENDS)
    ended.save(tmp_path / "go.json")
    data = json.loads((tmp_path / "go.json").read_text())
    assert data["settings"]["deadline"] == ENDS
    assert "deadline" not in planned(world).to_json()["settings"]
    again = confirm_plan(load_plan(tmp_path / "go.json", world), world, "go.json")
    assert again.settings == ended.settings and again.makespan <= ENDS
    data["settings"]["deadline"] = -1
    (tmp_path / "go.json").write_text(json.dumps(data))
    with pytest.raises(PlanError, match="deadline"):
        load_plan(tmp_path / "go.json", world)


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_rollouts_of_it_are_those_of_the_whole_plan_cut_off_there(world: World, loop: str) -> None:
    choices = RolloutChoices(loop=loop, rollouts=500)  # type: ignore[arg-type]
    whole = evaluate(world, planned(world), RolloutChoices(loop=loop, rollouts=500, deadline=ENDS))  # type: ignore[arg-type]
    ended = evaluate(world, planned(world, ENDS), choices)
    found = whole.outputs["deadline"]
    np.testing.assert_array_equal(ended.tally.visited, found.tally.visited)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(ended.tally.alive, found.tally.alive)  # type: ignore[attr-defined]
    cut = int(ended.tally.outcomes[Outcome.STEP_LIMIT])
    said = ended.to_json()["outcomes"]
    assert (said["deadline"], said["step_limit"]) == (cut, 0) and (cut > 0) == (loop == "closed")
    assert list(ended.singles()["outcome"]).count("deadline") == cut
    assert any(f"step {ENDS}" in note for note in ended.notes)
    assert not any("raise --max-steps" in note for note in ended.notes)


def test_compare_keeps_to_it_and_says_what_differs(world: World) -> None:
    choices = RolloutChoices(rollouts=300)
    sides = [make_side(world, planned(world, deadline), choices) for deadline in (None, ENDS)]
    answer = compare(*sides)
    assert answer.differing == (("no deadline",), (f"deadline {ENDS}",))
    alone = evaluate(world, planned(world, ENDS), choices)
    assert answer.pairs["visited"].y == int(alone.tally.visited @ np.arange(len(alone.tally.visited)))


def test_a_later_deadline_of_the_rollouts_contradicts_it(world: World) -> None:
    plan = planned(world, ENDS)
    for asked in (evaluate, make_side):
        with pytest.raises(UsageError, match=f"ends the mission at step {ENDS}"):
            asked(world, plan, RolloutChoices(rollouts=10, deadline=ENDS + 1))  # type: ignore[operator]
    assert evaluate(world, plan, RolloutChoices(rollouts=10, deadline=ENDS - 1)).outputs["deadline"] is not None


def test_plan_record_and_export_take_it_and_their_paths_end_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, log, out = tmp_path / "go.json", tmp_path / "run.mcap", tmp_path / "go.csv"
    assert run(["plan", WORLD_DEADLINE, "--robots", "3", "--deadline", str(ENDS), "--out", str(made)]) == 0
    assert f"The mission ends at step {ENDS}" in capsys.readouterr().out
    (row,) = answer_of(capsys, "record", WORLD_DEADLINE, "--plan", str(made), "--ids", "3", "--out", str(log))[
        "rollouts"
    ]
    assert (row["time"], row["outcome"]) == (ENDS, "deadline")
    (told,) = answer_of(capsys, "inspect", str(log))["rollouts"]
    assert told["outcome"] == "deadline" and f"rollout 3 ends: deadline at step {ENDS}" in told["text"]
    assert json.loads(open_log(log).attachment("tally.json"))["outcomes"]["deadline"] == 1
    assert next(read_rollouts(log)).trace.outcome is Outcome.STEP_LIMIT
    assert run(["inspect", str(log), "--replay"]) == 0
    capsys.readouterr()
    assert run(["export", WORLD_DEADLINE, "--plan", str(made), "--out", str(out)]) == 0
    longest = max(len(robot["path"]) for robot in json.loads(made.read_text())["robots"])
    assert longest <= ENDS + 1
    assert len(out.read_text().splitlines()) <= 3 * (ENDS + 2)


def test_a_sweep_keeps_to_the_deadline_of_its_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, spec = tmp_path / "go.json", tmp_path / "sweep.yaml"
    assert run(["plan", WORLD_DEADLINE, "--robots", "3", "--deadline", str(ENDS), "--out", str(made)]) == 0
    spec.write_text(json.dumps({"base": {"input": WORLD_DEADLINE, "plan": str(made)}, "rollouts": 200}))
    capsys.readouterr()
    (row,) = answer_of(capsys, "sweep", str(spec), "--store", str(tmp_path / "s.db"), "--processes", "1")["settings"]
    assert row["time"]["mean"] <= ENDS and row["outcomes"]["deadline"] > 0 == row["outcomes"]["step_limit"]
    with Store.open(tmp_path / "s.db", write=False) as store:
        (stored,) = select(store, {})
        counts = stored.sums["outcomes"]  # the codes of 0.3
        assert counts[Outcome.STEP_LIMIT] == row["outcomes"]["deadline"] and counts[Outcome.DEADLINE] == 0
        assert outcomes_of(replace(stored, sums={"outcomes": counts[:6]})) == row["outcomes"]
        before = replace(stored, facts={**stored.facts}, sums={"outcomes": counts[:5]})
        del before.facts["deadline"]  # a store of 0.3 knows it only as a label
        assert outcomes_of(before)["step_limit"] == row["outcomes"]["deadline"]
        assert outcomes_of(replace(before, what=before.what | {"deadline": ENDS})) == row["outcomes"]
    assert run(["results", str(tmp_path / "s.db"), "--csv", str(tmp_path / "r.csv")]) == 0
    (line,) = csv.DictReader((tmp_path / "r.csv").read_text().splitlines())
    assert {outcome.word: int(line[outcome.word]) for outcome in Outcome} == row["outcomes"]
    assert not {"stopped", "stuck", "timeout", "path_end", "called_off"} & line.keys()


# Waypoint files, against numbers worked out by hand on a map that is not square, moved and turned.

TURNED = World.create(np.zeros((2, 3)), cell_size=0.5, origin=(10.0, 20.0, math.pi / 6))


def write_waypoints(plan: Plan, world: World, path: Path) -> None:
    path.write_text(waypoints_csv(plan, world), encoding="utf-8", newline="")


def rows_of(path: Path) -> list[list[float]]:
    with path.open(newline="", encoding="utf-8") as lines:
        rows = list(csv.reader(lines))
    assert rows[0] == ["robot", "step", "x", "y", "yaw"]
    return [[float(value) for value in row] for row in rows[1:]]


def test_poses_by_hand(tmp_path: Path) -> None:
    """Grid frame: [0, 0] is at (0.25, 0.75) m of the lower-left corner, turned by 30 degrees and moved by (10, 20)."""
    write_waypoints(paths_plan(TURNED, [0, 0, 1, 4, 4, 3], [5]), TURNED, tmp_path / "w.csv")
    expected = [
        [0, 0, 9.841506, 20.774519, math.pi / 6],  # waits at its start, facing its first move
        [0, 1, 9.841506, 20.774519, math.pi / 6],
        [0, 2, 10.274519, 21.024519, math.pi / 6],  # east along the row
        [0, 3, 10.524519, 20.591506, -math.pi / 3],  # south: to the next row
        [0, 4, 10.524519, 20.591506, -math.pi / 3],  # waits
        [0, 5, 10.091506, 20.341506, -5 * math.pi / 6],  # west: 180 + 30 = -150 degrees
        [1, 0, 10.957532, 20.841506, math.pi / 6],  # never moves
    ]
    rows = rows_of(tmp_path / "w.csv")
    np.testing.assert_allclose(rows, expected, rtol=0, atol=6e-7)
    np.testing.assert_allclose([row[4] for row in rows], [row[4] for row in expected], rtol=0, atol=1e-14)


def test_without_an_origin_the_lower_left_corner_is_zero(tmp_path: Path) -> None:
    world = World.create(np.zeros((2, 3)))
    write_waypoints(paths_plan(world, [3, 0, 1]), world, tmp_path / "w.csv")
    text = (tmp_path / "w.csv").read_text(encoding="utf-8")
    assert text.splitlines() == [
        "robot,step,x,y,yaw",
        f"0,0,0.500000,0.500000,{math.pi / 2!r}",
        f"0,1,0.500000,1.500000,{math.pi / 2!r}",
        "0,2,1.500000,1.500000,0.0",
    ]


def test_far_coordinates_keep_their_digits_and_zero_has_no_sign(tmp_path: Path) -> None:
    far = World.create(np.zeros((1, 2)), cell_size=0.25, origin=(-0.125000001, 5_400_000.1, 0.0))
    write_waypoints(paths_plan(far, [0, 1]), far, tmp_path / "w.csv")
    lines = (tmp_path / "w.csv").read_text(encoding="utf-8").splitlines()
    assert lines[1:] == ["0,0,0.000000,5400000.225000,0.0", "0,1,0.250000,5400000.225000,0.0"]


@pytest.mark.parametrize("quarter_turns", range(-9, 10))
def test_yaw_is_always_in_the_half_open_circle(quarter_turns: int) -> None:
    """East, north, west, south in the grid, on maps turned by quarter turns: in (-pi, pi], the ends not confused."""
    world = World.create(np.zeros((3, 3)), origin=(0.0, 0.0, quarter_turns * math.pi / 2))
    found = headings(np.array([4, 5, 2, 1, 4]), world)
    grid = np.array([0, 0, 1, 2, 3])
    turns = (grid + quarter_turns) % 4
    expected = np.array([0, math.pi / 2, math.pi, -math.pi / 2])[turns]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert ((found > -math.pi) & (found <= math.pi)).all()


def test_the_yaw_points_from_cell_to_cell(tmp_path: Path) -> None:
    """Each move's direction in metres is that of the yaw written with the cell it enters."""
    rng = np.random.default_rng(3)
    world = World.create(np.zeros((4, 7)), cell_size=0.3, origin=(-3.0, 8.0, 2.2))
    path = [9]
    for _ in range(60):
        row, col = divmod(path[-1], 7)
        options = [(row, col), (row - 1, col), (row + 1, col), (row, col - 1), (row, col + 1)]
        inside = [r * 7 + c for r, c in options if 0 <= r < 4 and 0 <= c < 7]
        path.append(int(rng.choice(inside)))
    write_waypoints(paths_plan(world, path), world, tmp_path / "w.csv")
    rows = np.array(rows_of(tmp_path / "w.csv"))
    for before, after in pairwise(rows):
        moved = after[2:4] - before[2:4]
        if np.abs(moved).max() > 0:
            direction = [math.cos(after[4]), math.sin(after[4])]
            np.testing.assert_allclose(moved / 0.3, direction, rtol=0, atol=1e-5)


# A planner's setting is one line: everything that speaks of it follows from there.

OTHER = {
    "levels": 3, "density": 2.5, "risk": "log", "transit": "area", "max_steps": 99,
    "policy": "per_cell", "risk_cap": 0.5, "robot_value": 7.5,
    "plan_for": "open_loop", "effort": 7, "range": 9, "deadline": 30,
    "weibull_shape": 2.5, "hazard_multiplier": 0.5, "return_to": "nearest", "recharge": 4, "deliver_every": 3,
    "deliver_value": 12.5, "in_area": "boustrophedon", "types": "rover", "steps_per_move": 2, "radio": 4.5,
    "priority": 5, "wrecks": "block",
}  # fmt: skip
WRONG = {
    "levels": 1, "density": 1.0, "risk": "brave", "transit": "air", "max_steps": 0,
    "policy": "bold", "risk_cap": 1.5, "robot_value": 0.0,
    "plan_for": "both", "effort": -1, "range": -1, "deadline": -1,
    "weibull_shape": 0.1, "hazard_multiplier": 65.0, "return_to": "base", "recharge": 0, "deliver_every": 0,
    "deliver_value": 0.0, "in_area": "spiral", "types": "", "steps_per_move": 0, "radio": 0.0,
    "priority": 0, "wrecks": "sink",
}  # fmt: skip
NEEDS = {name: {"policy": "per_cell"} for name in ("risk_cap", "robot_value", "priority")} | {
    "effort": {"plan_for": "open_loop"}
}
NEEDS |= {name: {"return_to": "home"} for name in AGAIN} | {"recharge": {"range": 9, "return_to": "home"}}
"""What else has to be chosen."""


def test_everything_that_speaks_of_settings_follows_from_the_table() -> None:
    assert set(SETTINGS) == {field.name for field in fields(Settings)} == set(OTHER) == set(WRONG)
    found = {name for name, setting in SETTINGS.items() if setting.found}
    assert set(SETTINGS) <= {field.name for field in fields(Choices)}
    options = {one.name: set(one.options) for one in COMMANDS}
    for command in ("plan", "record", "evaluate", "compare"):
        assert set(SETTINGS) - options[command] == found
    assert {f"b_{name}" for name in set(SETTINGS) - found - {"deadline"}} <= options["compare"]
    assert set(PLANNER) == set(SETTINGS)
    typed = {name: value for name, value in OTHER.items() if name not in found}
    assert Given(typed).choices.given() == typed
    assert Settings(**Choices().given()) == Settings()
    assert len(Settings().described()) == len(SETTINGS)


@pytest.mark.parametrize("name", SETTINGS)
def test_a_value_out_of_range_is_refused_everywhere(name: str, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=name):
        Settings(**NEEDS.get(name, {}), **{name: WRONG[name]}).check()
    world, other = World.create([[0.0, 0.1, 0.2]]), NEEDS.get(name, {}) | {name: OTHER[name]}
    plan = replace(make_plan(world, [[0, 0]]), settings=Settings(**other))
    plan.save(tmp_path / "plan.json")
    assert asdict(load_plan(tmp_path / "plan.json", world).settings) == asdict(Settings()) | other
    text = (tmp_path / "plan.json").read_text()
    for right, wrong in ((f'"{OTHER[name]}"', f'"{WRONG[name]}"'), (f": {OTHER[name]}", f": {WRONG[name]}")):
        text = text.replace(right, wrong) if isinstance(OTHER[name], str) else text
    if not isinstance(OTHER[name], str):
        text = text.replace(f'"{name}":{OTHER[name]}', f'"{name}":{WRONG[name]}')
    (tmp_path / "wrong.json").write_text(text)
    with pytest.raises(PlanError, match=f"`settings.{name}` is"):
        load_plan(tmp_path / "wrong.json", world)


def test_a_command_line_names_options_and_a_file_its_keys() -> None:
    def told(source: str = "", **wrong: object) -> str:
        with pytest.raises(PlanError) as caught:
            Settings(**wrong).check(source)  # type: ignore[arg-type]
        return str(caught.value)

    token = COMMAND_LINE.set(True)
    try:
        assert told(range=-3) == "--range -3; expected a whole number, 1 to 4194302, or a list of one a robot"
        assert told(range=(0, 5)).startswith("--range 0,5; expected")
        assert told(robot_value=5.0).startswith(
            "--robot-value 5 with --policy mrac; expected --policy per_cell or frontier or watchful;"
        )
        effort = "--effort 5 with --plan-for closed_loop; expected --plan-for open_loop; leave --effort out"
        assert told(effort=5) == effort
        assert told("plan.json", range=-3).startswith("plan.json: range is -3; expected") and told(
            "plan.json", range=-3
        ).endswith("1 to 4194302, or a list of one a robot, or null")
    finally:
        COMMAND_LINE.reset(token)
    assert told(range=-3).startswith("range is -3; expected") and told(range=-3).endswith("or None")


# Times: how long a step takes changes what is said and which deadlines can be given, and nothing else.

CELLS = np.array([[0.0, 0.0, 0.3, 0.0], [0.0, np.nan, 0.0, 0.2], [0.0, 0.0, 0.1, 0.0]])
ONE: dict[str, Any] = {"rollouts": 256, "advice": False, "exact": "never"}


def scenario(folder: Path, *lines: str) -> Path:
    np.save(folder / "map.npy", CELLS)
    (folder / "s.yaml").write_text("\n".join(["map: map.npy", "robots: {count: 2}", *lines]))
    return folder / "s.yaml"


def without_minutes(said: Any) -> Any:
    if isinstance(said, list):
        return [without_minutes(one) for one in said]
    if not isinstance(said, dict):
        return said
    return {key: without_minutes(value) for key, value in said.items() if not key.endswith("_minutes")}


def test_times_are_hours_minutes_and_seconds() -> None:
    known = {"45min": 2700, "1h30min": 5400, "90s": 90, "1.5 h": 5400, "2h 5 min 1s": 7501, "0s": 0}
    assert {text: seconds_of(text) for text in known} == known
    wrong = ["", "45", "10m", "30min1h", "1h1h", "-5s", "1e3s", "nan", "h", "5 s s", "1.s", "\u0661s", "9999999999s"]
    for text in wrong:
        assert seconds_of(text) is None, text


def test_a_deadline_is_the_last_step_that_is_over_by_then() -> None:
    """Against fractions, which lose nothing: the float nearest to a whole number of steps counts as it."""
    rng = np.random.default_rng(1)
    for _ in range(2_000):
        tenths, unit, count = int(rng.integers(1, 400)), rng.choice(list(UNITS)), int(rng.integers(0, 9_999))
        found = Pace(tenths / 10).last_step("deadline", f"{count}{unit}")
        assert found == Fraction(count) * int(UNITS[unit]) // Fraction(tenths, 10)
    assert Pace(2.0).last_step("deadline", 450) == 450
    assert UNPACED.last_step("deadline", 450) == 450 and UNPACED.last_step("deadline", None) is None


def test_what_is_said() -> None:
    assert Pace(3.0).step(450) == "step 450 (22 min 30 s)"
    assert Pace(3.0).steps(1) == "1 step (3 s)"
    assert Pace(0.05).also(3) == " (0.15 s)"
    assert (UNPACED.step(450), UNPACED.steps(1), UNPACED.also(9)) == ("step 450", "1 step", "")


def test_minutes_stand_beside_steps() -> None:
    said = {
        "time": {"mean": 30.0, "se": 3.0, "ci95": [24.0, 36.0], "quantiles": {"0.5": 30}},
        "time_to": {"0.5": 12, "0.9": None},
        "plan": {"makespan": 60, "deadline": None}, "control": {"time": 0.5}, "orders": [{"step": 6, "robot": 6}],
    }  # fmt: skip
    assert with_minutes(said, UNPACED) is said
    found = with_minutes(said, Pace(10.0))
    assert without_minutes(found) == said
    assert found["time_minutes"] == {"mean": 5.0, "se": 0.5, "ci95": [4.0, 6.0]}
    assert found["time_to_minutes"] == {"0.5": 2.0, "0.9": None}
    assert found["plan"] == {"makespan": 60, "makespan_minutes": 10.0, "deadline": None}
    assert found["control"] == {"time": 0.5}
    assert found["orders"] == [{"step": 6, "step_minutes": 1.0, "robot": 6}]


def test_a_pace_changes_nothing_but_what_is_said() -> None:
    plain = mrac.load(CELLS)
    paced = mrac.load(CELLS, step_seconds=30)
    assert paced.pace == Pace(30.0)
    assert (paced.sha256, paced.randomness_sha256) == (plain.sha256, plain.randomness_sha256)
    one = mrac.evaluate(plain, 2, deadline=4, **ONE)
    other = mrac.evaluate(paced, 2, deadline="2 min", **ONE)
    assert one.tally == other.tally
    assert mrac.plan(plain, 2, deadline=4).to_json() == mrac.plan(paced, 2, deadline="2min").to_json()


def test_the_command_line_says_both(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without a pace no word of minutes; with one the same answer, and the minutes of it."""
    source = str(scenario(tmp_path))
    words = ("evaluate", source, "--rollouts", "256", "--no-advice", "--exact", "never")

    def answer(*more: str) -> dict[str, Any]:
        return answer_of(capsys, *words, *more)

    def timeless(said: dict[str, Any]) -> dict[str, Any]:
        kept = without_minutes(said)
        return {key: kept[key] for key in ("coverage", "time", "losses", "outcomes", "bounds", "plan")}

    plain = answer("--deadline", "6")
    paced = answer("--deadline", "3min", "--step-seconds", "30")
    assert "_minutes" not in json.dumps(plain) and "step_seconds" not in plain
    assert timeless(paced) == timeless(plain)
    assert paced["step_seconds"] == 30 and paced["time_minutes"]["mean"] == pytest.approx(plain["time"]["mean"] / 2)
    assert run([*words, "--deadline", "3min", "--step-seconds", "30"]) == 0
    assert "By step 6 (3 min): " in capsys.readouterr().out


def test_a_scenario_says_it(tmp_path: Path) -> None:
    timed = load_input(scenario(tmp_path, "step: {seconds: 2}", "deadline: 11s"))
    plain = load_input(scenario(tmp_path, "deadline: 5"))
    assert timed.pace == Pace(2.0) and timed.sha256 == plain.sha256
    assert mrac.plan(timed).to_json()["robots"] == mrac.plan(plain).to_json()["robots"]
    assert mrac.plan(timed).settings.deadline == 5
    np.savez(tmp_path / "map.npz", threat=CELLS, cell_size=3.0)
    for text, seconds in (("speed: 0.5", 6.0), ("speed: 2", 1.5)):
        (tmp_path / "m.yaml").write_text(f"map: map.npz\n{text}\n")
        assert load_input(tmp_path / "m.yaml").pace == Pace(seconds)
    assert load_input(tmp_path / "m.yaml").with_pace(7).pace == Pace(7.0), "options stand in its place"
    np.save(tmp_path / "cells.npy", CELLS)
    (tmp_path / "m.yaml").write_text("map: {file: cells.npy, resolution: 0.5}\nspeed: 2\n")
    world = load_input(tmp_path / "m.yaml")
    assert world.pace == Pace(0.25) and world.cell_size == 0.5 and world.shape == (3, 4)
    (tmp_path / "m.yaml").write_text("map: {file: map.npz, resolution: 0.5}\n")
    with pytest.raises(InputError, match="in the file a pixel has 3 m"):
        load_input(tmp_path / "m.yaml")


WRONG_SCENARIOS = [
    (("step: {seconds: 0}",), "`step.seconds` is 0; expected seconds, 1e-06 to 1e\\+06"),
    (("step: 2",), "`step`"),
    (("step: {seconds: 2}", "speed: 1"), "`speed` is 1; expected none together with step"),
    (("speed: 1",), "without a cell size in metres.*resolution: 0.5"),
    (("deadline: 20q",), "`deadline` is '20q'.*or a time, as 45min"),
]


@pytest.mark.parametrize(("lines", "said"), WRONG_SCENARIOS)
def test_a_scenario_that_is_wrong(tmp_path: Path, lines: tuple[str, ...], said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_input(scenario(tmp_path, *lines))


def test_what_nobody_says_is_asked_for(tmp_path: Path) -> None:
    world = World.create(CELLS, cell_size=2.0)
    soon = tmp_path / "soon.yaml"
    soon.write_text("map: cells.npy\nrobots: {count: 1}\ndeadline: 20s\n")
    np.save(tmp_path / "cells.npy", np.zeros((3, 3)))
    with pytest.raises(UsageError, match=r"soon.yaml: `deadline` is 20s, but .* give the scenario's `step:"):
        mrac.plan(mrac.load(soon))
    with pytest.raises(UsageError, match="the duration of a step is not given"):
        mrac.plan(world, 1, deadline="45min")
    with pytest.raises(UsageError, match="'soon'"):
        mrac.plan(world.with_pace(1), 1, deadline="soon")
    with pytest.raises(UsageError, match="both"):
        world.with_pace(1, 1)
    with pytest.raises(UsageError, match="makes a step of 2 m take"):
        world.with_pace(speed=1e-9)
    for wrong in (0, -1, float("nan"), "1"):
        with pytest.raises(UsageError, match="seconds"):
            world.with_pace(wrong)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="the cell size is not given"):
        mrac.load(CELLS, speed=1)
    assert mrac.load(CELLS, speed=4, cell_size=2).pace == Pace(0.5)


# Names of release 0.3: read for one release, each with one warning, and hashed as before.

OLD = {"policy": "per_cell", "reserve": 0.5, "worth": 7.5}
NEW = {"policy": "per_cell", "risk_cap": 0.5, "robot_value": 7.5}


def test_names_of_0_3_are_read_with_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    np.save(tmp_path / "cells.npy", WORLD.threat)
    new = make_plan(WORLD, [[0, 0]], Settings(**NEW))
    file, scenario = tmp_path / "plan.json", tmp_path / "old.yaml"
    old = {name: value for name, value in new.settings.to_json().items() if name not in NEW}
    file.write_text(json.dumps(new.to_json() | {"settings": old | OLD | {"plan_for": "closed"}}))
    with pytest.warns(RenamedWarning, match="plan.json: `.*` is now `.*`; release 0.5") as said:
        assert load_plan(file, WORLD).settings == new.settings
    assert len(said) == 3
    with pytest.warns(RenamedWarning):
        assert mrac.plan(WORLD, 1, **OLD).settings == new.settings
    scenario.write_text("map: cells.npy\nrobots: {count: 1, susceptibility: 2}\nwear: {shape: 3}\nplan_for: open\n")
    with pytest.warns(RenamedWarning):
        asked = load_input(scenario).team.settings
    assert asked == {"weibull_shape": 3, "hazard_multiplier": 2, "plan_for": "open_loop"}
    assert run(["plan", str(tmp_path / "cells.npy"), "--policy", "per_cell", "--worth=7.5", "--reserve", "0.5"]) == 0
    assert "note: --worth is now --robot-value; release 0.5 no longer reads --worth\n" in capsys.readouterr().err


IDENTITIES = [
    ({}, "5239310a3d1b307e"), (NEW, "40085361c4841d18"),
    ({"plan_for": "open_loop", "effort": 9}, "b083ceac958a2ca2"),
    ({"weibull_shape": 2.0, "hazard_multiplier": (1.0, 3.0)}, "42063f4ad679392e"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "key"), IDENTITIES)
def test_identities_hash_the_names_of_0_3(settings: dict[str, Any], key: str) -> None:
    """Keys of runs as the commit before the new names computed them: stores go on without a new rollout."""
    world = World.create([[0, 0.1, 0], [0.2, 0, 0.3]])
    team = Team(world, np.array([[0, 0], [0, 2]]), Settings(**settings))
    assert run_key(team, RolloutChoices(seed=3)).startswith(key)
