"""The commands `size` and `front`."""

import json
import re
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from html import escape
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER, load_fixture
from helpers import after, answer_of, error_of, interrupt_rollouts
from numpy.typing import NDArray
from scipy.stats import binom

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.evaluation import evaluate as answer
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.advice import Advice
from analysis.evaluation.outputs.what_if import ThreatScale
from analysis.report.result import print_report, report_of
from analysis.sampling import RolloutChoices, make_engine_for
from analysis.search import pareto as search
from analysis.search import reports
from analysis.search import team_size as teams
from analysis.search.pareto import Figures, Front, Ladders, Point, Setting, between, find_front, first_robot_value, knee
from analysis.search.pareto import Goal as FrontGoal
from analysis.search.reports import _front_chart, front_summary, selection_lines, size_report, size_summary
from analysis.search.team_size import Goal, TeamVerdict, make_goal, smallest_enough, upper_bounds_of
from analysis.statistics.estimates import chance_interval, error_share, exactly, mean_interval
from analysis.statistics.variance_reduction import tally_mean
from analysis.theory.bounds import ideal_team
from analysis.theory.exact import poisson_binomial
from analysis.utils.tables import as_text
from planner.errors import UsageError
from planner.make_plan import make_plan
from planner.open_loop import plan_team
from planner.rollouts import tables
from planner.rollouts.engine import run_with_threshold_sums
from planner.rollouts.single_run import PythonLoop
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.world.world import World, load_world_file

# `mrac-jax size`: the decision rule, the search, the bounds that rule teams out, and answers that are known.

NAN = float("nan")
WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
HALF = World.create([[0.0, 0.5, 0.0]], starts=[[0, 0]] * 8)
"""All robots start in the first cell, and one of K gets past the second with chance 1 - 0.5**K: then all is covered."""


def sized(world: World, goal: Goal, *, settings: Settings | None = None, **choices: object) -> teams.TeamSize:
    return teams.find_size(world, settings or Settings(), goal, RolloutChoices(**{"exact": "never", **choices}))  # type: ignore[arg-type]


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


