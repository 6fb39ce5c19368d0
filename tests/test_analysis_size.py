"""`mrac-jax size`: the decision rule, the search, the bounds that rule teams out, and answers that are known."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, load_fixture
from PIL import Image
from refusals import refused
from rich.console import Console
from scipy.stats import binom

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.evaluation.evaluate import evaluate
from analysis.report.answer import print_report
from analysis.sampling import RolloutChoices, make_engine_for
from analysis.search.reports import size_headline, size_report
from analysis.search.team_size import (
    FEW,
    Goal,
    TeamSize,
    TeamVerdict,
    find_size,
    ideals_of,
    judge_team,
    make_goal,
    smallest_enough,
    team_ideals,
)
from analysis.statistics.control_variate import tally_mean
from analysis.statistics.estimates import chance_interval, mean_interval, share_of_doubt
from analysis.theory.bounds import ideal_team
from analysis.theory.exact import poisson_binomial
from planner.errors import UsageError
from planner.mrac.make_plan import make_plan
from planner.plan_team import plan_team
from planner.rollouts.engine import run_by_luck
from planner.settings import Settings
from planner.simulator import tables
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

NAN = float("nan")
WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
HALF = World.create([[0.0, 0.5, 0.0]], starts=[[0, 0]] * 8)
"""All robots start in the first cell, and one of K gets past the second with chance 1 - 0.5**K: then all is covered."""


def sized(world: World, goal: Goal, *, settings: Settings | None = None, **choices: object) -> TeamSize:
    return find_size(world, settings or Settings(), goal, RolloutChoices(**{"exact": "never", **choices}))  # type: ignore[arg-type]


def test_all_pairs_tables_are_made_once_for_all_teams(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[int] = []

    def all_pairs(near: np.ndarray, entry: np.ndarray, *types: np.dtype) -> tuple[np.ndarray, ...]:
        made.append(len(entry))
        return make_all_pairs(near, entry, *types)

    make_all_pairs = tables.all_pairs
    monkeypatch.setattr(tables, "all_pairs", all_pairs)
    goal = Goal(0.9, most=6)
    answer = sized(HALF, goal, rollouts=4_096)
    assert sum(point.rollouts > 0 for point in answer.points) > 1 and made == [3]
    kept, near, entry = tables.AllPairs(), np.array([[-1, -1, 1, -1], [-1, 0, -1, -1]], np.int32), np.array([1, 2])
    types = np.dtype(np.int32), np.dtype(np.uint16)
    assert kept.tables(near, entry, *types)[0].tolist() == [[0, 2], [1, 0]]
    assert kept.tables(near, entry[::-1].copy(), *types)[0].tolist() == [[0, 1], [2, 0]]


def answer(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict:
    assert run(["size", *words, "--json"]) == status
    return json.loads(capsys.readouterr().out)


def fake(enough: Callable[[int], bool], asked: list[int]) -> Callable[[int], TeamVerdict]:
    def verdict_of(robots: int) -> TeamVerdict:
        asked.append(robots)
        return TeamVerdict.ENOUGH if enough(robots) else TeamVerdict.NOT_ENOUGH

    return verdict_of


# The rules, as pure functions.


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((0.91, 0.95), TeamVerdict.ENOUGH),
        ((0.9, 0.9), TeamVerdict.ENOUGH),
        ((0.89, 0.9), TeamVerdict.UNDECIDED),
        ((0.85, 0.95), TeamVerdict.UNDECIDED),
        ((0.85, 0.89), TeamVerdict.NOT_ENOUGH),
        ((1.0, 1.0), TeamVerdict.ENOUGH),
    ],
)
def test_a_team_is_judged_by_its_whole_interval(interval: tuple[float, float], verdict: TeamVerdict) -> None:
    assert judge_team(interval, 0.9) is verdict


def test_all_looks_together_share_the_doubt() -> None:
    assert share_of_doubt(64, 6) * 64 * 6 == pytest.approx(0.05)


def test_search_finds_the_smallest_on_a_growing_curve() -> None:
    for first, most in ((1, 1), (1, 64), (5, 40), (7, 9)):
        for threshold in range(first, most + 2):
            asked: list[int] = []
            found = smallest_enough(first, most, fake(lambda k, t=threshold: k >= t, asked))  # type: ignore[misc]
            assert found == (threshold if threshold <= most else None)
            assert len(asked) == len(set(asked))
            assert all(first <= robots <= most for robots in asked)


def test_search_finds_the_smallest_on_a_curve_that_goes_down_again() -> None:
    asked: list[int] = []
    # Looked at first: 1, 2, 3, 5, 9. Team 4 is enough, 5 to 8 are not: only looking at every team shows it.
    assert smallest_enough(1, 64, fake(lambda robots: robots == 4 or robots >= 9, asked)) == 4
    assert asked[:5] == [1, 2, 3, 5, 9]
    # Nothing larger is enough, and the teams passed over are few: they are all looked at.
    assert smallest_enough(1, 20, fake(lambda robots: robots == 14, [])) == 14


def test_search_halves_a_wide_gap_and_looks_at_all_of_the_rest() -> None:
    asked: list[int] = []
    assert smallest_enough(1, 1024, fake(lambda robots: robots >= 700, asked)) == 700
    assert len(asked) <= 11 + 5 + FEW
    assert set(range(700 - 10, 700)) <= set(asked)
    # Too many to look at, and none of those looked at is enough: no answer.
    asked.clear()
    assert smallest_enough(1, 1024, fake(lambda robots: robots == 400, asked)) is None
    assert asked == [1, *(1 + 2**j for j in range(10)), 1024]


def test_undecided_is_not_enough_for_the_search() -> None:
    verdicts = {1: TeamVerdict.NOT_ENOUGH, 2: TeamVerdict.UNDECIDED, 3: TeamVerdict.ENOUGH, 4: TeamVerdict.ENOUGH}
    assert smallest_enough(1, 4, verdicts.__getitem__) == 3


def test_mean_interval_holds_for_skewed_counts_and_shrinks() -> None:
    rng, alpha, n = np.random.default_rng(5), 0.1, 400
    mean, missed = 10 * 0.99, 0  # ten cells with chance 0.99, else none: rare disasters
    for _ in range(2000):
        often = int(rng.binomial(n, 0.99))
        counts = np.bincount([0, 10], weights=[n - often, often], minlength=11).astype(np.int64)
        low, high = mean_interval(counts, alpha)
        missed += not low <= mean <= high
    assert missed <= 2000 * alpha
    counts = np.array([5000] + [0] * 9 + [5000])
    low, high = mean_interval(counts, 1e-4)
    assert (low, high) == pytest.approx((5 - 0.254921, 5 + 0.254921), abs=1e-6)  # by hand; normal: 0.1945
    assert mean_interval(np.array([0, 1]), alpha) == (0.0, 1.0)


def test_chance_interval_misses_no_more_often_than_it_says() -> None:
    n, alpha = 30, 0.02
    intervals = [chance_interval(successes, n, alpha) for successes in range(n + 1)]
    for p in np.linspace(0.001, 0.999, 200):
        missed = sum(binom.pmf(k, n, p) for k, (low, high) in enumerate(intervals) if not low <= p <= high)
        assert missed <= alpha
    assert intervals[0][0] == 0
    assert intervals[n] == (pytest.approx((alpha / 2) ** (1 / n)), 1.0)


def test_ideals_are_those_of_the_bounds() -> None:
    threat = np.random.default_rng(3).choice([0.0, 0.05, 0.2, 0.6], 40)
    for needed in (1, 20, 40):
        coverage, chance = ideals_of(threat, 12, needed)
        for robots in range(1, 13):
            assert coverage[robots - 1] == pytest.approx(ideal_team(threat, robots))
            hits = poisson_binomial(1.0 - np.sort(threat)[: needed - 1])[::-1]  # chance of so many hits before the last
            assert chance[robots - 1] == pytest.approx(hits[:robots].sum())
    assert ideals_of(threat, 3, 41)[1].tolist() == [0, 0, 0]


def test_ideals_follow_the_parts_of_the_map_and_the_deadline() -> None:
    world = World.create([[0.0, 0.0, NAN, 0.0, 0.0, 0.0]])
    starts = np.array([[0, 0], [0, 1], [0, 5]])
    assert team_ideals(world, starts, 5, 5, None).coverage.tolist() == [0.4, 0.4, 1.0]
    assert team_ideals(world, starts, 5, 5, None).chance.tolist() == [0, 0, 1]
    assert team_ideals(world, starts, 5, 3, 0).coverage.tolist() == pytest.approx([0.2, 0.4, 0.6])
    assert team_ideals(world, starts, 5, 2, 0).chance.tolist() == [0, 1, 1]


def test_no_team_exceeds_its_ideals() -> None:
    world = load_world_file(WORLD)
    for complete in (False, True):
        size = sized(world, make_goal(None if complete else 0.9, 0.9, complete, most=20), rollouts=1024)
        rolled = [point for point in size.points if point.rollouts]
        assert len(rolled) > 3
        for point in rolled:
            assert point.coverage is not None
            assert point.chance is not None
            assert point.coverage.ci95[0] <= point.ideal_coverage
            assert point.chance.ci95[0] <= point.ideal_chance


# Answers that are known.


def test_expected_coverage_of_a_world_with_known_means() -> None:
    known = {k: load_fixture(f"contiguous-14x23-1000-k{k}").answers for k in (1, 2)}
    cells = known[1]["cells"]["accessible"]
    means = {k: known[k]["closed_loop_exact"]["visited"] / cells for k in known}
    size = sized(load_world_file(WORLD), make_goal((means[1] + means[2]) / 2, None, False), seed=3)
    assert size.robots == 2
    assert size.point(1).verdict is TeamVerdict.NOT_ENOUGH
    for robots, mean in means.items():
        point = size.point(robots)
        assert point.coverage is not None
        assert point.interval is not None
        assert abs(point.coverage.mean - mean) <= 5 * point.coverage.se
        assert point.interval[0] <= mean <= point.interval[1]
        assert point.interval[0] < point.coverage.ci95[0]  # all verdicts together are to hold, not this one alone


def test_chance_of_a_corridor_with_one_danger() -> None:
    size = sized(HALF, make_goal(None, None, True))
    assert size.goal.confidence == 0.95
    assert size.robots == 5  # 1 - 0.5**4 = 0.9375, 1 - 0.5**5 = 0.96875
    for robots in (1, 2, 3, 4, 5):
        point = size.point(robots)
        assert point.chance is not None
        assert abs(point.chance.mean - (1 - 0.5**robots)) <= 5 * np.sqrt(0.25 / point.rollouts)
    # Two cells are always visited and the third as often as all: (3 - 0.5**K) / 3 reaches 0.95 with K = 3.
    assert sized(HALF, make_goal(0.95, None, False)).robots == 3
    # Survived: with chance 0.5**K only the first cell.
    assert sized(HALF, make_goal(0.95, None, False, "survived")).robots == 4


def test_what_lies_on_the_line_is_undecided() -> None:
    size = sized(HALF, make_goal(None, 0.5, True), rollouts=10_000)  # one robot completes with chance 0.5
    assert size.robots == 2
    assert size.of(TeamVerdict.UNDECIDED) == (1,)
    assert size.point(1).rollouts == 10_000
    assert size_headline(size).startswith("1 or 2 robots: with 2, ")
    assert "1 is undecided after 10,000 rollouts" in size_headline(size)
    alone = sized(HALF, make_goal(None, 0.5, True, most=1), rollouts=10_000)
    assert alone.robots is None
    assert alone.to_json()["undecided"] == [1]
    assert size_headline(alone).startswith("No team of up to 1 robot is shown to be enough")
    short = sized(HALF, make_goal(None, 0.9, True, most=2))
    assert size_headline(short).startswith(
        "No team of up to 2 robots is enough for a chance of 90 % for every accessible "
    )
    assert "with 2, 7" in size_headline(short)


def test_without_threats_one_robot_is_enough_for_certain() -> None:
    for confidence in (None, 0.999):
        size = sized(World.create(np.zeros((4, 5))), make_goal(1.0, confidence, False))
        point = size.point(1)
        assert size.robots == 1
        assert point.exact
        assert point.interval == (1.0, 1.0)


def test_open_loop_means_are_exact() -> None:
    # The danger is the last cell of the way: it is visited for certain, and left alive with chance 0.5.
    world = World.create([[0.0, 0.0, 0.5]])
    assert sized(world, make_goal(1.0, None, False), loop="open").robots == 1
    size = sized(world, make_goal(0.9, None, False, "survived", most=3), loop="open")
    assert size.point(1).coverage == size.point(1).coverage.__class__(2.5 / 3, 0.0, (2.5 / 3, 2.5 / 3))
    with pytest.raises(UsageError, match="no number of rollouts"):
        sized(world, make_goal(1.0, None, False))


def test_a_team_s_counts_are_those_of_evaluate_with_the_same_seed() -> None:
    world = load_world_file(WORLD)
    size = sized(world, make_goal(0.8, None, False), seed=9, rollouts=4096)
    rolled = [point for point in size.points if point.rollouts]
    assert len(rolled) >= 3
    for point in rolled:
        plan = make_plan(world, place_starts(world, point.robots)[0])
        tally = evaluate(world, plan, RolloutChoices(rollouts=point.rollouts, seed=9, exact="never")).tally
        assert point.coverage == tally_mean(tally, "visited", 1.0 / tally.accessible)


def test_explicit_starts_in_two_parts_of_a_map() -> None:
    world = World.create([[0.0, 0.0, NAN, 0.0, 0.0]], starts=[[0, 0], [0, 4]])
    size = sized(world, make_goal(0.9, None, False))
    assert size.robots == 2
    assert size.cells == 4
    assert size.point(1).verdict is TeamVerdict.IMPOSSIBLE
    assert "2 starts are given" in size.notes[0]
    # The first robot alone reaches half of what the team reaches: enough for half, of the same denominator.
    half = sized(world, make_goal(0.5, None, False))
    assert half.robots == 1
    assert half.point(1).coverage is not None
    assert half.point(1).coverage.mean == 0.5  # type: ignore[union-attr]
    # The same sampled: both cells of its part are always visited, half of all.
    risky = sized(World.create([[0.0, 0.5, NAN, 0.0, 0.0]], starts=[[0, 0], [0, 4]]), make_goal(0.45, None, False))
    assert risky.robots == 1
    assert not risky.point(1).exact
    assert risky.point(1).coverage.mean == 0.5  # type: ignore[union-attr]


def test_a_deadline_counts_what_is_covered_by_then() -> None:
    world = World.create(np.zeros((1, 10)), starts=[[0, 0], [0, 9]])
    for loop in ("open", "closed"):
        size = sized(world, make_goal(1.0, None, False), loop=loop, deadline=4)
        assert size.robots == 2
        assert size.point(1).verdict is TeamVerdict.IMPOSSIBLE
        late = sized(world, make_goal(1.0, None, False), loop=loop, deadline=9)
        assert late.robots == 1
        early = sized(world, make_goal(0.9, None, False), loop=loop, deadline=3)
        assert early.robots is None


def test_a_mission_s_own_deadline_is_said() -> None:
    world, goal = World.create(np.zeros((1, 8))), make_goal(0.6, None, False, most=2)
    found = find_size(world, Settings(deadline=4), goal, RolloutChoices(rollouts=64))
    assert found.to_json()["deadline"] == found.deadline == 4
    assert "by step 4" in str(found)


def test_a_deadline_counts_what_evaluate_counts() -> None:
    world = load_world_file(WORLD)
    for loop in ("open", "closed"):
        size = sized(world, make_goal(0.3, None, False, most=3), loop=loop, deadline=40, rollouts=4096)
        rolled = [point for point in size.points if point.coverage]
        assert len(rolled) == 2  # by step 40 one robot has entered 41 cells, too few
        for point in rolled:
            plan = make_plan(world, place_starts(world, point.robots)[0])
            found = evaluate(world, plan, RolloutChoices(loop=loop, rollouts=4096, deadline=40))  # type: ignore[arg-type]
            cut = found.outputs.get("deadline")
            assert cut is not None
            visited, n = cut.tally.visited, size.cells
            by_then = (
                found.closed_form.by_deadline(40)[0] / n
                if loop == "open"
                else tally_mean(cut.tally, "visited", 1 / n).mean
            )
            assert point.coverage is not None
            assert point.coverage.mean == pytest.approx(by_then, rel=1e-12)
            assert point.chance is not None
            assert point.chance.mean == pytest.approx(visited[size.needed :].sum() / visited.sum())


def test_precision_makes_every_team_that_precise() -> None:
    size = sized(load_world_file(WORLD), make_goal(0.66, None, False), precision=0.004)
    assert size.robots == 2
    for point in size.points:
        assert point.verdict is TeamVerdict.IMPOSSIBLE or point.coverage.half_width < 0.004  # type: ignore[union-attr]


# What is printed and written.


def test_json_table_and_first_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = (WORLD, "--target", "0.66", "--rollouts", "20000", "--exact", "never")
    found = answer(capsys, *words)
    keys = {
        "target", "confidence", "complete", "meaning", "robots", "undecided", "curve", "seed", "loop", "engine",
        "version", "not_looked_at", "starts", "cells", "most",
    }  # fmt: skip
    assert found.keys() >= keys
    assert (found["robots"], found["undecided"], found["not_looked_at"]) == (2, [], [])
    assert (found["target"], found["confidence"], found["complete"], found["loop"]) == (0.66, None, False, "closed")
    assert len(found["starts"]) == 2
    assert "partial" not in found
    last = found["curve"][-1]
    assert (last["robots"], last["verdict"]) == (2, "enough")
    assert last["coverage"]["ci95"][0] < last["coverage"]["mean"] < last["coverage"]["ci95"][1]
    assert last["verdict_interval"][0] >= 0.66
    assert 0 <= last["chance"]["mean"] <= 1
    assert run(["size", *words]) == 0
    assert capsys.readouterr().out.startswith("2 robots are enough: ")


def test_the_headline_is_of_rollouts_that_had_no_part_in_the_choice() -> None:
    world = load_world_file(Path(WORLD))
    choices = RolloutChoices(rollouts=8192, seed=3, engine="numba", exact="never")
    found = find_size(world, Settings(), make_goal(0.66, None, False), choices)
    own, fresh = found.point(found.robots or 0), found.confirmed
    assert fresh is not None and own.coverage is not None and fresh.coverage is not None
    start = max(point.rollouts for point in found.points)
    plan = plan_team(world, found.starts[: found.robots], Settings())
    engine = make_engine_for(world, plan, choices)
    runs = tally_mean(run_by_luck(engine, 3, start, own.rollouts)[0], "visited", 1.0 / found.cells)
    assert fresh.coverage == runs and fresh.coverage.mean != own.coverage.mean
    assert f"{100 * fresh.coverage.mean:.4g} %" in size_headline(found) and "fresh rollouts" in size_headline(found)
    assert found.to_json()["confirmed"]["coverage"] == fresh.coverage.to_json()


def test_tables_fit_eighty_columns() -> None:
    for goal in (make_goal(0.9, 0.9, False), make_goal(None, None, True, most=40)):
        out = io.StringIO()
        print_report(size_report(sized(load_world_file(WORLD), goal, rollouts=256)), Console(file=out, width=80))
        rows = [line for line in out.getvalue().splitlines() if line.rstrip().endswith(("enough", "impossible"))]
        assert len(rows) > 3
        assert all(".." in row or "<=" in row for row in rows)  # nothing was cut off


def test_no_team_is_an_answer(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, WORLD, "--target", "0.95", "--most", "3")
    assert found["robots"] is None
    assert found["starts"] is None
    assert [point["verdict"] for point in found["curve"]] == ["impossible"] * 3
    assert found["curve"][0]["coverage"] is None
    assert run(["size", WORLD, "--target", "0.95", "--most", "3"]) == 0
    assert "whatever the strategy" in capsys.readouterr().out.splitlines()[0]


def test_out_writes_picture_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "folder"
    found = answer(capsys, WORLD, "--target", "0.66", "--rollouts", "4096", "--out", str(folder))
    assert {path.name for path in folder.iterdir()} == {"index.html", "size.png", "size.txt", "size.json"}
    assert json.loads((folder / "size.json").read_text()) == found
    with Image.open(folder / "size.png") as picture:
        assert picture.size[0] == 1200


def test_the_picture_shows_the_answer() -> None:
    size = sized(HALF, make_goal(None, 0.5, True), rollouts=10_000)
    axes = mrac.plots.size_figure(size).axes[0]
    assert axes.get_title(loc="left") == "1 or 2 robots for a 50 % chance of every cell"
    lines = {line.get_label(): np.asarray(line.get_xdata()).tolist() for line in axes.get_lines()}
    assert lines["enough: 2"] == [2, 2]
    assert lines["undecided"] == [1]
    chance = next(line for line in axes.get_lines() if line.get_label() == "chance of every cell")
    assert np.asarray(chance.get_ydata())[1] == pytest.approx(75, abs=5)


def test_interrupted_prints_what_is_there(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    import planner.simulator.closed_loop

    whole, calls = planner.simulator.closed_loop.run_range, []

    def interrupted(*given: object, **options: object) -> object:
        calls.append(given)
        if len(calls) == 10:  # four a team: compilation, and looks at 1,024, 2,048 and 4,096
            raise KeyboardInterrupt
        return whole(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(planner.simulator.closed_loop, "run_range", interrupted)
    found = answer(capsys, WORLD, "--target", "0.95", status=130)
    assert found["partial"] is True
    assert found["robots"] is None
    assert sum(point["rollouts"] > 0 for point in found["curve"]) == 2
    calls.clear()
    assert run(["size", WORLD, "--target", "0.95"]) == 130
    assert capsys.readouterr().out.startswith("Interrupted before the answer: ")
    calls[:] = [()] * 9  # before anything was done: nothing to print
    assert run(["size", WORLD, "--target", "0.95"]) == 130
    assert capsys.readouterr().out == ""


def test_interrupted_while_a_team_is_rolled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    import planner.simulator.closed_loop

    whole, calls = planner.simulator.closed_loop.run_range, []

    def interrupted(*given: object, **options: object) -> object:
        calls.append(given)
        if len(calls) == 6:  # after compilation and four looks
            raise KeyboardInterrupt
        return whole(*given, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(planner.simulator.closed_loop, "run_range", interrupted)
    size = sized(HALF, make_goal(None, 0.5, True))
    assert size.partial
    assert size.robots is None
    assert size.to_json()["undecided"] == [1]
    assert size.point(1).rollouts == 8192
    assert size_headline(size).startswith("Interrupted before the answer: nothing is decided yet")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("WORLD", "--target, a fraction"),
        ("WORLD --target 0", "--target 0"),
        ("WORLD --target 1.1", "--target 1.1"),
        ("WORLD --target -0.5", "--target -0.5"),
        ("WORLD --target nan", "expected a number"),
        ("WORLD --target 90%", "expected a number"),
        ("WORLD --target 1", "use --complete"),
        ("WORLD --target 0.9 --complete", "one of them"),
        ("WORLD --target 0.9 --confidence 1", "--confidence 1"),
        ("WORLD --target 0.9 --confidence 0", "--confidence 0"),
        ("WORLD --target 0.9 --most 0", "--most 0"),
        ("WORLD --target 0.9 --most 1025", "1 to 1024"),
        ("WORLD --target 0.9 --most 1.5", "whole number"),
        ("WORLD --target 0.9 --meaning seen", "visited or survived"),
        ("WORLD --target 0.9 --plan plan.json", "--plan"),
        ("WORLD --target 0.9 --robots 3", "--robots"),
        ("WORLD --target 0.9 --rollouts 0", "--rollouts 0"),
        ("WORLD --target 0.9 --rollouts 5 --precision 0.1", "one of them"),
        ("WORLD --target 0.9 --levels 1", "--levels 1; expected"),
        ("WORLD --target 0.9 --starts 0,0", "obstacle"),
        ("WORLD --target 0.9 --out WORLD", "is a file"),
        ("nowhere.npz --target 0.9", "no such file"),
    ],
)
def test_wrong_usage_is_one_line_and_status_2(
    words: str, said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    line = refused(capsys, "size", *(WORLD if word == "WORLD" else word for word in words.split()))
    assert said.lower() in line.lower()
    assert list(tmp_path.iterdir()) == []
