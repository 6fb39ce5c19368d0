"""`mrac-jax check --paper`: its points and the paper's statements."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers import answer_of, uniform
from page_reader import refused
from PIL import Image

from analysis import reproduction as paper
from analysis.cli.app import run
from analysis.statistics.estimates import over_maps
from analysis.statistics.variance_reduction import expected_pieces, pieces
from analysis.sweeps.store import Run, Store
from analysis.sweeps.store_files import sums_of
from analysis.theory.exact import open_loop_exact
from planner.errors import UsageError
from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.threshold_classes import classes_by_threshold
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# `mrac-jax check --paper`: the same points however they are run, from the right maps, and the command.


def columns(answer: paper.Reproduction) -> dict:
    return {
        (setting, *key): value.tolist()
        for setting, point in answer.points.items()
        for key, value in point.columns.items()
    }


def test_points_are_those_of_the_maps_rolled_out_by_hand() -> None:
    answer = paper.reproduce("fig4", maps=2, rollouts=30, seed=5, processes=1)
    assert (answer.maps, list(answer.points)) == (2, list(paper.SETTINGS["fig4"]))
    for setting, point in answer.points.items():
        for number, seed in enumerate((5, 6)):
            world = random_world(20, 20, ThreatPattern("contiguous", seed=seed))
            plan = make_plan(world, place_starts(world, setting.robots)[0])
            for loop, first_only in (("closed", False), ("first", True)):
                tally = run_range(compile_closed_loop(plan, world, first_only=first_only), seed, 0, 30)[0]
                mean = tally.visited @ np.arange(tally.accessible + 1) / 30
                assert point.columns["mean", loop, "visited"][number] == pytest.approx(mean / tally.accessible)
                assert point.columns["mean", loop, "survived_free"][number] == pytest.approx(
                    tally.survived @ np.arange(tally.accessible + 1) / 30 / world.free.sum()
                )
            exact = open_loop_exact(plan, world)
            assert point.columns["mean", "open", "visited_free"][number] == pytest.approx(
                exact.visited / world.free.sum()
            )
            assert point.columns["mean", "open", "time"][number] == pytest.approx(exact.mean_time)
        assert point.runs["coverage"].sum() == point.runs["time"].sum() == 60


def test_maps_are_put_right_by_what_all_of_them_tell_of_luck() -> None:
    """Least squares over the single rollouts of all maps, with a level for each map, gives the same means."""
    [setting, _], maps, rollouts = paper.SETTINGS["fig4"], 6, 300
    point = paper.reproduce("fig4", maps=maps, rollouts=rollouts, processes=1).points[setting]
    y, luck = [], []
    for seed in range(maps):
        world = random_world(20, 20, ThreatPattern("contiguous", seed=seed))
        loop = compile_closed_loop(make_plan(world, place_starts(world, setting.robots)[0]), world)
        y.append(run_range(loop, seed, 0, rollouts, singles=True)[1].visited / len(loop.cells))  # type: ignore[union-attr]
        met = pieces(classes_by_threshold(seed, 0, rollouts, setting.robots), setting.robots)
        luck.append(met - expected_pieces(setting.robots))
    levels = np.repeat(np.eye(maps), rollouts, axis=0)
    found = np.linalg.lstsq(np.hstack([levels, np.concatenate(luck)]), np.concatenate(y), rcond=None)[0]
    assert point.columns["mean", "closed", "visited"] == pytest.approx(found[:maps])
    raw = point.columns["run", "closed", "visited"]
    assert raw == pytest.approx(np.mean(y, axis=1)) and abs(raw - found[:maps]).max() > 0.001


@pytest.mark.slow
def test_intervals_over_maps_hold_and_the_control_does_not_bend_them() -> None:
    """240 samples of 25 maps: each interval holds the mean of all 6,000 as often as it says (3 standard errors below
    .95); the mean of all samples differs from that without the control by no more than 4 standard errors."""
    group, groups = 25, 240
    answer = paper.reproduce("fig4", maps=group * groups, rollouts=50, seed=10**6)
    for setting, point in answer.points.items():
        for loop in ("closed", "first"):
            for figure in ("visited", "survived", "time"):
                raw, found = point.columns["run", loop, figure], []
                for begin in range(0, len(raw), group):
                    sample = {key: column[begin : begin + group] for key, column in point.columns.items()}
                    paper.controlled_means(sample, 50)
                    found.append((sample["mean", loop, figure], over_maps(sample["mean", loop, figure])))
                held = np.mean([one.ci95[0] <= raw.mean() <= one.ci95[1] for _, one in found])
                moved = np.concatenate([means for means, _ in found]) - raw
                assert held >= 0.95 - 3 * (0.95 * 0.05 / groups) ** 0.5, (setting, loop, figure)
                assert abs(moved.mean()) <= 4 * moved.std() / len(moved) ** 0.5, (setting, loop, figure)


@pytest.mark.parametrize("processes", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_no_point_depends_on_how_it_was_run(tmp_path: Path, processes: int) -> None:
    one = paper.reproduce("fig7", maps=2, rollouts=8, processes=1)
    with Store.open(tmp_path / "s.db") as store:
        two = paper.reproduce("fig7", maps=1, rollouts=4, store=store, processes=1)
        again = paper.reproduce("fig7", maps=2, rollouts=8, store=store, processes=processes)
        assert again.finished.reused == 2 * 8 * 4
        third = paper.reproduce("fig7", maps=2, rollouts=8, store=store, processes=1)
        assert (third.finished.rollouts, third.finished.reused) == (0, 2 * 2 * 8 * 8)
    assert columns(one) == columns(again) == columns(third)
    assert two.maps == 1
    assert one.points[paper.Setting("contiguous", 8, 0.0)].estimate("closed", "visited").mean == 1.0


FEW = ["--maps", "2", "--rollouts", "4", "--processes", "1"]


def test_the_command_prints_saves_and_is_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["check", "--paper", "fig6", *FEW, "--store", str(tmp_path / "s.db")]
    found = answer_of(capsys, *words, "--out", str(tmp_path / "out"))
    assert [point["robots"] for point in found["figures"]["fig6"]] == [1, 2, 4, 8, 10, 12, 16, 20]
    assert {one["figure"] for one in found["statements"]} == {"Fig. 6"}
    assert json.loads((tmp_path / "out" / "reproduction.json").read_text())["statements"] == found["statements"]
    with Image.open(tmp_path / "out" / "fig6.png") as picture:
        assert picture.width == 1200
    lines = (tmp_path / "out" / "points.csv").read_text().splitlines()
    assert len(lines) == 1 + 16 * 16
    assert run(words) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "statements of the paper" in out and "256 from the store" in out
    assert run(["check", "--paper", "fig4", *FEW, "--out", str(tmp_path / "four")]) == 0
    assert (tmp_path / "four" / "fig4.png").exists()


def test_interrupted_leaves_whole_maps(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    from analysis import reproduction as module

    real, taken = module._Collected.take, []

    def stop_in_the_third_map(self, done):  # type: ignore[no-untyped-def]
        real(self, done)
        taken.append(done)
        if len(taken) == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(module._Collected, "take", stop_in_the_third_map)
    found = answer_of(
        capsys, "check", "--paper", "fig4", "--maps", "9", "--rollouts", "4", "--processes", "1", status=130
    )
    assert (found["maps"], found["partial"]) == (2, True)


WRONG_USAGE = [
    ("check --paper", "--paper"),
    ("check --paper fig3", "fig4 or fig5"),
    ("check --paper fig4 --maps 0", "--maps 0"),
    ("check --paper fig4 --rollouts 0", "--rollouts 0"),
    ("check --paper fig4 --seed -1", "--seed -1"),
    ("check --paper fig4 --processes 0", "--processes 0"),
    ("check --paper fig4 --processes 2 --scheduler tcp://host:1", "one of them"),
    ("check --paper fig4 --store nowhere/s.db", "nowhere"),
]


@pytest.mark.parametrize(("words", "said"), WRONG_USAGE)
def test_wrong_usage_is_one_line_and_status_2(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refused(capsys, *words.split()).lower()


def test_maps_out_of_range_are_refused() -> None:
    with pytest.raises(UsageError, match="maps="):
        paper.reproduce("fig4", maps=0, rollouts=1)


# The paper's statements against made-up points whose answers are known.

MAPS = 200


def point(coverage: float, time: float, robots: int = 8, ratio: float = 0.25, kind: str = "contiguous") -> paper.Point:
    """A point whose maps scatter by 10 points of coverage and 20 steps around these means, the same for every point."""
    noise = uniform(1, np.arange(MAPS), 0, 0) - 0.5
    noise -= noise.mean()
    means = {
        (loop, figure): coverage + 0.2 * noise for loop in ("closed", "first", "open") for figure in paper.COVERAGE
    }
    means |= {(loop, "time"): time + 40 * noise * (1 + 0.1 * robots) for loop in ("closed", "first", "open")}
    means["ideal", "visited"] = np.minimum(means["closed", "visited"] + 0.1, 1.0)
    columns = {("mean", *key): value for key, value in means.items()}
    columns |= {("run", *key): value for key, value in means.items()}
    columns |= {("square", *key): value**2 + 0.01 for key, value in means.items()}
    return paper.Point(kind, robots, ratio, columns, {}, 100)


def verdicts(*points: paper.Point) -> dict[str, paper.StatementVerdict]:
    return {f"{found.figure} {found.statement}": found.verdict for found in paper.findings(points)}


def test_numbers_are_held_by_both_standard_errors() -> None:
    found = verdicts(point(0.44, 230, 1), point(0.57, 235, 2))
    assert found["Fig. 5 1 robot: 44 % covered"] is paper.StatementVerdict.REPRODUCED
    assert found["Fig. 5 2 robots: 62 % covered"] is paper.StatementVerdict.NOT_REPRODUCED
    deviation = next(f.deviation for f in paper.findings([point(0.57, 235, 2)]) if "62 % covered" in f.statement)
    se = 0.2 * np.std(uniform(1, np.arange(MAPS), 0, 0), ddof=1) / np.sqrt(MAPS)
    run = np.sqrt(np.mean(point(0.57, 235, 2).columns["square", "closed", "visited"]) - 0.57**2) / np.sqrt(500)
    assert deviation == pytest.approx((0.57 - 0.62) / np.sqrt(se**2 + run**2 + 0.01**2 / 12))


def test_directions_are_held_map_by_map() -> None:
    """The maps' common scatter is larger than these differences: only paired, they stand out."""
    found = verdicts(point(0.44, 230, 1), point(0.441, 228, 2), point(0.442, 220, 4), point(0.443, 221, 8))
    assert found["Fig. 5 time rises from one robot to two"] is paper.StatementVerdict.NOT_REPRODUCED
    assert found["Fig. 5 coverage rises with every robot"] is paper.StatementVerdict.REPRODUCED
    assert found["Fig. 5 time falls with every robot after the second"] is not paper.StatementVerdict.REPRODUCED


