"""Searches for start positions, for threats to remove and for places of threats."""

import json
import shlex
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_worlds import fields
from helpers import after, answer_of, error_of

import mrac_jax as mrac
from analysis.inputs import Asked, load_task
from analysis.sampling import RolloutChoices, make_singles
from analysis.search import place_reports
from analysis.search import threats as search
from analysis.search.place_reports import removal_summary, starts_findings, starts_report, starts_summary
from analysis.search.start_positions import border, candidate_cells, find_starts, read_candidates, sites_of, spread_out
from analysis.search.threats import Attack, Clearing, by_cell, find_clearing, threats_of
from analysis.theory.exact import coverage_gradient, open_loop_exact
from planner.errors import InputError, PlanError, UsageError
from planner.make_plan import make_plan
from planner.policies import RULES
from planner.rollout_sampling import LossDraws
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.single_run import PythonLoop, SingleRun
from planner.settings import Choices, Settings
from planner.world.scenario import load_input
from planner.world.world import World

# `mrac-jax starts`: candidates, what is simulated against the simulator as Python, the scenario, wrong input.

LAKE = np.zeros((6, 8))
LAKE[2:4, 2:4] = np.nan  # no border: the edge cannot be reached from it over obstacles
LAKE[0, 6:], LAKE[1, 7] = np.nan, np.nan
LAKE[4:, 4:] = 0.3
LAKE[2, 5:] = 0.1
WORLD = World.create(LAKE)
RUNS = 16


def test_the_border_is_the_edge_and_what_reaches_to_it() -> None:
    found = border(WORLD)
    by_hand = {(row, col) for row in range(6) for col in range(8) if row in (0, 5) or col in (0, 7)}
    by_hand |= {(1, 6)}
    safe = {(row, col) for row, col in by_hand if LAKE[row, col] == 0}
    assert set(map(tuple, np.argwhere(found).tolist())) == safe and (1, 2) not in safe


def test_candidates_are_a_mask_or_a_list_in_one_part_of_the_map() -> None:
    mask = np.zeros(LAKE.shape, dtype=bool)
    mask[0, :3] = True
    for given in (mask, mask.astype(int), [[0, 2], [0, 0], [0, 1], [0, 2]]):
        cells, notes = candidate_cells(WORLD, given)
        assert cells.tolist() == [[0, 0], [0, 1], [0, 2]] and not notes
    cells, notes = candidate_cells(World.create([[0.0, 0.0, np.nan, 0.0]]), [[0, 0], [0, 3]])
    assert cells.tolist() == [[0, 0]] and "1 of 2 candidates" in notes[0]
    narrow = World.create(np.zeros((3, 2)))
    assert len(candidate_cells(narrow, np.eye(3, 2, dtype=bool))[0]) == 2  # booleans are a mask, whatever their shape


def test_sites_are_safe_areas_and_single_dangerous_cells() -> None:
    cells = np.array([[0, 0], [5, 0], [3, 7], [2, 5], [2, 6]])
    sites = sorted(sorted(map(tuple, site.tolist())) for site in sites_of(WORLD, cells))
    apart = [[(0, 0), (5, 0)], [(2, 5)], [(2, 6)], [(3, 7)]]
    assert sites in (apart, [[(0, 0), (3, 7), (5, 0)], *apart[1:3]])
    line = np.array([[0, col] for col in range(9)])
    assert set(map(tuple, spread_out(line)[:3].tolist())) == {(0, 0), (0, 8), (0, 4)}
    assert sorted(spread_out(line, 2).tolist()) == line.tolist()


GIVEN = [[0, 0], [5, 0], [3, 7], [2, 6]]
CHOICES = RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never")


def visited_from(starts: np.ndarray, ids: range, world: World = WORLD, seed: int = 3) -> np.ndarray:
    """Cells visited in each rollout of the simulator as Python, `[n, N]`."""
    loop = PythonLoop(make_plan(world, starts, Settings()), world)
    return np.array([loop.run(seed, rollout).visited for rollout in ids])


