"""Plan files: what was saved is read back, other planners' paths are taken, and everything else is refused by name."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from plan_files import load_plan

import planner.plan.plan_file
from planner.csv_tables import read_csv_grid
from planner.errors import MapError, PlanError
from planner.files import LONG_BYTES
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Area, Leg, Plan, RobotPlan
from planner.plan.plan_file import count_shares
from planner.plan_team import plan_team, read_plan
from planner.settings import Settings
from planner.world.changing_maps import with_phases
from planner.world.scenario import load_input
from planner.world.world import World

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
        assert count_shares(plan) == plan.shares


def test_a_plan_of_version_1_is_read_where_its_rules_are_todays(tmp_path: Path) -> None:
    """Also of phases, if its paths follow by the rules of today; else one line says that these changed."""
    plain = World.create([[0, 0.5, 0, 0]])
    ends = with_phases(plain, [(4, np.zeros((1, 4)))])
    calm = with_phases(plain, [(1, np.zeros((1, 4)))])
    for world, worth in ((plain, None), (plain, 4.0), (calm, 4.0)):
        made = make_plan(world, [[0, 0]], Settings(policy="per_cell", worth=worth))
        again = read_plan(written(tmp_path, made.to_json() | {"version": 1}), world)
        assert made.to_json()["version"] == 2
        plans_equal(again, made)
    data = make_plan(ends, [[0, 0]], Settings(policy="per_cell", worth=4.0)).to_json()
    path = {"robots": [{"path": [[0, 0]], "legs": []}], "nominal": {"outcome": "called_off", "time": 2, "shares": 0}}
    for version, more in ((1, "; release 0.4 changed the rules for phases"), (2, "")):
        with pytest.raises(PlanError, match="the path of robot 0") as error:
            read_plan(written(tmp_path, data | path | {"version": version}), ends)
        assert ("release 0.4" in str(error.value)) is bool(more) and more in str(error.value)
        assert "make the plan anew" in str(error.value) and "\n" not in str(error.value)


def test_notes_in_a_file_are_kept(tmp_path: Path) -> None:
    data = own_plan().to_json() | {"notes": ["made on a Monday"]}
    assert load_plan(written(tmp_path, data), WORLD).notes == ("made on a Monday",)


def test_without_nominal_the_end_of_the_run_is_worked_out(tmp_path: Path) -> None:
    """SPEC's plan file has no `nominal`: that key is this project's own addition."""
    data = own_plan().to_json()
    del data["nominal"]
    assert plans_equal(load_plan(written(tmp_path, data), WORLD), own_plan())
    data["robots"][0]["path"].pop()
    data["robots"][0]["legs"].pop()
    assert load_plan(written(tmp_path, data), WORLD).outcome == "step_limit"


@pytest.mark.parametrize(
    ("before", "now"),
    [
        ("complete", "complete"),
        ("stuck", "no_progress"),
        ("timeout", "step_limit"),
        ("called_off", "not_worth_the_risk"),
    ],
)
def test_outcomes_of_0_3_are_read_and_written_by_their_names_of_today(tmp_path: Path, before: str, now: str) -> None:
    data = own_plan().to_json()
    data["nominal"]["outcome"] = before
    plan = load_plan(written(tmp_path, data), WORLD)
    assert plan.outcome == plan.to_json()["nominal"]["outcome"] == now
    data["settings"]["deadline"] = 9
    assert load_plan(written(tmp_path, data), WORLD).outcome == ("deadline" if before == "timeout" else now)


def test_settings_left_out_take_their_defaults(tmp_path: Path) -> None:
    data = own_plan().to_json() | {"settings": {"density": 2}}
    assert load_plan(written(tmp_path, data), WORLD).settings == Settings(density=2.0)


def test_another_planners_paths_are_taken_with_a_note_on_cells_left_out(tmp_path: Path) -> None:
    data = {"format": "coverage-plan/1", "map": "x", "paths": [[[0, 0], [0, 1], [0, 1], [1, 1]], [[1, 3], [1, 3]]]}
    plan = load_plan(written(tmp_path, data), WORLD)
    assert plan.is_foreign
    assert (plan.outcome, plan.time, plan.shares, plan.areas, plan.areas_added) == ("end_of_paths", 3, 0, (), ())
    assert [robot.path.tolist() for robot in plan.robots] == [[0, 1, 1, 5], [7, 7]]
    assert all(robot.path.dtype == np.int64 and robot.legs == () for robot in plan.robots)
    assert plan.notes == ("accessible cells on no path: 3 (the first: [0, 2])",)
    assert (plan.shape, plan.sha256) == (WORLD.shape, WORLD.sha256)


def test_another_planners_complete_plan_has_no_note(tmp_path: Path) -> None:
    path = [[0, 0], [0, 1], [1, 1], [1, 2], [0, 2], [0, 3], [1, 3]]
    plan = load_plan(written(tmp_path, {"paths": [path]}), WORLD)
    assert (plan.notes, plan.time) == ((), 6)


def test_given_paths_and_a_scenario_that_says_more_of_its_robots(tmp_path: Path) -> None:
    WORLD.save(tmp_path / "w.npz")
    (tmp_path / "s.yaml").write_text("map: w.npz\nrobots: {count: 1, range: 2, susceptibility: 3}\ndeadline: 4\n")
    world = load_input(tmp_path / "s.yaml")
    path = [[0, 0], [0, 1], [1, 1], [1, 2], [0, 2], [0, 3], [1, 3]]
    plan = load_plan(written(tmp_path, {"paths": [path]}), world)
    assert plan.bearing.susceptibility == 3 and len(plan.robots[0].path) == 7
    unkept = f"whatever {world.source} says of range and deadline"
    assert plan.notes == (f"robots follow given paths to their end, {unkept}",)
    own = plan_team(world, [[0, 0]], Settings(plan_for="open", range=2, effort=0))
    own.save(tmp_path / "own.json")
    assert not any("whatever" in note for note in load_plan(tmp_path / "own.json", world).notes)


def test_cells_out_of_reach_are_not_missed(tmp_path: Path) -> None:
    world = World.create([[0.0, np.nan, 0.0]])
    assert load_plan(written(tmp_path, {"paths": [[[0, 0]]]}), world).notes == ()


def test_another_planners_plan_survives_our_own_format(tmp_path: Path) -> None:
    plan = load_plan(written(tmp_path, {"paths": [[[0, 0], [0, 1]], [[1, 3]]]}), WORLD)
    plan.save(tmp_path / "saved.json")
    assert plans_equal(load_plan(tmp_path / "saved.json", WORLD), plan)


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps({"paths": [[[0, 0]]]}), encoding="utf-8-sig")
    assert load_plan(path, WORLD).time == 0


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


def test_a_bare_list_of_paths_is_taken(tmp_path: Path) -> None:
    paths = [[[0, 0], [0, 1]], [[1, 3]]]
    bare, named = (load_plan(written(tmp_path, data), WORLD) for data in (paths, {"paths": paths}))
    assert [robot.path.tolist() for robot in bare.robots] == [robot.path.tolist() for robot in named.robots]
    assert bare.notes == named.notes


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ([[0, 0], [0, 1]], "put it in a list: [[[row, col], ...]]"),
        ([[[0, 0], [0, 9]]], "robot 0, step 1: cell [0, 9] is off the map"),
        ([3, 4], "robot 0: its path is 3; expected at least the start: [[row, col], ...]"),
        ([{"path": [[0, 0]]}], "expected at least the start: [[row, col], ...]"),
    ],
)
def test_other_bare_lists_are_refused_with_the_right_hint(tmp_path: Path, data: Any, said: str) -> None:
    assert said in refused(written(tmp_path, data))


@pytest.mark.parametrize("data", [[], None, 3, "paths", {}, {"format": "mrac-world"}, {"path": [[[0, 0]]]}])
def test_json_that_is_no_plan(tmp_path: Path, data: Any) -> None:
    assert "expected" in refused(written(tmp_path, json.dumps(data)))


# --- what is refused: paths ---


@pytest.mark.parametrize(
    ("paths", "words"),
    [
        ([], ["`paths` is []"]),
        ({}, ["`paths` is {}"]),
        (None, ["`paths` is None"]),
        ([[]], ["robot 0", "[]", "at least the start"]),
        ([[[0, 0]], []], ["robot 1"]),
        ([[[0, 0]], "north"], ["robot 1", "'north'"]),
        ([[[0, 0]], [[0, 3], [0, 4]]], ["robot 1, step 1", "[0, 4]", "off the map", "col 0..3"]),
        ([[[0, 0], [-1, 0]]], ["robot 0, step 1", "[-1, 0]", "off the map", "row 0..1"]),
        ([[[0, 10**30]]], ["robot 0, step 0", "off the map"]),
        ([[[0, 0], [1, 0]]], ["robot 0, step 1", "[1, 0]", "obstacle"]),
        ([[[0, 0], [0, 1], [1, 2]]], ["robot 0, step 2", "jump", "[0, 1]", "[1, 2]"]),
        ([[[0, 3], [1, 3], [1, 1]]], ["robot 0, step 2", "jump", "[1, 3]", "[1, 1]"]),
        ([[[0, 0], [0.0, 1.0]]], ["robot 0, step 1", "[0.0, 1.0]", "whole numbers"]),
        ([[[0, 0], [0, True]]], ["robot 0, step 1", "[0, True]"]),
        ([[[0, 0], [0, float("nan")]]], ["robot 0, step 1", "[0, nan]"]),
        ([[[0, 0], [0, "1"]]], ["robot 0, step 1", "[0, '1']"]),
        ([[[0, 0], [0, None]]], ["robot 0, step 1", "[0, None]"]),
        ([[[0, 0], [0, 1, 0]]], ["robot 0, step 1", "[0, 1, 0]"]),
        ([[[0, 0], 1]], ["robot 0, step 1", ": 1;"]),
        ([[[0, 0], [[0, 0], [0, 0]]]], ["robot 0, step 1"]),
        ([[[0, 0], {"row": 0, "col": 1}]], ["robot 0, step 1", "row"]),
        ([[0, 0]], ["robot 0, step 0"]),
    ],
)
def test_paths_that_cannot_be_driven(tmp_path: Path, paths: Any, words: list[str]) -> None:
    message = refused(written(tmp_path, {"paths": paths}))
    assert all(word in message for word in words), message
    if isinstance(paths, list) and paths:
        own = own_plan().to_json()
        own["robots"] = [{"path": path, "legs": []} for path in paths]
        assert all(word in refused(written(tmp_path, own)) for word in words)


def test_limits_of_the_random_number_counter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "at most 1024" in refused(written(tmp_path, {"paths": [[[0, 0]]] * 1025}))
    assert len(load_plan(written(tmp_path, {"paths": [[[0, 0]]] * 1024}), WORLD).robots) == 1024
    monkeypatch.setattr(planner.plan.plan_file, "MAX_STEP", 5)
    assert "robot 0: 6 steps" in refused(written(tmp_path, {"paths": [[[0, 0]] * 7]}))
    assert load_plan(written(tmp_path, {"paths": [[[0, 0]] * 6]}), WORLD).time == 0


# --- what is refused: the project's own format ---


def change(*keys: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def plant(data: dict[str, Any]) -> None:
        place: Any = data
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = to

    return plant


def without(*keys: Any) -> Callable[[dict[str, Any]], None]:
    def plant(data: dict[str, Any]) -> None:
        place: Any = data
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]

    return plant


LEG, AREA, ADDED = ("robots", 1, "legs", 0), ("areas", 1), ("areas_added", 0)
FAULTS: list[tuple[Callable[[dict[str, Any]], None], list[str]]] = [
    (change("format", to="mrac-plans"), ["'mrac-plans'", '"mrac-plan"']),
    (change("version", to=3), ["`version` is 3", "version 1 to 2", "update"]),
    (change("version", to=0), ["`version` is 0"]),
    (change("version", to=True), ["`version` is True"]),
    (change("version", to="1"), ["`version` is '1'"]),
    (without("version"), ["`version` is missing"]),
    (without("world"), ["`world` is missing"]),
    (change("world", to=[2, 4]), ["`world` is [2, 4]", "keys"]),
    (change("world", "shape", to=[4, 2]), ["plan for another map", "[4, 2]", "[2, 4]", "small.npz"]),
    (change("world", "shape", to=[2.0, 4.0, 1]), ["plan for another map"]),
    (change("world", "shape", to="2x4"), ["another map: 2x4 cells"]),
    (change("world", "sha256", to="ab" * 32), ["plan for another map", "abababababab", WORLD.sha256[:12]]),
    (change("world", "sha256", to=None), ["another map", "sha256 None"]),
    (change("robots", to=[]), ["`robots` is []"]),
    (change("robots", 1, to=[[0, 3]]), ["robots[1]"]),
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
    (without(*LEG, "stop"), ["legs[0].stop` is missing"]),
    (change("settings", to=[]), ["`settings` is []"]),
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
    (change("settings", to=None), ["`areas` is [", "no settings"]),
    (without("areas"), ["`areas` is missing"]),
    (without("areas_added"), ["`areas_added` is missing"]),
    (change(*AREA, to=3), ["`areas[1]` is 3"]),
    (change(*AREA, "level", to=-1), ["`areas[1].level` is -1"]),
    (change(*AREA, "level", to=7), ["`areas[1].level` is 7", "0..6"]),
    (change(*AREA, "robot", to=2), ["`areas[1].robot` is 2", "0..1"]),
    (change(*AREA, "robot", to=-2), ["`areas[1].robot` is -2"]),
    (change(*AREA, "robot", to=None), ["`areas[1].robot` is None"]),
    (change(*AREA, "cells", to=[]), ["`areas[1].cells` is []"]),
    (change(*AREA, "cells", to=[3, 8]), ["`areas[1].cells` holds 8", "0..7"]),
    (change(*AREA, "cells", to=[3, -1]), ["`areas[1].cells` holds -1"]),
    (change(*AREA, "cells", to=[3, 7.0]), ["`areas[1].cells` holds 7.0"]),
    (change(*AREA, "cells", to=[3, True]), ["`areas[1].cells` holds True"]),
    (change(*AREA, "cells", to=[3, 4]), ["`areas[1].cells`", "[1, 0]", "obstacle"]),
    (change(*AREA, "cells", to=[3, 7, 3]), ["`areas[1].cells`", "[0, 3]", "twice"]),
    (change(*AREA, "cells", to=[3]), ["[1, 3]", "in 0 areas"]),
    (change(*AREA, "cells", to=[2, 3, 7]), ["[0, 2]", "in 2 areas"]),
    (change(*ADDED, "cells", to=[9]), ["`areas_added[0].cells` holds 9"]),
    (change("nominal", to=3), ["`nominal` is 3"]),
    (change("nominal", "outcome", to="stopped"), ["`nominal.outcome` is 'stopped'", "complete"]),
    (change("nominal", "outcome", to="all_robots_lost"), ["`nominal.outcome` is 'all_robots_lost'", "no_progress"]),
    (change("nominal", "time", to=2), ["`nominal.time` is 2", "the last move or a later one, 3 to"]),
    (change("nominal", "time", to=10**30), ["time"]),
    (change("nominal", "shares", to=-1), ["`nominal.shares` is -1"]),
    (change("notes", to="one"), ["`notes` is 'one'"]),
    (change("notes", to=[1]), ["`notes[0]` is 1"]),
]


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
    with pytest.raises(MapError, match="more than 2 cells"):  # at the first lines
        read_csv_grid(large, 2)
    assert caplog.messages == [f"reading {large} (8 MB), which takes a while ..."]
