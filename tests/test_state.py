"""State files, and states from masks, grids, lists of cells and tracks."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import VisitLoop, paths_of
from oracle_simulator import Paper
from oracle_tree import Tree, exactly
from PIL import Image
from test_map_files import grid as serialised
from test_map_files import log
from test_mission import SETTINGS as DRIVEN
from test_mission import case

import mrac_jax as mrac
from analysis.recording.frames import make_frames
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import open_loop_exact
from planner.errors import InputError, PlanError, StateError, UsageError
from planner.make_plan import confirm_plan, make_plan
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.plan.state import MissionState
from planner.plan.state_file import load_state, parse_state, read_state
from planner.rollouts.closed_loop import compile_closed_loop, new_cells, run_range, trace_rollouts
from planner.rollouts.open_loop import compile_plan
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import NO_AREA, NO_ROBOT
from planner.world.world import World

# State files: a mission cut at a step, saved and gone on with ends as the uncut one (SPEC section 12).

LEFT_OUT = {"mrac, deadline", "per_cell, log", "weibull_shape", "home", "nearest, deadline", "own rule"}
SETTINGS = {name: more for name, more in DRIVEN.items() if name not in LEFT_OUT}
STEPS = (0, 3, 11, 25)
"""Where rollouts are cut, every other one of them each."""


def rest_of(world: World, state: MissionState, **more: Any) -> Plan:
    """The plan of the rest, by way of both files."""
    read = parse_state(json.loads(json.dumps(state.to_json())), world, "file")
    made = make_plan(world, read.starts, Settings(**more), state=read)
    return confirm_plan(parse_plan(json.loads(json.dumps(made.to_json())), world, "file"), world, "file")


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 5), marks=pytest.mark.slow)], ids=str)
@pytest.mark.parametrize("more", SETTINGS.values(), ids=list(SETTINGS))
def test_a_rollout_goes_on_as_if_it_had_not_been_cut(more: dict[str, Any], seeds: range) -> None:
    cuts = 0
    for seed in seeds:
        world, plan = case(seed, **more)
        whole = VisitLoop(plan, world)  # a state has no thresholds, so that rests draw them anew
        for rollout in range(2 if seed == 2 else 1):
            uncut = whole.run(seed, rollout)
            for step in STEPS[(seed + rollout) % 2 :: 2]:
                state = whole.state_at(step, seed, rollout)
                if state is None:
                    assert uncut.step <= step
                    continue
                cuts += 1
                rest = rest_of(world, state, **more)
                run = VisitLoop(rest, world).run(seed, rollout)
                assert (run.outcome, run.step) == (uncut.outcome, uncut.step)
                for name in ("visited", "survived", "alive"):
                    np.testing.assert_array_equal(getattr(run, name), getattr(uncut, name))
                for before, after in zip(paths_of(uncut), paths_of(run), strict=True):
                    np.testing.assert_array_equal(before[step + 1 :], after[step + 1 :])
                python = PythonLoop(rest, world)
                run = python.run(seed, rollout)
                loop = compile_closed_loop(rest, world, tabled=seed != 1)
                tally, singles = run_range(loop, seed, rollout, 4, singles=True, threads=1)
                found = [int(getattr(singles, name)[0]) for name in ("visited", "survived", "time", "alive", "outcome")]
                assert found == [run.visited.sum(), run.survived.sum(), run.step, run.alive.sum(), run.outcome]
                for trace in trace_rollouts(loop, seed, (rollout, rollout + 1)):
                    assert trace == python.trace(seed, trace.rollout), (seed, rollout, step)
                    frames = make_frames(trace, state)
                    at = trace.rollout - rollout
                    assert (frames.visited[-1], frames.survived[-1]) == (singles.visited[at], singles.survived[at])
                    assert frames.visited[step] == len(state.visited)
                assert tally.new_visited.sum() == tally.visited @ np.arange(len(tally.visited))
                assert tally.new_survived.sum() == tally.survived @ np.arange(len(tally.survived))
                assert new_cells(loop, seed, rollout, 1)[0].sum() == run.visited.sum()
    assert cuts > len(seeds)


def by_hand(world: World, plan: Plan, visited: list[int]) -> dict[str, Any]:
    width = world.shape[1]
    robots: list[dict[str, Any]] = [{"cell": [int(row), int(col)]} for row, col in plan.starts]
    robots[0] = {"cell": robots[0]["cell"], "status": "dead"}
    return {
        "format": "mrac-state", "version": 1, "world": {"shape": list(world.shape), "sha256": world.sha256},
        "step": 20, "visited": [list(divmod(cell, width)) for cell in visited], "robots": robots,
    }  # fmt: skip


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
    rest = rest_of(world, parse_state(said, world, "hand.json"), **SETTINGS["robot_value"])
    assert rest.state is not None and [robot.status for robot in rest.state.robots] == ["dead", *["traveling"] * 3]
    assert not any(robot.held for robot in rest.state.robots)


def oracle_of(plan: Plan, threat: np.ndarray) -> Paper:
    """The plain oracle's run where the plan's state stands."""
    state, width = plan.state, plan.shape[1]

    def cells_of(numbers: Any) -> list[tuple[int, int]]:
        return [divmod(cell, width) for cell in numbers.tolist()]

    areas = [(area.level, None, cells_of(area.cells)) for area in state.areas]
    run = Paper(threat, [(row, col) for row, col in state.starts.tolist()], areas)
    run.visited, run.survived, run.step = set(cells_of(state.visited)), set(cells_of(state.survived)), state.step + 1
    for patch, area in zip(run.patches, state.areas, strict=True):
        patch.owner, patch.over = None if area.robot == NO_ROBOT else area.robot, area.state == "completed"
    for walker, robot in zip(run.team, state.robots, strict=True):
        walker.doing, walker.way = robot.status, cells_of(robot.ahead)
        walker.patch = None if robot.area == NO_AREA else robot.area
    return run


def test_expected_values_of_the_rest_are_the_enumerated_ones() -> None:
    """One robot left: the closed form, the tree of all hits, and 20,000 rollouts agree."""
    threat = np.zeros((3, 4), dtype=np.float32)
    threat[1, 1:3], threat[2, 3] = 0.3, 0.2
    world = World.create(threat)
    state = parse_state(by_hand(world, make_plan(world, [[0, 1], [0, 0]]), [0, 1, 2, 5]), world, "hand.json")
    plan = make_plan(world, state.starts, state=state)
    exact, tree = open_loop_exact(plan, world), exactly(Tree(oracle_of(plan, threat), threat))
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
    state = PythonLoop(plan, world).state_at(11, 4, 2)
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
    state = PythonLoop(plan, world).state_at(3, 0, 0)
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
    "off the map": (_set("visited", [100_000]), "off the map"),
    "negative cell": (_set("robots", 0, "cell", -1), "off the map"),
    "a cell twice": (_set("visited", [[0, 0], [0, 0]]), "twice|obstacle"),
    "a jump": (lambda data: _busy(data, "ahead", [0, 40]), "jumps|obstacle"),
    "nothing ahead": (lambda data: _busy(data, "ahead", []), "nothing is ahead"),
    "not its area": (lambda data: _busy(data, "area", 999), "not its own|another or none"),
    "overlap": (lambda data: data["areas"][0].update(cells=data["areas"][1]["cells"]), "areas"),
    "unassigned but visited": (lambda data: _swap(data, "completed", "unassigned"), "only visited cells"),
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
    state = PythonLoop(plan, world).state_at(25, 1, 1)
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
    state = PythonLoop(plan, world).state_at(3, 0, 0)
    data = state.to_json()
    data["areas"][0]["level"] += 1
    with pytest.raises(StateError, match=r"level.* give the settings of the plan that was driven, levels among"):
        make_plan(world, state.starts, state=parse_state(data, world, "state.json"))
    with pytest.raises(StateError, match=r"robot 0 is .* after 7 moves"):
        data = state.to_json()
        data["robots"][0]["moves"] = 7
        make_plan(world, state.starts, Settings(range=6), state=parse_state(data, world, "state.json"))
    world, plan = case(3, policy="per_cell")
    state = PythonLoop(plan, world).state_at(8, 0, 0)
    with pytest.raises(StateError, match=r"not by policy mrac.* plan that was driven, policy among them"):
        make_plan(world, state.starts, state=state)
    with pytest.raises(InputError, match=r"missing\.json"):
        load_state(tmp_path / "missing.json", world)


# A mission's state from masks, grids, lists of cells and tracks: what is visited, who is where, what is none.

LAND = np.zeros((4, 6))
LAND[0, 3], LAND[2, 5] = np.nan, 0.25
WORLD = World.create(LAND, cell_size=2.0, origin=(10.0, 20.0, 0.0))
"""Its lower-left corner is at (10, 20); cell [row, col] has its centre at (11 + 2 col, 27 - 2 row)."""
DONE = [[1, 0], [1, 1], [2, 1]]
STARTS = [[2, 1]]


def cells_of(visited: np.ndarray) -> list[list[int]]:
    return [list(divmod(int(cell), 6)) for cell in visited]


def mask(cells: list[list[int]], ratio: int = 1) -> np.ndarray:
    held = np.zeros((4, 6), dtype=bool)
    held[tuple(np.array(cells).T)] = True
    return held.repeat(ratio, axis=0).repeat(ratio, axis=1)


@pytest.mark.parametrize("dtype", [bool, np.uint8, np.float32])
def test_a_mask_of_cells(tmp_path: Path, dtype: type) -> None:
    np.save(tmp_path / "m.npy", mask(DONE).astype(dtype))
    state, notes = read_state(tmp_path / "m.npy", WORLD, STARTS)
    assert cells_of(state.visited) == DONE and state.starts.tolist() == STARTS and state.step == 0
    assert notes == ("m.npy: 3 cells are visited (13.0 % of those in reach), step 0",)


def test_a_mask_of_pixels_marks_cells_that_are_half_done(tmp_path: Path) -> None:
    """Cells of 3 x 3 pixels, and a row of pixels that fills none; of one cell 5 pixels are done, of another 4."""
    pixels = np.vstack([mask(DONE, 3), np.ones((1, 18), dtype=bool)])
    pixels[9:12, 0:3] = [[1, 1, 1], [1, 1, 0], [0, 0, 0]]
    pixels[9:12, 3:6] = [[1, 1, 1], [1, 0, 0], [0, 0, 0]]
    np.save(tmp_path / "m.npy", pixels)
    assert cells_of(read_state(tmp_path / "m.npy", WORLD, STARTS)[0].visited) == [*DONE, [3, 0]]
    Image.fromarray((255 * pixels).astype(np.uint8)).save(tmp_path / "m.png")
    assert cells_of(read_state(tmp_path / "m.png", WORLD, STARTS)[0].visited) == [*DONE, [3, 0]]


@pytest.mark.parametrize("value", [-1, -9999, np.nan, np.inf])
def test_a_mask_with_what_is_unknown_is_refused(tmp_path: Path, value: float) -> None:
    given = mask(DONE).astype(np.float32 if not np.isfinite(value) else np.int16)
    given[3, 2] = value
    np.save(tmp_path / "m.npy", given)
    with pytest.raises(InputError, match=rf"m\.npy: {value} at row 3, col 2 \(1 such value\); expected .* above 0"):
        read_state(tmp_path / "m.npy", WORLD, STARTS)


def test_obstacles_and_cells_out_of_reach_are_left_out_of_a_mask(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", mask([*DONE, [0, 3]]))
    state, notes = read_state(tmp_path / "m.npy", WORLD, STARTS)
    assert cells_of(state.visited) == DONE and "1 of its cells are obstacles or out of the robots' reach" in notes[0]


@pytest.mark.parametrize("kind", ["yaml", "mcap"])
def test_an_occupancy_grid_lies_by_its_origin(tmp_path: Path, kind: str) -> None:
    """Pixels of 1 m from (8, 20): two columns lie off the map; what is marked is visited."""
    grid = np.zeros((8, 14), dtype=bool)
    grid[:, 2:] = mask(DONE, 2)
    if kind == "yaml":
        Image.fromarray(np.where(grid, 0, 255).astype(np.uint8)).save(tmp_path / "g.png")
        keys = {"image": "g.png", "resolution": 1.0, "origin": [8, 20, 0], "occupied_thresh": 0.65, "free_thresh": 0.2}
        (tmp_path / "g.yaml").write_text(json.dumps(keys))
    else:
        values = np.where(grid, 100, 0)[::-1]
        log(tmp_path / "g.mcap", ("/covered", serialised(values, turn=(0, 0, 0, 1), corner=(8.0, 20.0), size=1.0)))
    assert cells_of(read_state(tmp_path / f"g.{kind}", WORLD, STARTS)[0].visited) == DONE


@pytest.mark.parametrize("text", ["row,col\n1,0\n1,1\n2,1\n", "1,0\n1,1\n2,1\n", "n,col,row\n7,0,1\n7,1,1\n7,1,2\n",
                                  "x_m,y_m\n11.9,25.2\n13,25\n13,23\n900,25\n", "row;col\n1;0\n1;1\n2;1\n",
                                  "x_m;y_m\n11,9;25,2\n13;25\n13;23\n"])  # fmt: skip
def test_visited_cells_in_a_csv_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    assert cells_of(read_state(tmp_path / "c.csv", WORLD, STARTS)[0].visited) == DONE


TRACKS = [
    ("robot,row,col\n0,1,0\n1,3,3\n0,1,1\n1,3,3\n0,2,1\n1,3,4\n", 2),
    ("robot,row,col,step\n1,3,4,9\n0,1,0,0\n0,2,1,9\n0,1,1,4\n1,3,3,0\n", 9),
    ("robot,x_m,y_m\n0,11,25\n0,11.5,25.5\n0,13,25\n0,13,23\n0,900,23\n0,13,23\n1,17,21\n1,19,21\n", 2),
]


@pytest.mark.parametrize(("text", "step"), TRACKS)
def test_driven_tracks(tmp_path: Path, text: str, step: int) -> None:
    """Whose lines lie mixed, in any order where steps are said, in metres with a place that is off the map."""
    (tmp_path / "t.csv").write_text(text)
    state, notes = read_state(tmp_path / "t.csv", WORLD)
    assert cells_of(state.visited) == [*DONE, [3, 3], [3, 4]] and state.starts.tolist() == [[2, 1], [3, 4]]
    assert [robot.moves for robot in state.robots] == [2, 1] and state.step == step
    assert ("900" in text) == any("1 of 8 places lie off the map" in note for note in notes)


@pytest.mark.parametrize("name", ["step", "time", "t", "Timestamp", "datetime"])
@pytest.mark.parametrize("form", ["{}", "{}.5", "2026-05-01T12:00:0{}", "2026-05-01 12:00:0{}.5Z", "17{}0123456789"])
def test_tracks_lie_in_the_order_of_their_times(tmp_path: Path, name: str, form: str) -> None:
    """The step is that of the lines, or as many moves as the robot that moved most made."""
    if name == "step" and form != "{}":
        form = "{}"
    lines = [f"0,{form.format(2)},2,1", f"0,{form.format(0)},1,0", f"0,{form.format(1)},1,1"]
    (tmp_path / "t.csv").write_text("\n".join([f"robot,{name},row,col", *lines]))
    state, _ = read_state(tmp_path / "t.csv", WORLD)
    assert state.starts.tolist() == [[2, 1]] and state.step == 2 and state.robots[0].moves == 2


def test_times_of_several_zones_and_times_that_are_none(tmp_path: Path) -> None:
    head = "robot,timestamp,row,col\n0,2026-05-01T12:00:00+02:00,1,0\n"
    (tmp_path / "t.csv").write_text(head + "0,2026-05-01T10:00:02Z,2,1\n0,2026-05-01T11:00:01+01:00,1,1\n")
    assert read_state(tmp_path / "t.csv", WORLD)[0].starts.tolist() == [[2, 1]]
    for wrong in ("noon", "", "17"):
        (tmp_path / "t.csv").write_text(head + f"0,{wrong},1,1\n")
        with pytest.raises(InputError, match=r"t\.csv: line \d: timestamp is '"):
            read_state(tmp_path / "t.csv", WORLD)


def test_tracks_on_a_georeferenced_map_may_be_in_degrees(tmp_path: Path) -> None:
    from planner.world.frame import around

    world = World.create(LAND, cell_size=2.0, origin=(10.0, 20.0, 0.0), georeference=around(52.0, 8.0))
    places = world.georeference.to_lonlat([[11, 25], [13, 25], [13, 23]])
    lines = [f"rover,{longitude!r},{latitude!r}" for longitude, latitude in places.tolist()]
    (tmp_path / "t.csv").write_text("\n".join(["robot,lon,lat", *lines]))
    assert cells_of(read_state(tmp_path / "t.csv", world)[0].visited) == DONE
    turned = [f"rover\t{longitude - 360}\t{latitude}".replace(".", ",") for longitude, latitude in places.tolist()]
    (tmp_path / "u.csv").write_text("\n".join(["robot\tlon\tlat", *turned]))
    state, notes = read_state(tmp_path / "u.csv", world)
    assert cells_of(state.visited) == DONE and "by tabs, numbers as written with decimal commas" in notes[0]
    (tmp_path / "u.csv").write_text((tmp_path / "t.csv").read_text().replace("lon,lat", "lat,lon"))
    with pytest.raises(InputError, match=r"u\.csv: latitude stands first, as in 52\.000.*, 8\.000.*swap"):
        read_state(tmp_path / "u.csv", world)
    with pytest.raises(InputError, match="in EPSG:4326, and the map has no georeference; give columns x and y"):
        read_state(tmp_path / "t.csv", WORLD)


def test_a_robot_that_was_lost_on_its_track(tmp_path: Path) -> None:
    """As the plan and the evaluation of the rest say it, and a state file has it."""
    (tmp_path / "t.csv").write_text("robot,row,col,status\na,1,0,\na,1,1,dead\nb,2,1,\n")
    state, _ = read_state(tmp_path / "t.csv", WORLD)
    assert [robot.status for robot in state.robots] == ["dead", "idle"] and state.lost == 1
    plan = mrac.plan(WORLD, state=tmp_path / "t.csv")
    assert plan.state is not None and plan.state.lost == 1 and any("3 cells are visited" in note for note in plan.notes)
    state.save(tmp_path / "now.json")
    said = json.loads((tmp_path / "now.json").read_text())
    del said["world"], said["checksum"]  # as whoever changes it by hand does
    (tmp_path / "now.json").write_text(json.dumps(said))
    again, _ = read_state(tmp_path / "now.json", WORLD)
    assert again.to_json() == state.to_json()


def test_what_a_state_file_says_of_its_world_is_checked(tmp_path: Path) -> None:
    state = {"format": "mrac-state", "version": 1, "visited": DONE, "robots": [{"cell": [2, 1]}]}
    for world in ({"shape": [4, 7]}, {"sha256": "0" * 64}):
        (tmp_path / "s.json").write_text(json.dumps(state | {"world": world}))
        with pytest.raises(InputError, match="state of another map"):
            read_state(tmp_path / "s.json", WORLD)
    (tmp_path / "s.json").write_text(json.dumps(state | {"world": {"shape": [4, 6]}}))
    assert cells_of(read_state(tmp_path / "s.json", WORLD)[0].visited) == DONE


def test_masks_and_where_the_robots_are_in_python(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", mask(DONE))
    plan = mrac.plan(WORLD, state=tmp_path / "m.npy", starts=[[3, 0], [2, 1]])
    assert plan.state is not None and cells_of(plan.state.visited) == [*DONE, [3, 0]] and len(plan.robots) == 2
    with pytest.raises(InputError, match="does not give the robots' places; give starts, one cell for each robot"):
        mrac.plan(WORLD, state=tmp_path / "m.npy")


NO_STATES = [
    ("t.csv", "robot,row,col\n0,1,9\n", "line 2: '0, 1, 9' is no cell of the map; expected row 0..3 and col 0..5"),
    ("t.csv", "robot,row,col\n0,0,3\n", "line 2: '0, 0, 3' is an obstacle"),
    ("t.csv", "robot,row,col\n0,1.5,2\n", "is no cell of the map"),
    ("t.csv", "robot,row,col\n0,nan,2\n", "line 2: row is 'nan'"),
    ("t.csv", "robot,row,col\n", "has a header and no points"),
    ("t.csv", "", "is empty"),
    ("t.csv", "robot,row,col,step\n0,1,2,-3\n", "line 2: step is '-3'"),
    ("t.csv", "robot,row,col,status\n0,1,2,happy\n", "line 2: status 'happy'; expected idle, done, dead or lost"),
    ("t.csv", "robot,row,col,status\n0,1,2,dead\n", "every robot is dead"),
    ("t.csv", "robot,x,y\n0,11,25\n0,900,25\n", "robot 0 ends off the map or on an obstacle"),
    ("t.csv", "robot,a,b\n0,11,25\n", "has the columns robot, a, b; expected row and col, or x and y in metres"),
    ("t.csv", "robot,row,col\n" + "0,1,1\n" * 131_072, "131073 lines; expected at most 131072"),
    ("t.csv", "robot,row,col\n" + "".join(f"{n},1,1\n" for n in range(1025)), "1025 robots; expected at most 1024"),
    ("m.txt", "1,1\n", "no state is read from '.txt'"),
    ("m.npy", "x", "cannot be read as .npy"),
    ("m.png", "x", "cannot be read as an image"),
    ("m.mcap", "x", "is not an MCAP file"),
]


@pytest.mark.parametrize(("name", "text", "said"), NO_STATES)
def test_what_is_no_state(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_state(tmp_path / name, WORLD, None if text.startswith("robot") else STARTS)
    assert said in str(caught.value) and name in str(caught.value) and "\n" not in str(caught.value)


def test_masks_and_starts_that_do_not_fit(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.ones((5, 5)))
    with pytest.raises(InputError, match="a mask of 5 x 5; expected the map's 4 x 6 cells, or its pixels"):
        read_state(tmp_path / "m.npy", WORLD, STARTS)
    np.save(tmp_path / "m.npy", np.ones((4, 6, 2)))
    with pytest.raises(InputError, match="expected a mask"):
        read_state(tmp_path / "m.npy", WORLD, STARTS)
    np.save(tmp_path / "m.npy", np.ones((4, 6)))
    with pytest.raises(InputError, match="every cell in reach is visited"):
        read_state(tmp_path / "m.npy", WORLD, STARTS)
    (tmp_path / "t.csv").write_text("robot,row,col\n0,1,1\n")
    with pytest.raises(InputError, match=r"starts and .*t\.csv, which gives the robots' places; leave starts out"):
        read_state(tmp_path / "t.csv", WORLD, STARTS)
