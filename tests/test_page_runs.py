"""The runs that a page plays: packed as they were, picked as `record` picks, and unfolded by its script."""

from __future__ import annotations

import base64
import re
import zlib
from typing import Any

import numpy as np
import pytest
import quickjs
from conftest import FOLDER
from page_reader import check_page_is_sound

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.layers import nominal, picked
from analysis.evaluation.report import report
from analysis.page.document import asset
from analysis.page.paths import Run, pack, packed_runs
from analysis.recording.frames import make_frames
from analysis.report.html import page_of
from analysis.sampling import RolloutChoices, make_engine_for
from planner.mrac.make_plan import make_plan
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

COLS = 23


@pytest.fixture(scope="module")
def answer() -> Evaluation:
    world = load_world_file(FOLDER / "contiguous-14x23-1000.npz")
    return evaluate(world, make_plan(world, place_starts(world, 3)[0]), RolloutChoices(rollouts=60))


@pytest.fixture(scope="module")
def packed(answer: Evaluation) -> dict[str, Any]:
    """What the page's script is given to play."""
    reader = check_page_is_sound(page_of(report(answer), "mrac-jax evaluate", {}, ()))
    return next(found for found in reader.data() if "runs" in found)


def moves_of(text: str) -> bytes:
    """The codes of a robot's moves, a byte each."""
    return zlib.decompress(base64.b64decode(text))


def unpacked(run: dict[str, Any], cols: int) -> np.ndarray:
    """Cells `[T, K]` of a packed run."""
    ways = []
    for start, text in zip(run["starts"], run["moves"], strict=True):
        codes = np.frombuffer(moves_of(text), dtype=np.uint8)
        steps = np.array([0, -cols, cols, -1, 1])[np.pad(codes, (0, run["time"] - len(codes)))]
        ways.append(start + np.append(0, np.cumsum(steps)))
    return np.stack(ways, axis=1)


def test_a_page_holds_the_plan_and_the_rollouts_that_record_would_pick(answer: Evaluation, packed: dict) -> None:
    plan, *rolled = packed["runs"]
    assert packed["shape"] == [14, COLS] and packed["accessible"] == answer.tally.accessible
    cells = unpacked(plan, COLS)
    for number, robot in enumerate(answer.plan.robots):
        assert np.array_equal(cells[: len(robot.path), number], robot.path)
    engine = make_engine_for(answer.world, answer.plan, answer.choices)
    _, ids, count = picked(answer.world, answer.plan, answer.choices, answer.tally.rollouts)
    assert count == 60 and [run["name"].split(",")[0] for run in rolled] == ["median", "worst", "best"]
    results = engine.results(0, count)
    order = np.sort(results.visited)
    assert results.visited[ids].tolist() == [order[29], order[0], order[-1]]
    for run, trace in zip(rolled, engine.traces(ids), strict=True):
        assert np.array_equal(unpacked(run, COLS), trace.cells)
        frames = make_frames(trace)
        assert run["lost"] == [-1 if alive.all() else int(np.argmin(alive)) for alive in frames.alive.T]


def test_where_nothing_can_happen_the_plan_alone_is_played() -> None:
    world = World.create(np.zeros((1, 4)))
    answer = evaluate(world, make_plan(world, [[0, 0]]), RolloutChoices(rollouts=10))
    reader = check_page_is_sound(page_of(report(answer), "mrac-jax evaluate", {}, ()))
    runs = next(found for found in reader.data() if "runs" in found)["runs"]
    assert [(run["name"], run["time"], run["lost"]) for run in runs] == [("plan", 3, [-1])]


def test_runs_that_have_no_room_are_left_out(answer: Evaluation, monkeypatch: pytest.MonkeyPatch) -> None:
    run, free = nominal(answer.plan), answer.world.free
    room = sum(map(len, pack(run, COLS)["moves"]))
    monkeypatch.setattr("analysis.page.paths.RUNS_MOST_LETTERS", room)
    assert packed_runs([run, run], free) == packed_runs([run], free) != {}
    monkeypatch.setattr("analysis.page.paths.RUNS_MOST_LETTERS", room - 1)
    assert packed_runs([run], free) == {}
    with pytest.raises(ValueError, match="from cell to cell"):
        pack(Run("jumps", np.array([[0], [2]], dtype=np.int32), np.array([-1])), 5)


def test_the_script_unfolds_a_run_as_the_recording_does(answer: Evaluation, packed: dict) -> None:
    """Who covers which cell when, and every robot's way, beside `make_frames`, which shares nothing with the script."""
    tell = quickjs.Function(
        "tell",
        asset("replay.js")
        + """
      function tell(moves, run, shape) {
        const replay = unfold(moves, run.starts, run.lost, run.time, ...shape), half = run.time >> 1;
        return { when: [...replay.when], who: [...replay.who], covered: upTo(replay.steps, half),
          left: replay.robots.filter((robot) => !isLost(robot, half)).length,
          at: replay.robots.map((robot) => cellAt(robot, half)),
          trails: replay.robots.map((robot) => trail(robot, half, shape[1])) };
      }""",
    )
    found = [tell([list(moves_of(text)) for text in run["moves"]], run, packed["shape"]) for run in packed["runs"][1:]]
    engine = make_engine_for(answer.world, answer.plan, answer.choices)
    for told, trace in zip(
        found, engine.traces(picked(answer.world, answer.plan, answer.choices, answer.tally.rollouts)[1]), strict=True
    ):
        frames, half = make_frames(trace), trace.time // 2
        assert told["when"] == frames.visited_at.tolist() and told["who"] == frames.visited_by.tolist()
        assert told["covered"] == frames.visited[half] and told["left"] == frames.alive_count[half]
        assert told["at"] == trace.cells[half].tolist()
        for letters, way in zip(told["trails"], trace.cells[: half + 1].T, strict=True):
            assert walked(letters) == way[np.append(True, np.diff(way) != 0)].tolist()


def walked(letters: str) -> list[int]:
    """The cells of an SVG path of moves."""
    col, row = map(int, re.findall(r"^M(\d+) (\d+)", letters)[0])
    cells = [row * COLS + col]
    for way, times in re.findall(r"([hv])(-?\d+)", letters):
        step = (1 if way == "h" else COLS) * int(np.sign(int(times)))
        cells += [cells[-1] + step * (number + 1) for number in range(abs(int(times)))]
    return cells
