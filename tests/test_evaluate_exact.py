"""What an evaluation calls exact is the expected value of the loop that was evaluated, or null."""

from __future__ import annotations

import numpy as np
import pytest
from doubt import closed_loop, expected, one_of, open_loop

import mrac_jax as mrac
from analysis.evaluation.report import report
from analysis.evaluation.words import chances_words, losses_words
from analysis.kit.folder import as_text
from analysis.report.face import print_report
from planner.worlds.world import World

WORLD = World.create([[0, 0, 0.05, 0, np.nan], [0.3, 0, 0, 0, 0.5], [0, 0, 0, 0, 0.1]])
STARTS = [(2, 2), (1, 1), (1, 4)]
QUIET = {"advice": False, "band": False, "engine": "numba"}


def test_losses_alive_and_time_of_the_closed_loop_are_its_own() -> None:
    """Against the readable simulator, played through every pattern of hits; time against its own rollouts."""
    plan = mrac.plan(WORLD, starts=STARTS)
    answer = mrac.evaluate(WORLD, plan, rollouts=20_000, **QUIET)
    said, tally = answer.to_json(), answer.tally
    draw = one_of([WORLD.threat.ravel()])
    alive, alone = expected(closed_loop(plan, WORLD), draw)[2], expected(open_loop(plan, WORLD), draw)[2]
    assert alone - alive > 0.1
    assert said["exact"]["alive"] == said["exact"]["closed_loop"]["alive"] == pytest.approx(alive, abs=1e-6)
    assert said["losses"]["exact"] == pytest.approx(3 - alive, abs=1e-6)
    assert said["exact"]["open_loop"]["alive"] == pytest.approx(alone, abs=1e-6)
    assert said["exact"]["open_loop"]["losses"] == pytest.approx(3 - alone, abs=1e-6)
    steps = np.arange(len(tally.time))
    mean = tally.time @ steps / tally.rollouts
    se = np.sqrt(tally.time @ (steps - mean) ** 2) / tally.rollouts
    assert abs(said["exact"]["time"] - mean) < 5 * se < abs(said["exact"]["open_loop"]["time"] - mean)
    assert f"{3 - alive:.4g}" in as_text(lambda console: print_report(report(answer), console))
    assert answer.losses.ci95 == (answer.losses.mean,) * 2 == (pytest.approx(3 - alive, abs=1e-6),) * 2


def test_sentences_say_the_exact_value_where_it_is_known() -> None:
    """Few rollouts miss it: the headline, the sentences and the tile agree, and the table shows both."""
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS), rollouts=64, **QUIET)
    robots, steps = answer.exact, f"{answer.exact.time:,.0f} steps on average"
    lost, sampled = f"{3 - robots.alive:.2f}", f"{answer.tally.alive @ np.arange(3, -1, -1) / 64:.2f}"
    assert lost != sampled, "a seed whose luck shows"
    assert f"on average {lost} of 3" in losses_words(answer) and steps in chances_words(answer)
    assert any(tile.value == f"{lost} of 3" for tile in report(answer).figures)
    shown = as_text(lambda console: print_report(report(answer), console))
    row = next(line for line in shown.splitlines() if line.startswith("  robots lost "))
    said = row.removeprefix("  robots lost ").partition(" of 3")[0].strip()
    assert said == f"{float(sampled):.{len(said.partition('.')[2])}f}" != lost, "the row is of the rollouts"


def test_how_a_mission_ends_is_said_in_words() -> None:
    """One row a way to end; the limit of a plan with a deadline is the deadline."""
    world = World.create([[0, 0.1, 0, 0, 0.5, 0]])
    for asked, row in (
        ({"deadline": 3}, "chance to end at the deadline"),
        ({"range": 3}, "chance to end stuck: no robot can go on"),
        ({"policy": "per_cell", "worth": 10}, "chance to end as the rest is not worth a robot"),
    ):
        answer = mrac.evaluate(world, mrac.plan(world, 1, **asked), rollouts=64, **QUIET)
        shown = as_text(lambda console, answer=answer: print_report(report(answer), console))
        assert [line for line in shown.splitlines() if "chance to end" in line and row in line], shown


def test_one_robot_s_loops_are_one() -> None:
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS[:1]), rollouts=20_000, **QUIET)
    exact, tally = answer.to_json()["exact"], answer.tally
    assert exact["time"] == exact["open_loop"]["time"] == answer.time.mean
    assert exact["alive"] == exact["open_loop"]["alive"]
    assert abs(exact["time"] - tally.time @ np.arange(len(tally.time)) / tally.rollouts) < 0.1


def test_a_robot_that_waits_before_it_gives_up_has_no_exact_time() -> None:
    """It is called off two steps after its last move: the open loop's time is not the closed loop's."""
    world = World.create([[0, 0, 0.5, 0]])
    answer = mrac.evaluate(world, mrac.plan(world, 1, policy="per_cell", worth=100), rollouts=16, **QUIET)
    assert answer.plan.outcome == "called_off"
    assert answer.to_json()["exact"]["time"] is None


def test_what_is_not_known_of_the_closed_loop_is_null() -> None:
    """A team under hazards, and one on maps in doubt: the open loop's values have a name of their own."""
    q = np.where(np.nan_to_num(WORLD.threat) > 0, 0.5, 0.0)
    for world in (mrac.with_hazard(WORLD, "persistent", q, 0.5), mrac.with_maps(WORLD, [WORLD.threat, WORLD.threat])):
        said = mrac.evaluate(world, mrac.plan(world, starts=STARTS), rollouts=256, **QUIET).to_json()
        assert said["exact"]["alive"] is said["exact"]["time"] is said["losses"]["exact"] is None
        assert said["exact"]["closed_loop"] is None
        assert said["exact"]["open_loop"]["losses"] > 0
        assert said["losses"]["ci95"][0] < said["losses"]["ci95"][1]
