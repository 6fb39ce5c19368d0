"""Intervals of mean time reach for what was not seen: they hold as often as they say, and none is a point by luck."""

from __future__ import annotations

import numpy as np
import pytest

import mrac_jax as mrac
from analysis.statistics.estimates import Estimate, mean_estimate
from analysis.theory.verdicts import longest_mission, longest_run
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.world.world import World

QUICK, ALL = 30, pytest.param(300, marks=pytest.mark.slow)
ENDS = [(0, 0), (0, 30)]


def row(length: int, p: float) -> World:
    """A row of cells; the second stops a robot with chance p."""
    return World.create([[0.0, p, *[0.0] * (length - 2)]])


def hold(found: list[Estimate], truth: float) -> None:
    """Each of these intervals has a width, and at least 94 % of them hold the truth."""
    ends = np.array([one.ci95 for one in found])
    assert (ends[:, 0] < ends[:, 1]).all()
    assert not any("exact" in one.said() for one in found)
    assert ((ends[:, 0] <= truth) & (truth <= ends[:, 1])).mean() >= 0.94


@pytest.mark.parametrize(("p", "q", "rollouts"), [(0.02, 0.01, 20), (0.02, 0.01, 100), (1e-4, 2e-4, 4096)])
@pytest.mark.parametrize("seeds", [QUICK, ALL])
def test_a_difference_of_times(p: float, q: float, rollouts: int, seeds: int) -> None:
    """One robot on 20 cells is stopped at step 1 or drives for 19 steps; most samples see no rollout that differs."""
    a, b = row(20, p), row(20, q)
    sides = (a, mrac.plan(a, 1)), (b, mrac.plan(b, 1))
    found = [mrac.compare(*sides, rollouts=rollouts, seed=seed).difference("time").estimate for seed in range(seeds)]
    hold(found, (float(np.float32(p)) - float(np.float32(q))) * 18)


@pytest.mark.parametrize("rollouts", [50, 100, 400, 1000])
@pytest.mark.parametrize("seeds", [QUICK, ALL])
def test_a_time_that_rare_losses_make_longer(rollouts: int, seeds: int) -> None:
    """Two robots from the ends of a row: 15 steps, but 28 if the first is lost at step 1, and 15 if the other is."""
    world = row(31, 0.002)
    plan = mrac.plan(world, starts=ENDS)
    most = longest_run(world, plan, "closed")
    assert most == longest_mission(world, ENDS, Settings()) == 8 * 2 * 31 + 64
    truth = mrac.evaluate(world, plan, rollouts=1, advice=False, band=False).closed
    assert truth is not None and truth.time is not None
    assert truth.time == pytest.approx(15.026, abs=5e-4)
    engines = [make_engine(plan, world, Rolling(seed=seed), "numba") for seed in range(seeds)]
    hold([mean_estimate(engine.tally(0, rollouts).time, 1.0, most) for engine in engines], truth.time)


def test_every_answer_s_time_reaches_so_far() -> None:
    """evaluate, front, size: none of 40 rollouts met the loss that makes missions longer; the interval knows it."""
    world, quiet = row(31, 0.002), {"engine": "numba"}
    sampled, plan = {"rollouts": 40, "exact": "never"}, mrac.plan(world, starts=ENDS)
    evaluated = mrac.evaluate(world, plan, advice=False, band=False, **sampled, **quiet)
    assert np.count_nonzero(evaluated.tally.time) == 1
    points = mrac.front(world, starts=ENDS, losses=2.0, reserves=[], worths=[4.0], **sampled, **quiet).points
    teams = mrac.size(World.create(world.threat, starts=ENDS), target=0.99, **sampled).points
    times = [evaluated.figures.time, *(point.time for point in points if point.setting.deadline is None)]
    times += [point.time for point in teams if point.robots == 2 and point.time is not None]
    assert len(times) >= 4
    assert all(time.ci95[1] > time.mean + 1 for time in times)
    assert evaluated.to_json()["time"]["ci95"][1] > 16
    known = mrac.evaluate(world, plan, rollouts=40, advice=False, band=False, **quiet)
    assert known.time.ci95 == (pytest.approx(15.026, abs=5e-4),) * 2


def test_of_one_robot_and_of_the_open_loop_a_proven_largest_time() -> None:
    world = World.create([[0, 0, 0.5, 0, np.nan, 0], [0, 0, 0.1, 0, 0, 0]])
    for worth in (None, 30.0):
        plan = mrac.plan(world, starts=[(0, 0)], policy="per_cell", worth=worth)
        most = longest_run(world, plan, "closed")
        tally = make_engine(plan, world, Rolling(), "numba").tally(0, 2000)
        assert np.flatnonzero(tally.time).max() == most < longest_mission(world, [(0, 0)], Settings())
        assert longest_run(world, plan, "open") == plan.makespan <= most
