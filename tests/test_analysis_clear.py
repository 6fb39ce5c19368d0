"""`mrac-jax clear`: gains against the readable simulator, the gradient against differences, wrong input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.removal.answer import Clearing
from analysis.removal.search import find_clearing, threats_of
from analysis.removal.table import findings, headline
from analysis.sampling import RolloutChoices
from analysis.theory.exact import open_loop_exact
from mrac_jax.open_loop.gradient import coverage_gradient
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import simulate
from planner.plans.settings import Settings
from planner.threefry import uniform
from planner.worlds.world import World

RISKS = np.zeros((6, 9))
RISKS[1:3, 3:7], RISKS[4:, 6:], RISKS[0, 8], RISKS[3, 2], RISKS[5, 0] = 0.2, 0.05, np.nan, np.nan, 0.2
WORLD = World.create(RISKS, starts=[[0, 0], [3, 0]])
RUNS = 40


@pytest.fixture(scope="module")
def small() -> Clearing:
    choices = RolloutChoices(rollouts=RUNS, seed=3, engine="numba")
    return find_clearing(WORLD, WORLD.starts, Settings(), choices, count=2)


def by_the_readable_simulator(planned: World, true: World, ids: range) -> np.ndarray:
    """Cells visited and robots lost on average, planned on one map and hit on the other."""
    plan = make_plan(planned, WORLD.starts, Settings())
    problem, threat = prepare(planned, plan.starts, plan.settings), true.threat.ravel()
    runs = []
    for rollout in ids:

        def hit(robot: int, step: int, cell: int, rollout: int = rollout) -> bool:
            return bool(uniform(3, rollout, step, robot) < threat[cell])

        runs.append(simulate(problem, plan.areas, hit=hit))
    return np.mean([[one.visited.sum(), (~one.alive).sum()] for one in runs], axis=0)


def test_threats_are_connected_areas_of_one_level() -> None:
    threats = threats_of(WORLD, WORLD.starts, 16)
    assert [(one.name, len(one.cells)) for one in threats] == [("area 0", 6), ("area 1", 8), ("area 2", 1)]
    assert [one.p for one in threats] == pytest.approx([0.05, 0.2, 0.2])
    without = threats[1].cleared(WORLD)
    assert (without.threat[1:3, 3:7] == 0).all() and without.threat[5, 0] == np.float32(0.2)
    assert np.isnan(without.threat[0, 8]) and WORLD.threat[1, 3] > 0


def test_gains_are_what_the_readable_simulator_says(small: Clearing) -> None:
    base = by_the_readable_simulator(WORLD, WORLD, range(RUNS))
    for one in small.options:
        cleared = one.threat.cleared(WORLD)
        assert one.known is not None and one.unknown.rollouts == RUNS
        start = by_the_readable_simulator(WORLD, WORLD, range(one.known.rollouts))
        for gain, planned, before in ((one.known, cleared, start), (one.unknown, WORLD, base)):
            after = by_the_readable_simulator(planned, cleared, range(gain.rollouts))
            assert gain.cells.mean == pytest.approx(after[0] - before[0])
            assert gain.robots.mean == pytest.approx(before[1] - after[1])
    first, second = small.turns
    assert len(second.options) == len(first.options) - 1 and first.picked.threat not in small.picks[1:]
    far = range(RUNS, 2 * RUNS)
    after, before = (by_the_readable_simulator(world, world, far) for world in (small.cleared_world, WORLD))
    assert small.gain is not None and small.gain.cells.mean == pytest.approx(after[0] - before[0])
    through = [one for one in first.options if one.known is not None and one.known.rollouts == RUNS]
    assert first.picked in through
    assert first.picked.known == max((one.known for one in through if one.known), key=lambda gain: gain.cells.mean)


def test_the_gradient_is_that_of_the_closed_form() -> None:
    plan = make_plan(WORLD, WORLD.starts, Settings())
    gradient = coverage_gradient(plan, WORLD)
    step = 2.0**-7
    for row, col in [(0, 0), (0, 4), (1, 3), (2, 6), (4, 6), (5, 8), (5, 0), (3, 2)]:
        if np.isnan(WORLD.threat[row, col]):
            assert gradient[row, col] == 0
            continue
        threat = np.stack([WORLD.threat, WORLD.threat, WORLD.threat])
        threat[1:, row, col] += np.array([step, 2 * step], dtype=np.float32)
        at = [open_loop_exact(plan, replace(WORLD, threat=each)).visited for each in threat]
        slope = (-3 * at[0] + 4 * at[1] - at[2]) / (2 * step)  # of second order, from above: p >= 0
        assert gradient[row, col] == pytest.approx(slope, rel=2e-2, abs=1e-3)
    assert gradient.min() < -1


# The command.


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def test_the_command_says_gains_as_json(capsys: pytest.CaptureFixture[str], world_file: str, small: Clearing) -> None:
    assert run(["clear", world_file, "--count", "2", "--rollouts", str(RUNS), "--seed", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads(json.dumps(small.to_json()))
    assert found["pick"] == [threat.name for threat in small.picks] and found["gain"]["first_rollout"] == RUNS
    keys = {"name", "cells", "p", "screen", "hits", "known", "unknown", "behind"}
    assert all(set(one) == keys and one["unknown"]["ci95"] for one in found["threats"])
    assert found["threats"][1]["cells"] == [9 * row + col for row in (1, 2) for col in range(3, 7)]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "--count 0; expected a whole number of threats, 1 to 3"),
        (["--count", "4"], "--count 4; expected a whole number of threats, 1 to 3"),
        (["--starts", "0,8"], "[0, 8], an obstacle"),
        (["--robots", "3"], "--robots 3 contradicts the 2 starts"),
        (["--plan-for", "open"], "Unknown option: --plan-for"),
        (["--rollouts", "4294967296"], "expected at most 2147483648"),
    ],
)
def test_bad_options_are_told(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, words: list[str], said: str
) -> None:
    assert run(["clear", world_file, *words, "--out", str(tmp_path / "out")]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err and not (tmp_path / "out").exists()


def test_without_threat_there_is_nothing_to_clear() -> None:
    with pytest.raises(UsageError, match="no cell that a robot can reach is dangerous"):
        mrac.clear(mrac.load(np.zeros((3, 3))))
    behind = mrac.load([[0.0, np.nan, 0.5]])
    with pytest.raises(UsageError, match="no cell that a robot can reach is dangerous"):
        mrac.clear(behind, starts=[[0, 0]])


def test_an_interruption_leaves_the_picks_so_far() -> None:
    calls: list[int] = []

    def stop(done: int, total: int, seconds: float) -> None:
        calls.append(done)
        if len(calls) > 5:
            raise KeyboardInterrupt

    answer = mrac.clear(WORLD, count=3, rollouts=RUNS, progress=stop)
    assert answer.partial and len(answer.picks) == 1 and answer.gain is None
    assert headline(answer).startswith("Interrupted.") and answer.to_json()["gain"] is None
    with pytest.raises(KeyboardInterrupt):
        mrac.clear(WORLD, rollouts=RUNS, progress=stop)


def test_the_answer_prints_and_saves_itself(small: Clearing, tmp_path: Path) -> None:
    files = {file.name for file in small.save(tmp_path / "out")}
    assert files == {"index.html", "clear.png", "risk_paid.png", "clear.json"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert headline(small) in page and all(said in page for said in findings(small))
    assert "Where risk is paid" in page and 2 <= len(repr(small).splitlines()) <= 24