def test_the_other_kind_and_the_ratios() -> None:
    both = [
        point(0.7, 200, 4),
        point(0.6, 210, 4, kind="scattered"),
        point(0.5, 190, 2),
        point(0.4, 150, 2, kind="scattered"),
    ]
    found = verdicts(*both)
    assert found["Fig. 6 coverage is lower than in contiguous areas"] is paper.StatementVerdict.REPRODUCED
    assert found["Fig. 6 coverage takes longer than in contiguous areas"] is paper.StatementVerdict.NOT_REPRODUCED
    ratios = [point(1 - r, 100 + 400 * min(r, 0.15) - 300 * max(r - 0.15, 0), ratio=r) for r in (0.0, 0.1, 0.15, 0.25)]
    found = verdicts(*ratios)
    assert found["Fig. 7 coverage falls with the ratio of threats"] is paper.StatementVerdict.REPRODUCED
    assert found["Fig. 7 time rises up to a ratio of 15 %"] is paper.StatementVerdict.REPRODUCED
    assert found["Fig. 7 time falls above 15 %"] is paper.StatementVerdict.REPRODUCED


def test_equal_settings_decide_nothing() -> None:
    found = [f for f in paper.findings([point(0.5, 200, 2), point(0.5, 200, 4)]) if "coverage rises" in f.statement]
    assert [(f.deviation, f.verdict) for f in found] == [(0.0, paper.StatementVerdict.UNDECIDED)]


