"""`mrac-jax starts`: candidates, what is simulated against the readable simulator, the scenario, wrong input."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from page_reader import Reader

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.inputs import Asked, load_task
from analysis.sampling import RolloutChoices
from analysis.search.place_reports import starts_findings, starts_headline, starts_report
from analysis.search.start_positions import border, candidate_cells, find_starts, read_candidates, sites_of, spread_out
from planner.errors import InputError, PlanError
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.settings import Choices, Settings
from planner.world.scenario import load_input
from planner.world.world import World

LAKE = np.zeros((6, 8))
LAKE[2:4, 2:4] = np.nan  # no border: the edge cannot be reached from it over obstacles
LAKE[0, 6:], LAKE[1, 7] = np.nan, np.nan
LAKE[4:, 4:] = 0.3
LAKE[2, 5:] = 0.1
WORLD = World.create(LAKE)
RUNS = 24


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
    parted = World.create([[0.0, 0.0, np.nan, 0.0]])
    cells, notes = candidate_cells(parted, [[0, 0], [0, 3]])
    assert cells.tolist() == [[0, 0]] and "1 of 2 candidates" in notes[0]
    narrow = World.create(np.zeros((3, 2)))
    assert len(candidate_cells(narrow, np.eye(3, 2, dtype=bool))[0]) == 2  # booleans are a mask, whatever their shape


def test_sites_are_safe_areas_and_single_dangerous_cells() -> None:
    cells = np.array([[0, 0], [5, 0], [3, 7], [2, 5], [2, 6]])
    sites = [sorted(map(tuple, site.tolist())) for site in sites_of(WORLD, cells)]
    assert sorted(sites) == [[(0, 0), (5, 0)], [(2, 5)], [(2, 6)], [(3, 7)]] or sorted(sites) == [
        [(0, 0), (3, 7), (5, 0)], [(2, 5)], [(2, 6)],
    ]  # fmt: skip
    line = np.array([[0, col] for col in range(9)])
    assert set(map(tuple, spread_out(line)[:3].tolist())) == {(0, 0), (0, 8), (0, 4)}
    assert sorted(spread_out(line, 2).tolist()) == line.tolist()


@pytest.mark.parametrize("depot", [True, False])
def test_where_cells_are_worth_something_it_goes_by_value(depot: bool) -> None:
    value = np.where(np.arange(8) >= 4, 7.5, 1.0) * np.ones((6, 1))
    valued, choices = (
        WORLD.with_values(value, 0.5),
        RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never"),
    )
    given = [[0, 0], [5, 0], [3, 7], [2, 6]]
    answer = find_starts(valued, 2, Settings(), choices, depot=depot, candidates=given)
    worth = np.where(valued.free, value, 0.0).ravel() / value[valued.free].sum()
    for place in answer.places:
        loop = ReferenceLoop(make_plan(WORLD, place.starts, Settings()), WORLD)
        runs = np.array([loop.run(3, rollout).visited for rollout in range(place.rollouts)])
        assert place.value is not None and place.coverage is not None
        assert place.value.mean == pytest.approx((runs @ worth).mean(), abs=1e-9)
        assert place.coverage.mean * answer.cells == pytest.approx(runs.sum(axis=1).mean())
        assert place.value.mean * value[valued.free].sum() <= place.screen * (1 + 5 * place.value.se)
    tried = [place for place in answer.places if place.rollouts == RUNS]
    able = [place for place in tried if place.is_depot or not depot]
    assert answer.places[answer.best].value == max((p.value for p in able if p.value), key=lambda one: one.mean)
    found, fresh = answer.to_json(), answer.confirmed
    assert fresh is not None and fresh.value is not None and found["value"] == fresh.value.to_json()
    assert "% of the value covered on average" in starts_headline(answer) and not answer.notes
    assert answer.gain is None or found["gain"] == answer.gain.to_json()
    plain = find_starts(WORLD, 2, Settings(), choices, depot=depot, candidates=given).to_json()
    assert "value" not in plain and all("value" not in one for one in plain["candidates"])


@pytest.mark.parametrize("depot", [True, False])
def test_what_is_simulated_is_what_the_readable_simulator_says(depot: bool) -> None:
    given = [[0, 0], [5, 0], [3, 7], [2, 6]]
    choices = RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never")
    answer = find_starts(WORLD, 2, Settings(), choices, depot=depot, candidates=given)
    assert answer.starts.shape == (2, 2) and answer.rolled - sum(p.rollouts for p in answer.places) == RUNS * (
        1 + (answer.best != answer.here)
    )
    for place in answer.places:
        loop = ReferenceLoop(make_plan(WORLD, place.starts, Settings()), WORLD)
        mean = np.mean([loop.run(3, rollout).visited.sum() for rollout in range(place.rollouts)])
        assert place.coverage is not None and place.coverage.mean * answer.cells == pytest.approx(mean)
        assert place.coverage.mean * answer.cells <= place.screen + 5 * place.coverage.se * answer.cells
        if depot:
            assert place.now or (place.is_depot and place.starts[0].tolist() in given)
            assert place.now or (place.one_robot is not None and place.one_robot <= place.screen)
    loop = ReferenceLoop(make_plan(WORLD, answer.starts, Settings()), WORLD)
    again = np.mean([loop.run(3, rollout).visited.sum() for rollout in range(RUNS, 2 * RUNS)])
    assert answer.confirmed is not None and answer.confirmed.coverage is not None
    assert answer.confirmed.coverage.mean * answer.cells == pytest.approx(again)
    tried = [place for place in answer.places if place.rollouts == RUNS and (place.is_depot or not depot)]
    best = answer.places[answer.best]
    assert best.coverage == max((place.coverage for place in tried if place.coverage), key=lambda one: one.mean)


def test_free_starts_are_spread_over_sites() -> None:
    walled = np.zeros((3, 9))
    walled[:, 3], walled[:, 6] = 0.5, 0.5
    answer = mrac.starts(World.create(walled), 3, rollouts=32)
    assert sorted(col // 3 for _, col in answer.starts.tolist()) == [0, 1, 2]
    assert answer.chosen.coverage is not None and answer.chosen.coverage.mean > 0.75


ISLANDS = np.zeros((3, 9))
ISLANDS[:, 3], ISLANDS[:, 6] = 0.5, 0.5


def test_where_the_team_stands_and_the_best_depot_are_in_the_race_to_the_end() -> None:
    """And the pick is told against where the team stands, on rollouts that had no part in the choice."""
    world = World.create(ISLANDS, starts=[[0, 0], [0, 0], [0, 0]])
    answer = mrac.starts(world, 3, rollouts=200, seed=4, exact="never")
    now, last = answer.places[answer.here], max(place.rollouts for place in answer.places)  # type: ignore[index]
    assert now.starts.tolist() == [[0, 0]] * 3 and now.rollouts == last == 200
    assert any(place.is_depot and not place.now and place.rollouts == last for place in answer.places) or now.is_depot
    assert not answer.stay and answer.gain is not None and answer.confirmed is not None
    told = {}
    for starts in (answer.starts, now.starts):
        loop = ReferenceLoop(make_plan(world, starts, Settings()), world)
        told[starts.tobytes()] = np.mean([loop.run(4, rollout).visited.sum() for rollout in range(200, 400)]) / 27
    mine, theirs = told[answer.starts.tobytes()], told[now.starts.tobytes()]
    assert answer.gain.mean == pytest.approx(mine - theirs) and answer.gain.ci95[0] > 0
    assert answer.confirmed.coverage.mean == pytest.approx(mine)  # type: ignore[union-attr]
    assert " more than from the starts of the input" in starts_headline(answer) and answer.to_json()["gain"]["mean"] > 0
    for said in (starts_headline(answer), next(starts_findings(answer))):
        assert " % " in said and " ± " in said and "95 %" not in said, "% is a share of the cells"
    assert any(
        " ±: half the 95 % interval, in brackets its ends;" in note
        for part in starts_report(answer).parts
        for note in part.notes
    )


def test_nothing_worse_is_recommended() -> None:
    """Whoever stands at the best starts that there are is told to stay, and gets his own starts back."""
    best = [[1, 1], [1, 4], [1, 7]]
    world = World.create(ISLANDS, starts=best)
    answer = mrac.starts(world, 3, candidates=[[0, 0], [2, 0]], rollouts=200)
    assert answer.stay and answer.starts.tolist() == best and answer.to_json()["stay"] is True
    assert starts_headline(answer).startswith("Stay: nothing found is surely better than the starts of the input: ")
    depot = mrac.starts(world, 3, depot=True, candidates=[[0, 0], [2, 0]], rollouts=200)
    assert depot.stay and depot.chosen.is_depot and "stay, unless it has to be a depot" in starts_headline(depot)
    assert depot.gain is not None and depot.gain.ci95[1] < 0


def test_a_team_that_stands_elsewhere_is_not_compared() -> None:
    parted = World.create([[0.0, 0.2, 0.0, np.nan, 0.0, 0.2, 0.0, 0.0]], starts=[[0, 0]])
    answer = mrac.starts(parted, 1, candidates=[[0, 4], [0, 7]], rollouts=50)
    assert answer.here is None and not answer.stay and answer.gain is None
    assert any("it is not compared" in note for note in answer.notes)


# The command.


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def asked(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    assert run([*words, "--json"]) == 0
    found: dict = json.loads(capsys.readouterr().out)
    return found


def test_scenario_and_command_reproduce_the_best(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    source, wanted = tmp_path / "in" / "mission.yaml", tmp_path / "out" / "best.yaml"
    source.write_text("map: {file: ../world.npz}  # a map\nrobots: {count: 2}\nlevels: 8\n")
    told = ["--depot", "--rollouts", "64", "--seed", "5", "--policy", "per_cell", "--risk", "log", "--exact", "never"]
    found = asked(capsys, "starts", str(source), *told, "--scenario-out", str(wanted))
    program, *words = shlex.split(found["command"])
    assert program == "mrac-jax" and words[-2:] == ["--seed", "6"]
    once = asked(capsys, *words)["coverage"]["visited"]
    mine = found["coverage"]
    assert mine == found["confirmed"]["coverage"] and mine["mean"] != once["mean"]
    assert abs(mine["mean"] - once["mean"]) < 5 * np.hypot(mine["se"], once["se"])
    chose = next(one for one in found["candidates"] if one["starts"] == found["starts"][:1])
    same = ["--rollouts", str(chose["rollouts"]), "--seed", "5", "--risk", "log", "--exact", "never"]
    for command in ([*words[:-4], *same[:4], *same[-2:]], ["evaluate", str(wanted), *same]):
        once = asked(capsys, *command)
        assert once["coverage"]["visited"]["mean"] == chose["coverage"]["mean"] and once["starts"] == found["starts"]
    written = load_input(wanted)
    assert written.sha256 == WORLD.sha256 and written.team.settings == {"levels": 8, "policy": "per_cell"}
    keys = {"starts", "screen", "one_robot", "coverage", "losses", "behind", "rollouts"}
    assert all(set(one) == keys for one in found["candidates"]) and found["confirmed"]["first_rollout"] == 64


@pytest.mark.parametrize("option", [[], ["--wear", "2", "--susceptibility", "3"], ["--policy", "mrac"]])
def test_the_scenario_asks_for_what_was_searched(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, option: list[str]
) -> None:
    """Range, home and a shape of wear too, of the input or of an option; another policy leaves its limits behind."""
    source, wanted = tmp_path / "s.yaml", tmp_path / "best.yaml"
    team = "{count: 2, range: 20, return_to: home, susceptibility: 2}"
    source.write_text(f"map: world.npz\nrobots: {team}\npolicy: per_cell\nworth: 9\nturn: 2\nwear: {{shape: 1.5}}\n")
    found = asked(capsys, "starts", str(source), *option, "--rollouts", "32", "--scenario-out", str(wanted))
    again = asked(capsys, "evaluate", str(wanted), "--rollouts", "32", "--seed", "1")
    place = ",".join(map(str, found["starts"][0])) + ";" + ",".join(map(str, found["starts"][1]))
    told = ["--starts", place, "--rollouts", "32", "--seed", "1"]
    assert again["coverage"] == asked(capsys, "evaluate", str(source), *option, *told)["coverage"]
    assert load_input(wanted).pace.turn == 2


def test_a_bare_map_becomes_a_scenario(capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path) -> None:
    wanted = tmp_path / "best.yaml"
    found = asked(capsys, "starts", world_file, "--robots", "2", "--rollouts", "32", "--scenario-out", str(wanted))
    scenario = load_input(wanted)
    assert scenario.starts is not None and scenario.starts.tolist() == found["starts"]
    assert scenario.sha256 == WORLD.sha256 and len(found["starts"]) == found["robots"] == 2


@pytest.mark.parametrize(
    ("file", "rows", "said"),
    [
        ("list.csv", [[0, 0], [2, 2]], "[2, 2] is an obstacle (1 such of 2)"),
        ("list.csv", [[0, 0], [6, 0]], "[6, 0] lies off the map; expected row 0..5 and col 0..7"),
        ("list.csv", [[0.5, 0]], "holds numbers that are no cells"),
        ("mask.npy", np.ones((3, 3)), "has shape (3, 3); expected a mask of the map, (6, 8)"),
        ("mask.npy", np.zeros((6, 8)), "names no cell"),
        ("mask.npy", np.ones((6, 8)), "is an obstacle (7 such of 48)"),
        ("mask.txt", np.ones((6, 8)), "is neither 'border' nor such a file"),
    ],
)
def test_wrong_candidates_are_told(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, file: str, rows: list, said: str
) -> None:
    path, out = tmp_path / file, tmp_path / "best.yaml"
    if path.suffix == ".npy":
        np.save(path, np.asarray(rows))
    else:
        path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    assert run(["starts", world_file, "--candidates", str(path), "--scenario-out", str(out)]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err and not out.exists()


def test_a_list_of_candidates_may_have_a_header(tmp_path: Path) -> None:
    """And other separators, which a note says."""
    (tmp_path / "doors.csv").write_text("name,col,row\nnorth,1,0\nsouth,2,5\n")
    assert read_candidates(tmp_path / "doors.csv")[0].tolist() == [[0, 1], [5, 2]]
    (tmp_path / "doors.csv").write_text("nan,1\n5,2\n")
    assert read_candidates(tmp_path / "doors.csv")[0].shape == (2, 2)
    (tmp_path / "doors.csv").write_text("x,y\n5,2\n")
    with pytest.raises(InputError, match=r"doors\.csv: has the columns x, y; expected row and col"):
        read_candidates(tmp_path / "doors.csv")
    for text in ("name;col;row\nnorth;1;0\nsouth;2;5\n", "0\t1\n5\t2\n", "row col\n0 1\n5 2\n"):
        (tmp_path / "doors.csv").write_text(text)
        cells, (note,) = read_candidates(tmp_path / "doors.csv")
        assert cells.tolist() == [[0, 1], [5, 2]] and "columns are read as separated by" in note


def test_starts_that_reach_little_of_the_map_are_told(tmp_path: Path) -> None:
    """Three of its cells are cut off from the one where the robot stands: of a file that is no map, for example."""
    land = np.array([[0.0, np.nan, 0.0, 0.0, 0.0]])
    World.create(land, [[0, 0]]).save(tmp_path / "cut.npz")
    World.create(land, [[0, 2]]).save(tmp_path / "near.npz")
    notes = [load_task(Asked(str(tmp_path / name), Choices())).notes for name in ("cut.npz", "near.npz")]
    said = "1 of 4 free cells can be reached from the starts: obstacles cut 75 % off"
    assert said in notes[0] and not any("can be reached" in note for note in notes[1])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robots", "0"], "--robots 0; expected a whole number, 1 to 1024"),
        (["--candidates", "nowhere.csv"], "nowhere.csv"),
        (["--plan-for", "open"], "Unknown option: --plan-for"),
        (["--scenario-out", "best.json"], "does not end in .yaml"),
        (["--rollouts", "4294967296"], "expected at most 2147483648"),
        (["--worth", "5"], "worth"),
    ],
)
def test_bad_options_are_told(capsys: pytest.CaptureFixture[str], world_file: str, words: list[str], said: str) -> None:
    assert run(["starts", world_file, *words]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err


def test_in_python_wrong_arguments_are_told() -> None:
    with pytest.raises(InputError, match="candidates='coast'"):
        mrac.starts(WORLD, candidates="coast")
    with pytest.raises(InputError, match="no cell on the border of the map is safe"):
        mrac.starts(World.create([[0.1, 0.2]]))
    with pytest.raises(PlanError, match="plan_for is open"):
        find_starts(WORLD, 1, Settings(plan_for="open"), RolloutChoices())


def test_an_interruption_leaves_the_best_so_far() -> None:
    def stop(done: int, total: int, seconds: float) -> None:
        raise KeyboardInterrupt

    answer = mrac.starts(WORLD, 2, depot=True, rollouts=32, progress=stop, on_interrupt="return")
    assert answer.partial and answer.confirmed is None and starts_headline(answer).startswith("Interrupted.")
    assert answer.to_json()["partial"] is True and sum(p.coverage is not None for p in answer.places) == 1


def test_the_answer_prints_and_saves_itself(tmp_path: Path) -> None:
    for depot in (True, False):
        answer = mrac.starts(WORLD, 2, depot=depot, rollouts=32)
        files = {file.name for file in answer.save(tmp_path / str(depot))}
        assert files == {"index.html", "starts.png", "starts.txt", "starts.json", "plan.json"}
        page = Reader((tmp_path / str(depot) / "index.html").read_text()).text
        assert starts_headline(answer) in page and all(said in page for said in starts_findings(answer))
        assert 2 <= len(repr(answer).splitlines()) <= 24
        assert (answer.world_with_starts.starts == answer.starts).all()
