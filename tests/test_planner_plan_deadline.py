"""A plan that ends the mission at a step: its file says so, and all that is made of it keeps to it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER
from plan_files import load_plan
from validate import validate

from analysis.cli.app import run
from analysis.comparison import compare, make_side
from analysis.evaluation.evaluate import evaluate
from analysis.recording.contents import read_rollouts
from analysis.recording.log_reader import open_log
from analysis.sampling import RolloutChoices
from analysis.sweeps.results import outcomes_of, select
from analysis.sweeps.store import Store
from planner.errors import PlanError, UsageError
from planner.mrac.make_plan import confirm_plan, make_plan
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.tally import Outcome
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
ENDS = 30


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(Path(WORLD))


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
    assert run(["plan", WORLD, "--robots", "3", "--deadline", str(ENDS), "--out", str(made)]) == 0
    assert f"The mission ends at step {ENDS}" in capsys.readouterr().out
    assert run(["record", WORLD, "--plan", str(made), "--ids", "3", "--out", str(log), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["rollouts"]
    assert (row["time"], row["outcome"]) == (ENDS, "deadline")
    assert run(["inspect", str(log), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["rollouts"]
    assert told["outcome"] == "deadline" and f"rollout 3 ends: deadline at step {ENDS}" in told["text"]
    assert json.loads(open_log(log).attachment("tally.json"))["outcomes"]["deadline"] == 1
    assert next(read_rollouts(log)).trace.outcome is Outcome.STEP_LIMIT
    assert run(["replay", str(log)]) == 0
    capsys.readouterr()
    assert run(["export", WORLD, "--plan", str(made), "--out", str(out)]) == 0
    longest = max(len(robot["path"]) for robot in json.loads(made.read_text())["robots"])
    assert longest <= ENDS + 1
    assert len(out.read_text().splitlines()) <= 3 * (ENDS + 2)


def test_a_sweep_keeps_to_the_deadline_of_its_plan(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made, spec = tmp_path / "go.json", tmp_path / "sweep.yaml"
    assert run(["plan", WORLD, "--robots", "3", "--deadline", str(ENDS), "--out", str(made)]) == 0
    spec.write_text(json.dumps({"base": {"input": WORLD, "plan": str(made)}, "rollouts": 200}))
    capsys.readouterr()
    assert run(["sweep", str(spec), "--store", str(tmp_path / "s.db"), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["settings"]
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
