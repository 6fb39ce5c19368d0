"""The best policy of a map: what is raced, that the best comes through, and that its gain is told on other luck."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from oracle_tree import closed_loop_exact

import mrac_jax as mrac
from analysis.cli.app import run
from analysis.estimators import racing as best
from analysis.estimators.racing import contenders
from analysis.evaluation.report import report
from analysis.utils.tables import policy_words
from planner.mrac.make_plan import make_plan
from planner.policies import RULES
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts


def test_what_is_given_stays_and_no_setting_comes_twice() -> None:
    raced = contenders(Settings(), 8)
    assert len(raced) == len(set(raced)) == 10
    assert {one.reserve for one in raced} == {None, 1 / 2, 1 / 4, 1 / 8}
    assert [one.policy for one in raced].count("mrac") == 1
    assert {one.reserve for one in contenders(Settings(), 1)} == {None}
    limited = contenders(Settings(reserve=0.3, worth=20.0, density=6.0, risk="log"), 8)
    given = Settings(policy="per_cell", reserve=0.3, worth=20.0, density=6.0, risk="log")
    assert limited == [given, replace(given, policy="watchful")]


def test_on_small_maps_it_is_no_less_than_the_best_by_the_readable_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(best, "TRIES", 5)
    more = 0
    for seed in range(3):
        world = random_world(4, 5, ThreatPattern("scattered", levels=(0.2, 0.4), seed=seed), threats=0.4)
        starts = place_starts(world, 2)[0]
        plans = [make_plan(world, starts, one) for one in contenders(Settings(), 2)]
        covered = [closed_loop_exact(plan, world).visited for plan in plans]
        found = best.plan_best(world, starts, Settings())
        visited = closed_loop_exact(found, world).visited
        assert visited >= max(covered) - 1e-6
        more += visited > max(covered) + 1e-6
        assert found.settings is not None and (found.settings.priority is not None) == (visited > max(covered) + 1e-6)
        gain = (visited - covered[0]) / world.accessible(starts).sum() * 100
        said = re.search(r"(\d+\.\d+) points", found.notes[-1])
        assert gain < 0.005 if said is None else float(said[1]) == pytest.approx(gain, abs=0.006)
    assert more


def test_the_gain_is_told_on_other_luck(monkeypatch: pytest.MonkeyPatch) -> None:
    """The race rolls out ids 0 .. USUAL - 1, and what is told the ids after them: their difference, worked out here."""
    monkeypatch.setattr(best, "USUAL", 1024)
    monkeypatch.setattr(best, "TRIES", 0.5)
    world = random_world(pattern=ThreatPattern("contiguous", seed=5))
    plan = mrac.plan(world, 6, policy="best", seconds=60)
    paper = make_plan(world, plan.starts, Settings())
    loops = [compile_closed_loop(one, world) for one in (paper, plan)]
    visited = [run_range(loop, best.LUCK, 1024, 1024, singles=True)[1].visited for loop in loops]
    gain = 100 * float(np.mean(visited[1] - visited[0])) / world.accessible(plan.starts).sum()
    said = re.search(r"([\d.]+) points ± ([\d.]+)", plan.notes[-1])
    assert said is not None
    assert abs(float(said[1]) - gain) < 2 * float(said[2])  # the control by luck moves it within its interval
    again = mrac.plan(world, 6, policy="best", seconds=60)
    assert (again.settings, again.notes) == (plan.settings, plan.notes)


def test_a_race_that_is_cut_off_says_so() -> None:
    world = random_world(pattern=ThreatPattern("scattered", seed=2))
    plan = mrac.plan(world, 4, policy="best", seconds=1e-6)
    assert plan.settings in contenders(Settings(), 4)
    assert plan.notes[-1].endswith("the search ended after 1e-06 s")


def test_one_sentence_says_what_was_found_and_what_no_strategy_exceeds() -> None:
    world = random_world(pattern=ThreatPattern("scattered", seed=2))
    plan = mrac.plan(world, 2, policy="best", seconds=1e-6)
    answer = mrac.evaluate(world, plan, rollouts=64)
    shown, limit = report(answer), answer.bounds.any_strategy
    name, most = shown.headline.split(" on average with ")[1].split("; no strategy exceeds ")
    name, _, lost = name.partition(", and ")
    assert lost.startswith("lose ") and "%" not in lost
    assert limit is not None and 0 <= float(most.split(" %")[0]) - 100 * limit.mean <= 0.01
    assert plan.settings is not None and name == policy_words(plan.settings)
    assert not any("No strategy" in line for line in shown.findings)


def test_where_it_cannot_be_asked(capsys: pytest.CaptureFixture[str]) -> None:
    world = ["example:paper", "--robots", "2"]
    for words in (["--policy", "best", "--plan", "x.json"], ["--policy", "best", "--plan-for", "open"]):
        assert run(["evaluate", *world, *words]) == 2
        assert capsys.readouterr().err.startswith("error: ")
    assert run(["size", "example:paper", "--policy", "best"]) == 2
    assert capsys.readouterr().err == f"error: --policy 'best'; expected {' or '.join(RULES)}\n"
