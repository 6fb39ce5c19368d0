"""The command line: answers, JSON, files, errors, tables on narrow consoles, help."""

import io
import json
import re
import shlex
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, load_fixture
from helpers import answer_of, error_of, interrupt_rollouts, load_plan, run_python
from page_reader import refused
from PIL import Image
from rich.table import Table
from rich.text import Text

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.cli.options import parse_whole
from analysis.evaluation.evaluate import evaluate, too_few, until_enough
from analysis.evaluation.outputs.over_time import Deadline
from analysis.sampling import PRECISION, RolloutChoices, how_much, make_roll_out
from analysis.statistics.estimates import looks
from analysis.utils.notes import say
from analysis.utils.tables import FittedTable, SafeConsole, as_text, make_table
from planner.errors import PER_VISIT, InputError, visible
from planner.settings import SETTINGS
from planner.world.map_files import FORMATS
from planner.world.world import World, load_world_file

# The command line as a user meets it: answers, JSON, files, and one clear line for everything that is wrong.

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")


def answer(capsys: pytest.CaptureFixture[str], *words: str) -> dict:
    return answer_of(capsys, "evaluate", *words, *{"--no-advice"} - {*words})


def test_open_loop_answer_is_the_closed_form(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, WORLD, "--robots", "8", "--loop", "open", "--rollouts", "20000")
    assert (found["loop"], found["robots"], found["rollouts"]) == ("open", 8, 20000)
    known = load_fixture("contiguous-14x23-1000-k8").answers
    assert found["cells"] == known["cells"]
    assert found["starts"] == known["starts"]
    for meaning in ("visited", "survived"):
        exact = found["exact"]["open_loop"][meaning]
        assert exact == pytest.approx(known["open_loop_exact"][meaning], abs=1e-6)
        sampled = found["coverage"][meaning]
        assert abs(sampled["mean"] - exact / known["cells"]["accessible"]) <= 5 * sampled["se"]
        assert sampled["quantiles"].keys() == {"0.05", "0.5", "0.95"}
        best = exact / known["cells"]["accessible"]
        assert found["best"][meaning] == {"mean": pytest.approx(best), "se": 0.0, "ci95": [pytest.approx(best)] * 2}
    assert found["bounds"]["theorem3"]["visited"] == pytest.approx(known["theorem3"]["visited"], abs=1e-6)
    assert sum(found["outcomes"].values()) == 20000


def test_closed_loop_is_the_default_and_differs_from_the_open(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, WORLD, "--robots", "8", "--rollouts", "8192", "--seed", "7")
    assert found["loop"] == "closed"
    mean, se = load_fixture("contiguous-14x23-1000-k8").answers["closed_loop_sampled"]["visited"]
    accessible = found["cells"]["accessible"]
    sampled = found["coverage"]["visited"]
    assert found["best"]["visited"] == {key: sampled[key] for key in ("mean", "se", "ci95")}  # nothing sharper is known
    assert abs(sampled["mean"] * accessible - mean) <= 5 * np.hypot(sampled["se"] * accessible, se)


def test_one_robot_is_the_same_in_both_loops(capsys: pytest.CaptureFixture[str]) -> None:
    both = [
        answer(capsys, WORLD, "--loop", loop, "--rollouts", "1000", "--exact", "never") for loop in ("open", "closed")
    ]
    assert both[0]["robots"] == 1
    assert both[0]["coverage"] == both[1]["coverage"]
    assert both[0]["alive"] == both[1]["alive"]


def test_engines_count_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    words = (WORLD, "--robots", "3", "--loop", "open", "--rollouts", "5000", "--deadline", "60")
    numba, jax = (answer(capsys, *words, "--engine", engine) for engine in ("numba", "jax"))
    for key in ("coverage", "time", "outcomes", "alive", "deadline"):
        assert numba[key] == jax[key], key


