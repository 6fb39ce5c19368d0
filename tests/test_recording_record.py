"""Recording: what is in the file, that it can be read back, and that the same input gives the same bytes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import SEED, foreign_plan, small_recording, small_task
from rolling import rollout_results

from analysis.recording import contents
from analysis.recording import record as rolling
from analysis.recording.contents import read_outcomes, read_rollouts
from analysis.recording.log_reader import open_log
from analysis.recording.record import OutcomeColumns, Request, parse_picks, record, scenario_text
from analysis.recording.viewers import messages as drawn
from analysis.theory.bounds import all_bounds
from planner.errors import InputError, UsageError
from planner.rollouts.engine import closed_loop_engine
from planner.rollouts.open_loop import compile_plan
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.tally import RolloutResults


def test_rollouts_come_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    world, plan = small_recording(path, ids=(9, 2, 4))
    traces = list(closed_loop_engine(compile_closed_loop(plan, world), SEED, "numba").traces([9, 2, 4]))
    found = list(read_rollouts(path))
    assert [one.trace for one in found] == traces
    for one in found:
        results = run_range(compile_closed_loop(plan, world), SEED, one.trace.rollout, 1, singles=True)[1]
        assert results is not None
        last = (one.visited[-1], one.survived[-1], one.alive[-1], one.trace.time)
        assert last == (results.visited[0], results.survived[0], results.alive[0], results.time[0])
        assert (one.loop, one.seed, one.shape) == ("closed", SEED, world.shape)
        assert one.accessible == world.accessible(plan.starts).sum()
        assert one.trace.cells.dtype == one.trace.events.dtype == np.int32


@pytest.mark.usefixtures("few_lanes", "small_traces")
def test_same_input_same_bytes_whatever_the_engine(tmp_path: Path) -> None:
    choices = {"ids": (), "picks": parse_picks("worst,best,random"), "evaluated": 300, "outcomes": True}
    small_recording(tmp_path / "a.mcap", **choices)
    small_recording(tmp_path / "b.mcap", **choices)
    small_recording(tmp_path / "jax.mcap", **choices, engine="jax")
    first = (tmp_path / "a.mcap").read_bytes()
    assert first == (tmp_path / "b.mcap").read_bytes() == (tmp_path / "jax.mcap").read_bytes()
    assert b"numba" not in first
    assert str(tmp_path).encode() not in first


def test_what_lies_beside_the_messages(tmp_path: Path) -> None:
    path = tmp_path / "r.mcap"
    world, plan = small_recording(path, ids=(), picks=parse_picks("median"), evaluated=100, scenario=b"map: x\n")
    log = open_log(path)
    settings = contents.read_settings(log.attachment("settings.json"), "r")
    assert (settings.seed, settings.evaluated, settings.plan, settings.loop) == (SEED, 100, "made", "closed")
    assert settings.ids == tuple(settings.picks.values())
    stored = contents.read_world(log.attachment("world.npz"), "r")
    assert stored.sha256 == world.sha256
    assert (stored.cell_size, stored.origin) == (world.cell_size, world.origin)
    assert contents.read_plan(log.attachment("plan.json"), stored, "r").to_json() == plan.to_json()
    tally = contents.read_tally(log.attachment("tally.json"), log.attachment("tally-cells.npz"), "r")
    assert tally == run_range(compile_closed_loop(plan, world), SEED, 0, 100)[0]
    bounds = json.loads(log.attachment("bounds.json"))
    assert bounds["ideal_team"] == all_bounds(plan, world).ideal_team
    assert json.loads(log.attachment("layout.json"))
    assert bytes(log.attachment("scenario.yaml")) == b"map: x\n"
    (items,) = (items for name, items in log.metadata if name == "mrac-jax")
    assert (items["format"], items["seed"], items["rows"], items["columns"]) == ("mrac-recording", "5", "6", "9")


def test_every_outcome_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rolling, "BLOCK", 64)
    path = tmp_path / "r.mcap"
    world, plan = small_recording(path, ids=(), picks=parse_picks("best"), evaluated=1000, outcomes=True)
    found = read_outcomes(path)
    truth = run_range(compile_closed_loop(plan, world), SEED, 0, 1000, singles=True)[1]
    assert truth is not None
    assert np.array_equal(found.ids, np.arange(1000))
    for name in ("visited", "survived", "time", "alive", "outcome"):
        assert np.array_equal(getattr(found, name), getattr(truth, name)), name
        assert getattr(found, name).dtype == getattr(truth, name).dtype
    sizes = [len(message.data) for message in open_log(path).messages(["/outcomes"])]
    assert len(sizes) == 16
    (best,) = read_rollouts(path)
    order = np.lexsort((found.ids, found.time, -found.survived, -found.visited))
    assert best.trace.rollout == order[0]


def test_blocks_of_outcomes_are_aligned_however_they_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rolling, "BLOCK", 10)
    results = RolloutResults(7, *(np.arange(26, dtype=np.int32) for _ in range(4)), np.zeros(26, dtype=np.int8))
    seen = []
    for cut in (1, 3, 26):
        columns = OutcomeColumns()
        messages = []
        for start in range(0, 26, cut):
            messages += columns.add(rolling.part_of(results, start, min(start + cut, 26)))
        messages += columns.rest()
        seen.append([rolling.topics.Outcomes.FromString(message.data) for message in messages])
    assert seen[0] == seen[1] == seen[2]
    assert [block.first for block in seen[0]] == [7, 10, 20, 30]
    assert [len(block.visited) for block in seen[0]] == [3, 10, 10, 3]


def test_no_outcomes_unless_asked(tmp_path: Path) -> None:
    small_recording(tmp_path / "r.mcap")
    assert len(read_outcomes(tmp_path / "r.mcap").ids) == 0


def test_ids_alone_are_the_tally(tmp_path: Path) -> None:
    world, plan = small_task()
    done = record(world, plan, Request(ids=(3, 4, 9), seed=SEED), tmp_path / "r.mcap")
    assert done.tally.ids == ((3, 5), (9, 10))
    assert [row.rollout for row in done.rows] == [3, 4, 9]


@pytest.mark.parametrize("foreign", [False, True])
def test_the_open_loop(tmp_path: Path, foreign: bool) -> None:
    world, plan = small_task()
    chosen = foreign_plan(world, plan) if foreign else plan
    request = Request(picks=parse_picks("worst"), evaluated=500, outcomes=True, loop="open", seed=SEED)
    done = record(world, chosen, request, tmp_path / "r.mcap")
    truth = rollout_results(compile_plan(chosen, world), seed=SEED, count=500)
    found = read_outcomes(tmp_path / "r.mcap")
    assert np.array_equal(found.visited, truth.visited)
    (one,) = read_rollouts(tmp_path / "r.mcap")
    assert one.visited[-1] == truth.visited.min()
    assert one.trace.rollout == done.rows[0].rollout
    assert one.loop == "open"


def test_it_says_that_it_writes(tmp_path: Path) -> None:
    world, plan = small_task()
    told: list[str] = []
    record(world, plan, Request(ids=(3, 4), seed=SEED), tmp_path / "r.mcap", doing=told.append)
    assert told == ["writing rollout 1 of 2", "writing rollout 2 of 2", "closing the file"]


def test_an_interruption_before_a_rollout_is_complete_leaves_what_was_there(tmp_path: Path) -> None:
    world, plan = small_task()
    path = tmp_path / "r.mcap"
    path.write_bytes(b"older")

    def interrupt(done: int, total: int, seconds: float) -> None:
        raise KeyboardInterrupt

    request = Request(picks=parse_picks("best"), evaluated=5000, outcomes=True)
    with pytest.raises(KeyboardInterrupt):
        record(world, plan, request, path, progress=interrupt)
    assert path.read_bytes() == b"older"
    assert sorted(one.name for one in tmp_path.iterdir()) == ["r.mcap"]


def interrupt_at(monkeypatch: pytest.MonkeyPatch, rollout: int, message: int) -> None:
    """Ctrl-C at a message of a rollout, by their numbers."""
    make, count = drawn.rollout_messages, iter(range(10**9))

    def messages(*given: Any) -> Any:
        mine = next(count)
        for number, one in enumerate(make(*given)):
            if (mine, number) == (rollout, message):
                raise KeyboardInterrupt
            yield one

    monkeypatch.setattr("analysis.recording.record.rollout_messages", messages)


def test_an_interruption_keeps_the_rollouts_that_are_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world, plan = small_task()
    path, request = tmp_path / "r.mcap", Request(ids=(3, 4, 9), seed=SEED)
    for name in ("r.mcap", "r.interrupted.mcap"):
        with monkeypatch.context() as patched:
            interrupt_at(patched, 1, 40)
            done = record(world, plan, request, path)
        assert (done.partial, done.path, [row.rollout for row in done.rows]) == (True, tmp_path / name, [3])
        assert open_log(done.path).partial == "interrupted"
        assert [one.trace.rollout for one in read_rollouts(done.path)] == [3]
    before = path.read_bytes()
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        interrupt_at(patched, 0, 40)
        record(world, plan, request, path)
    assert path.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["r.interrupted.mcap", "r.mcap"]
    whole = record(world, plan, request, path)
    assert not whole.partial
    assert not open_log(path).partial


def test_a_growing_file_of_an_earlier_run_is_kept(tmp_path: Path) -> None:
    (tmp_path / "r.mcap.partial").write_bytes(b"precious")
    with pytest.raises(UsageError, match="recover it with"):
        small_recording(tmp_path / "r.mcap")
    assert [one.name for one in tmp_path.iterdir()] == ["r.mcap.partial"]
    assert (tmp_path / "r.mcap.partial").read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("request_", "said"),
    [
        (Request(), "nothing to record"),
        (Request(ids=(1,), step_seconds=0.0), "step_seconds=0.0"),
        (Request(ids=(1,), step_seconds=501.0), "step_seconds=501.0"),
        (Request(picks=parse_picks("best")), "picks"),
        (Request(ids=(1,), outcomes=True), "outcomes"),
        (Request(ids=(1,), first_only=True, loop="open"), "first_only=True"),
    ],
)
def test_requests_that_make_no_sense(tmp_path: Path, request_: Request, said: str) -> None:
    world, plan = small_task()
    with pytest.raises(UsageError, match=said):
        record(world, plan, request_, tmp_path / "r.mcap")
    assert list(tmp_path.iterdir()) == []


def test_times_that_ros_cannot_hold_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.record.MOST_SECONDS", 100.0)
    with pytest.raises(UsageError, match="make step_seconds less"):
        small_recording(tmp_path / "r.mcap", step_seconds=400.0)


def test_a_rollout_that_is_not_all_there(tmp_path: Path) -> None:
    from recordings import nth, rewrite

    small_recording(tmp_path / "r.mcap")
    for topic in ("/rollout/step", "/rollout/end", "/rollout/start"):
        rewrite(tmp_path / "r.mcap", tmp_path / "cut.mcap", change=nth(topic, 0, lambda data: None))
        with pytest.raises(InputError, match=r"cut\.mcap"):
            list(read_rollouts(tmp_path / "cut.mcap"))


def test_the_scenario_goes_along_and_no_other_input(tmp_path: Path) -> None:
    assert b"map:" in (scenario_text("example:terrain") or b"")
    assert scenario_text("example:paper") is None
    from importlib.resources import files

    assert scenario_text(str(files("analysis.examples") / "building_map.yaml")) is None


def test_settings_are_checked_value_by_value() -> None:
    good = contents.Settings("closed", "every_visit", 1, (2,), {"best": 2}, 10, False, 1.0, "made", "0.1").to_json()
    assert contents.read_settings(contents.json_bytes(good), "f").ids == (2,)
    for change in (
        {"seed": -1},
        {"seed": True},
        {"seed": 2**64},
        {"ids": [1.5]},
        {"ids": "1"},
        {"loop": "both"},
        {"step_seconds": 1e9},
        {"picks": {"best": "2"}},
        {"version": 3},
        {"version": 0},
        {"version": "2"},
        {"format": "other"},
    ):
        with pytest.raises(InputError, match=r"f \(settings.json\)"):
            contents.read_settings(contents.json_bytes(good | change), "f")
    with pytest.raises(InputError, match="no JSON"):
        contents.read_settings(b"[" * 100_000, "f")


def test_first_visits_alone(tmp_path: Path) -> None:
    world, plan = small_recording(tmp_path / "r.mcap", first_only=True)
    loop = compile_closed_loop(plan, world, first_only=True)
    traces = list(closed_loop_engine(loop, SEED, "numba").traces([3, 4]))
    assert [one.trace for one in read_rollouts(tmp_path / "r.mcap")] == traces
    assert replace(Request(), first_only=True).first_only
