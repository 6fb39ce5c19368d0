"""What an evaluation calls exact is the expected value of the loop that was evaluated, or null."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from doubt import closed_loop, expected, one_of, open_loop
from oracle_tree import closed_loop_exact

import mrac_jax as mrac
from analysis.estimators.trial import SLACK
from analysis.evaluation.charts import distribution, histogram_bins
from analysis.evaluation.evaluate import TO_LOOK_AT
from analysis.evaluation.report import chances_words, losses_words, report
from analysis.report.answer import print_report
from analysis.utils.folder import as_text
from planner.formatting import percent
from planner.simulator.closed_loop import compile_closed_loop
from planner.simulator.exact_tree import WHOLE, Tree
from planner.simulator.runners import Runner
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

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
    assert answer.losses.ci95 == (answer.losses.mean,) * 2 == (pytest.approx(3 - alive, abs=1e-6),) * 2


def test_sentences_say_the_exact_value_where_it_is_known() -> None:
    """Few rollouts miss it: the headline, the sentences, the tile and the table agree."""
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS), rollouts=64, **QUIET)
    robots, steps = answer.exact, f"{answer.exact.time:,.0f} steps on average"
    lost, sampled = f"{3 - robots.alive:.2f}", f"{answer.tally.alive @ np.arange(3, -1, -1) / 64:.2f}"
    assert lost != sampled, "a seed whose luck shows"
    assert f"on average {lost} of 3" in losses_words(answer) and steps in chances_words(answer)
    assert any(tile.value == f"{lost} of 3" for tile in report(answer).figures)
    shown = as_text(lambda console: print_report(report(answer), console))
    row = next(line for line in shown.splitlines() if line.startswith("  robots lost "))
    assert row.removeprefix("  robots lost ").strip().startswith(f"{lost} of 3") and "exact" in row


def test_advice_says_of_the_plan_what_the_headline_says() -> None:
    """Not what 64 rollouts came to, where all is known."""
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS), rollouts=64, **QUIET | {"advice": True})
    _, coverage, losses = answer.outputs["advice"].now
    told = [(coverage, answer.visited), (losses, answer.losses)]
    assert all((now.mean, now.ci95) == (shown.mean, shown.ci95) and now.half_width == 0 for now, shown in told)
    assert losses.mean != pytest.approx(answer.tally.alive @ np.arange(3, -1, -1) / 64)


@pytest.mark.parametrize("seed", [3, 8])
def test_chances_and_quantiles_are_those_of_a_brute_force_enumeration(seed: int) -> None:
    """Whatever the few rollouts are like: every figure, the curve, the histogram, the words and the JSON."""
    world = random_world(4, 5, ThreatPattern("scattered", 3, (0.1, 0.3), seed), obstacles=0.1, threats=0.3)
    plan = mrac.plan(world, 2)
    answer, oracle = mrac.evaluate(world, plan, rollouts=64, **QUIET), closed_loop_exact(plan, world)
    found, said, close = answer.figures, answer.to_json(), partial(pytest.approx, abs=1e-6)
    cells = len(oracle.visited_chance) - 1
    for meaning in ("visited", "survived"):
        chance, covered = getattr(oracle, f"{meaning}_chance"), getattr(found, meaning)
        reached, own = np.cumsum(chance[::-1])[::-1], getattr(answer, meaning)
        assert covered.counts / covered.counts.sum() == close(chance)
        assert [covered.chance(cell).mean for cell in range(cells + 1)] == close(reached)
        assert own.at_least(0.9).ci95 == close((reached[int(np.ceil(0.9 * cells - 1e-9))],) * 2)
        for q in (0.05, 0.3, 0.5, 0.95):
            assert own.quantile(q) * cells == np.searchsorted(np.cumsum(chance), q - 1e-9)
        assert said["coverage"][meaning]["at_least"]["1"]["mean"] == close(reached[-1])
        assert said["coverage"][meaning]["ci95"] == close([getattr(oracle, meaning) / cells] * 2)
    assert [chance.mean for chance in found.left] == close(oracle.alive_chance)
    assert said["complete"]["mean"] == close(oracle.complete)
    assert found.assured == np.searchsorted(np.cumsum(oracle.visited_chance), 0.05 - 1e-9)
    assert found.complete.columns() == (f"{100 * oracle.complete:.2f}", "exact")
    assert f"Every accessible cell is visited in {100 * oracle.complete:.2f} % of runs" in chances_words(answer)
    steps, bars = distribution(answer)
    edges = histogram_bins(found.visited.counts)
    heights = np.histogram(np.arange(cells + 1), bins=edges, weights=oracle.visited_chance)[0]
    assert bars.series[0].y == close(100 * heights)
    assert (bars.title, steps.series[0].low) == ("Runs by coverage", close(np.asarray(steps.series[0].y)))


def test_what_a_tree_left_makes_chances_intervals_that_are_certain() -> None:
    world = random_world(14, 14, ThreatPattern("scattered", 4, (0.1, 0.2), 3), threats=0.3)
    plan = mrac.plan(world, 3)
    loop = compile_closed_loop(plan, world)
    fine, coarse = (Tree(Runner(loop, 0, 4).grow(WHOLE, WHOLE // of, 10**7), WHOLE // of) for of in (10**12, 1000))
    assert coarse.left > 10 * SLACK > 0
    sampled = mrac.evaluate(world, plan, rollouts=64, exact="never", **QUIET).figures
    exact, wide = sampled.with_tree(fine), sampled.with_tree(coarse)
    assert exact.losses.half_width == 0 and wide.time == sampled.time
    for one, other in zip(exact.visited.at_least.values(), wide.visited.at_least.values(), strict=True):
        assert other.ci95[0] <= one.ci95[0] <= one.ci95[1] <= other.ci95[1]
        assert one.columns()[1] == "exact"
    assert wide.visited.at_least[0.75].columns()[1].endswith(", certain")
    assert wide.assured is not None and wide.assured <= exact.assured


def test_no_more_is_rolled_out_than_is_looked_at_where_all_is_known() -> None:
    """Whatever precision is asked for; but as many as asked for by number, or by what counts rollouts itself."""
    plan, ask = mrac.plan(WORLD, starts=STARTS), partial(mrac.evaluate, WORLD, **QUIET)
    known, sampled = (ask(plan, precision=2e-4, exact=exact) for exact in ("auto", "never"))
    assert known.tally.rollouts == TO_LOOK_AT < sampled.tally.rollouts
    assert not known.notes and known.control == {} != sampled.control
    assert ask(plan, rollouts=64).tally.rollouts == 64
    assert ask(plan, precision=2e-4, deadline=4).tally.rollouts == sampled.tally.rollouts


def test_how_a_mission_ends_is_said_in_words() -> None:
    """One row a way to end; the limit of a plan with a deadline is the deadline."""
    world = World.create([[0, 0.1, 0, 0, 0.5, 0]])
    for asked, row in (
        ({"deadline": 3}, "chance that it is cut off at the deadline"),
        ({"max_steps": 3}, "chance that it is cut off at the step limit"),
        ({"range": 3}, "chance that it ends because no robot can go on"),
        ({"policy": "per_cell", "worth": 10}, "chance that it ends because the rest is not worth the risk"),
    ):
        answer = mrac.evaluate(world, mrac.plan(world, 1, **asked), rollouts=64, **QUIET)
        shown = as_text(lambda console, answer=answer: print_report(report(answer), console))
        assert [line for line in shown.splitlines() if row in line], shown


def test_one_robot_s_loops_are_one() -> None:
    answer = mrac.evaluate(WORLD, mrac.plan(WORLD, starts=STARTS[:1]), rollouts=20_000, **QUIET)
    exact, tally = answer.to_json()["exact"], answer.tally
    assert exact["time"] == answer.time.mean == pytest.approx(exact["open_loop"]["time"], abs=1e-6)
    assert exact["alive"] == pytest.approx(exact["open_loop"]["alive"], abs=1e-6)
    assert abs(exact["time"] - tally.time @ np.arange(len(tally.time)) / tally.rollouts) < 0.1


def test_a_robot_that_waits_before_it_gives_up_has_no_exact_time() -> None:
    """It ends two steps after its last move: the open loop's time is not the closed loop's."""
    world = World.create([[0, 0, 0.5, 0]])
    answer = mrac.evaluate(world, mrac.plan(world, 1, policy="per_cell", worth=100), rollouts=16, **QUIET)
    assert answer.plan.outcome == "not_worth_the_risk"
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


def test_by_a_step_at_which_every_run_has_ended_nothing_is_said_twice() -> None:
    world = World.create([[0.0, 0.6, 0.0, 0.9], [0.0, 0.0, 0.1, 0.0]])
    plan = mrac.plan(world, 2, return_to="home")
    over, before = (mrac.evaluate(world, plan, rollouts=200, deadline=steps, advice=False) for steps in (40, 3))
    assert not any("By step" in line for line in report(over).findings)
    deadline, told = over.outputs["deadline"].as_json(), over.to_json()
    assert deadline["visited"]["mean"] == pytest.approx(told["best"]["visited"]["mean"])
    assert deadline["losses"]["mean"] == pytest.approx(told["losses"]["mean"])
    assert told["some_left"]["ci95"][0] == pytest.approx(told["some_left"]["ci95"][1])
    loop = mrac.evaluate(world, mrac.plan(world, 2), rollouts=200, deadline=3, loop="open", advice=False)
    visited, _ = loop.closed_form.by_deadline(3)
    assert f"By step 3: {percent(visited / 8, 2)} (exact) visited" in report(loop).findings[0]
    assert "deadline" in before.to_json()


def test_the_chance_that_a_robot_is_left_is_always_in_the_json() -> None:
    world = World.create([[0.0, 0.3, 0.2, 0.1]])
    sampled = mrac.evaluate(world, mrac.plan(world, 2), rollouts=300, exact="never", advice=False)
    left, count = sampled.to_json()["some_left"], int(sampled.tally.alive[1:].sum())
    assert left["mean"] == count / 300 and left["ci95"][0] < left["mean"] < left["ci95"][1]
    known = mrac.evaluate(world, mrac.plan(world, 2), rollouts=300, loop="open", advice=False)
    assert known.to_json()["some_left"]["mean"] == pytest.approx(1 - np.prod(1 - known.closed_form.survival))