@pytest.mark.parametrize("depot", [True, False])
def test_what_is_simulated_is_what_the_simulator_as_python_says(depot: bool) -> None:
    """Where cells have values it goes by value."""
    value = np.where(np.arange(8) >= 4, 7.5, 1.0) * np.ones((6, 1))
    valued = WORLD.with_values(value, 0.5)
    share = np.where(valued.free, value, 0.0).ravel() / value[valued.free].sum()
    for world, figure in ((WORLD, "coverage"), (valued, "value")):
        answer = find_starts(world, 2, Settings(), CHOICES, depot=depot, candidates=GIVEN)
        found = answer.to_json()
        assert answer.starts.shape == (2, 2)
        assert answer.rolled - sum(p.rollouts for p in answer.places) == RUNS * (1 + (answer.best != answer.here))
        for place in answer.places:
            runs, cells = visited_from(place.starts, range(place.rollouts)), place.coverage.times(answer.cells)
            assert cells.mean == pytest.approx(runs.sum(axis=1).mean())
            if world is valued:
                assert place.value.mean == pytest.approx((runs @ share).mean(), abs=1e-9)
                assert place.value.mean * value[valued.free].sum() <= place.screen * (1 + 5 * place.value.se)
            else:
                assert cells.mean <= place.screen + 5 * cells.se
            if depot and not place.now:
                assert place.is_depot and place.starts[0].tolist() in GIVEN and place.one_robot <= place.screen
        again = visited_from(answer.starts, range(RUNS, 2 * RUNS)).sum(axis=1).mean()
        assert answer.confirmed.coverage.mean * answer.cells == pytest.approx(again)
        tried = [place for place in answer.places if place.rollouts == RUNS and (place.is_depot or not depot)]
        best = max((getattr(place, figure) for place in tried), key=lambda one: one.mean)
        assert getattr(answer.places[answer.best], figure) == best
        assert world is valued or not any("value" in one for one in (found, *found["candidates"]))
    assert found["value"] == answer.confirmed.value.to_json()
    assert answer.gain is None or found["gain"] == answer.gain.to_json()
    assert "% of the value covered on average" in starts_summary(answer) and not answer.notes


ISLANDS = np.zeros((3, 9))
ISLANDS[:, 3], ISLANDS[:, 6] = 0.5, 0.5


