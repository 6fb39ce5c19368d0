"""`mrac-jax front`: what is looked at, what nothing beats, the pick; held against the readable simulator."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from conftest import load_fixture
from numpy.typing import NDArray

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.sampling import RolloutChoices
from analysis.tradeoff.front import Front, Point, settings_of
from analysis.tradeoff.page import _chart, front_page
from analysis.tradeoff.rules import Figures, Goal, Setting, between, efficient, first_worth, make_goal
from analysis.tradeoff.search import Ladders, find_front
from analysis.tradeoff.table import TITLES, headline, pick_lines
from planner.errors import InputError, UsageError
from planner.mrac.make_plan import make_plan
from planner.mrac.reference import ReferenceLoop
from planner.plans.settings import Settings
from planner.worlds.world import World

THREAT = np.zeros((6, 9))
THREAT[1:3, 3:7], THREAT[4:, 6:], THREAT[0, 8], THREAT[3, 2] = 0.2, 0.05, np.nan, np.nan
WORLD = World.create(THREAT, starts=[[0, 0], [5, 0]])
RESERVED, WORTHS, RUNS = (0.5,), (4.0, 15.0), 40


@pytest.fixture(scope="module")
def small() -> Front:
    ladders = Ladders(RESERVED, WORTHS, (0.4, 0.7))
    choices = RolloutChoices(rollouts=RUNS, seed=3, engine="numba")
    return find_front(WORLD, WORLD.starts, Settings(), choices, goal=Goal(losses=0.5), ladders=ladders)


def by_the_readable_simulator(setting: Setting, ids: range) -> NDArray[np.float64]:
    """Mean cells visited, robots lost and steps."""
    settings = replace(settings_of(Settings(), setting), max_steps=setting.deadline)
    loop = ReferenceLoop(make_plan(WORLD, WORLD.starts, settings), WORLD)
    runs = [loop.run(3, rollout) for rollout in ids]
    lost = [(~one.alive).sum() for one in runs]
    return np.mean([[one.visited.sum() for one in runs], lost, [one.time for one in runs]], axis=1)


def shown(point: Point, cells: int) -> NDArray[np.float64]:
    return np.array([point.coverage.mean * cells, point.losses.mean, point.time.mean])


def test_every_point_is_what_the_readable_simulator_says(small: Front) -> None:
    settings = {point.setting for point in small.points}
    assert {Setting("mrac"), Setting("per_cell"), Setting("per_cell", reserve=0.5)} <= settings
    assert {s.worth for s in settings if s.worth} == {*WORTHS}
    cut = {s.policy for s in settings if s.deadline is not None}
    assert cut == {"mrac", "per_cell"} and len(settings) == len(small.points) == 2 + 4 + 1 + 2
    for point in small.points:
        assert shown(point, small.cells) == pytest.approx(by_the_readable_simulator(point.setting, range(RUNS)))
    picked, again = small.picked, small.confirmed
    assert picked is not None and again is not None and again.setting == picked.setting
    assert shown(again, small.cells) == pytest.approx(by_the_readable_simulator(picked.setting, range(RUNS, 2 * RUNS)))


def test_missions_end_at_the_first_step_by_which_a_landmark_is_covered(small: Front) -> None:
    for policy in ("mrac", "per_cell"):
        for mark in (0.4, 0.7):
            cut = [
                p for p in small.points if p.setting.policy == policy and p.setting.deadline and p.coverage.mean >= mark
            ]
            last = min(cut, key=lambda point: point.setting.deadline or 0)
            before = last.setting._replace(deadline=(last.setting.deadline or 0) - 1)
            assert by_the_readable_simulator(before, range(RUNS))[0] / small.cells < mark <= last.coverage.mean


# The rules, as pure functions.


def test_efficient_is_what_no_other_one_beats() -> None:
    draw = np.random.default_rng(5)
    for _ in range(50):
        points = [Figures(*map(float, row)) for row in draw.integers(0, 4, (12, 3))]
        for one, best in zip(points, efficient(points), strict=True):
            better = [
                other.coverage - one.coverage >= 0 and one.losses - other.losses >= 0 and one.time - other.time >= 0
                and (other.coverage > one.coverage or other.losses < one.losses or other.time < one.time)
                for other in points
            ]  # fmt: skip
            assert best == (not any(better))


def test_a_goal_picks_the_most_coverage_or_the_fewest_lost() -> None:
    points = [Figures(0.9, 3, 50), Figures(0.7, 1, 40), Figures(0.7, 1, 30), Figures(0.2, 0, 5), Figures(0.7, 2, 9)]
    assert [Goal(losses=lost).pick(points) for lost in (9, 3, 2.9, 1, 0.5)] == [0, 0, 2, 2, 3]
    assert [Goal(target=share).pick(points) for share in (0.95, 0.9, 0.7, 0.1)] == [None, 0, 2, 3]
    assert Goal(losses=-1.0).pick(points) is None and Goal().pick(points) is None
    assert bool(Goal(losses=0.0)) and not Goal()


def test_the_ladder_of_worth() -> None:
    assert (first_worth(0.2), first_worth(0.03), first_worth(0.9)) == (5, 33, 1.1)
    assert between(10, 40) == 20 and between(200, 100) == 141
    assert Setting("per_cell", worth=0.1, deadline=7).options() == shlex.split(
        "--policy per_cell --worth 0.1 --deadline 7"
    )
    assert str(Setting("per_cell", 0.25, 12)) == "per_cell, reserve 0.25, worth 12"


def test_around_a_goal_worths_are_tried_between() -> None:
    one = load_fixture("contiguous-14x23-1000-k2")
    goal, ladders = Goal(losses=0.5), Ladders((), None, ())
    answer = find_front(one.world, one.starts, Settings(), RolloutChoices(rollouts=60), goal=goal, ladders=ladders)
    settings = {p.setting: p for p in answer.points if p.setting.worth is not None}
    lost = {setting.worth or 0: point.losses.mean for setting, point in settings.items() if setting.deadline is None}
    worths = sorted(lost)
    rungs = [worths[0] * 2.0**step for step in range(16)]
    tried = {worth for worth in worths if worth not in rungs}
    assert worths[0] == first_worth(float(np.nanmax(one.world.threat)))
    assert 1 <= len(tried) <= 3 and lost[worths[-1]] < 0.02
    assert any(lost[a] > 0.5 >= lost[b] and {a, b} & tried for a, b in pairwise(worths))
    assert len({p.figures for p in settings.values()}) == len(settings)
    (early,) = {setting.worth for setting in settings if setting.deadline is not None}
    assert lost[max(worth for worth in worths if worth <= (early or 0))] > 0.5  # equal ones are left out


# The command.


def asked(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict:
    assert run([*words, "--json"]) == status
    found: dict = json.loads(capsys.readouterr().out)
    return found


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


def test_the_command_of_the_pick_reproduces_it(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    told = ["--rollouts", "200", "--seed", "5", "--levels", "8", "--worths", "12", "--reserves", ""]
    saved = tmp_path / "plan.json"
    for goal in (["--target", "0.9", "--deadline", "40"], ["--losses", "0.9", "--plan-out", str(saved)]):
        front = asked(capsys, "front", world_file, *told, *goal)
        point = front["points"][front["pick"]]
        program, *words = shlex.split(front["command"])
        assert program == "mrac-jax" and words[:2] == ["evaluate", world_file]
        once = asked(capsys, *words)
        where = once if point["deadline"] is None else once["deadline"]
        coverage = (once["coverage"] if point["deadline"] is None else where)["visited"]
        assert coverage["mean"] == point["coverage"]["mean"] and coverage["ci95"] == point["coverage"]["ci95"]
        assert where["losses"]["mean"] == point["losses"]["mean"]
        assert front["confirmed"]["first_rollout"] == front["rollouts"] == 200
    again = asked(capsys, "evaluate", world_file, "--plan", str(saved), "--rollouts", "200", "--seed", "5")
    assert again["coverage"]["visited"]["mean"] == point["coverage"]["mean"]
    assert again["plan"]["settings"]["levels"] == 8
    keys = {"policy", "reserve", "worth", "deadline", "coverage", "losses", "time", "efficient"}
    assert all(set(one) == keys for one in front["points"]) and any(one["efficient"] for one in front["points"])


def test_a_goal_that_nothing_meets_is_an_answer(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    words = ["front", world_file, "--rollouts", "50", "--worths", "", "--reserves", "", "--target", "1"]
    assert run([*words, "--plan-out", str(tmp_path / "plan.json")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("No setting has 100 % or more covered on average: the most is")
    assert not (tmp_path / "plan.json").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--losses", "1", "--target", "0.5"], "both --losses and --target are given"),
        (["--losses", "-1"], "--losses -1; expected a number of robots lost"),
        (["--target", "1.5"], "--target 1.5; expected a fraction"),
        (["--policy", "per_cell"], "Unknown option: --policy"),
        (["--worth", "5"], "Unknown option: --worth. Did you mean --worths"),
        (["--worths", "5,much"], "--worths '5,much'; expected numbers"),
        (["--worths", "5,-1"], "--worths -1; expected a number, above 0"),
        (["--reserves", "2"], "--reserves 2; expected"),
        (["--plan-out", "plan.json"], "--plan-out plan.json without a pick"),
        (["--rollouts", "4294967296"], "--rollouts 4294967296; expected at most 2147483648"),
    ],
)
def test_bad_options_are_told(capsys: pytest.CaptureFixture[str], world_file: str, words: list[str], said: str) -> None:
    assert run(["front", world_file, *words]) == 2
    err = capsys.readouterr().err.strip().splitlines()[-1]
    assert err.startswith("error: ") and said in err


def test_without_danger_every_run_is_the_same() -> None:
    answer = mrac.front(mrac.load(np.zeros((4, 5))), robots=2, target=0.5)
    assert {point.setting.family for point in answer.points} == {"mrac", "per_cell"}
    assert all(point.losses.ci95 == (0, 0) and point.coverage.half_width == 0 for point in answer.points)
    assert answer.picked is not None and answer.picked.coverage.mean >= 0.5
    assert any("Every run is the same" in line for line in pick_lines(answer))


def test_an_interruption_leaves_what_was_done() -> None:
    seen: list[int] = []

    def stop(done: int, total: int, seconds: float) -> None:
        seen.append(done)
        if len(seen) == 3:
            raise KeyboardInterrupt

    answer = mrac.front(WORLD, rollouts=50, losses=1, progress=stop)
    assert answer.partial and len(answer.points) == 2 and answer.pick is None and answer.confirmed is None
    assert answer.to_json()["partial"] is True and headline(answer) == "Interrupted after 2 settings."
    seen[:] = [0, 0]
    with pytest.raises(KeyboardInterrupt):
        mrac.front(WORLD, rollouts=50, progress=stop)


def test_the_front_prints_and_saves_itself(small: Front, tmp_path: Path) -> None:
    files = {file.name for file in small.save(tmp_path / "out")}
    assert files == {"index.html", "front.png", "front.json", "plan.json"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert headline(small) in page and front_page(small, "", {}, ()) == front_page(small, "", {}, ())
    for curve in _chart(small, "time").series:  # through the settings as they rise, whatever they take
        of = [point for point in small.points if TITLES[point.setting.family] == curve.name]
        assert list(curve.x) == [point.time.mean for point in of]
    assert 2 <= len(repr(small).splitlines()) <= 24 and small._repr_html_().startswith("<b>")
    told = json.loads((tmp_path / "out" / "front.json").read_text())
    assert told["points"][told["pick"]]["losses"]["mean"] <= 0.5
    with pytest.raises(InputError, match="worths=-5"):
        mrac.front(WORLD, worths=[-5])
    with pytest.raises(UsageError, match="losses=nan"):
        make_goal(float("nan"), None)


# Advice, by `evaluate`.


def test_evaluate_says_what_covers_more(capsys: pytest.CaptureFixture[str], world_file: str) -> None:
    words = ["evaluate", world_file, "--rollouts", "20000"]
    advice = asked(capsys, *words)["advice"]
    assert set(advice) == {"policy", "reserve", "worth", "difference"} and advice["policy"] == "per_cell"
    world = mrac.load(world_file)
    pair = [(world, mrac.plan(world, policy=policy)) for policy in ("mrac", "per_cell")]
    fair = mrac.compare(*pair, rollouts=4096).difference("visited").estimate
    assert advice["difference"] == fair.to_json() and fair.ci95[0] > 0
    for more in (["--no-advice"], ["--policy", "per_cell"], ["--loop", "open"]):
        assert asked(capsys, *words, *more)["advice"] is None
    assert asked(capsys, *words[:3], "19999")["advice"] is None
    told = mrac.evaluate(world, rollouts=20_000, band=False)
    assert any("--policy per_cell covers" in line for line in told.outputs["advice"].footnotes())


def test_no_advice_where_it_would_cost_robots_or_is_not_seen() -> None:
    safe = mrac.load(np.zeros((5, 5)))
    assert mrac.evaluate(safe, 1, rollouts=20_000).to_json()["advice"] is None
    one = mrac.load([[0.0, 0.3, 0.0]])  # one way to go
    assert mrac.evaluate(one, 1, rollouts=20_000).to_json()["advice"] is None