def test_columns_of_a_map_are_those_of_its_runs() -> None:
    threat = np.zeros((4, 5))
    threat[1:3, 1:4], threat[0, 4] = 0.2, np.nan
    world = World.create(threat)
    plan = make_plan(world, [[0, 0], [3, 4], [3, 0], [2, 4]])
    tally, results = run_range(compile_closed_loop(plan, world), 3, 0, 500, singles=True)
    facts = {
        "cells": {"accessible": 19, "free": 19, "dangerous": 6},
        "exact": dict.fromkeys(("visited", "survived", "time"), 0),
    }
    facts |= {"robots": 4, "longest": 90, "ideal_team": None}
    run = Run("key", {}, facts, ((0, 500),), sums_of(tally))
    columns, runs = paper.columns_of(run, tally, "closed"), paper.runs_of(tally, 19)
    assert columns["controls", "closed", "visited_free"][0] == pytest.approx(columns["run", "closed", "visited_free"])
    assert columns["run", "closed", "visited_free"] == pytest.approx(results.visited.mean() / 19)
    assert columns["square", "closed", "survived"] == pytest.approx(((results.survived / 19) ** 2).mean())
    assert columns["run", "closed", "time"] == pytest.approx(results.time.mean())
    assert columns["share", "closed", "coverage"] == pytest.approx((results.visited <= round(0.8033 * 19)).mean())
    assert columns["share", "closed", "time"] == 1.0
    per_cent = results.visited * 100 // 19
    assert np.array_equal(runs["coverage"], np.bincount(per_cent, minlength=101))
    assert np.array_equal(runs["time"], np.bincount(results.time // 10))


def test_intervals_over_maps_are_student_s_and_wider_for_a_long_tail() -> None:
    even, skew = np.array([0.2, 0.5, 0.8]), np.array([0.2, 0.4, 0.9])
    for values in (even, skew):
        found = over_maps(values)
        assert found.mean == pytest.approx(0.5) and found.se == pytest.approx(values.std(ddof=1) / np.sqrt(3))
    assert over_maps(even).ci95[1] - 0.5 == pytest.approx(4.302653 * 0.3 / np.sqrt(3), rel=1e-6)
    rare = (
        (-(0.3**3) - 0.1**3 + 0.4**3) / (0.3**2 + 0.1**2 + 0.4**2) / 3
    )  # third central moment over the second, / maps
    half = 4.302653 * np.sqrt(0.13 / 3 + 6 * rare**2)
    assert over_maps(skew).ci95 == pytest.approx((0.5 - half, 0.5 + half), rel=1e-6)
    assert over_maps(skew[:1]).ci95 == (-np.inf, np.inf)


def test_a_finding_names_the_worst() -> None:
    ups = [point(0.5, 200, 1), point(0.6, 200, 2), point(0.55, 200, 4)]
    found: list[paper.Finding] = [f for f in paper.findings(ups) if "coverage rises" in f.statement]
    assert "1 of 2 in the other direction; worst k = 2 to 4: by -5.0 +- 0.0 points" in found[0].found