def test_precision_stops_when_it_is_reached(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, WORLD, "--robots", "4", "--loop", "open", "--precision", "0.002")
    low, high = found["coverage"]["visited"]["ci95"]
    assert (high - low) / 2 < 0.002
    assert found["rollouts"] in looks()
    # One look earlier it was not precise enough.
    before = answer(capsys, WORLD, "--robots", "4", "--loop", "open", "--rollouts", str(found["rollouts"] // 2))
    low, high = before["coverage"]["visited"]["ci95"]
    assert (high - low) / 2 >= 0.002


def test_without_a_number_a_tenth_of_a_point_is_enough(capsys: pytest.CaptureFixture[str]) -> None:
    """The same ids as a number asks for, so the same counts; Python stops where the command does."""
    found = answer(capsys, WORLD, "--robots", "2", "--loop", "open", "--seconds", "600")
    low, high = found["coverage"]["visited"]["ci95"]
    assert (high - low) / 2 < PRECISION and found["rollouts"] in looks() and "notes" not in found
    counted = answer(capsys, WORLD, "--robots", "2", "--loop", "open", "--rollouts", str(found["rollouts"]))
    assert counted["coverage"] == found["coverage"]
    world = mrac.load(WORLD)
    asked = mrac.evaluate(world, 2, loop="open", seconds=600, band=False, advice=False)
    assert asked.tally.rollouts == found["rollouts"]
    assert (asked.choices.precision, mrac.evaluate(world, 2, rollouts=64).choices.seconds) == (PRECISION, None)
    with pytest.raises(mrac.InputError, match="both rollouts and precision"):
        mrac.evaluate(world, 2, rollouts=64, precision=0.1)


def test_time_ends_a_run_that_is_not_precise_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever number of rollouts stands behind it then, the answer says how sure it is."""
    world = mrac.load(WORLD)
    plan = mrac.plan(world, 2)
    choices = RolloutChoices(**how_much(None, 0.0001, 7.0))
    stages = make_roll_out(world, plan, choices)(replace(choices, rollouts=10**6), None)
    slow = (replace(stage, seconds=2.0 * number) for number, stage in enumerate(stages, 1))
    told: list[int] = []
    seen = list(until_enough(slow, choices, lambda done, total, seconds: told.append(total)))
    assert [stage.seconds for stage in seen] == [2.0, 4.0, 6.0, 8.0]
    last = seen[-1].tally.rollouts
    assert told[0] >= seen[0].tally.rollouts and told[-1] == last
    (note,) = too_few(seen[-1], choices)
    assert re.fullmatch(r"7 s came before .* coverage is ± [0-9.]+ points, requested: ± 0.01; .*", note)
    answer = evaluate(world, plan, replace(choices, precision=None, rollouts=10**9, seconds=1e-6))
    assert answer.tally.rollouts < 10**6 and not answer.partial and "1e-06 s ended after" in answer.notes[0]


def test_deadline_is_exact_where_it_is_known(capsys: pytest.CaptureFixture[str]) -> None:
    for loop in ("open", "closed"):
        found = answer(capsys, WORLD, "--robots", "4", "--loop", loop, "--deadline", "40", "--rollouts", "8192")
        deadline, cells = found["deadline"], found["cells"]["accessible"]
        assert deadline["steps"] == 40
        assert deadline["visited"]["mean"] < found["coverage"]["visited"]["mean"]
        if loop == "open":
            assert deadline["visited"]["mean"] == pytest.approx(deadline["exact"]["open_loop"]["visited"] / cells)
            assert deadline["visited"]["se"] == 0, "what is known is not sampled"


def test_the_deadline_is_said_after_the_headline(capsys: pytest.CaptureFixture[str]) -> None:
    words = ("--robots", "4", "--deadline", "40", "--no-advice", "--exact", "never", "--rollouts", "100")
    found = answer(capsys, WORLD, *words)["deadline"]
    assert run(["evaluate", WORLD, *words]) == 0
    said = " ".join(capsys.readouterr().out.split())
    visited, lost = 100 * found["visited"]["mean"], found["losses"]["mean"]
    assert f". By step 40: {visited:.1f} % visited, {lost:.1f}" in said
    assert " of 4 robots lost on average. " in said and "is a 95 % confidence bound" in said
    assert run(["evaluate", WORLD, *words[:-1], "20"]) == 0
    assert "95 % confidence" not in capsys.readouterr().out, "the summary says nothing of 95 % of runs then"


@pytest.mark.usefixtures("few_lanes")
def test_a_limit_that_cuts_rollouts_off_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, WORLD, "--robots", "3", "--rollouts", "500", "--max-steps", "100")
    cut = found["outcomes"]["step_limit"]
    assert 0 < cut < 500
    assert found["notes"] == [f"{cut} of 500 rollouts were cut off at the step limit: raise --max-steps"]


def test_table_names_both_meanings(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["evaluate", WORLD, "--robots", "8", "--loop", "open", "--rollouts", "4096", "--theory"]) == 0
    out = capsys.readouterr().out
    for word in ("visited", "survived", "chance to visit every cell", "upper bound for the team", "exact"):
        assert word in out
    verdicts = {line.split("C = ")[1].split("  ")[0]: line.split()[-1] for line in out.splitlines() if "C = " in line}
    known = load_fixture("contiguous-14x23-1000-k8").answers
    failing = {
        reading.replace("_", " as a "): value > known["open_loop_exact"]["visited"]
        for reading, value in known["theorem3"]["visited"].items()
    }
    assert {name: verdict == "FAILS" for name, verdict in verdicts.items()} == failing


def test_cell_size_coarsens_a_bare_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    World.create(np.where(np.arange(70).reshape(7, 10) == 34, 0.25, 0.0), cell_size=0.5).save(tmp_path / "fine.npz")
    found = answer(capsys, str(tmp_path / "fine.npz"), "--cell-size", "1", "--rollouts", "64")
    assert found["cells"] == {"total": 15, "free": 15, "accessible": 15, "dangerous": 1}


def test_a_map_without_threats_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    World.create(np.zeros((2, 3))).save(tmp_path / "safe.npz")
    assert run(["evaluate", str(tmp_path / "safe.npz"), "--rollouts", "64", "--json"]) == 0
    assert "no cell is dangerous" in capsys.readouterr().err


def test_out_writes_pictures_plan_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "folder"
    assert run(["evaluate", WORLD, "--robots", "3", "--rollouts", "512", "--no-advice", "--out", str(folder)]) == 0
    names = {path.name for path in folder.iterdir()}
    assert names == {
        "index.html", "world.png", "covered.png", "losses.png", "distribution.png", "over_time.png", "plan.json",
        "evaluation.json", "evaluation.txt",
    }  # fmt: skip
    saved = json.loads((folder / "evaluation.json").read_text())
    assert saved["rollouts"] == 512
    page = (folder / "index.html").read_text()
    assert "evaluate" in page and "--robots 3 --rollouts 512" in page
    assert load_plan(folder / "plan.json", load_world_file(WORLD)).robots[0].legs
    assert str(folder / "world.png") in capsys.readouterr().err


def test_plan_file_round_trip_gives_the_same_answer(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, points = tmp_path / "plan.json", tmp_path / "points.csv"
    assert run(["plan", WORLD, "--robots", "3", "--out", str(file), "--waypoints", str(points)]) == 0
    capsys.readouterr()
    assert points.read_text().startswith("robot,step,x,y,yaw\n0,0,")
    for loop in ("open", "closed"):
        made = answer(capsys, WORLD, "--robots", "3", "--loop", loop, "--rollouts", "4096")
        read = answer(capsys, WORLD, "--plan", str(file), "--loop", loop, "--rollouts", "4096")
        assert made["coverage"] == read["coverage"]
        assert made["bounds"] == read["bounds"]


def test_plan_of_another_planner_runs_open_loop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    World.create([[0.0, 0.2, 0.0]]).save(tmp_path / "world.npz")
    plan = tmp_path / "other.json"
    plan.write_text('{"paths": [[[0, 0], [0, 1]]]}')
    found = answer(capsys, str(tmp_path / "world.npz"), "--plan", str(plan), "--rollouts", "4096")
    assert found["loop"] == "open"
    assert found["exact"]["open_loop"]["visited"] == pytest.approx(2.0)
    assert found["bounds"]["theorem3"]["visited"]["interior_set"] is None
    assert found["bounds"]["eq5"] == [{"printed": None, "with_c00": None}]
    words = (str(tmp_path / "world.npz"), "--plan", str(plan), "--rollouts", "64")
    assert answer(capsys, *words, "--engine", "jax")["engine"] == "jax"
    closed = answer(capsys, *words, "--loop", "closed")  # the robot goes on to the cell that its path leaves out
    assert closed["coverage"]["visited"]["mean"] > 0.9 > closed["exact"]["open_loop"]["visited"] / 3
    assert run(["evaluate", *words, "--loop", "closed"]) == 0
    assert "1 robot visits 93.33 % (exact)" in capsys.readouterr().out


def test_generate_makes_the_paper_s_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "world.npz"
    assert run(["generate", str(file), "--size", "20x30", "--kind", "scattered", "--seed", "4", "--robots", "2"]) == 0
    world = load_world_file(file)
    assert world.shape == (20, 30)
    assert int(np.isnan(world.threat).sum()) == 150
    assert int((world.threat > 0).sum()) == 150
    assert len(world.starts) == 2
    onto = tmp_path / "onto.npz"
    assert run(["generate", str(onto), "--map", str(file), "--ratio", "0.1", "--areas", "3"]) == 0
    assert (load_world_file(onto).threat >= world.threat)[world.free].all()


REFUSED = [line.split(" => ") for line in (FOLDER / "refused_commands.txt").read_text().splitlines()]
"""Command lines, and what is said of each."""
REFUSED += [[f"evaluate WORLD {left}", PER_VISIT] for left in ("--luck step", "--luck=tolerance", "--mode fast")]
REFUSED += [["record WORLD --luck step --out x.mcap", PER_VISIT], ["front WORLD --luck step", PER_VISIT]]


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_wrong_usage_is_one_line_and_status_2(
    words: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, *(WORLD if word == "WORLD" else word for word in words.split()))
    assert line == said if said.startswith("error: ") else said.lower() in line.lower()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("text", ["2000", "2_000", "2e3", "2.0E+3", "+2000"])
def test_whole_numbers_may_be_written_short(text: str) -> None:
    assert parse_whole(text, "--rollouts") == 2000


def test_a_generated_map_is_coarsened(tmp_path: Path) -> None:
    fine, coarse = tmp_path / "fine.npz", tmp_path / "coarse.npz"
    World.create(np.zeros((8, 12)), cell_size=0.5).save(fine)
    assert run(["generate", str(coarse), "--map", str(fine), "--cell-size", "2", "--ratio", "0.5"]) == 0
    made = load_world_file(coarse)
    assert (made.shape, made.cell_size, int((made.threat > 0).sum())) == ((2, 3), 2.0, 3)


def test_threats_on_a_map_keep_its_value_and_refuse_what_they_contradict(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    threat, value = np.zeros((4, 6)), np.arange(24.0).reshape(4, 6)
    World.create(threat, value=value, detect=0.7).save("v.npz")
    assert run(["generate", "out.npz", "--map", "v.npz"]) == 0
    made = load_world_file("out.npz")
    assert made.threat.any() and made.value is not None and made.detect is not None
    assert np.array_equal(made.value, value) and (made.detect == 0.7).all()
    capsys.readouterr()
    np.save("t.npy", threat + 0.1)
    World.create(threat + 0.05).save("v.npz", force=True)
    for keys, named in (
        ("latent_hazard: {kind: consumed, h: 0.5}", "leave `latent_hazard` out"),
        ("moving_threats: [{walk: 0.5, h: 0.2}]", "leave `moving_threats` out"),
        ("phases: [{from: 5, threats: [{raster: t.npy}]}]", "leave `phases` out"),
        ("true_map: t.npy\nsensor_range: {range: 2}", "leave `true_map`, `prior_map` and `sensor_range` out"),
    ):
        Path("s.yaml").write_text(f"map: {{file: v.npz}}\n{keys}\n")
        line = refused(capsys, "generate", "out.npz", "--map", "s.yaml")
        assert "s.yaml: putting random threats on a map requires" in line and named in line
    Path("s.yaml").write_text("map: {file: v.npz}\nrobots: {count: 2, range: 9}\ndeadline: 5\n")
    assert run(["generate", "out.npz", "--map", "s.yaml"]) == 0
    left = "left out, since a world file holds the map alone: robots.count, deadline, range"
    assert left in capsys.readouterr().err.splitlines()


def test_contradictions_of_a_plan_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "plan.json"
    assert run(["plan", WORLD, "--robots", "2", "--out", str(file)]) == 0
    capsys.readouterr()
    other = str(FOLDER / "contiguous-14x23-1001.npz")
    for words, said in (
        ([WORLD, "--robots", "3"], "contradicts the 2 robots"),
        ([WORLD, "--starts", "0,1"], "contradicts the starts"),
        ([WORLD, "--risk", "log"], "--risk log contradicts"),
        ([other], "another map"),
    ):
        assert said in error_of(capsys, "evaluate", *words, "--plan", str(file))
    jump = tmp_path / "jump.json"
    jump.write_text('{"paths": [[[0, 1], [0, 4]]]}')
    assert "`paths[0]` jumps" in error_of(capsys, "evaluate", WORLD, "--plan", str(jump))


def test_a_plan_made_for_other_robots_than_the_scenario_s_is_noted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    World.create([[0.0, 0.1, 0.0], [0.0, 0.2, 0.1]]).save(tmp_path / "w.npz")
    file, scenario = tmp_path / "plan.json", tmp_path / "s.yaml"
    scenario.write_text("map: w.npz\nrobots: {count: 1, hazard_multiplier: 3, return_to: home}\nweibull_shape: 2\n")
    other = "weibull_shape and hazard_multiplier and return_to"
    said = f"{file} was made for another {other} than {scenario} says: its own count"
    for made_for, note in (("w.npz", said), ("s.yaml", "")):
        assert run(["plan", str(tmp_path / made_for), "--robots", "1", "--out", str(file), "--force"]) == 0
        capsys.readouterr()
        assert run(["evaluate", str(scenario), "--plan", str(file), "--rollouts", "16"]) == 0
        err = capsys.readouterr().err
        assert (note in err.splitlines()) if note else "made for another" not in err


def test_tampered_plan_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    threat = [[0.0, 0.0, 0.0, np.nan, 0.0, 0.0, 0.2], [0.0, 0.1, 0.0, np.nan, 0.0, 0.0, 0.2]]
    World.create(threat).save(tmp_path / "w.npz")
    world, file = str(tmp_path / "w.npz"), tmp_path / "plan.json"
    assert run(["plan", world, "--starts", "0,0;0,4", "--out", str(file)]) == 0
    good = json.loads(file.read_text())

    def swap(plan: dict) -> None:
        for area in plan["areas"]:
            area["robot"] = {0: 1, 1: 0, -1: -1}[area["robot"]]

    def greedy(plan: dict) -> None:
        for area in plan["areas"]:
            area["robot"] = 0 if area["robot"] == 1 else area["robot"]

    def wrong_level(plan: dict) -> None:
        plan["areas"][0]["level"] = 1
        for robot in plan["robots"]:
            robot["legs"] = []

    def cut(plan: dict) -> None:
        for robot in plan["robots"]:
            robot["path"], robot["legs"] = robot["path"][:1], []

    def merged(plan: dict) -> None:
        plan["areas"] = [{"level": 0, "robot": -1, "cells": sorted(c for a in plan["areas"] for c in a["cells"])}]
        for robot in plan["robots"]:
            robot["legs"] = []

    for tamper in (swap, greedy, wrong_level, cut, merged):
        plan = json.loads(json.dumps(good))
        tamper(plan)
        file.write_text(json.dumps(plan))
        capsys.readouterr()
        assert run(["evaluate", world, "--plan", str(file), "--rollouts", "64"]) == 2, tamper.__name__
        captured = capsys.readouterr()
        assert captured.out == ""
        assert captured.err.startswith(f"error: {file}: ")
    without_legs = json.loads(json.dumps(good))
    for robot in without_legs["robots"]:
        robot["legs"] = []
    file.write_text(json.dumps(without_legs))
    bounds = answer_of(capsys, "evaluate", world, "--plan", str(file), "--rollouts", "64")["bounds"]
    assert bounds["theorem3"]["visited"]["interior_set"] is not None


def test_outputs_never_replace_the_input_or_each_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = tmp_path / "w.npz"
    World.create([[0.0, 0.1]]).save(world)
    before = world.read_bytes()
    for words in (["--out", str(world)], ["--out", str(tmp_path / "p"), "--waypoints", str(tmp_path / "p")]):
        assert "is an input, or is written twice" in error_of(capsys, "plan", str(world), *words)
    assert run(["plan", str(world), "--out", str(tmp_path)]) == 2
    assert world.read_bytes() == before


READ_AND_WRITTEN = [
    ("plan w.npz --state s.json --out s.json", "s.json"),
    ("plan team-0.yaml --robots 2 --waypoints team.yaml", "team-0.yaml"),
    ("export w.npz --plan p.json --out p.json --to geojson", "p.json"),
    ("export rows.yaml --out field.csv", "field.csv"),
    ("export plan.json --out field.csv", "field.csv"),
    ("studio team-0.yaml --out w.yaml", "w.npz"),
    ("starts team-0.yaml --candidates near.csv --scenario-out team-0.yaml", "team-0.yaml"),
    ("generate w.npz --map team-0.yaml", "w.npz"),
]


@pytest.mark.parametrize(("words", "kept"), READ_AND_WRITTEN)
def test_no_file_that_is_read_is_written(
    words: str, kept: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    World.create([[0.0, 0.1, 0.1]], [[0, 0], [0, 1]]).save("w.npz")
    Path("field.csv").write_text("0,0.1,0.1\n")
    Path("team-0.yaml").write_text("map: w.npz\n")
    Path("rows.yaml").write_text("map: field.csv\n")
    assert run(["plan", "field.csv", "--out", "plan.json"]) == 0
    assert run(["plan", "w.npz", "--out", "p.json"]) == 0
    Path("s.json").write_text("{}")
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    capsys.readouterr()
    assert error_of(capsys, *words.split()).startswith(f"error: {kept} is an input")
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


@pytest.mark.usefixtures("one_picture")
def test_a_folder_keeps_what_was_read_from_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Image.fromarray(np.full((2, 3), 254, dtype=np.uint8)).save("world.png")
    Path("s.yaml").write_text("map: world.png\nthreats: [{generate: {kind: scattered, ratio: 0.5}}]\n")
    World.create([[0.0, 0.1, 0.1]], [[0, 0]]).save("known.npz")
    few = ["--rollouts", "64", "--out", "."]
    before = {name: Path(name).read_bytes() for name in ("world.png", "known.npz")}
    assert run(["threats", "known.npz", "--add", "1", *few]) == 0
    assert run(["evaluate", "s.yaml", "--no-advice", *few]) == 0
    assert Path("world.png").read_bytes() == before["world.png"] != Path("evaluation/world.png").read_bytes()
    assert Path("known.npz").read_bytes() == before["known.npz"] != Path("attack/known.npz").read_bytes()
    attacked = (mrac.load(f"attack/known.{suffix}").threat for suffix in ("yaml", "npz"))
    assert np.array_equal(*attacked), "files that name each other stay together"
    assert run(["plan", "s.yaml", "--out", "plan.json"]) == 0
    named = Path("plan.json").read_bytes()
    assert run(["evaluate", "s.yaml", "--no-advice", "--plan", "plan.json", *few]) == 0
    assert Path("plan.json").read_bytes() == named, "which names its map"
    for again in ([], ["--plan", "here/plan.json"]):
        assert run(["evaluate", "known.npz", "--no-advice", "--rollouts", "64", "--out", "here", *again]) == 0
    assert not Path("here/evaluation").exists(), "the same content replaces nothing"


def test_a_reader_that_goes_away_is_no_error_and_numba_imports_no_jax() -> None:
    script = (
        f"import sys; from analysis.cli.app import run; "
        f"words = ['evaluate', {WORLD!r}, '--rollouts', '64', '--exact', 'never', '--no-advice']; "
        f"sys.exit(run(words) or 3 * ('jax' in sys.modules))"
    )
    command = f"{shlex.join([sys.executable, '-c', script])} | true; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "0", done.stderr


def test_interrupted_in_the_deadline_still_prints(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: object) -> object:
        raise KeyboardInterrupt

    monkeypatch.setattr(Deadline, "measure", interrupted)
    found = answer_of(capsys, "evaluate", WORLD, "--rollouts", "4096", "--deadline", "9", "--no-advice", status=130)
    assert found["partial"] is True
    assert found["rollouts"] == 4096


def test_interrupted_prints_what_was_done(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_rollouts(monkeypatch, 4)
    found = answer_of(capsys, "evaluate", WORLD, "--robots", "3", "--rollouts", "10000000", status=130)
    assert found["partial"] is True
    assert 1024 <= found["rollouts"] < 10_000_000


RENAMED = {
    "clear a.npz --count 2 --remove areas": "threats a.npz --remove 2 --unit areas",
    "clear a.npz --rollouts 9": "threats a.npz --rollouts 9 --remove 1",
    "attack a.npz --count=2 --p 0.3": "threats a.npz --add=2 --p 0.3",
    "replay a.mcap --all": "inspect a.mcap --all --replay",
    "recover a.mcap --out b.mcap": "inspect a.mcap --repair b.mcap",
    "recover a.mcap": "inspect a.mcap --repair a.recovered.mcap",
    "reproduce fig4 --maps 2": "check --paper fig4 --maps 2",
}


@pytest.mark.parametrize("old", RENAMED)
def test_commands_of_release_0_3_run_the_new_ones_after_one_line(
    old: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    seen: list[list[str]] = []
    monkeypatch.setattr("analysis.cli.app.app", lambda words, **how: seen.append(words))
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert run(old.split()) == 0
    assert seen == [RENAMED[old].split()]
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"note: `{old.split()[0]}` is now `{seen[0][0]} --")


@pytest.mark.parametrize("words", ["threats a.npz --remove", "threats --add a.npz", "threats a.npz --add --seed 2"])
def test_a_number_of_threats_is_one_by_default(words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []
    monkeypatch.setattr("analysis.cli.app.app", lambda given, **how: seen.extend(given))
    assert run(words.split()) == 0
    assert re.search(r"--(add|remove) 1\b", " ".join(seen))


def test_help_lists_commands_in_five_groups(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--help"]) == 0
    listed = re.findall(r"^(?:╭─|│) (\w+) ", capsys.readouterr().out, re.MULTILINE)
    assert listed == [
        "Answer", "evaluate", "compare", "front", "size", "studio", "Place", "starts", "threats", "Drive", "plan",
        "export", "drive", "debrief", "Record", "record", "inspect", "Research", "sweep", "results", "check",
        "generate", "Commands",
    ]  # fmt: skip


def test_help_is_quick_to_import() -> None:
    """`--help` loads none of the heavy libraries (measured: under 0.5 s)."""
    script = (
        "import sys; from analysis.cli.app import run; run(['--help']); "
        "heavy = {'jax', 'numba', 'scipy', 'matplotlib', 'numpy'} & set(sys.modules); assert not heavy, heavy"
    )
    assert "evaluate" in run_python(script)


# Every table of every command on consoles of 80, 100 and 120 columns: no figure, interval or name is cut.

WIDTHS = (80, 100, 120)
THREAT = np.zeros((6, 9))
THREAT[1:3, 3:7], THREAT[4:, 6:], THREAT[0, 8] = 0.2, 0.05, np.nan
FEW, TEAM = ["--rollouts", "64"], ["--robots", "3"]
CLOSED, FRONT = ["evaluate", "map.npz", *TEAM, *FEW], ["--robot-values", "12.5", "--risk-caps", "0.25", *FEW]
COMMANDS = {
    "evaluate": [*CLOSED, "--threat-scale", "0.5,2", "--deadline", "40", "--theory"],
    "open loop": [*CLOSED, "--loop", "open", "--theory"], "value": ["evaluate", "valued.yaml", *FEW],
    "in doubt": ["evaluate", "doubtful.yaml", *FEW],
    "size": ["size", "map.npz", "--target", "0.9", "--most", "4", *FEW],
    "size of value": ["size", "valued.yaml", "--target", "0.9", "--most", "4", *FEW],
    "front": ["front", "map.npz", *TEAM, *FRONT],
    "front with a goal": ["front", "valued.yaml", "--target", "0.5", *FRONT],
    "starts": ["starts", "map.npz", *TEAM, *FEW], "starts of value": ["starts", "valued.yaml", "--depot", *FEW],
    "threats to remove": ["threats", "map.npz", "--remove", "1", *TEAM, *FEW],
    "threats to add": ["threats", "map.npz", "--add", "1", *TEAM, *FEW],
    "threats to add on value": ["threats", "valued.yaml", "--add", "2", "--p", "0.4", *FEW],
    "compare": ["compare", "map.npz", *TEAM, "--b.policy", "per_cell", "--b.robot-value", "12.5", *FEW],
    "check": ["check", "map.npz", *TEAM, *FEW],
    "check of many": ["check", "--worlds", "2", "--robots", "1,2,3,4,12", "--size", "6x6", "--processes", "1", *FEW],
    "plan": ["plan", "map.npz", *TEAM], "sweep": ["sweep", "sweep.yaml", "--store", "results.db", "--processes", "1"],
    "results": ["results", "results.db"], "record": ["record", "map.npz", *TEAM, "--out", "run.mcap", "--force"],
    "inspect": ["inspect", "run.mcap"],
}  # fmt: skip
BEFORE = {"results": "sweep", "inspect": "record"}
"""What makes the file that a command reads."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the inputs of the commands above lie."""
    made = tmp_path_factory.mktemp("tables")
    World.create(THREAT).save(made / "map.npz")
    scenario = {"map": "map.npz", "robots": {"count": 3}}
    doubt = {"map_uncertainty": {"spread": {"kind": "lognormal", "sigma": 0.5, "by": "common"}}}
    (made / "valued.yaml").write_text(json.dumps(scenario | {"value": 1234.5, "detect": 0.5}))
    (made / "doubtful.yaml").write_text(json.dumps(scenario | doubt))
    settings = {
        "base": {"input": "map.npz"},
        "rollouts": 64,
        "sweep": {"robots": [1, 3], "policy": ["mrac", "per_cell"]},
    }
    (made / "sweep.yaml").write_text(json.dumps(settings))
    return made


@pytest.mark.parametrize("command", COMMANDS)
def test_no_table_cuts_a_figure(
    command: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each is run once, on 80 columns; its tables are printed again at each width."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("COLUMNS", "80")
    if command in BEFORE:
        assert run(COMMANDS[BEFORE[command]]) == 0
        capsys.readouterr()
    shown: list[FittedTable] = []
    drawn = FittedTable.__rich_console__
    with monkeypatch.context() as kept:
        kept.setattr(FittedTable, "__rich_console__", lambda self, *how: (shown.append(self), drawn(self, *how))[1])
        assert run(COMMANDS[command]) == 0
    said = capsys.readouterr().out
    assert shown and "…" not in said and max(map(len, said.splitlines())) <= 80
    for table in shown:
        for width in WIDTHS:
            check_whole(table, width)


def check_whole(table: FittedTable, width: int) -> None:
    """Every figure stands on one line as it is, unless its column is said to be left out; no line is too long."""
    said = as_text(lambda console: console.print(table), width)
    body, _, note = said.partition("omitted at a width of")
    left_out, words = " ".join(note.split()), set(body.split())
    lines = [" ".join(line.split()) for line in body.splitlines()]
    assert "…" not in said and max(map(len, said.splitlines())) <= width
    for place, column in enumerate(table.columns):
        name = table._named(place)
        if name and name in left_out:
            continue
        assert set(str(column.header).split()) <= words, (name, width)
        for cell in map(str, column.cells):
            whole = any(" ".join(cell.split()) in line for line in lines)
            in_words = column.justify != "right" and set(cell.split()) <= words
            assert whole or in_words, (name, cell, width)


# Text from files and names on the terminal: shown as escapes, whichever way it gets there.

HOSTILE = "a\x1b]0;title\x07b\x9b2Jc\u202etxt\u2066d\x08e\u200bf"
SHOWN = r"a\x1b]0;title\x07b\x9b2Jc\u202etxt\u2066d\x08e\u200bf"


def harmless(text: str) -> bool:
    return all(letter.isprintable() or letter == "\n" for letter in text)


def test_visible_keeps_what_can_be_seen() -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible(visible(HOSTILE)) == SHOWN
    for plain in ("", "Zürich ± 3 %, 地図 🤖", "two\nlines\tand a tab", "\u00a0"):
        assert visible(plain) == plain
    assert visible("two\nlines\u2028\ud800", kept="") == r"two\nlines\u2028\ud800"


def test_notes_and_errors(capsys: pytest.CaptureFixture[str]) -> None:
    say([HOSTILE, "wrote a\nerror: b"])
    assert capsys.readouterr().err == f"{SHOWN}\nwrote a\\nerror: b\n"
    assert SHOWN in str(InputError(HOSTILE, source=HOSTILE, expected=HOSTILE, fix=HOSTILE))
    assert harmless(str(InputError(HOSTILE, source=HOSTILE, expected=HOSTILE, fix=HOSTILE)))


@pytest.mark.parametrize("colours", [True, False])
def test_the_console_shows_escapes_in_lines_tables_and_titles(colours: bool) -> None:
    out = io.StringIO()
    console = SafeConsole(file=out, width=200, force_terminal=colours, color_system="standard" if colours else None)
    table = Table("[red]x", HOSTILE, title=HOSTILE)
    table.add_row(HOSTILE, Text(HOSTILE, style="bold"))
    console.print(HOSTILE, highlight=False)
    console.print(table)
    console.print("[link=https://example.org]x[/link] [/] :smile:", highlight=False)
    said = out.getvalue()
    assert said.count(SHOWN) == 4  # of a Text of its own rich drops some characters, the others are escapes too
    assert "[link=https://example.org]x[/link] [/] :smile:" in said
    assert "[red]x" in said
    if colours:  # the console's own colours, and nothing else
        assert "\x1b[1m" in said
        said = said.replace("\x1b[0m", "")
        said = re.sub(r"\x1b\[[0-9;]*m", "", said)
    assert harmless(said)
    rows = [line for line in said.splitlines() if "│" in line or "┃" in line]
    assert len(rows) == 2
    assert len({len(line) for line in rows}) == 1


def test_the_command_line_shows_escapes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    World.create(np.array([[0.0, 0.25, np.nan]])).save(f"{HOSTILE}.npz")
    Path("keys.yaml").write_text(f'map: x.npz\n"{HOSTILE.encode("unicode_escape").decode()}": 1\n')
    Path("raw.yaml").write_bytes(b"map: x\x1b.npz\n")
    Path("plan.json").write_text(json.dumps({"format": HOSTILE}))
    Path("a.geojson").write_text(json.dumps({"type": HOSTILE}))
    Path("shapes.yaml").write_text(
        f'map: "{HOSTILE.encode("unicode_escape").decode()}.npz"\nthreats: [{{polygons: a.geojson}}]\n'
    )
    name = f"{HOSTILE}.npz"
    wrong = (
        ["evaluate", f"{HOSTILE}.txt"],
        ["evaluate", "keys.yaml"],
        ["evaluate", "raw.yaml"],
        ["evaluate", "shapes.yaml"],
        ["evaluate", name, "--plan", "plan.json"],
        ["evaluate", name, f"--{HOSTILE}"],
        ["evaluate", name, "--robots", HOSTILE],
        [HOSTILE],
    )
    for words in wrong:
        assert run(words) == 2
        said = capsys.readouterr()
        assert said.out == ""
        assert said.err.startswith("error: ")
        assert harmless(said.err), words
    assert run(["plan", name, "--out", f"{HOSTILE}.json", "--waypoints", f"{HOSTILE}.csv"]) == 0
    said = capsys.readouterr()
    assert harmless(said.out + said.err)
    assert f"wrote {SHOWN}.json" in said.err


# `--help` and what is missing: every choice by its words, every format, what a command needs.


def help_of(command: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert run([command, "--help-all"]) == 0
    return re.sub(r"[\s│]+", " ", capsys.readouterr().out)


@pytest.mark.parametrize("command", ["evaluate", "plan", "compare", "starts"])
def test_choices_are_named(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    told, shown = help_of(command, capsys), 0
    for name, setting in SETTINGS.items():
        if setting.kind == "word" and f"--{name.replace('_', '-')} " in told:
            words = (*setting.words, "best") if name == "policy" and command in ("evaluate", "plan") else setting.words
            assert f"[choices: {', '.join(words)}]" in told, name
            shown += 1
    assert shown >= 3


def test_input_names_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    told = help_of("evaluate", capsys)
    named = set(re.findall(r"(?<!\w)\.[a-z]+\b", told[told.index("INPUT Scenario") : told.index("example:NAME")]))
    assert named == set(FORMATS)


def test_a_scenario_is_no_sweep(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "field.yaml").write_text("map: field.npy\n")
    assert "use it in a sweep file with `base: {input: field.yaml}`" in error_of(
        capfd, "sweep", str(tmp_path / "field.yaml")
    )


# Tables on narrow consoles: figures and names stay whole, what is left out is said, the rest stands in blocks.

COLUMNS = ("place", "bound", "visited, %", "from .. to", "robots lost", "from .. to", "rollouts")
ROW = ("the old depot behind the hall", "1234.5", "91.53", "91.501..91.557", "3.21", "3.1987..3.2213", "1,004,096")


def table(*dropped: str) -> FittedTable:
    made = make_table(COLUMNS, "Places", left=("place",), dropped=dropped)
    made.add_row(*ROW)
    return made


def shown(made: FittedTable, width: int) -> str:
    return as_text(lambda console: console.print(made), width)


@pytest.mark.parametrize("width", [40, 44, 60, 80, 100, 120])
@pytest.mark.parametrize("dropped", [(), ("rollouts", "bound", "from .. to")])
def test_no_figure_is_cut_or_wrapped_and_what_is_left_out_is_named(width: int, dropped: tuple[str, ...]) -> None:
    said = shown(table(*dropped), width)
    body, _, note = " ".join(said.split()).partition("omitted at a width of")
    assert "…" not in said and max(map(len, said.splitlines())) <= width
    for name, cell in list(zip(COLUMNS, ROW, strict=True))[1:]:
        assert (cell in said.split()) != (name in note and cell not in body), (name, said)
    assert all(word in body for word in ROW[0].split())


def test_the_least_important_columns_go_first_and_the_last_of_those_of_a_name() -> None:
    wide = shown(table(), 120).splitlines()
    assert len(wide) == 6 and "omitted" not in "".join(wide)
    said = shown(table("rollouts", "from .. to", "bound"), 70)
    gone = "omitted at a width of 70 characters: robots lost from .. to, rollouts; a wider window, --out and --json"
    assert f"{gone} have them" in " ".join(said.split())
    assert ROW[3] in said and ROW[5] not in said and ROW[1] in said


def test_without_columns_to_leave_out_they_stand_in_blocks_that_begin_with_the_name() -> None:
    said = shown(table(), 60)
    assert said.count("place") == said.count("the old depot") > 1
    assert said.count("Places") == 1 and "omitted" not in said