def answer_size(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict:
    return answer_of(capsys, "size", *words, status=status)


def fake(enough: Callable[[int], bool], asked: list[int]) -> Callable[[int], TeamVerdict]:
    def verdict_of(robots: int) -> TeamVerdict:
        asked.append(robots)
        return TeamVerdict.ENOUGH if enough(robots) else TeamVerdict.NOT_ENOUGH

    return verdict_of


# The rules, as pure functions.


def test_a_team_is_judged_by_its_whole_interval() -> None:
    enough, undecided, not_enough = TeamVerdict.ENOUGH, TeamVerdict.UNDECIDED, TeamVerdict.NOT_ENOUGH
    for *interval, verdict in ((0.91, 0.95, enough), (0.9, 0.9, enough), (0.89, 0.9, undecided), (1.0, 1.0, enough),
                               (0.85, 0.95, undecided), (0.85, 0.89, not_enough)):  # fmt: skip
        assert teams.verdict_of_team(tuple(interval), 0.9) is verdict


def test_search_finds_the_smallest_on_a_growing_curve() -> None:
    for first, most in ((1, 1), (1, 64), (5, 40), (7, 9)):
        for threshold in range(first, most + 2):
            asked: list[int] = []
            found = smallest_enough(first, most, fake(lambda k, t=threshold: k >= t, asked))  # type: ignore[misc]
            assert found == (threshold if threshold <= most else None)
            assert len(asked) == len(set(asked)) and first <= min(asked) and max(asked) <= most


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
    assert len(asked) <= 11 + 5 + teams.FEW
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
    assert error_share(64, 6) * 64 * 6 == pytest.approx(0.05), "all looks together share the doubt"
    assert intervals[0][0] == 0
    assert intervals[n] == (pytest.approx((alpha / 2) ** (1 / n)), 1.0)


def test_ideals_are_those_of_the_bounds() -> None:
    threat = np.random.default_rng(3).choice([0.0, 0.05, 0.2, 0.6], 40)
    for needed in (1, 20, 40):
        coverage, chance = upper_bounds_of(threat, 12, needed)
        for robots in range(1, 13):
            assert coverage[robots - 1] == pytest.approx(ideal_team(threat, robots))
            hits = poisson_binomial(1.0 - np.sort(threat)[: needed - 1])[::-1]  # chance of so many hits before the last
            assert chance[robots - 1] == pytest.approx(hits[:robots].sum())
    assert upper_bounds_of(threat, 3, 41)[1].tolist() == [0, 0, 0]


def test_ideals_follow_the_parts_of_the_map_and_the_deadline() -> None:
    world = World.create([[0.0, 0.0, NAN, 0.0, 0.0, 0.0]])
    for needed, deadline, coverage, chance in ((5, None, [0.4, 0.4, 1], [0, 0, 1]), (2, 0, [0.2, 0.4, 0.6], [0, 1, 1])):
        found = teams.team_upper_bounds(world, np.array([[0, 0], [0, 1], [0, 5]]), 5, needed, deadline)
        assert (found.coverage.tolist(), found.chance.tolist()) == (pytest.approx(coverage), chance)


def test_no_team_exceeds_its_ideals() -> None:
    for complete in (False, True):
        goal = make_goal(None if complete else 0.9, 0.9, complete, most=20)
        size = sized(load_world_file(WORLD), goal, rollouts=1024)
        rolled = [point for point in size.points if point.rollouts]
        assert len(rolled) > 3 and all(point.coverage.ci95[0] <= point.ideal_coverage for point in rolled)
        assert all(point.chance.ci95[0] <= point.ideal_chance for point in rolled)


# Answers that are known.


def test_expected_coverage_of_a_world_with_known_means() -> None:
    known = {k: load_fixture(f"contiguous-14x23-1000-k{k}").answers for k in (1, 2)}
    means = {k: known[k]["closed_loop_exact"]["visited"] / known[1]["cells"]["accessible"] for k in known}
    size = sized(load_world_file(WORLD), make_goal((means[1] + means[2]) / 2, None, False), seed=3)
    assert size.robots == 2 and size.point(1).verdict is TeamVerdict.NOT_ENOUGH
    for robots, mean in means.items():
        point = size.point(robots)
        assert abs(point.coverage.mean - mean) <= 5 * point.coverage.se
        assert point.interval[0] <= mean <= point.interval[1]
        assert point.interval[0] < point.coverage.ci95[0]  # all verdicts together are to hold, not this one alone


def test_chance_of_a_corridor_with_one_danger() -> None:
    size = sized(HALF, make_goal(None, None, True))
    assert size.goal.confidence == 0.95
    assert size.robots == 5  # 1 - 0.5**4 = 0.9375, 1 - 0.5**5 = 0.96875
    for robots in (1, 2, 3, 4, 5):
        point = size.point(robots)
        assert abs(point.chance.mean - (1 - 0.5**robots)) <= 5 * np.sqrt(0.25 / point.rollouts)
    # Two cells are always visited and the third as often as all: (3 - 0.5**K) / 3 reaches 0.95 with K = 3.
    assert sized(HALF, make_goal(0.95, None, False)).robots == 3
    # Survived: with chance 0.5**K only the first cell.
    assert sized(HALF, make_goal(0.95, None, False, "survived")).robots == 4


def test_what_lies_on_the_line_is_undecided() -> None:
    size = sized(HALF, make_goal(None, 0.5, True), rollouts=10_000)  # one robot completes with chance 0.5
    assert (size.robots, size.of(TeamVerdict.UNDECIDED), size.point(1).rollouts) == (2, (1,), 10_000)
    said = size_summary(size)
    assert said.startswith("2 robots are enough: ") and said.endswith("; undecided after 10,000 rollouts: 1.")
    alone = sized(HALF, make_goal(None, 0.5, True, most=1), rollouts=10_000)
    assert alone.robots is None and alone.to_json()["undecided"] == [1]
    assert size_summary(alone).startswith("No team of up to 1 robot is shown to be enough")
    said = "No team of up to 2 robots is shown to be enough for a chance of 90 % for every accessible cell visited: "
    assert size_summary(sized(HALF, make_goal(None, 0.9, True, most=2))).startswith(f"{said}with 2, 7")
    axes = mrac.plots.size_figure(size).axes[0]
    assert axes.get_title(loc="left") == "Robots for a 50 % chance of every cell: 2 robots"
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert list(lines["enough: 2"].get_xdata()) == [2, 2] and list(lines["undecided"].get_xdata()) == [1]
    assert lines["chance of every cell"].get_ydata()[1] == pytest.approx(75, abs=5)


def test_without_threats_one_robot_is_enough_for_certain() -> None:
    for confidence in (None, 0.999):
        size = sized(World.create(np.zeros((4, 5))), make_goal(1.0, confidence, False))
        assert size.robots == 1 and size.point(1).exact and size.point(1).interval == (1.0, 1.0)


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
        choices = RolloutChoices(rollouts=point.rollouts, seed=9, exact="never")
        tally = evaluate(world, mrac.plan(world, point.robots), choices).tally
        assert point.coverage == tally_mean(tally, "visited", 1.0 / tally.accessible)


def test_explicit_starts_in_two_parts_of_a_map() -> None:
    world = World.create([[0.0, 0.0, NAN, 0.0, 0.0]], starts=[[0, 0], [0, 4]])
    size = sized(world, make_goal(0.9, None, False))
    assert (size.robots, size.cells, size.point(1).verdict) == (2, 4, TeamVerdict.IMPOSSIBLE)
    assert "2 starts are given" in size.notes[0]
    # The first robot alone reaches half of what the team reaches: enough for half, of the same denominator. The same
    # sampled: both cells of its part are always visited, half of all.
    risky = World.create([[0.0, 0.5, NAN, 0.0, 0.0]], starts=[[0, 0], [0, 4]])
    for of, share in ((world, 0.5), (risky, 0.45)):
        half = sized(of, make_goal(share, None, False))
        assert half.robots == 1 and half.point(1).coverage.mean == 0.5 and half.point(1).exact == (of is world)


def test_a_deadline_counts_what_is_covered_by_then() -> None:
    world = World.create(np.zeros((1, 10)), starts=[[0, 0], [0, 9]])
    for loop in ("open", "closed"):
        for target, deadline, robots in ((1.0, 4, 2), (1.0, 9, 1), (0.9, 3, None)):
            size = sized(world, make_goal(target, None, False), loop=loop, deadline=deadline)
            assert size.robots == robots and (robots == 1 or size.point(1).verdict is TeamVerdict.IMPOSSIBLE)


def test_a_mission_s_own_deadline_is_said() -> None:
    found = sized(World.create(np.zeros((1, 8))), make_goal(0.6, None, False, most=2), settings=Settings(deadline=4))
    assert found.to_json()["deadline"] == found.deadline == 4 and "by step 4" in str(found)


def test_a_deadline_counts_what_evaluate_counts() -> None:
    world = load_world_file(WORLD)
    for loop in ("open", "closed"):
        size = sized(world, make_goal(0.3, None, False, most=3), loop=loop, deadline=40, rollouts=4096)
        rolled = [point for point in size.points if point.coverage]
        assert len(rolled) == 2  # by step 40 one robot has entered 41 cells, too few
        for point in rolled:
            found = mrac.evaluate(world, point.robots, loop=loop, rollouts=4096, deadline=40, advice=False, band=False)
            tally, exact = found.outputs["deadline"].tally, found.closed_form.by_deadline(40)[0] / size.cells
            mean = exact if loop == "open" else tally_mean(tally, "visited", 1 / size.cells).mean
            assert point.coverage.mean == pytest.approx(mean, rel=1e-12)
            assert point.chance.mean == pytest.approx(tally.visited[size.needed :].sum() / tally.visited.sum())


def test_precision_makes_every_team_that_precise() -> None:
    size = sized(load_world_file(WORLD), make_goal(0.66, None, False), precision=0.004)
    assert size.robots == 2
    for point in size.points:
        assert point.verdict is TeamVerdict.IMPOSSIBLE or point.coverage.half_width < 0.004  # type: ignore[union-attr]


# What is printed and written.


def test_json_table_and_first_line(capsys: pytest.CaptureFixture[str]) -> None:
    words = (WORLD, "--target", "0.66", "--rollouts", "20000", "--exact", "never")
    found = answer_size(capsys, *words)
    known = {"robots": 2, "undecided": [], "not_looked_at": [], "target": 0.66, "confidence": None, "complete": False}
    assert found.items() >= (known | {"loop": "closed"}).items() and "partial" not in found
    assert found.keys() >= {"meaning", "seed", "engine", "version", "cells", "most"} and len(found["starts"]) == 2
    last = found["curve"][-1]
    assert (last["robots"], last["verdict"]) == (2, "enough")
    assert last["coverage"]["ci95"][0] < last["coverage"]["mean"] < last["coverage"]["ci95"][1]
    assert last["verdict_interval"][0] >= 0.66 and 0 <= last["chance"]["mean"] <= 1
    assert run(["size", *words]) == 0 and capsys.readouterr().out.startswith("2 robots are enough: ")


def test_the_headline_is_of_rollouts_that_had_no_part_in_the_choice() -> None:
    found = sized(load_world_file(WORLD), make_goal(0.66, None, False), rollouts=8192, seed=3, engine="numba")
    own, fresh = found.point(found.robots), found.confirmed
    plan = plan_team(found.world, found.starts[: found.robots], Settings())
    engine = make_engine_for(found.world, plan, RolloutChoices(rollouts=8192, seed=3, engine="numba", exact="never"))
    tally, _ = run_with_threshold_sums(engine, 3, max(point.rollouts for point in found.points), own.rollouts)
    assert fresh.coverage == tally_mean(tally, "visited", 1.0 / found.cells)
    assert fresh.coverage.mean != own.coverage.mean
    assert f"{100 * fresh.coverage.mean:.4g} %" in size_summary(found) and "fresh rollouts" in size_summary(found)
    assert found.to_json()["confirmed"]["coverage"] == fresh.coverage.to_json()


def test_tables_fit_eighty_columns() -> None:
    for goal in (make_goal(0.9, 0.9, False), make_goal(None, None, True, most=40)):
        said = size_report(sized(load_world_file(WORLD), goal, rollouts=256))
        lines = as_text(lambda console, said=said: print_report(said, console), 80).splitlines()
        rows = [line for line in lines if line.rstrip().endswith(("enough", "impossible"))]
        assert len(rows) > 3 and all(".." in row or "<=" in row for row in rows)  # nothing was cut off


def test_no_team_is_an_answer(capsys: pytest.CaptureFixture[str]) -> None:
    found = answer_size(capsys, WORLD, "--target", "0.95", "--most", "3")
    assert found["robots"] is found["starts"] is found["curve"][0]["coverage"] is None
    assert [point["verdict"] for point in found["curve"]] == ["impossible"] * 3
    assert run(["size", WORLD, "--target", "0.95", "--most", "3"]) == 0
    assert "upper bound" in (said := " ".join(capsys.readouterr().out.split())) and "whatever the policy" in said


def test_interrupted_prints_what_is_there(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    tenth = 10  # four a team: compilation, and looks at 1,024, 2,048 and 4,096
    interrupt_rollouts(monkeypatch, tenth)
    found = answer_size(capsys, WORLD, "--target", "0.95", status=130)
    assert found["partial"] is True and found["robots"] is None
    assert sum(point["rollouts"] > 0 for point in found["curve"]) == 2
    # Interrupted before anything was done there is nothing to print.
    for call, said in ((tenth, "Interrupted before the answer for 95 % of "), (1, "")):
        interrupt_rollouts(monkeypatch, call)
        assert run(["size", WORLD, "--target", "0.95"]) == 130
        out = capsys.readouterr().out
        assert out.startswith(said) and bool(out) == bool(said)


def test_interrupted_while_a_team_is_rolled_out(monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt_rollouts(monkeypatch, 6)  # after compilation and four looks
    size = sized(HALF, make_goal(None, 0.5, True))
    assert size.partial and size.robots is None and size.to_json()["undecided"] == [1]
    assert size.point(1).rollouts == 8192
    assert size_summary(size).endswith(" for every accessible cell visited: undecided: 1.")


# `mrac-jax front`: what is looked at, what nothing beats, the pick; held against the simulator as Python.

THREAT = np.zeros((6, 9))
THREAT[1:3, 3:7], THREAT[4:, 6:], THREAT[0, 8], THREAT[3, 2] = 0.2, 0.05, np.nan, np.nan
WORLD_FRONT = World.create(THREAT, starts=[[0, 0], [5, 0]])
RISK_CAPS, ROBOT_VALUES, RUNS = (0.5,), (4.0, 15.0), 50


USUAL = Ladders((), None, ())


def found_of(ladders: Ladders = USUAL, rollouts: int = 1000, seed: int = 7, **goal: float) -> Front:
    """The front of WORLD_FRONT with a goal, every value of it sampled."""
    choices = RolloutChoices(rollouts=rollouts, seed=seed, engine="numba", exact="never")
    limit = FrontGoal(**goal) if goal else None
    return find_front(WORLD_FRONT, WORLD_FRONT.starts, Settings(), choices, goal=limit, ladders=ladders)


@pytest.fixture(scope="module")
def small() -> Front:
    return found_of(Ladders(RISK_CAPS, ROBOT_VALUES, (0.4, 0.7)), RUNS, 3, losses=0.8)


def rolled_out(setting: Setting, ids: range) -> NDArray[np.float64]:
    """Mean cells visited, robots lost and steps."""
    loop = PythonLoop(make_plan(WORLD_FRONT, WORLD_FRONT.starts, search.settings_of(Settings(), setting)), WORLD_FRONT)
    runs = [loop.run(3, rollout) for rollout in ids]
    lost = [(~one.alive).sum() for one in runs]
    return np.mean([[one.visited.sum() for one in runs], lost, [one.step for one in runs]], axis=1)


def shown(point: Point, cells: int) -> NDArray[np.float64]:
    return np.array([point.coverage.mean * cells, point.losses.mean, point.time.mean])


def test_every_point_is_what_the_simulator_as_python_says(small: Front) -> None:
    settings = {point.setting for point in small.points}
    assert {Setting("mrac"), Setting("per_cell"), Setting("per_cell", risk_cap=0.5)} <= settings
    assert {s.robot_value for s in settings if s.robot_value} == {*ROBOT_VALUES}
    cut = {s.policy for s in settings if s.deadline is not None}
    assert cut == {"mrac", "per_cell"} and len(settings) == len(small.points) == 2 + 4 + 1 + 2
    for point in small.points:
        assert shown(point, small.cells) == pytest.approx(rolled_out(point.setting, range(RUNS)))
    picked, again = small.picked, small.confirmed
    assert picked is not None and again is not None and again.setting == picked.setting
    assert shown(again, small.cells) == pytest.approx(rolled_out(picked.setting, range(RUNS, 2 * RUNS)))


def test_missions_end_at_the_first_step_by_which_a_landmark_is_covered(small: Front) -> None:
    ended = [point for point in small.points if point.setting.deadline]
    for policy, mark in product(("mrac", "per_cell"), (0.4, 0.7)):
        cut = [point for point in ended if point.setting.policy == policy and point.coverage.mean >= mark]
        last = min(cut, key=lambda point: point.setting.deadline)
        before = last.setting._replace(deadline=last.setting.deadline - 1)
        assert rolled_out(before, range(RUNS))[0] / small.cells < mark <= last.coverage.mean


# The rules, as pure functions.


def test_efficient_is_what_no_other_one_beats() -> None:
    draw = np.random.default_rng(5)
    for _ in range(50):
        points = [Figures(*map(float, row)) for row in draw.integers(0, 4, (12, 3))]
        for one, best in zip(points, search.efficient(points), strict=True):
            better = [
                other.coverage - one.coverage >= 0 and one.losses - other.losses >= 0 and one.time - other.time >= 0
                and (other.coverage > one.coverage or other.losses < one.losses or other.time < one.time)
                for other in points
            ]  # fmt: skip
            assert best == (not any(better))


def test_a_goal_picks_the_most_coverage_or_the_fewest_lost() -> None:
    points = [Figures(0.9, 3, 50), Figures(0.7, 1, 40), Figures(0.7, 1, 30), Figures(0.2, 0, 5), Figures(0.7, 2, 9)]
    assert [FrontGoal(losses=lost).pick(points) for lost in (9, 3, 2.9, 1, 0.5)] == [0, 0, 2, 2, 3]
    assert [FrontGoal(target=share).pick(points) for share in (0.95, 0.9, 0.7, 0.1)] == [None, 0, 2, 3]
    assert FrontGoal(losses=-1.0).pick(points) is None and FrontGoal().pick(points) is None
    assert bool(FrontGoal(losses=0.0)) and not FrontGoal()


def test_the_ladder_of_worth() -> None:
    assert (first_robot_value(0.2), first_robot_value(0.03), first_robot_value(0.9)) == (5, 33, 1.1)
    assert between(10, 40) == 20 and between(200, 100) == 141
    words = Setting("per_cell", robot_value=0.1, deadline=7).options()
    assert " ".join(words) == "--policy per_cell --robot-value 0.1 --deadline 7"
    assert str(Setting("per_cell", 0.25, 12)) == "per_cell, risk cap 0.25, robot value 12"


def test_around_a_goal_worths_are_tried_between() -> None:
    one = load_fixture("contiguous-20x20-1000-k2")
    choices = RolloutChoices(rollouts=3000, exact="never")
    found = find_front(one.world, one.starts, Settings(), choices, goal=FrontGoal(losses=0.5), ladders=USUAL)
    settings = {p.setting: p for p in found.points if p.setting.robot_value is not None}
    lost = {setting.robot_value: point.losses.mean for setting, point in settings.items() if setting.deadline is None}
    values = sorted(lost)
    tried = set(values) - {values[0] * 2.0**step for step in range(16)}
    assert values[0] == first_robot_value(float(np.nanmax(one.world.threat)))
    assert 1 <= len(tried) <= 3 and lost[values[-1]] < 0.02
    assert any(lost[a] > 0.5 >= lost[b] and {a, b} & tried for a, b in pairwise(values))
    assert len({p.figures for p in settings.values()}) == len(settings)
    (early,) = {setting.robot_value for setting in settings if setting.deadline is not None}
    assert lost[max(value for value in values if value <= early)] > 0.5  # equal ones are left out
    ends = {setting.deadline: point for setting, point in settings.items() if setting.deadline is not None}
    # An end at one of three equal parts of the coverage between the two values gave 0.617.
    assert found.confirmed.most <= 0.5 and found.confirmed.coverage.mean > 0.625 and len(ends) <= 6
    assert ends[found.picked.setting.deadline + 1].most > 0.5, "the last step that keeps the limit"


# The command.


@pytest.fixture
def world_file(tmp_path: Path) -> str:
    WORLD_FRONT.save(tmp_path / "world.npz")
    return str(tmp_path / "world.npz")


TOLD = ["--rollouts", "1000", "--seed", "5", "--robot-values", "12", "--risk-caps", "", "--exact", "never"]


@pytest.mark.parametrize("goal", [["--target", "0.75", "--deadline", "40"], ["--losses", "0.9"]])
def test_the_plan_of_the_pick_keeps_what_was_promised(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, goal: list[str]
) -> None:
    """The same ids, seed and map: `evaluate --plan` gives the figures of `front`, wherever the mission ends."""
    saved = str(tmp_path / "plan.json")
    front = answer_of(capsys, "front", world_file, *TOLD, "--levels", "8", *goal, "--plan-out", saved)
    point, words = front["points"][front["pick"]], ["--rollouts", "1000", "--seed", "5", "--exact", "never"]
    same = answer_of(capsys, "evaluate", world_file, "--plan", saved, *words)
    assert same["coverage"]["visited"]["mean"] == point["coverage"]["mean"]
    assert same["losses"]["mean"] == point["losses"]["mean"] and same["time"]["mean"] == point["time"]["mean"]
    assert same["plan"]["settings"]["levels"] == 8 and same["plan"]["settings"].get("deadline") == point["deadline"]
    keys = {"policy", "risk_cap", "robot_value", "deadline", "coverage", "losses", "time", "efficient"}
    assert all(set(one) == keys for one in front["points"]) and any(one["efficient"] for one in front["points"])
    again = front["confirmed"]
    assert again["first_rollout"] == front["rollouts"] == 1000 and 1 <= again["tried"] <= 6
    assert again["bound"] <= 0.9 if "--losses" in goal else again["bound"] >= 0.75


def test_the_command_of_the_pick_rolls_out_luck_that_had_no_part_in_the_choice(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    told = ["front", world_file, *TOLD, "--losses", "0.9", "--deadline", "40"]
    for more, ended in (([], True), (["--plan-out", str(tmp_path / "plan.json")], False)):
        front = answer_of(capsys, *told, *more)
        program, *words = shlex.split(front["command"])
        assert program == "mrac-jax" and words[:2] == ["evaluate", world_file] and words[-2:] == ["--seed", "6"]
        same, fresh = answer_of(capsys, *words), front["confirmed"]
        where = same["deadline"] if ended else same | same["coverage"]
        for mine, theirs in ((fresh["coverage"], where["visited"]), (fresh["losses"], where["losses"])):
            assert 0 < abs(mine["mean"] - theirs["mean"]) < 5 * np.hypot(mine["se"], theirs["se"])


def test_the_pick_is_the_best_that_is_sure_to_keep_the_limit_on_other_rollouts() -> None:
    """The setting that covers most within the limit is a hair from it: not sure to keep it, so not picked."""
    ladders = Ladders((), (4.0, 15.0), tuple(np.arange(0.3, 0.99, 0.03)))
    near = max((p for p in found_of(ladders).points if p.setting.deadline), key=lambda point: point.losses.mean)
    limit = near.losses.mean + 0.005  # half a standard error: it seems to be kept, and half of all luck says not
    found = found_of(ladders, losses=limit)
    picked, again = found.picked, found.confirmed
    assert again.most <= limit and picked.most <= limit
    assert near.coverage.mean > picked.coverage.mean and near.losses.mean > picked.losses.mean
    sure = sorted((p for p in found.points if p.most <= limit), key=lambda p: -p.coverage.mean)
    assert sure.index(picked) == found.tried - 1
    assert front_summary(found).endswith(f"; the goal is at most {limit:g} of 2 robots lost.")
    met = f"The goal is met with confidence 0.95, for all tries together: on average {again.most:.2f} robots or fewer"
    assert any(line.startswith(f"{met} are lost.") for line in selection_lines(found))


def test_the_chance_of_error_is_shared_among_tries(monkeypatch: pytest.MonkeyPatch) -> None:
    """When the others fail, the next best is tried, with half the chance of error; when all fail nothing is picked."""
    for fails, tried in ((3, 3), (99, None)):
        shares: list[float] = []

        def stubborn(self: object, point: Point, share: float, fails: int = fails, shares: list = shares) -> Point:
            shares.append(share)
            return replace(point, most=9.0 if len(shares) < fails else 0.0)

        monkeypatch.setattr(search._Search, "_again", stubborn)
        found = found_of(Ladders((), (4.0, 15.0), (0.3, 0.5, 0.7, 0.9)), 200, losses=1.5)
        assert shares == [0.05 / 2**n for n in range(1, len(shares) + 1)] and sum(shares) < 0.05
        if tried is None:
            assert found.pick is None and len(shares) == 6 == found.tried
            assert "with confidence 0.95: at most 1.5 of 2 robots lost" in front_summary(found)
        else:
            assert found.tried == tried and "It is number 3 of the settings tried" in " ".join(selection_lines(found))


def test_without_a_goal_the_headline_is_of_fresh_rollouts(capsys: pytest.CaptureFixture[str], world_file: str) -> None:
    front = mrac.front(mrac.load(world_file), rollouts=300, robot_values=[4, 15, 500], exact="never")
    assert [point.setting for point in front.priced] == [point.setting for point in front.corners()]
    for point in front.priced:
        own = next(one for one in front.points if one.setting == point.setting)
        assert f"{100 * point.coverage.mean:.1f} %" in front_summary(front)
        assert own.coverage.mean != point.coverage.mean or not own.coverage.half_width
    assert run(["front", world_file, "--rollouts", "300", "--exact", "never"]) == 0
    said = capsys.readouterr().out
    assert "--seed 1" in said and "efficient" not in said.splitlines()[0] and "nothing beats" not in said


def test_a_goal_that_nothing_meets_is_an_answer(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path
) -> None:
    words = ["front", world_file, "--rollouts", "50", "--robot-values", "", "--risk-caps", "", "--target", "1"]
    assert run([*words, "--plan-out", str(tmp_path / "plan.json")]) == 0
    assert capsys.readouterr().out.startswith("No setting meets the goal, 100 % or more covered: the nearest is ")
    assert not (tmp_path / "plan.json").exists()


WRONG = {
    "--losses 1 --target 0.5": "both --losses and --target are given",
    "--losses -1": "--losses -1; expected a number of robots lost",
    "--target 1.5": "--target 1.5; expected a fraction", "--target 90": "did you mean 0.9?",
    "--losses 99": "--losses 99; expected at most 2, the number of robots",
    "--policy per_cell": "Unknown option: --policy; it is an option of evaluate, ",
    "--robot-value 5": "Unknown option: --robot-value; did you mean '--robot-values'? --robot-value is an option of "
                       "evaluate, ",
    "--robot-values 5,much": "--robot-values '5,much'; expected numbers",
    "--robot-values 5,-1": "--robot-values -1; expected a number above 0", "--risk-caps 2": "--risk-caps 2; expected",
    "--plan-out plan.json": "--plan-out plan.json without a pick",
    "--rollouts 4294967296": "--rollouts 4294967296; expected at most 2147483648",
}  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_bad_options_are_told(capsys: pytest.CaptureFixture[str], world_file: str, words: str) -> None:
    assert WRONG[words] in error_of(capsys, "front", world_file, *words.split())


def test_without_danger_every_run_is_the_same() -> None:
    found = mrac.front(mrac.load(np.zeros((4, 5))), robots=2, target=0.5)
    assert {point.setting.family for point in found.points} == {"mrac", "per_cell"}
    assert all(point.losses.ci95 == (0, 0) and point.coverage.half_width == 0 for point in found.points)
    best, kept, *_ = selection_lines(found)
    assert found.picked.coverage.mean >= 0.5 and kept == "The goal is met: these figures are exact."
    assert ". Exact expectation: 100 % covered" in best or found.picked.setting.deadline
    assert front_summary(found).endswith("and lose 0 robots, on average (exact); the goal is 50 % or more covered.")


def test_an_interruption_leaves_what_was_done() -> None:
    answer = mrac.front(WORLD_FRONT, rollouts=50, losses=1, progress=after(3), on_interrupt="return")
    assert answer.partial and len(answer.points) == 2 and answer.pick is None and answer.confirmed is None
    assert answer.to_json()["partial"] is True and front_summary(answer) == "Interrupted after 2 settings."
    with pytest.raises(KeyboardInterrupt):
        mrac.front(WORLD_FRONT, rollouts=50, progress=after(1))


def test_the_front_s_chart_has_a_curve_through_the_settings_of_each_kind(small: Front) -> None:
    *curves, mark = _front_chart(small, "time").series
    assert (mark.name, mark.x) == ("selected", [small.picked.time.mean])
    for curve in curves:  # through the settings as they rise, whatever they take
        of = [point for point in small.points if reports.TITLES[point.setting.family] == curve.name]
        cheap = min(one.coverage.mean for one, is_cheap in zip(small.points, small.cheap, strict=True) if is_cheap)
        assert list(curve.x) == [point.time.mean for point in of if point.coverage.mean >= cheap]
    told, saved = small.to_json(), report_of(small).files
    assert set(saved) == {"plan.json"}
    assert told["points"][told["pick"]]["losses"]["mean"] <= told["confirmed"]["bound"] <= 0.8
    for wrong, said in (({"robot_values": [-5]}, "robot_values=-5"), ({"losses": NAN}, "losses=nan")):
        with pytest.raises(UsageError, match=said):
            mrac.front(WORLD_FRONT, **wrong)  # type: ignore[arg-type]


# What one should do, by `evaluate`: a quick front.


def quick(rollouts: int, seconds: float, **how: Any) -> list[Point]:
    choices = RolloutChoices(engine="numba", rollouts=rollouts, exact="never")
    how |= {"losses": 9.0, "kept": AllPairs(), "doing": lambda what: None, "seconds": seconds}
    return list(search.quick_points(WORLD_FRONT, WORLD_FRONT.starts, Settings(), choices, **how))


def test_a_quick_front_knows_what_is_free_and_what_all_costs() -> None:
    points = quick(512, 60)
    assert {point.setting.family for point in points} == {"mrac", "per_cell", "robot_value"}
    known = {point.setting: point.figures for point in found_of(rollouts=512, seed=0).points}
    both = [point for point in points if point.setting in known]
    assert len(both) > 3 and all(known[point.setting] == point.figures for point in both), "the same luck"
    free = next(point for point in points if point.losses.ci95[1] == 0)
    assert 0 < free.coverage.mean < max(point.coverage.mean for point in points)
    (first,) = quick(512, 0)
    assert first.losses.mean == 0, "the careful ones come first"


def test_code_that_the_first_setting_compiles_costs_a_quick_front_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a first run a minute goes by before the first setting is known: the others are looked at all the same."""
    looks, look_at = [], search._Search.look_at
    monkeypatch.setattr(search._Search, "look_at", lambda self, one: (looks.append(one), look_at(self, one))[1])
    points = quick(64, 4, clock=lambda: 60.0 * bool(looks) + len(looks) / 100)
    assert len(points) > 3 and {point.setting.family for point in points} == {"mrac", "per_cell", "robot_value"}


@pytest.mark.usefixtures("full_effort")
def test_evaluate_says_what_costs_no_robot_and_what_the_rest_costs(
    capsys: pytest.CaptureFixture[str], world_file: str
) -> None:
    words = ["evaluate", world_file, "--rollouts", "8192"]
    advice, world = answer_of(capsys, *words)["advice"], mrac.load(world_file)
    keys = {"policy", "risk_cap", "robot_value", "coverage", "losses", "difference", "rollouts", "front"}
    assert set(advice) == keys and advice["policy"] == "per_cell" and advice["rollouts"] == 1024
    assert any(point["robot_value"] == advice["robot_value"] for point in advice["front"])
    values = {"mrac": None, "per_cell": advice["robot_value"]}
    pair = [(world, mrac.plan(world, policy=policy, robot_value=value)) for policy, value in values.items()]
    assert advice["difference"] == mrac.compare(*pair, rollouts=1024).difference("visited").estimate.to_json()
    other = mrac.evaluate(*pair[1], rollouts=1024, advice=False, band=False)
    assert other.visited.mean == pytest.approx(advice["coverage"]["mean"], abs=1e-12) or other.certain
    for more in (["--no-advice"], ["--loop", "open"], ["--rollouts", "63"]):
        assert answer_of(capsys, *words[: 2 if "63" in more else 4], *more)["advice"] is None
    assert run(words) == 0
    shown = capsys.readouterr().out
    line = f"`--policy per_cell --robot-value {advice['robot_value']:g}`"
    assert line in " ".join(shown.split()) and shown.index("--robot-value") > shown.index("Coverage, %")
    told = mrac.evaluate(world, rollouts=8192, band=False)
    (lead,) = told.outputs["advice"].elements().alternatives
    assert re.match(r"To cover [\d.]+ % and lose .*: `policy='per_cell', robot_value=\d+`[;.]", lead)
    assert lead in str(told).splitlines() and str(told).index(lead) < str(told).index("visited on average")
    assert escape(lead) in told._repr_html_()


@pytest.mark.usefixtures("one_picture")
def test_the_answer_is_printed_before_anything_else_is_worked_out(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The summary and its tables, then the tables of other threats, the alternatives and the bound; nothing twice."""
    words = ["evaluate", world_file, "--rollouts", "2048", "--threat-scale", "0.5"]
    shown = list[str]()

    def watch(owner: Any, name: str) -> None:
        work = getattr(owner, name)
        monkeypatch.setattr(
            owner, name, lambda *given, **named: shown.append(capsys.readouterr().out) or work(*given, **named)
        )

    watch(ThreatScale, "measure")
    watch(Advice, "measure")
    watch(answer, "any_strategy")
    assert run([*words, "--out", str(tmp_path)]) == 0
    first, scaled, advised, bound = *shown, capsys.readouterr().out
    assert first.startswith("2 robots visit ") and "Chances in %" in first and "Coverage, %" in first
    assert scaled.startswith("\nResults with scaled threats") and advised.startswith("\nTo cover ")
    assert bound.startswith("\nNo strategy visits more than ")
    whole = " ".join((tmp_path / "evaluation.txt").read_text().split())
    rest = " ".join((scaled + advised + bound).split())
    assert sorted(whole.split()) == sorted(f"{first} {rest}".split())


@pytest.mark.usefixtures("one_picture")
def test_alternatives_that_are_interrupted_leave_the_answer(
    capsys: pytest.CaptureFixture[str], world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Advice, "measure", interrupted)
    assert run(["evaluate", world_file, "--rollouts", "2048", "--out", str(tmp_path)]) == 130
    shown, (saved, page) = capsys.readouterr().out, ((tmp_path / name) for name in ("evaluation.json", "index.html"))
    assert shown.count("2 robots visit ") == shown.count("Chances in %") == 1
    assert "Interrupted: the rollouts done so far are shown." in shown
    assert json.loads(saved.read_text())["partial"] and page.is_file()


@pytest.mark.usefixtures("one_picture")
def test_files_are_written_though_the_reader_has_gone(
    world_file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`mrac-jax evaluate ... --out answer | head -1`."""

    def gone(*given: Any, **named: Any) -> None:
        raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", sys.stdout)  # the command puts another in its place
    monkeypatch.setattr("analysis.cli.console.show", gone)
    assert run(["evaluate", world_file, "--rollouts", "500", "--loop", "open", "--out", str(tmp_path / "out")]) == 0
    sys.stdout.close()
    assert {"index.html", "evaluation.json", "plan.json"} <= {file.name for file in (tmp_path / "out").iterdir()}


def priced(robot_value: float | None, coverage: float, losses: float) -> Point:
    """A setting `per_cell` with known figures."""
    figures = exactly(coverage), exactly(losses), exactly(20.0)
    return Point(Setting("per_cell", robot_value=robot_value), *figures, None, coverage, losses)


def test_a_setting_that_covers_more_for_no_more_robots_is_advised() -> None:
    """Where the plan loses few robots, only what covers more for sure is named."""

    def advice(coverage: float, losses: float, *more: Any) -> Advice:
        return Advice((Setting("mrac"), exactly(coverage), exactly(losses)), 5, (point,), 64, *more)

    point = priced(40, 0.9, 0.1)
    found = advice(0.8, 0.2, point, exactly(0.1))
    assert not found.saves(point) and found.better() is point
    costly, at = advice(0.95, 5.0, point, exactly(-0.05)), "`policy='per_cell', robot_value=40`."
    for one, said in (
        (found, "(10.00 points more) without losing more robots"),
        (costly, "and lose 0.10 robots on average"),
    ):
        assert list(one.elements().alternatives) == [f"To cover 90.0 % {said}: {at}"]
    assert advice(0.95, 0.2).better() is None


def test_what_hardly_covers_anything_is_not_advised_because_it_is_free() -> None:
    """Then the knee is, if there is one; and what covers clearly more than the plan at its price is named beside it."""
    now, points = (Setting("mrac"), exactly(0.6), exactly(3.0)), (priced(99, 0.02, 0.0), priced(20, 0.5, 1.0))
    found = Advice(now, 3, points, 64)
    assert found.better() is points[1] and found.more() is None
    straight = Advice(now, 3, (points[0], priced(20, 0.22, 1.0)), 64)
    assert straight.better() is None, "every cell costs about as much"
    said = "To cover 50.0 % and lose 1.00 robots on average: `policy='per_cell', robot_value=20`; to cover 70.0 % "
    for losses, loses in ((3.0, "with the same losses"), (2.5, "and lose 2.50 robots on average")):
        whole = (*points, priced(None, 0.7, losses))
        more = replace(found, points=whole, advised=points[1], difference=exactly(-0.1)).elements().alternatives
        assert list(more) == [f"{said}{loses}: `policy='per_cell'`."]


def test_the_knee_is_the_best_bargain_between_two_settings() -> None:
    low, high = Figures(0.2, 0.0, 9.0), Figures(0.8, 6.0, 9.0)
    points = [low, Figures(0.5, 1.5, 9.0), Figures(0.6, 2.0, 9.0), Figures(0.7, 4.5, 9.0), high]
    assert knee(points, low, high) == 2  # (0.4 / 0.6) - (2 / 6) = 1 / 3 above the line
    assert knee([low, Figures(0.5, 3.0, 9.0), Figures(0.5, 2.5, 9.0), high], low, high) is None
    assert knee(points, high, low) is None and knee([], low, high) is None
    front = mrac.front(WORLD_FRONT, rollouts=300, robot_values=[4, 15, 500])
    corners = priced(9, 0.3, 0.0), priced(7, 0.99, 0.05), replace(priced(None, 1.0, 2.0), setting=Setting("mrac"))
    bent = replace(front, points=corners, priced=corners, words=("map.npy",))
    assert bent.corners() == corners
    said = "2 robots can cover 30.0 % and lose 0 robots, or 99.0 % and lose 0.05 robots, or 100 % and lose 2 robots"
    assert front_summary(bent) == f"{said}, on average."
    lines = selection_lines(bent)
    assert lines[1] == "per_cell, robot value 7: 99.00 % covered, 0.05 robots lost."
    assert any(line.startswith("run it: ") and "--robot-value 7 " in line for line in lines), "the bargain"


def test_no_advice_on_an_interrupted_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing more is planned or compiled for somebody who pressed Ctrl-C."""
    calls = []
    monkeypatch.setattr(Advice, "measure", lambda *given: calls.append(given) or iter(()))
    answer = mrac.evaluate(WORLD_FRONT, rollouts=10**9, progress=after(2), on_interrupt="return")
    assert answer.partial and not calls and answer.to_json()["advice"] is None
    assert mrac.evaluate(WORLD_FRONT, rollouts=64, band=False).partial is False and len(calls) == 1
    monkeypatch.undo()
    safe = mrac.evaluate(mrac.load(np.zeros((5, 5))), 1, rollouts=20_000)
    assert safe.to_json()["advice"] is None, "nothing is in danger"


def test_a_large_map_gets_fewer_rollouts_of_each_setting_by_its_size_alone() -> None:
    sizes = {(20, 20): 4096, (32, 64): 4096, (46, 46): 2048, (137, 137): 256, (800, 800): 16}
    assert {
        shape: search.usual_rollouts(World.create(np.zeros(shape)), np.zeros((1, 2), int)) for shape in sizes
    } == sizes
    threat = np.zeros((46, 46))
    threat[9, 9] = 0.5
    answer = mrac.front(World.create(threat), starts=[[0, 0]], robot_values=())
    assert answer.choices.rollouts == 2048


def test_the_ideal_of_a_team_is_not_followed_where_nobody_is_left() -> None:
    """By hand: j cells are entered with chance .5**(j - 1) by one robot; 5,000 of them come to 2, from above."""
    assert 2.0 <= ideal_team(np.full(5000, 0.5), 1) < 2.0 + 1e-11
    assert ideal_team(np.full(3, 0.5), 1) == 1.75
