"""`mrac-jax front`: what is looked at, what nothing beats, the pick; held against the readable simulator."""

from __future__ import annotations

import json
import re
import shlex
import sys
from dataclasses import replace
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import load_fixture
from numpy.typing import NDArray
from page_reader import Reader

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.evaluation import answer
from analysis.evaluation.outputs.advice import Advice
from analysis.evaluation.outputs.what_if import ThreatScale
from analysis.report.html import page_of
from analysis.sampling import RolloutChoices
from analysis.search import pareto as search
from analysis.search.pareto import (
    Figures,
    Front,
    Goal,
    Ladders,
    Point,
    Setting,
    between,
    efficient,
    find_front,
    first_worth,
    knee,
    make_goal,
    quick_points,
    settings_of,
    usual_rollouts,
)
from analysis.search.reports import TITLES, _front_chart, front_headline, front_report, pick_lines
from analysis.statistics.estimates import exactly
from analysis.theory.bounds import ideal_team
from planner.errors import InputError, UsageError
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.settings import Settings
from planner.simulator.tables import AllPairs
from planner.world.world import World

THREAT = np.zeros((6, 9))
THREAT[1:3, 3:7], THREAT[4:, 6:], THREAT[0, 8], THREAT[3, 2] = 0.2, 0.05, np.nan, np.nan
WORLD = World.create(THREAT, starts=[[0, 0], [5, 0]])
RESERVED, WORTHS, RUNS = (0.5,), (4.0, 15.0), 200


@pytest.fixture(scope="module")
def small() -> Front:
    ladders = Ladders(RESERVED, WORTHS, (0.4, 0.7))
    choices = RolloutChoices(rollouts=RUNS, seed=3, engine="numba", exact="never")
    return find_front(WORLD, WORLD.starts, Settings(), choices, goal=Goal(losses=0.8), ladders=ladders)


def by_the_readable_simulator(setting: Setting, ids: range) -> NDArray[np.float64]:
    """Mean cells visited, robots lost and steps."""
    loop = ReferenceLoop(make_plan(WORLD, WORLD.starts, settings_of(Settings(), setting)), WORLD)
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
    answer = find_front(
        one.world, one.starts, Settings(), RolloutChoices(rollouts=3000, exact="never"), goal=goal, ladders=ladders
    )
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


def figures_of(told: dict, ended: bool) -> tuple[dict, dict, float]:
    """Coverage and losses that `evaluate --json` tells; `ended`: of the mission that ends at its deadline."""
    where = told["deadline"] if ended else told
    return (where if ended else told["coverage"])["visited"], where["losses"]


@pytest.mark.parametrize("goal", [["--target", "0.75", "--deadline", "40"], ["--losses", "0.9"]])
def test_the_plan_of_the_pick_keeps_what_was_promised(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, goal: list[str]
) -> None:
    """The same ids, seed and map: `evaluate --plan` gives the figures of `front`, wherever the mission ends."""
    saved = tmp_path / "plan.json"
    told = [
        "--rollouts",
        "1000",
        "--seed",
        "5",
        "--levels",
        "8",
        "--worths",
        "12",
        "--reserves",
        "",
        "--exact",
        "never",
    ]
    front = asked(capsys, "front", world_file, *told, *goal, "--plan-out", str(saved))
    point = front["points"][front["pick"]]
    words = ["evaluate", world_file, "--plan", str(saved), "--rollouts", "1000", "--seed", "5", "--exact", "never"]
    same = asked(capsys, *words)
    assert same["coverage"]["visited"]["mean"] == point["coverage"]["mean"]
    assert same["losses"]["mean"] == point["losses"]["mean"] and same["time"]["mean"] == point["time"]["mean"]
    assert same["plan"]["settings"]["levels"] == 8 and same["plan"]["settings"].get("deadline") == point["deadline"]
    keys = {"policy", "reserve", "worth", "deadline", "coverage", "losses", "time", "efficient"}
    assert all(set(one) == keys for one in front["points"]) and any(one["efficient"] for one in front["points"])
    again = front["confirmed"]
    assert again["first_rollout"] == front["rollouts"] == 1000 and 1 <= again["tried"] <= 6
    assert again["bound"] <= 0.9 if "--losses" in goal else again["bound"] >= 0.75