def test_free_starts_are_spread_over_sites() -> None:
    answer = mrac.starts(World.create(ISLANDS), 3, rollouts=32)
    assert sorted(col // 3 for _, col in answer.starts.tolist()) == [0, 1, 2]
    assert answer.chosen.coverage.mean > 0.75


def test_where_the_team_stands_and_the_best_depot_are_in_the_race_to_the_end() -> None:
    """And the pick is told against where the team stands, on rollouts that had no part in the choice."""
    world = World.create(ISLANDS, starts=[[0, 0], [0, 0], [0, 0]])
    answer = mrac.starts(world, 3, rollouts=96, seed=4, exact="never")
    now, last = answer.places[answer.here], max(place.rollouts for place in answer.places)
    assert now.starts.tolist() == [[0, 0]] * 3 and now.rollouts == last == 96
    assert now.is_depot or any(p.is_depot and not p.now and p.rollouts == last for p in answer.places)
    again = [visited_from(starts, range(96, 192), world, 4) for starts in (answer.starts, now.starts)]
    mine, theirs = (runs.sum(axis=1).mean() / 27 for runs in again)
    assert not answer.stay and answer.gain.mean == pytest.approx(mine - theirs) and answer.gain.ci95[0] > 0
    assert answer.confirmed.coverage.mean == pytest.approx(mine)
    assert " more than from the starts of the input" in starts_summary(answer) and answer.to_json()["gain"]["mean"] > 0
    for said in (starts_summary(answer), next(starts_findings(answer))):
        assert " % " in said and " ± " in said and "95 %" not in said, "% is a share of the cells"
    notes = [note for part in starts_report(answer).parts for note in part.notes]
    assert any(" ±: half the 95 % interval, in brackets its ends;" in note for note in notes)


def test_nothing_worse_is_recommended() -> None:
    """Whoever stands at the best starts that there are is told to stay, and gets his own starts back."""
    best, ask = [[1, 1], [1, 4], [1, 7]], {"candidates": [[0, 0], [2, 0]], "rollouts": 200}
    answer, depot = (mrac.starts(World.create(ISLANDS, starts=best), 3, depot=depot, **ask) for depot in (False, True))
    assert answer.stay and answer.starts.tolist() == best and answer.to_json()["stay"] is True
    assert starts_summary(answer).startswith("Keep the starts of the input: no place found is significantly better; ")
    assert depot.stay and depot.chosen.is_depot and "keep those unless a depot is needed" in starts_summary(depot)
    assert depot.gain.ci95[1] < 0


def test_a_team_that_stands_elsewhere_is_not_compared() -> None:
    parted = World.create([[0.0, 0.2, 0.0, np.nan, 0.0, 0.2, 0.0, 0.0]], starts=[[0, 0]])
    answer = mrac.starts(parted, 1, candidates=[[0, 4], [0, 7]], rollouts=50)
    assert answer.here is None and not answer.stay and answer.gain is None
    assert any("are not compared" in note for note in answer.notes)


# The command.


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def test_scenario_and_command_reproduce_the_best(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    for folder in ("in", "out"):
        (tmp_path / folder).mkdir()
    source, wanted = tmp_path / "in" / "mission.yaml", str(tmp_path / "out" / "best.yaml")
    source.write_text("map: {file: ../world.npz}  # a map\nrobots: {count: 2}\nlevels: 8\n")
    told = ["--depot", "--rollouts", "64", "--seed", "5", "--policy", "per_cell", "--risk", "log", "--exact", "never"]
    found = answer_of(capsys, "starts", str(source), *told, "--scenario-out", wanted)
    program, *words = shlex.split(found["command"])
    assert program == "mrac-jax" and words[-2:] == ["--seed", "6"]
    once, mine = answer_of(capsys, *words)["coverage"]["visited"], found["coverage"]
    assert mine == found["confirmed"]["coverage"]
    assert 0 < abs(mine["mean"] - once["mean"]) < 5 * np.hypot(mine["se"], once["se"])
    chose = next(one for one in found["candidates"] if one["starts"] == found["starts"][:1])
    same = ["--rollouts", str(chose["rollouts"]), "--seed", "5", "--risk", "log", "--exact", "never"]
    for command in ([*words[:-4], *same[:4], *same[-2:]], ["evaluate", wanted, *same]):
        once = answer_of(capsys, *command)
        assert once["coverage"]["visited"]["mean"] == chose["coverage"]["mean"] and once["starts"] == found["starts"]
    written = load_input(wanted)
    assert written.sha256 == WORLD.sha256 and written.team.settings == {"levels": 8, "policy": "per_cell"}
    keys = {"starts", "screen", "one_robot", "coverage", "losses", "behind", "rollouts"}
    assert all(set(one) == keys for one in found["candidates"]) and found["confirmed"]["first_rollout"] == 64


@pytest.mark.parametrize("option", [[], ["--weibull-shape", "2", "--hazard-multiplier", "3"], ["--policy", "mrac"]])
def test_the_scenario_asks_for_what_was_searched(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, option: list[str]
) -> None:
    """Range, home and a shape of wear too, of the input or of an option; another policy leaves its limits behind."""
    source, wanted, few = tmp_path / "s.yaml", str(tmp_path / "best.yaml"), ["--rollouts", "32"]
    team = "{count: 2, range: 20, return_to: home, hazard_multiplier: 2}"
    limits = "policy: per_cell\nrobot_value: 9\nturn: 2\nweibull_shape: 1.5\n"
    source.write_text(f"map: world.npz\nrobots: {team}\n{limits}")
    found = answer_of(capsys, "starts", str(source), *option, *few, "--scenario-out", wanted)
    again = answer_of(capsys, "evaluate", wanted, *few, "--seed", "1")
    place = ";".join(f"{row},{col}" for row, col in found["starts"])
    told = answer_of(capsys, "evaluate", str(source), *option, *few, "--seed", "1", "--starts", place)
    assert again["coverage"] == told["coverage"] and load_input(wanted).pace.turn == 2


def test_a_bare_map_becomes_a_scenario(capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path) -> None:
    wanted = str(tmp_path / "best.yaml")
    found = answer_of(capsys, "starts", world_file, "--robots", "2", "--rollouts", "32", "--scenario-out", wanted)
    scenario = load_input(wanted)
    assert scenario.starts.tolist() == found["starts"] and len(found["starts"]) == found["robots"] == 2
    assert scenario.sha256 == WORLD.sha256


WRONG_CANDIDATES = [
    ("list.csv", "0,0\n2,2", "[2, 2] is an obstacle (1 such of 2)"),
    ("list.csv", "0,0\n6,0", "[6, 0] lies off the map; expected row 0..5 and col 0..7"),
    ("list.csv", "0.5,0", "holds numbers that are not cells"),
    ("mask.npy", np.ones((3, 3)), "has shape (3, 3); expected a mask of the map, (6, 8)"),
    ("mask.npy", np.zeros((6, 8)), "names no cell"),
    ("mask.npy", np.ones((6, 8)), "is an obstacle (7 such of 48)"),
    ("mask.txt", "1,1", "is neither 'border' nor such a file"),
]


@pytest.mark.parametrize(("file", "rows", "said"), WRONG_CANDIDATES)
def test_wrong_candidates_are_told(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, file: str, rows: Any, said: str
) -> None:
    path, out = tmp_path / file, tmp_path / "best.yaml"
    path.write_text(rows) if isinstance(rows, str) else np.save(path, rows)
    err = error_of(capsys, "starts", world_file, "--candidates", str(path), "--scenario-out", str(out))
    assert said in err and not out.exists()


def test_a_list_of_candidates_may_have_a_header(tmp_path: Path) -> None:
    """And other separators, which a note says."""

    def read(text: str) -> tuple[np.ndarray, Sequence[str]]:
        (tmp_path / "doors.csv").write_text(text)
        return read_candidates(tmp_path / "doors.csv")

    assert read("name,col,row\nnorth,1,0\nsouth,2,5\n")[0].tolist() == [[0, 1], [5, 2]]
    assert read("nan,1\n5,2\n")[0].shape == (2, 2)
    with pytest.raises(InputError, match=r"doors\.csv: has the columns x, y; expected row and col"):
        read("x,y\n5,2\n")
    for text in ("name;col;row\nnorth;1;0\nsouth;2;5\n", "0\t1\n5\t2\n", "row col\n0 1\n5 2\n"):
        cells, (note,) = read(text)
        assert cells.tolist() == [[0, 1], [5, 2]] and "columns are read as separated by" in note


def test_starts_that_reach_little_of_the_map_are_told(tmp_path: Path) -> None:
    """Three of its cells are cut off from the one where the robot stands: of a file that is no map, for example."""
    land = np.array([[0.0, np.nan, 0.0, 0.0, 0.0]])
    World.create(land, [[0, 0]]).save(tmp_path / "cut.npz")
    World.create(land, [[0, 2]]).save(tmp_path / "near.npz")
    notes = [load_task(Asked(str(tmp_path / name), Choices())).notes for name in ("cut.npz", "near.npz")]
    said = "1 of 4 free cells can be reached from the starts: obstacles cut 75 % off"
    assert said in notes[0] and not any("can be reached" in note for note in notes[1])


def test_in_python_wrong_arguments_are_told() -> None:
    safe, row, behind = mrac.load(np.zeros((3, 3))), mrac.load(np.zeros((1, 2))), mrac.load([[0.0, np.nan, 0.5]])
    for error, said, ask in (
        (InputError, "candidates coast is neither 'border'", lambda: mrac.starts(WORLD, candidates="coast")),
        (InputError, "no cell on the border of the map is safe", lambda: mrac.starts(World.create([[0.1, 0.2]]))),
        (PlanError, "plan_for is open", lambda: find_starts(WORLD, 1, Settings(plan_for="open_loop"), CHOICES)),
        (
            UsageError,
            r"no polygon, .* or site of its threats .*; use unit='areas'",
            lambda: clear(WORLD_CLEAR, "sources"),
        ),
        (UsageError, "unit='all'; expected 'areas' or 'sources'", lambda: clear(WORLD_CLEAR, "all")),
        (UsageError, "no cell that a robot can reach is dangerous", lambda: clear(safe)),
        (UsageError, "no cell that a robot can reach is dangerous", lambda: clear(behind.with_starts([[0, 0]]))),
        (InputError, "no accessible cell is left", lambda: mrac.threats(row, add=1, starts=[[0, 0], [0, 1]])),
    ):
        with pytest.raises(error, match=said):
            ask()


def clear(world: World, unit: Any = None) -> Clearing:
    return mrac.threats(world, remove=1, unit=unit)


def test_an_interruption_leaves_the_best_so_far() -> None:
    answer = mrac.starts(WORLD, 2, depot=True, rollouts=32, progress=after(1), on_interrupt="return")
    assert answer.partial and answer.confirmed is None and starts_summary(answer).startswith("Interrupted.")
    assert answer.to_json()["partial"] is True and sum(p.coverage is not None for p in answer.places) == 1


# `threats --remove`: gains against the simulator as Python, the gradient against differences, wrong input.

RISKS = np.zeros((6, 9))
RISKS[1:3, 3:7], RISKS[4:, 6:], RISKS[0, 8], RISKS[3, 2], RISKS[5, 0] = 0.2, 0.05, np.nan, np.nan, 0.2
WORLD_CLEAR = World.create(RISKS, starts=[[0, 0], [3, 0]])


@pytest.fixture(scope="module")
def small() -> Clearing:
    return find_clearing(WORLD_CLEAR, WORLD_CLEAR.starts, Settings(), CHOICES, count=2)


@cache
def rolled_out(planned: World, true: World, ids: range) -> np.ndarray:
    """Cells visited, robots lost, value visited on average, planned on one map and hit on the other."""
    robot_value = np.ones(true.threat.size) if true.value is None else true.value.ravel()
    plan = make_plan(planned, WORLD_CLEAR.starts, Settings())
    loop = compile_closed_loop(plan, planned, interpreted=True)
    runs = [SingleRun(loop, hit=LossDraws(true, 3, rollout).hits).play() for rollout in ids]
    return np.mean([[one.visited.sum(), (~one.alive).sum(), one.visited @ robot_value] for one in runs], axis=0)


def test_threats_are_connected_areas_of_one_level() -> None:
    remove, threats, notes = threats_of(WORLD_CLEAR, WORLD_CLEAR.starts, 16)
    assert remove == "areas" and not notes
    assert [(one.name, len(one.cells)) for one in threats] == [("area 0", 6), ("area 1", 8), ("area 2", 1)]
    assert [one.p for one in threats] == pytest.approx([0.05, 0.2, 0.2])
    without = threats[1].cleared(WORLD_CLEAR)
    assert (without.threat[1:3, 3:7] == 0).all() and without.threat[5, 0] == np.float32(0.2)
    assert np.isnan(without.threat[0, 8]) and WORLD_CLEAR.threat[1, 3] > 0


def check_gains(answer: Clearing, world: World) -> None:
    """Cells, robots and value gained, with a new plan and with the old one, on the rollouts of the search."""
    base = rolled_out(world, world, range(RUNS))
    for one in answer.options:
        cleared = one.threat.cleared(world)
        assert one.known is not None and one.unknown.rollouts == RUNS
        start = rolled_out(world, world, range(one.known.rollouts))
        for gain, planned, before in ((one.known, cleared, start), (one.unknown, world, base)):
            after = rolled_out(planned, cleared, range(gain.rollouts))
            found = [gain.cells.mean, -gain.robots.mean, gain.counted.mean]
            assert found == pytest.approx((after - before).tolist(), abs=1e-9)


def test_gains_are_what_the_simulator_as_python_says(small: Clearing) -> None:
    check_gains(small, WORLD_CLEAR)
    first, second = small.turns
    assert len(second.options) == len(first.options) - 1 and first.picked.threat not in small.picks[1:]
    far = range(RUNS, 2 * RUNS)
    after, before = (rolled_out(world, world, far) for world in (small.cleared_world, WORLD_CLEAR))
    assert small.gain.cells.mean == pytest.approx(after[0] - before[0])
    through = [one for one in first.options if one.known is not None and one.known.rollouts == RUNS]
    assert first.picked in through
    assert first.picked.known == max((one.known for one in through), key=lambda gain: gain.cells.mean)


def test_where_cells_are_worth_something_gains_are_in_value() -> None:
    valued = WORLD_CLEAR.with_values(np.where(np.arange(9) >= 5, 12.5, 1.0) * np.ones((6, 1)))
    answer = find_clearing(valued, WORLD_CLEAR.starts, Settings(), CHOICES)
    check_gains(answer, valued)
    through = [one.known.counted.mean for one in answer.options if one.known and one.known.rollouts == RUNS]
    best, found, said = answer.turns[0].picked.known, answer.to_json(), removal_summary(answer)
    assert best.counted.mean == max(through) and answer.unit == "of value" and " of value " in said
    assert found["value_gain"] == answer.gain.value.to_json() and found["threats"][0]["unknown"]["value"]
    assert answer.gain.counted.describe(unit=" of value") in said  # fresh rollouts
    assert best.counted.describe(unit=" of value") not in said


def test_the_gradient_is_that_of_the_closed_form() -> None:
    plan = make_plan(WORLD_CLEAR, WORLD_CLEAR.starts, Settings())
    gradient = coverage_gradient(plan, WORLD_CLEAR)
    assert gradient[3, 2] == 0 and np.isnan(WORLD_CLEAR.threat[3, 2])
    for row, col in [(0, 0), (0, 4), (1, 3), (2, 6), (4, 6), (5, 8), (5, 0)]:
        threats = np.stack([WORLD_CLEAR.threat] * 3)
        threats[:, row, col] += np.arange(3, dtype=np.float32) * np.float32(2.0**-7)
        at = [open_loop_exact(plan, replace(WORLD_CLEAR, threat=threat)).visited for threat in threats]
        slope = (-3 * at[0] + 4 * at[1] - at[2]) * 2.0**6  # of second order, from above: p >= 0
        assert gradient[row, col] == pytest.approx(slope, rel=2e-2, abs=1e-3)
    assert gradient.min() < -1


# The polygons, points and sites of a scenario.


def overlapping(folder: Path) -> str:
    """A field over the middle, a smaller one within it, a point beside both, a field where no robot gets to."""
    ground = np.zeros((6, 9))
    ground[:, 7] = np.nan
    World.create(ground).save(folder / "map.npz", force=True)
    fields(folder / "fields.json", ("wide", 0.2, 2, 1, 6, 4), ("inner", 0.5, 3, 2, 5, 3), ("beyond", 0.4, 8, 0, 9, 6))
    (folder / "points.csv").write_text("x,y,strength\n6.5,5.5,0.3\n")
    (folder / "site.yaml").write_text(
        "map: map.npz\nrobots: {starts: [[0, 0], [5, 0]]}\nthreats:\n- {polygons: fields.json}\n"
        "- {points: points.csv, falloff: {kind: disc, radius: 0.6}}\n"
    )
    return str(folder / "site.yaml")


def test_sources_are_cleared_one_by_one_and_what_overlaps_stays(tmp_path: Path) -> None:
    world = mrac.load(overlapping(tmp_path))
    answer = mrac.threats(world, unit="sources", rollouts=RUNS, seed=3, engine="numba", remove=3)
    names = ["wide", "inner", "line 2 of points.csv"]
    assert [one.threat.name for one in answer.options] == names and "beyond" in world.sources.names  # type: ignore[union-attr]
    assert [one.threat.p for one in answer.options] == pytest.approx([0.2, 0.5, 0.3])
    assert " the other one (" in answer.turns[1].certainty("better to remove")
    wide = answer.options[0].threat
    assert len(wide.cells) == 12 and wide.cleared(world).threat[3, 3] == np.float32(0.5)
    assert answer.options[1].threat.cleared(world).threat[3, 3] == np.float32(0.2)
    assert sorted(threat.name for threat in answer.picks) == sorted(names)
    reached = answer.cleared_world.threat[world.accessible(answer.starts)]
    assert (reached == 0).all() and (answer.cleared_world.threat[:, 8] == np.float32(0.4)).all()
    assert any("1 threat of the scenario" in note for note in answer.notes)
    gains = by_cell(answer.options, world.shape, lambda one: one.known)
    assert gains[3, 3] == max(one.known.cells.mean for one in answer.options[:2])  # type: ignore[union-attr]


def test_sources_are_the_default_where_there_are_several(tmp_path: Path) -> None:
    world = mrac.load(overlapping(tmp_path))
    chosen = {remove: threats_of(world, world.starts, 16, remove) for remove in (None, "sources", "areas")}
    assert chosen[None][0] == "sources" and chosen["areas"][0] == "areas"
    assert [one.name for one in chosen["areas"][1]] == ["area 0", "area 1", "area 2"]
    hidden = World.create(np.where(np.isnan(world.threat), np.nan, world.threat / 2), world.starts)
    for without in (hidden, replace(world, threat=hidden.threat)):
        assert threats_of(without, world.starts, 16)[0] == "areas"


# The command.


@pytest.fixture
def clear_file(tmp_path: Path) -> str:
    WORLD_CLEAR.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def test_the_command_says_gains_as_json(capsys: pytest.CaptureFixture[str], clear_file: str, small: Clearing) -> None:
    found = answer_of(capsys, "threats", clear_file, *f"--remove 2 --rollouts {RUNS} --seed 3 --exact never".split())
    assert found == json.loads(json.dumps(small.to_json()))
    assert found["pick"] == [threat.name for threat in small.picks] and found["gain"]["first_rollout"] == RUNS
    keys = {"name", "cells", "p", "screen", "hits", "known", "unknown", "behind"}
    assert all(set(one) == keys and one["unknown"]["ci95"] for one in found["threats"])
    assert found["threats"][1]["cells"] == [9 * row + col for row in (1, 2) for col in range(3, 7)]


WRONG_OPTIONS = {
    "starts --candidates nowhere.csv": "nowhere.csv",
    "starts --plan-for open_loop": "Unknown option: --plan-for",
    "starts --scenario-out best.json": "does not end in .yaml",
    "starts --rollouts 4294967296": "expected at most 2147483648",
    "starts --robot-value 5": "--robot-value 5 with --policy mrac",
    "threats --remove 0": "--remove 0; expected a whole number of threats, 1 to 3",
    "threats --remove 4": "--remove 4; expected a whole number of threats, 1 to 3",
    "threats --remove --unit all": "--unit 'all'; expected areas or sources",
    "threats --remove --unit sources": "lies where a robot can get; use --unit areas",
    "threats --add 0": "--add 0; expected a whole number of threats, 1 to 50",
    "threats --add 51": "--add 51; expected a whole number of threats, 1 to 50",
    "threats --add --p 0": "--p 0; expected a chance, 1e-6 or more and below 1",
    "threats --add --p 1": "--p 1; expected a chance, 1e-6 or more and below 1",
    "threats --add --p 1e-60": "--p 1e-60; expected a chance, 1e-6 or more and below 1",
}


@pytest.mark.parametrize("words", WRONG_OPTIONS)
def test_bad_options_are_told(capsys: pytest.CaptureFixture[str], clear_file: str, tmp_path: Path, words: str) -> None:
    command, *options = words.split()
    err = error_of(capsys, command, clear_file, *options, "--out", str(tmp_path / "out"))
    assert WRONG_OPTIONS[words] in err and not (tmp_path / "out").exists()


def test_an_interruption_leaves_the_picks_so_far() -> None:
    how = {"rollouts": RUNS, "exact": "never", "progress": after(6), "on_interrupt": "return"}
    answer = mrac.threats(WORLD_CLEAR, remove=3, **how)
    assert answer.partial and len(answer.picks) == 1 and answer.gain is answer.to_json()["gain"] is None
    assert removal_summary(answer).startswith("Interrupted.")


# `threats --add`: the worst places against brute force, `clear` as its way back, hidden truths, wrong input.

P, RUNS_ATTACK = 0.4, 64


def small_world(seed: int, height: int, width: int) -> World:
    """Few obstacles, some danger; one robot, whose coverage is a sum of products."""
    draw = np.random.default_rng(seed)
    threat = draw.choice([0.0, 0.0, 0.0, 0.1, np.nan], size=(height, width))
    threat[0, 0] = threat[0, 1] = 0.0
    return World.create(threat, starts=[[0, 0]])


def covered(path: np.ndarray, threat: np.ndarray) -> float:
    """Cells that one robot visits on average along a path: each with the chance that it gets so far."""
    alive, seen, total = 1.0, set[int](), 0.0
    for number, cell in enumerate(path.tolist()):
        total += alive * (cell not in seen)
        seen.add(cell)
        if number == 0 or cell != path[number - 1]:
            alive *= 1.0 - float(threat.flat[cell])
    return total


def brute_force(world: World, count: int) -> tuple[float, float]:
    """What the worst `count` cells leave to a robot that plans anew, and to one that keeps to its path."""
    path, worst = mrac.plan(world).robots[0].path, [np.inf, np.inf]
    free = [int(cell) for cell in np.flatnonzero(world.accessible(world.starts)) if cell != 0]
    for cells in combinations(free, count):
        threat = world.threat.copy()
        threat.flat[list(cells)] = 1.0 - (1.0 - threat.flat[list(cells)].astype(float)) * (1.0 - P)
        anew = mrac.plan(World.create(threat, starts=[[0, 0]])).robots[0].path
        for kind, way in enumerate((anew, path)):
            worst[kind] = min(worst[kind], covered(way, threat))
    return worst[0], worst[1]


def left(answer: Attack) -> tuple[float, float]:
    """What the places that were found leave to both robots."""
    known, path = answer.known_world, mrac.plan(answer.world).robots[0].path
    return covered(mrac.plan(known).robots[0].path, known.threat), covered(path, answer.hidden_world.threat)


@pytest.mark.parametrize(("seed", "height", "width", "count"), [(0, 6, 6, 1), (1, 6, 6, 1), (2, 3, 5, 2), (3, 3, 5, 2)])
def test_the_worst_places_are_those_of_brute_force(seed: int, height: int, width: int, count: int) -> None:
    world = small_world(seed, height, width)
    answer, best = mrac.threats(world, add=count, p=P), brute_force(world, count)
    assert left(answer) == pytest.approx(best, abs=1e-6)
    base = covered(mrac.plan(world).robots[0].path, world.threat)
    for placed, kind, leaves in ((answer.known, "known", best[0]), (answer.hidden, "hidden", best[1])):
        gain = getattr(placed, kind)
        assert gain.rollouts == 0 and gain.cells.mean == pytest.approx(base - leaves, abs=1e-6)
    assert answer.engine == "" and answer.known.hidden.cells.mean <= answer.hidden.hidden.cells.mean + 1e-9


@pytest.mark.slow
def test_two_threats_on_6x6_are_mostly_those_of_brute_force() -> None:
    """Two that cost little alone may cost a robot most that plans anew: greedy with exchange can miss them."""
    shares = []
    for seed in range(10, 20):
        world = small_world(seed, 6, 6)
        base = covered(mrac.plan(world).robots[0].path, world.threat)
        found, worst = left(mrac.threats(world, add=2, p=P)), brute_force(world, 2)
        shares.append([(base - one) / (base - other) for one, other in zip(found, worst, strict=True)])
    known, hidden = np.transpose(shares)
    assert hidden == pytest.approx(np.ones(10), abs=1e-6)
    assert known.max() <= 1 + 1e-6 and np.sum(known > 1 - 1e-6) >= 8


@pytest.fixture(scope="module")
def attacked() -> Attack:
    world = World.create(np.where(np.add.outer(np.arange(5), np.arange(6)) % 4 == 3, 0.1, 0.0), starts=[[0, 0], [4, 0]])
    return mrac.threats(world, add=2, p=P, rollouts=RUNS_ATTACK, seed=3, engine="numba", exact="never")


def test_clear_gives_back_what_was_placed(attacked: Attack) -> None:
    for world, placed in ((attacked.known_world, attacked.known), (attacked.hidden_world, attacked.hidden)):
        assert np.count_nonzero(world.threat != attacked.world.threat) == 2
        back = mrac.threats(world, remove=2, rollouts=16, exact="never")
        assert sorted(one.name for one in back.picks) == sorted(one.name for one in placed.threats)
        assert np.array_equal(back.cleared_world.threat, attacked.world.threat)
        cells = {int(one.cells[0]) for one in placed.threats}
        assert {int(one.threat.cells[0]) for one in back.options} == cells


def test_hidden_is_what_robots_meet_who_believe_the_old_map(attacked: Attack) -> None:
    """A hidden truth (docs/unknown.md), on the very rollouts that were compared."""
    told, true = attacked.world, (attacked.known_world, attacked.hidden_world)
    worlds = (told, *map(told.with_true_map, true))
    runs = [make_singles(one, mrac.plan(one), attacked.choices)(RUNS_ATTACK, RUNS_ATTACK) for one in worlds]
    for gain, other in zip((attacked.known.hidden, attacked.hidden.hidden), runs[1:], strict=True):
        assert gain.rollouts == RUNS_ATTACK
        assert gain.cells.mean == pytest.approx(np.mean(runs[0].visited.astype(float) - other.visited))
        assert gain.robots.mean == pytest.approx(np.mean(runs[0].alive.astype(float) - other.alive))


def test_what_a_scenario_says_of_combining_is_kept(tmp_path: Path) -> None:
    """The larger chance counts where it says so; the scenario's own threats can be cleared as before."""
    World.create(np.where(np.arange(6) == 3, 0.6, 0.0) * np.ones((2, 1))).save(tmp_path / "map.npz")
    (tmp_path / "points.csv").write_text("x,y,strength\n1.5,1.5,0.3\n")
    (tmp_path / "site.yaml").write_text(
        "map: map.npz\nrobots: {starts: [[0, 0]]}\ncombine: max\n"
        "threats:\n- {points: points.csv, falloff: {kind: disc, radius: 0.6}}\n"
    )
    world = mrac.load(tmp_path / "site.yaml")
    answer = mrac.threats(world, add=1, p=0.4)
    assert answer.known_world.threat.max() == np.float32(0.6)  # nothing is gained where it is worse already
    assert [*answer.known_world.sources.names] == ["line 2 of points.csv", answer.known.threats[0].name]  # type: ignore[union-attr]


def test_of_large_maps_some_cells_are_looked_at_and_fewer_planned_for(monkeypatch: pytest.MonkeyPatch) -> None:
    world = small_world(0, 6, 6)
    best = mrac.threats(world, add=1, p=P)
    monkeypatch.setattr(search, "MOST_PLACES", 12)
    monkeypatch.setattr(search, "TABLES", 0)
    few = mrac.threats(world, add=1, p=P)
    assert len(few.turn.options) == 12 and len(few.turn.simulated) == 8
    assert all(one.screen is not None for one in few.turn.options)
    assert [*few.notes] == ["of 27 cells, the 12 where added threat costs the plan's paths most"]
    assert left(few)[0] == pytest.approx(left(best)[0])  # here they hold the worst


def test_an_interruption_leaves_the_threats_so_far() -> None:
    answer = mrac.threats(small_world(0, 6, 6), add=2, p=P, progress=after(41), on_interrupt="return")
    assert answer.partial and len(answer.known.threats) >= 1 and answer.known.known is None
    assert place_reports.placement_summary(answer).startswith("Interrupted.")
    assert answer.to_json()["known"]["loss"]["known"] is None
    assert not answer.hidden.threats and {*place_reports.attack_report(answer).files} == {"known.npz", "known.yaml"}


def test_an_answer_by_a_rule_of_one_s_own_has_no_scenario(attacked: Attack, tmp_path: Path) -> None:
    """A rule that the process has not compiled: the answer is taken from one by a rule that it has."""
    mine = replace(attacked.settings, policy=replace(RULES["per_cell"], name="mine"))
    answer = replace(attacked, settings=mine)
    names = {path.name for path in answer.save(tmp_path / "out")}
    assert "known.npz" in names and "known.yaml" not in names


def test_the_command_says_it_as_json_and_writes_both_maps(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, attacked: Attack
) -> None:
    attacked.world.save(tmp_path / "map.npz")
    words = f"--add 2 --p {P} --rollouts {RUNS_ATTACK} --seed 3 --exact never --out {tmp_path}/out"
    found = answer_of(capsys, "threats", str(tmp_path / "map.npz"), *words.split())
    assert found == json.loads(json.dumps(attacked.to_json()))
    assert found["known"]["cells"] == [list(divmod(int(one.cells[0]), 6)) for one in attacked.known.threats]
    assert found["known"]["loss"]["known"]["mean"] == attacked.known.known.cells.mean
    for name, world in (("known", attacked.known_world), ("hidden", attacked.hidden_world)):
        assert np.array_equal(mrac.load(tmp_path / "out" / f"{name}.npz").threat, world.threat)
    team = mrac.load(tmp_path / "out" / "known.yaml")
    assert team.starts.tolist() == attacked.starts.tolist() and team.sha256 == attacked.known_world.sha256
