"""The paper's statements against made-up points whose answers are known."""

from __future__ import annotations

import numpy as np
import pytest
from rolling import uniform

from analysis.experiments.reproduction import COVERAGE, Finding, Point, StatementVerdict, columns_of, findings, runs_of
from analysis.statistics.estimates import over_maps
from analysis.sweeps.store import Run
from analysis.sweeps.store_files import sums_of
from planner.mrac.make_plan import make_plan
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.world.world import World

MAPS = 200


def point(coverage: float, time: float, robots: int = 8, ratio: float = 0.25, kind: str = "contiguous") -> Point:
    """A point whose maps scatter by 10 points of coverage and 20 steps around these means, the same for every point."""
    noise = uniform(1, np.arange(MAPS), 0, 0) - 0.5
    noise -= noise.mean()
    means = {(loop, figure): coverage + 0.2 * noise for loop in ("closed", "first", "open") for figure in COVERAGE}
    means |= {(loop, "time"): time + 40 * noise * (1 + 0.1 * robots) for loop in ("closed", "first", "open")}
    means["ideal", "visited"] = np.minimum(means["closed", "visited"] + 0.1, 1.0)
    columns = {("mean", *key): value for key, value in means.items()}
    columns |= {("run", *key): value for key, value in means.items()}
    columns |= {("square", *key): value**2 + 0.01 for key, value in means.items()}
    return Point(kind, robots, ratio, columns, {}, 100)


def verdicts(*points: Point) -> dict[str, StatementVerdict]:
    return {f"{found.figure} {found.statement}": found.verdict for found in findings(points)}


def test_numbers_are_held_by_both_standard_errors() -> None:
    found = verdicts(point(0.44, 230, 1), point(0.57, 235, 2))
    assert found["Fig. 5 1 robot: 44 % covered"] is StatementVerdict.REPRODUCED
    assert found["Fig. 5 2 robots: 62 % covered"] is StatementVerdict.NOT_REPRODUCED
    deviation = next(f.deviation for f in findings([point(0.57, 235, 2)]) if "62 % covered" in f.statement)
    se = 0.2 * np.std(uniform(1, np.arange(MAPS), 0, 0), ddof=1) / np.sqrt(MAPS)
    run = np.sqrt(np.mean(point(0.57, 235, 2).columns["square", "closed", "visited"]) - 0.57**2) / np.sqrt(500)
    assert deviation == pytest.approx((0.57 - 0.62) / np.sqrt(se**2 + run**2 + 0.01**2 / 12))


def test_directions_are_held_map_by_map() -> None:
    """The maps' common scatter is larger than these differences: only paired, they stand out."""
    found = verdicts(point(0.44, 230, 1), point(0.441, 228, 2), point(0.442, 220, 4), point(0.443, 221, 8))
    assert found["Fig. 5 time rises from one robot to two"] is StatementVerdict.NOT_REPRODUCED
    assert found["Fig. 5 coverage rises with every robot"] is StatementVerdict.REPRODUCED
    assert found["Fig. 5 time falls with every robot after the second"] is not StatementVerdict.REPRODUCED


def test_the_other_kind_and_the_ratios() -> None:
    both = [
        point(0.7, 200, 4),
        point(0.6, 210, 4, kind="scattered"),
        point(0.5, 190, 2),
        point(0.4, 150, 2, kind="scattered"),
    ]
    found = verdicts(*both)
    assert found["Fig. 6 coverage is lower than in contiguous areas"] is StatementVerdict.REPRODUCED
    assert found["Fig. 6 coverage takes longer than in contiguous areas"] is StatementVerdict.NOT_REPRODUCED
    ratios = [point(1 - r, 100 + 400 * min(r, 0.15) - 300 * max(r - 0.15, 0), ratio=r) for r in (0.0, 0.1, 0.15, 0.25)]
    found = verdicts(*ratios)
    assert found["Fig. 7 coverage falls with the ratio of threats"] is StatementVerdict.REPRODUCED
    assert found["Fig. 7 time rises up to a ratio of 15 %"] is StatementVerdict.REPRODUCED
    assert found["Fig. 7 time falls above 15 %"] is StatementVerdict.REPRODUCED


def test_equal_settings_decide_nothing() -> None:
    found = [f for f in findings([point(0.5, 200, 2), point(0.5, 200, 4)]) if "coverage rises" in f.statement]
    assert [(f.deviation, f.verdict) for f in found] == [(0.0, StatementVerdict.UNDECIDED)]


def test_columns_of_a_map_are_those_of_its_runs() -> None:
    threat = np.zeros((4, 5))
    threat[1:3, 1:4], threat[0, 4] = 0.2, np.nan
    world = World.create(threat)
    plan = make_plan(world, [[0, 0], [3, 4], [3, 0], [2, 4]])
    tally, results = run_range(compile_closed_loop(plan, world), 3, 0, 500, singles=True)
    assert results is not None
    facts = {
        "cells": {"accessible": 19, "free": 19, "dangerous": 6},
        "exact": dict.fromkeys(("visited", "survived"), 0),
    }
    facts |= {"robots": 4, "longest": 90, "ideal_team": None}
    run = Run("key", {}, facts, ((0, 500),), sums_of(tally))
    columns, runs = columns_of(run, tally, "closed", 19), runs_of(tally, 19)
    assert columns["beside", "closed", "visited_free"][0] == pytest.approx(columns["run", "closed", "visited_free"])
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
    found: list[Finding] = [f for f in findings(ups) if "coverage rises" in f.statement]
    assert "1 of 2 the other way; worst k = 2 to 4: by -5.0 +- 0.0 points" in found[0].found