def test_the_command_of_the_pick_rolls_out_luck_that_had_no_part_in_the_choice(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    saved = tmp_path / "plan.json"
    told = ["front", world_file, "--rollouts", "1000", "--seed", "5", "--worths", "12", "--reserves", "",
            "--exact", "never", "--losses", "0.9", "--deadline", "40"]  # fmt: skip
    for more, ended in (([], True), (["--plan-out", str(saved)], False)):
        front = asked(capsys, *told, *more)
        program, *words = shlex.split(front["command"])
        assert program == "mrac-jax" and words[:2] == ["evaluate", world_file] and words[-2:] == ["--seed", "6"]
        coverage, losses = figures_of(asked(capsys, *words), ended)
        fresh = front["confirmed"]
        for mine, theirs in ((fresh["coverage"], coverage), (fresh["losses"], losses)):
            assert abs(mine["mean"] - theirs["mean"]) < 5 * np.hypot(mine["se"], theirs["se"])
            assert mine["mean"] != theirs["mean"]


def test_the_pick_is_the_best_that_is_sure_to_keep_the_limit_on_other_rollouts() -> None:
    """The setting that covers most within the limit is a hair from it: not sure to keep it, so not picked."""
    choices = RolloutChoices(rollouts=1000, seed=7, engine="numba", exact="never")
    ladders = Ladders((), (4.0, 15.0), tuple(np.arange(0.3, 0.99, 0.03)))
    seen = find_front(WORLD, WORLD.starts, Settings(), choices, ladders=ladders)
    near = max((p for p in seen.points if p.setting.deadline), key=lambda point: point.losses.mean)
    limit = near.losses.mean + 0.005  # half a standard error: it seems to be kept, and half of all luck says not
    answer = find_front(WORLD, WORLD.starts, Settings(), choices, goal=Goal(losses=limit), ladders=ladders)
    picked, again = answer.picked, answer.confirmed
    assert picked is not None and again is not None and again.most <= limit and picked.most <= limit
    assert near.coverage.mean > picked.coverage.mean and near.losses.mean > picked.losses.mean
    sure = sorted((p for p in answer.points if p.most <= limit), key=lambda p: -p.coverage.mean)
    assert sure.index(picked) == answer.tried - 1
    assert front_headline(answer).endswith(f"; asked for was at most {limit:g} of 2 robots lost.")
    assert f"The limit is kept with confidence 0.95: on average {again.most:.2f} robots or fewer are lost." in [
        *pick_lines(answer)
    ]


def test_the_chance_of_error_is_shared_among_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """When the others fail, the next best is tried, with half the chance of error; when all fail nothing is picked."""
    asked_for: list[float] = []
    fail = 0

    def stubborn(self: search._Search, point: Point, doubt: float) -> Point:
        asked_for.append(doubt)
        return replace(point, most=9.0 if len(asked_for) < fail else 0.0)

    monkeypatch.setattr(search._Search, "_again", stubborn)
    choices = RolloutChoices(rollouts=200, seed=7, engine="numba", exact="never")
    for fails, tried in ((3, 3), (99, None)):
        asked_for.clear()
        fail = fails
        answer = find_front(WORLD, WORLD.starts, Settings(), choices, goal=Goal(losses=1.5),
                            ladders=Ladders((), (4.0, 15.0), (0.3, 0.5, 0.7, 0.9)))  # fmt: skip
        assert asked_for == [0.05 / 2**n for n in range(1, len(asked_for) + 1)] and sum(asked_for) < 0.05
        if tried is None:
            assert answer.pick is None and len(asked_for) == 6 == answer.tried
            assert front_headline(answer).startswith("No setting is sure to have at most 1.5 of 2 robots lost")
        else:
            assert answer.tried == tried and "It is the third that was tried" in " ".join(pick_lines(answer))


def test_without_a_goal_the_headline_is_of_fresh_rollouts(capsys: pytest.CaptureFixture[str], world_file: str) -> None:
    front = mrac.front(mrac.load(world_file), rollouts=300, worths=[4, 15, 500], exact="never")
    assert [point.setting for point in front.priced] == [point.setting for point in front.corners()]
    for point in front.priced:
        own = next(one for one in front.points if one.setting == point.setting)
        assert f"{100 * point.coverage.mean:.1f} %" in front_headline(front)
        assert own.coverage.mean != point.coverage.mean or not own.coverage.half_width
    assert run(["front", world_file, "--rollouts", "300", "--exact", "never"]) == 0
    said = capsys.readouterr().out
    assert "--seed 1" in said and "efficient" not in said.splitlines()[0] and "nothing beats" not in said


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
        (["--target", "90"], "did you mean 0.9?"),
        (["--losses", "99"], "--losses 99; expected at most 2, the robots that there are to lose"),
        (["--policy", "per_cell"], "Unknown option: --policy; it is an option of evaluate, "),
        (["--worth", "5"], "Unknown option: --worth; did you mean '--worths'? --worth is an option of evaluate, "),
        (["--worths", "5,much"], "--worths '5,much'; expected numbers"),
        (["--worths", "5,-1"], "--worths -1; expected a number above 0"),
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
    best, kept, *_ = pick_lines(answer)
    assert ". Exact expectation: 100 % covered" in best or answer.picked.setting.deadline
    assert kept == "The limit is kept: these figures are exact."
    assert front_headline(answer).endswith("and lose no robot, on average (exact); asked for was 50 % or more covered.")


def test_an_interruption_leaves_what_was_done() -> None:
    seen: list[int] = []

    def stop(done: int, total: int, seconds: float) -> None:
        seen.append(done)
        if len(seen) == 3:
            raise KeyboardInterrupt

    answer = mrac.front(WORLD, rollouts=50, losses=1, progress=stop, on_interrupt="return")
    assert answer.partial and len(answer.points) == 2 and answer.pick is None and answer.confirmed is None
    assert answer.to_json()["partial"] is True and front_headline(answer) == "Interrupted after 2 settings."
    seen[:] = [0, 0]
    with pytest.raises(KeyboardInterrupt):
        mrac.front(WORLD, rollouts=50, progress=stop)


def test_the_front_prints_and_saves_itself(small: Front, tmp_path: Path) -> None:
    files = {file.name for file in small.save(tmp_path / "out")}
    assert files == {"index.html", "front.png", "front.txt", "front.json", "plan.json"}
    page = (tmp_path / "out" / "index.html").read_text()
    assert front_headline(small) in Reader(page).text and page_of(front_report(small), "", {}, ()) == page_of(
        front_report(small), "", {}, ()
    )
    *curves, mark = _front_chart(small, "time").series
    assert small.picked is not None and (mark.name, mark.x) == ("the pick", [small.picked.time.mean])
    for curve in curves:  # through the settings as they rise, whatever they take
        of = [point for point in small.points if TITLES[point.setting.family] == curve.name]
        cheap = min(one.coverage.mean for one, is_cheap in zip(small.points, small.cheap, strict=True) if is_cheap)
        assert list(curve.x) == [point.time.mean for point in of if point.coverage.mean >= cheap]
    assert 2 <= len(repr(small).splitlines()) <= 24 and small._repr_html_().startswith("<b>")
    told = json.loads((tmp_path / "out" / "front.json").read_text())
    assert told["points"][told["pick"]]["losses"]["mean"] <= told["confirmed"]["bound"] <= 0.8
    with pytest.raises(InputError, match="worths=-5"):
        mrac.front(WORLD, worths=[-5])
    with pytest.raises(UsageError, match="losses=nan"):
        make_goal(float("nan"), None)


# What one should do, by `evaluate`: a quick front.


def test_a_quick_front_knows_what_is_free_and_what_all_costs() -> None:
    ask: dict[str, Any] = {"losses": 9.0, "kept": AllPairs(), "doing": lambda what: None}
    choices = RolloutChoices(engine="numba", rollouts=512, exact="never")
    points = quick_points(WORLD, WORLD.starts, Settings(), choices, seconds=60, **ask)
    assert {point.setting.family for point in points} == {"mrac", "per_cell", "worth"}
    whole = find_front(WORLD, WORLD.starts, Settings(), choices, ladders=Ladders((), None, ()))
    known = {point.setting: point.figures for point in whole.points}
    both = [point for point in points if point.setting in known]
    assert len(both) > 3 and all(known[point.setting] == point.figures for point in both), "the same luck"
    free = next(point for point in points if point.losses.ci95[1] == 0)
    assert 0 < free.coverage.mean < max(point.coverage.mean for point in points)
    (first,) = quick_points(WORLD, WORLD.starts, Settings(), choices, seconds=0, **ask)
    assert first.losses.mean == 0, "the careful ones come first"


def test_code_that_the_first_setting_compiles_costs_a_quick_front_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a first run a minute goes by before the first setting is known: the others are looked at all the same."""
    looks, look_at = [], search._Search.look_at
    monkeypatch.setattr(search._Search, "look_at", lambda self, one: (looks.append(one), look_at(self, one))[1])
    clock = lambda: 60.0 * bool(looks) + len(looks) / 100  # noqa: E731
    ask: dict[str, Any] = {"losses": 9.0, "kept": AllPairs(), "doing": lambda what: None}
    points = quick_points(
        WORLD, WORLD.starts, Settings(), RolloutChoices(engine="numba", rollouts=64), seconds=4, clock=clock, **ask
    )
    assert len(points) > 3 and {point.setting.family for point in points} == {"mrac", "per_cell", "worth"}


def test_evaluate_says_what_costs_no_robot_and_what_the_rest_costs(
    capsys: pytest.CaptureFixture[str], world_file: str
) -> None:
    words = ["evaluate", world_file, "--rollouts", "8192"]
    advice = asked(capsys, *words)["advice"]
    keys = {"policy", "reserve", "worth", "coverage", "losses", "difference", "rollouts", "front"}
    assert set(advice) == keys and advice["policy"] == "per_cell" and advice["rollouts"] == 1024
    assert any(point["worth"] == advice["worth"] for point in advice["front"])
    world = mrac.load(world_file)
    pair = [(world, mrac.plan(world, policy=policy, worth=advice["worth"] if policy == "per_cell" else None))
            for policy in ("mrac", "per_cell")]  # fmt: skip
    fair = mrac.compare(*pair, rollouts=1024).difference("visited").estimate
    assert advice["difference"] == fair.to_json()
    other = mrac.evaluate(*pair[1], rollouts=1024, advice=False, band=False)
    assert other.visited.mean == pytest.approx(advice["coverage"]["mean"], abs=1e-12) or other.certain
    for more in (["--no-advice"], ["--loop", "open"]):
        assert asked(capsys, *words, *more)["advice"] is None
    assert asked(capsys, *words[:3], "63")["advice"] is None
    assert run(words) == 0
    shown = capsys.readouterr().out
    line = f"`--policy per_cell --worth {advice['worth']:g}`"
    assert line in " ".join(shown.split()) and shown.index("--worth") > shown.index("Coverage, %")
    told = mrac.evaluate(world, rollouts=8192, band=False)
    (lead,) = told.outputs["advice"].blocks().alternatives
    assert re.match(r"To cover [\d.]+ % and lose .*: `policy='per_cell', worth=\d+`[;.]", lead)
    assert lead in str(told).splitlines() and str(told).index(lead) < str(told).index("visited on average")
    assert escape(lead) in told._repr_html_()


def test_the_answer_is_printed_before_anything_else_is_worked_out(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The summary and its tables, then the tables of other threats, the alternatives and the bound; nothing twice."""
    words = ["evaluate", world_file, "--rollouts", "2048", "--threat-scale", "0.5"]
    shown = list[str]()

    def watch(owner: Any, name: str) -> None:
        work = getattr(owner, name)
        monkeypatch.setattr(owner, name, lambda *given: shown.append(capsys.readouterr().out) or work(*given))

    watch(ThreatScale, "measure")
    watch(Advice, "measure")
    watch(answer, "any_strategy")
    assert run([*words, "--out", str(tmp_path)]) == 0
    first, scaled, advised, bound = *shown, capsys.readouterr().out
    assert first.startswith("2 robots visit ") and "Chances in %" in first and "Coverage, %" in first
    assert scaled.startswith("\nIf every threat") and advised.startswith("\nTo cover ")
    assert bound.startswith("\nNo strategy visits more than ")
    whole = " ".join((tmp_path / "evaluation.txt").read_text().split())
    rest = " ".join((scaled + advised + bound).split())
    assert sorted(whole.split()) == sorted(f"{first} {rest}".split())


def test_alternatives_that_are_interrupted_leave_the_answer(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Advice, "measure", interrupted)
    assert run(["evaluate", world_file, "--rollouts", "2048", "--out", str(tmp_path)]) == 130
    shown, (saved, page) = capsys.readouterr().out, ((tmp_path / name) for name in ("evaluation.json", "index.html"))
    assert shown.count("2 robots visit ") == shown.count("Chances in %") == 1
    assert "Interrupted: this is what was done until then." in shown
    assert json.loads(saved.read_text())["partial"] and page.is_file()


def test_files_are_written_though_the_reader_has_gone(
    world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`mrac-jax evaluate ... --out answer | head -1`."""

    def gone(*given: Any, **named: Any) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", sys.stdout)  # the command puts another in its place
    monkeypatch.setattr("analysis.cli.deliver.show", gone)
    assert run(["evaluate", world_file, "--rollouts", "500", "--loop", "open", "--out", str(tmp_path / "out")]) == 0
    sys.stdout.close()
    assert {"index.html", "evaluation.json", "plan.json"} <= {file.name for file in (tmp_path / "out").iterdir()}


def test_a_setting_that_covers_more_for_no_more_robots_is_advised() -> None:
    """Where the plan loses few robots, only what covers more for sure is named."""
    now, cheap = Setting("mrac"), Setting("per_cell", worth=40.0)
    point = Point(cheap, exactly(0.9), exactly(0.1), exactly(20.0), None, 0.9, 0.1)
    found = Advice((now, exactly(0.8), exactly(0.2)), 5, (point,), 64, point, exactly(0.1))
    assert not found.saves(point) and found.better() is point
    (said,) = found.blocks().alternatives
    assert said == ("To cover 90.0 % (10.00 points more) without losing more robots: `policy='per_cell', worth=40`.")
    assert Advice((now, exactly(0.95), exactly(0.2)), 5, (point,), 64).better() is None
    costly = Advice((now, exactly(0.95), exactly(5.0)), 5, (point,), 64, point, exactly(-0.05))
    assert list(costly.blocks().alternatives) == [
        "To cover 90.0 % and lose 0.10 robots on average: `policy='per_cell', worth=40`."
    ]


def test_what_hardly_covers_anything_is_not_advised_because_it_is_free() -> None:
    """Then the knee is, if there is one; and what covers clearly more than the plan at its price is named beside it."""

    def priced(worth: float | None, coverage: float, losses: float) -> Point:
        figures = exactly(coverage), exactly(losses), exactly(20.0)
        return Point(Setting("per_cell", worth=worth), *figures, None, coverage, losses)

    now, points = (Setting("mrac"), exactly(0.6), exactly(3.0)), (priced(99, 0.02, 0.0), priced(20, 0.5, 1.0))
    found = Advice(now, 3, points, 64)
    assert found.better() is points[1] and found.more() is None
    straight = (points[0], priced(20, 0.22, 1.0))
    assert Advice(now, 3, straight, 64).better() is None, "every cell costs about as much"
    best = priced(None, 0.7, 3.0)
    whole = replace(found, points=(*points, best), advised=points[1], difference=exactly(-0.1))
    (said,) = whole.blocks().alternatives
    assert said == (
        "To cover 50.0 % and lose 1.00 robots on average: `policy='per_cell', worth=20`; "
        "to cover 70.0 % with the same losses: `policy='per_cell'`."
    )
    fewer = replace(best, losses=exactly(2.5))
    (said,) = replace(whole, points=(*points, fewer)).blocks().alternatives
    assert said.endswith("; to cover 70.0 % and lose 2.50 robots on average: `policy='per_cell'`.")


def test_the_knee_is_the_best_bargain_between_two_settings() -> None:
    low, high = Figures(0.2, 0.0, 9.0), Figures(0.8, 6.0, 9.0)
    points = [low, Figures(0.5, 1.5, 9.0), Figures(0.6, 2.0, 9.0), Figures(0.7, 4.5, 9.0), high]
    assert knee(points, low, high) == 2  # (0.4 / 0.6) - (2 / 6) = 1 / 3 above the line
    assert knee([low, Figures(0.5, 3.0, 9.0), Figures(0.5, 2.5, 9.0), high], low, high) is None
    assert knee(points, high, low) is None and knee([], low, high) is None
    front = mrac.front(WORLD, rollouts=300, worths=[4, 15, 500])
    middle = Point(Setting("per_cell", worth=7.0), exactly(0.99), exactly(0.05), exactly(5.0), None, 0.99, 0.05)
    most = replace(middle, setting=Setting("mrac"), coverage=exactly(1.0), losses=exactly(2.0))
    free = replace(middle, setting=Setting("per_cell", worth=9.0), coverage=exactly(0.3), losses=exactly(0.0))
    bent = replace(front, points=(free, middle, most), priced=(free, middle, most), words=("map.npy",))
    assert bent.corners() == (free, middle, most)
    assert front_headline(bent) == (
        "2 robots can cover 30.0 % and lose no robot, 99.0 % and lose 0.05 robots, or 100 % and lose both robots, "
        "on average."
    )
    assert pick_lines(bent)[1] == "per_cell, worth 7: 99.00 % covered, 0.05 robots lost."
    assert any(line.startswith("run it: ") and "--worth 7 " in line for line in pick_lines(bent)), "the bargain"


def test_no_advice_where_nothing_is_in_danger_or_there_is_one_way_to_go() -> None:
    safe = mrac.load(np.zeros((5, 5)))
    assert mrac.evaluate(safe, 1, rollouts=20_000).to_json()["advice"] is None


def test_no_advice_on_an_interrupted_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing more is planned or compiled for somebody who pressed Ctrl-C."""
    calls = []
    monkeypatch.setattr(Advice, "measure", lambda *given: calls.append(given) or iter(()))
    told: list[int] = []

    def tell(done: int, total: int, seconds: float) -> None:
        told.append(done)
        if len(told) == 2:
            raise KeyboardInterrupt

    answer = mrac.evaluate(WORLD, rollouts=10**9, progress=tell, on_interrupt="return")
    assert answer.partial and not calls and answer.to_json()["advice"] is None
    assert mrac.evaluate(WORLD, rollouts=64, band=False).partial is False and len(calls) == 1


def test_a_large_map_gets_fewer_rollouts_of_each_setting_by_its_size_alone() -> None:
    sizes = {(20, 20): 4096, (32, 64): 4096, (46, 46): 2048, (137, 137): 256, (800, 800): 16}
    assert {shape: usual_rollouts(World.create(np.zeros(shape)), np.zeros((1, 2), int)) for shape in sizes} == sizes
    threat = np.zeros((46, 46))
    threat[9, 9] = 0.5
    answer = mrac.front(World.create(threat), starts=[[0, 0]], worths=())
    assert answer.choices.rollouts == 2048


def test_the_ideal_of_a_team_is_not_followed_where_nobody_is_left() -> None:
    """By hand: j cells are entered with chance .5**(j - 1) by one robot; 5,000 of them come to 2, from above."""
    assert 2.0 <= ideal_team(np.full(5000, 0.5), 1) < 2.0 + 1e-11
    assert ideal_team(np.full(3, 0.5), 1) == 1.75
