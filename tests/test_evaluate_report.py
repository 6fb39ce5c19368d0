"""What an evaluation says: words, the table on the terminal, coverage over time."""

import html
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER

import mrac_jax as mrac
from analysis.checking.report import check_report
from analysis.cli.app import run
from analysis.evaluation import report
from analysis.evaluation.evaluate import Evaluation, cut_off, evaluate
from analysis.evaluation.figures import Chance, sampled_share
from analysis.evaluation.outputs.over_time import BAND_LEAST, BAND_MOST, SHARE, STEPS, Band
from analysis.evaluation.report import QUANTILES_NOTE, cells_text, completion_text, losses_text, return_text, summary
from analysis.evaluation.report import report as evaluation_report
from analysis.evaluation.tables import WORDS, answer_tables, formula_counts, formulas_text, over_time
from analysis.page.charts import chart_html
from analysis.report.result import print_report
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.statistics import estimates
from analysis.statistics.estimates import Estimate, exactly, losses_sentence, proportion, quantile, robots_text
from analysis.sweeps.report import around as sweep_around
from analysis.sweeps.report import percent as sweep_percent
from analysis.theory.exact import open_loop_exact
from analysis.theory.verdicts import Verdict, overall
from analysis.utils.tables import as_text, plan_text, span_text, without_level
from planner import formatting
from planner.formatting import UNPACED, ceiled, chance, counted, duration, floored, inside, percent, share
from planner.make_plan import make_plan
from planner.plan.plan import NO_MORE, Plan, RobotPlan
from planner.plan.state import MissionState, RobotState
from planner.settings import Settings
from planner.simulator.codes import Outcome
from planner.tally import Tally, tally_key
from planner.world.world import World, load_world_file

# What an evaluation says in words: every share and mean follows from the tally, and none claims more than it.


def evaluation_of(alive: list[int], threat: float = 0.3) -> Evaluation:
    """An evaluation whose rollouts left 0, 1, ... robots alive so many times."""
    robots, runs = len(alive) - 1, sum(alive)
    world = World.create(np.full((3, max(3, robots)), threat))
    plan = mrac.plan(world, robots)
    cells = int(world.accessible(plan.starts).sum())
    empty = Tally.empty(tally_key("test", "closed", 0), world.shape, robots, cells, plan.makespan)
    counts = {name: getattr(empty, name).copy() for name in ("visited", "survived", "time", "outcomes")}
    for name, value in {"visited": cells, "survived": cells, "time": 3, "outcomes": Outcome.COMPLETE}.items():
        counts[name][value] = runs
    tally = replace(empty, alive=np.array(alive), ids=((0, runs),), **counts)
    return Evaluation(world, plan, open_loop_exact(plan, world), "closed", "numba", 0, tally, 1.0, 0.0)


SAID = {
    (20, 0): "1 of 1 robot lost on average; all in 100 % of runs, none in 0 %.",
    (3722, 6278): "0.37 of 1 robot lost on average; all in 37.2 % of runs, none in 62.8 %.",
    (60, 30, 10): "1.5 of 2 robots lost on average; all in 60 % of runs, none in 10 %.",
    (19990, 10, *[0] * 7): "More than 7.99 of 8 robots lost on average; all in 99.95 % of runs, none in 0 %.",
    (0, 0, 1, 99999): "Fewer than 0.01 of 3 robots lost on average; all in 0 % of runs, none in 99.999 %.",
    (0, 40, 60, 0): "1.4 of 3 robots lost on average; all in 0 % of runs, none in 0 %.",
}
"""Sentences by the runs that left 0, 1, ... robots."""


@pytest.mark.parametrize("alive", SAID)
def test_losses_in_words_and_in_the_headline(alive: tuple[int, ...]) -> None:
    evaluation = evaluation_of(list(alive))
    assert losses_text(evaluation) == SAID[alive]
    said = summary(evaluation)
    assert said.lower().endswith(f", with {SAID[alive].lower().partition(';')[0]}.")
    check_one_meaning(said)


def resumed(alive: list[int]) -> Evaluation:
    """Three robots, one of which the state says is dead: it is none of those that are lost in the runs."""
    whole = evaluation_of(alive)
    robots = tuple(RobotState(0, status) for status in ("dead", "idle", "idle"))
    state = MissionState(whole.world.shape, whole.world.sha256, 0, np.array([0]), np.array([0]), robots)
    return replace(whole, plan=replace(whole.plan, state=state))


def test_a_robot_lost_before_the_runs_is_told_apart() -> None:
    rest = resumed([60, 30, 10, 0])
    mean = "1.5 of 2 robots that were left lost on average"
    assert losses_text(rest) == f"{mean}; all in 60 % of runs, none in 10 %. 1 robot lost before."
    assert summary(rest).endswith(f", with {mean}.")
    assert losses_text(resumed([0, 0, 9, 0])).startswith("0 of 2 robots (0.9 or fewer) that were left lost on average;")


def check_one_meaning(said: str) -> None:
    """One sentence, in which every % is a share of the accessible cells: none is of runs, none is a confidence."""
    assert "of the accessible cells" in said and said.count(". ") == 0
    assert not re.search(r"95 %|% (of|in) (the )?(\d|all )*runs|% confidence", said)


def test_the_headline_has_a_half_width_and_what_19_of_20_runs_reach(capsys: pytest.CaptureFixture[str]) -> None:
    world = mrac.load([[0, 0.1, 0, 0.2], [0, 0, 0.1, 0]])
    answer = mrac.evaluate(world, 2, rollouts=2000, exact="never", advice=False, band=False)
    said, mean = summary(answer), without_level(answer.visited.describe(100, " %"))
    assert "±" in mean and said.startswith(f"2 robots visit {mean} of the accessible cells on average (at least ")
    assert " % in 19 of 20 runs), " in said
    check_one_meaning(said)
    shown_text = shown(answer, 200)
    assert report.INTERVALS in shown_text and QUANTILES_NOTE in shown_text
    assert re.search(
        r"covers [\d.]+ points ± [\d.]+ more than one whose robots .* \([\d.]+ %, exact\)\.$", report.gain_text(answer)
    )
    few = mrac.evaluate(world, 2, rollouts=20, exact="never", advice=False, band=False)
    assert "19 of 20" not in summary(few) and QUANTILES_NOTE not in shown(few, 200)


def test_what_19_of_20_runs_reach_is_rounded_downwards() -> None:
    whole = evaluation_of([0, 999, 1])
    for least, said in ((9, "100 %"), (8, "88.8 %"), (5, "55.5 %")):
        found = replace(whole)
        vars(found)["shown"] = replace(whole.shown, assured=least)
        assert report.assured_text(found) == said and f"(at least {said} in 19 of 20 runs)" in summary(found)


def test_nothing_is_added_to_a_mean_that_every_run_reaches() -> None:
    """The one danger is in the last cell, which is visited before it stops the robot."""
    for world in ([[0, 0, 0, 0, 0.3]], [[0, 0], [np.nan, 0.2]]):
        answer = mrac.evaluate(mrac.load(world), 1, rollouts=500, advice=False, band=False)
        assert summary(answer).startswith("1 robot visits 100 % (exact) of the accessible cells on average, with 0.")
        assert not {report.INTERVALS, QUANTILES_NOTE} & set(shown(answer, 500).splitlines())


def test_the_last_move_is_told_only_where_nobody_waits_for_news() -> None:
    """The robot is stopped in the second cell in 0.1 of runs, at step 1; else it refuses the fourth cell at step 2.

    With an announced phase it waits for it, until step 50 or 9, and the run ends at the next one:
    0.9 of 51 or of 10, and 0.1 of 1.
    """
    world, later = mrac.load([[0, 0.1, 0, 0.9, 0]]), np.array([[0, 0.1, 0, 0.95, 0]])
    for asked, said in (
        (world, "the last move is at step 2"),
        (world.with_phases([(50, later)], plan_on="first"), "the last move is at step 2"),
        (world.with_phases([(50, later)]), "a run takes 46 steps"),
        (world.with_phases([(9, later)]), "a run takes 9 steps"),
    ):
        answer = mrac.evaluate(asked, mrac.plan(asked, 1, policy="per_cell", robot_value=4), rollouts=64, advice=False)
        assert completion_text(answer) == f"Every accessible cell is visited in 0 % of runs; {said} on average."


def test_no_robot_can_be_lost_without_danger() -> None:
    assert summary(evaluation_of([0, 0, 9], threat=0.0)).endswith(" on average, no robot can be lost.")
    assert losses_text(evaluation_of([0, 0, 9], threat=0.0)) == "No robot can be lost."


def test_every_printed_share_of_losses_follows_from_the_tally() -> None:
    """Random tallies, most of them near an end: parsed back, each number is the tally's, to the digits printed."""
    rng = np.random.default_rng(11)
    known = {robots: evaluation_of([0] * robots + [1]) for robots in (1, 2, 3, 8)}
    for _ in range(600):
        robots = int(rng.choice(list(known)))
        runs = int(rng.choice([1, 2, 30, 1_000, 100_000, 10**7]))
        alive = rng.multinomial(runs, rng.dirichlet(np.full(robots + 1, rng.choice([1e-3, 0.05, 1.0]))))
        evaluation = known[robots]
        evaluation = replace(evaluation, tally=replace(evaluation.tally, alive=alive, ids=((0, runs),)))
        bound, mean, every, none = re.fullmatch(
            r"(More than |Fewer than |)([\d.]+) of \d robots? .*; all in (.*) % of runs, none in (.*) %\.",
            losses_text(evaluation),
        ).groups()  # type: ignore[union-attr]
        check_share(every, int(alive[0]), runs)
        check_share(none, int(alive[-1]), runs)
        true, printed = float(alive @ np.arange(robots, -1, -1)) / runs, float(mean)
        if bound:
            assert printed > true > 0 if bound == "Fewer than " else printed < true < robots
        else:
            assert abs(true - printed) <= 0.5 * 10.0 ** -len(mean.partition(".")[2]) + 1e-9


def check_share(printed: str, count: int, of: int) -> None:
    """The printed percentage is `count / of`: exactly where it is 0 or 100, to its digits otherwise."""
    number = float(printed.strip("<> "))
    true = 100 * count / of
    if printed.startswith("<"):
        assert 0 < true < number
    elif printed.startswith(">"):
        assert number < true < 100
    else:
        digits = len(printed.partition(".")[2])
        assert abs(true - number) <= 0.5 * 10**-digits + 1e-9
        assert (number == 0) == (count == 0) and (number == 100) == (count == of)


def test_shares_are_never_rounded_to_none_or_all() -> None:
    for of in (1, 2, 3, 7, 100, 199, 1000, 20_000, 100_000, 2**32):
        for count in {0, 1, 2, of // 3, of // 2, of - 2, of - 1, of}:
            if 0 <= count <= of:
                for digits in range(5):
                    check_share(share(count, of, digits).removesuffix(" %"), count, of)
                check_share(sampled_share(count, of), count, of)


def test_a_share_has_no_more_digits_than_its_interval_bears() -> None:
    """The last decimal is at most ten times finer than the half-width, unless fewer would claim 0 or 100 %."""
    for of in (10, 100, 5_000, 100_000):
        for count in range(1, of, max(1, of // 97)):
            printed = sampled_share(count, of)
            digits = len(printed.partition(".")[2])
            if digits and share(count, of, digits - 1)[0] not in "<>":
                assert 10.0 ** -(digits - 1) > 100 * proportion(count, of).half_width


def test_chances_in_words() -> None:
    known = evaluation_of([30, 10])
    for complete, said in ((40, "100"), (0, "0"), (10, "25")):
        outcomes = known.tally.outcomes.copy()
        outcomes[Outcome.COMPLETE], outcomes[Outcome.ALL_ROBOTS_LOST] = complete, 40 - complete
        some = replace(known, tally=replace(known.tally, outcomes=outcomes))
        words = f"Every accessible cell is visited in {said} % of runs; a run takes 3 steps on average."
        assert completion_text(some) == words


def test_the_cells_with_most_losses_and_least_coverage() -> None:
    """Of stops in three cells one or two take half; of nine cells one or two are covered rarely."""
    known = evaluation_of([0, 8, 0])
    for stops, covered, losses, rare in (
        ((6, 1, 1), (1, 8), "0.75 robots a run in row 0, column 0; half of all losses in 1 of 3 cells with", "1 of 9"),
        ((3, 3, 2), (1, 1), "0.375 robots a run in row 0, column 0; half of all losses in 2 of 3 cells", "2 of 9"),
        ((0, 4, 0), (8, 8), "0.5 robots a run in row 0, column 1; half of all losses in 1 of 1 cell with", "0 of 9"),
    ):
        tally = replace(known.tally, stops=np.array([*stops, *[0] * 6]), covered_visited=np.array([*covered, *[8] * 7]))
        first, second = cells_text(replace(known, tally=tally))
        assert first.startswith(f"Highest losses: {losses}")
        assert second.startswith(f"Covered in fewer than half of the runs: {rare} accessible cells; least likely: ")


def test_one_line_says_how_many_formulas_hold_and_fail() -> None:
    known = evaluation_of([30, 10, 0])
    counts, said = formula_counts(known), formulas_text(known)
    assert f"Of the paper's {sum(counts.values())} formulas" in said
    assert f"{counts[Verdict.HOLDS]} hold" in said and f"{counts[Verdict.FAILS]} fail" in said
    assert WORDS[overall([])] == ""


def test_what_a_plan_is_has_words_and_no_codes() -> None:
    plan = make_plan(World.create([[0.0, 0.2, 0.0]]), [[0, 0]])
    assert plan_text(plan) == "3 areas; if no robot is lost, the mission visits every accessible cell"
    shared = plan_text(replace(plan, shares=10, outcome="not_worth_the_risk"))
    said = "if no robot is lost, the mission ends because the rest is not worth the risk"
    assert shared == f"3 areas, shared 10 times; {said}"
    for outcome in Outcome:
        assert outcome.clause in replace(plan, outcome=outcome.word).ends
    said = "if no robot is lost, the mission visits every accessible cell"
    assert repr(plan).splitlines()[0] == f"Plan of MRAC: 1 robot on 1 x 3 cells; {said}"


def test_a_plan_says_its_policy_and_whether_robots_come_home() -> None:
    world = World.create([[0.0, 0.2, 0.0, 0.0]])
    settings = Settings(policy="watchful", risk_cap=0.5, return_to="home", range=4)
    plan = make_plan(world, [[0, 0]], settings)
    ended = f"the mission {NO_MORE}"
    assert plan_text(plan) == f"watchful, risk cap 0.5; 3 areas; if no robot is lost, {ended}"
    (table, *_) = answer_tables(mrac.evaluate(world, plan, rollouts=64, advice=False))
    assert f"chance that it {NO_MORE}" in list(table.columns[0].cells)


def test_figures_have_the_digits_that_their_interval_allows() -> None:
    for half in np.geomspace(1e-6, 30, 400):
        digits = estimates.digits_of(half)
        assert 0.5 * 10.0**-digits <= half * (1 + 1e-6) or digits == 0
        assert digits == 0 or 0.5 * 10.0 ** (1 - digits) > half * (1 - 1e-6), "one digit fewer would leave the interval"
        low, high = (0.5 - half, 0.5 + half)
        mean, interval = estimate(0.5, low, high, half).columns()
        ends = [float(end) for end in interval.split(" .. ")]
        assert abs(float(mean) - 0.5) <= half * (1 + 1e-6) + 0.5 * (digits == 0)
        assert ends[0] <= low + 1e-6 and high - 1e-6 <= ends[1], "rounded outwards"


def test_no_end_is_named_after_the_deadline() -> None:
    world = World.create(np.zeros((1, 9)))
    plan = make_plan(world, np.array([[0, 0]]), Settings(return_to="home", deadline=6))
    assert plan.time == 6
    plan = replace(plan, outcome="no_progress")  # as where the last one is back in the last step
    assert span_text(plan, world.pace) == "the last move is at step 6, 6 moves, 2 quarter turns"


def test_robots_that_return_to_base() -> None:
    world = World.create(np.zeros((1, 9)))
    answer = mrac.evaluate(world, mrac.plan(world, 2, return_to="home"), rollouts=64, advice=False, exact="never")
    said = "2 of 2 robots back at base on average; all in 100 % of runs."
    assert return_text(answer) == f"{said} 100 % (exact) of the accessible cells are delivered."
    assert return_text(mrac.evaluate(world, 2, rollouts=64, advice=False)) == ""


def test_the_end_that_a_plan_names_is_that_of_its_rollouts() -> None:
    """Where the rest is not worth the risk, a mission ends some steps after its last move: both say so alike."""
    world = World.create(np.array([[0.0, 0.0, 0.0, 0.5, 0.0]]))
    for robot_value, said in (
        (None, "makespan 4 steps, 4 moves, 0 quarter turns"),
        (1000.0, "the last move is at step 2, the end 2 steps later, 2 moves, 0 quarter turns"),
    ):
        plan = make_plan(world, np.array([[0, 0]]), Settings(policy="per_cell", robot_value=robot_value))
        assert span_text(plan, world.pace) == said
        ended = mrac.evaluate(world, plan, rollouts=64, advice=False).tally.time
        assert plan.makespan + (2 if robot_value else 0) == len(ended) - 1


# --- one rule for shares, chances and robots lost ---


def estimate(mean: float, low: float, high: float, se: float = 0.1) -> Estimate:
    return Estimate(mean, se, (low, high))


TEXTS = {
    "shares": ([percent(x, 2) for x in (0, 1e-17, 4e-5, 0.5, 0.99995, 1 - 1e-9, 1)],
               ["0 %", "< 0.01 %", "< 0.01 %", "50.00 %", "> 99.99 %", "> 99.99 %", "100 %"]),
    "sums lose so much; nothing is -0.0": ([percent(x) for x in (-1e-17, -0.0)], ["0 %", "0 %"]),
    "figures": ([inside(x, 8, 2) for x in (0, 1e-9, 0.006, 7.994, 7.996, 8)],
                ["0", "< 0.01", "0.01", "7.99", "> 7.99", "8"]),
    "chances": ([chance(p) for p in (0.05, 0.9999, 0.99999994, 1.0, 2e-7)],
                ["5 %", "99.99 %", "99.99999 %", "100 %", "2e-05 %"]),
    "chances with digits": ([chance(0.29, 12), chance(0.9999999, 12)], ["29 %", "99.99999 %"]),
    "columns that say %": ([ceiled(0.999951, unit=""), chance(0.9999999, unit="")], ["99.996", "99.99999"]),
    "bounds from below": ([floored(x) for x in (0.99999, 1, 0.5, 0.29)], ["99.9 %", "100 %", "50.0 %", "29.0 %"]),
    "bounds from above": ([ceiled(x) for x in (0.999951, 0.12341, 0.29)], ["99.996 %", "12.35 %", "29.00 %"]),
    "100 is whole": ([ceiled(x) for x in (1 - 1e-10, 1.0, 1 - 2e-8)], ["100 %", "100 %", "99.999998 %"]),
    "robots": ([robots_text(mean, 8) for mean in (0.0, 1e-9, 0.006, 4.0, 7.994, 7.9999, 8.0)],
               [f"{mean} of 8 robots"
                for mean in ("0", "fewer than 0.01", "0.01", "4.00", "7.99", "more than 7.99", "8")]),
    "one robot": ([robots_text(0.999, 1)], ["more than 0.99 of 1 robot"]),
    "losses in a table": (
        [estimates.losses_shown(estimate(*one), 8)
         for one in ((8, 7.981, 8), (7.9996, 7.996, 8), (0, 0, 0.0009), (1.873, 1.868, 1.878), (2.5, 2.5, 2.5))],
        [("8 of 8", "7.98 or more"), ("> 7.99 of 8", "7.99 or more"), ("0 of 8", "0.01 or fewer"),
         ("1.87 of 8", "1.86 .. 1.88"), ("2.50 of 8", "exact")]),
    "losses in a sentence": (
        [losses_sentence(estimate(0.2, 0.0, 1.5), 2), losses_sentence(estimate(0.01, 0.0, 0.03), 1)],
        ["0.2 (1.5 or fewer, 95 %) robots", "0.01 (0.03 or fewer, 95 %) robots"]),
    "never seen: the most it may be": ([estimate(0, 0, 0.0009, 0).describe(100, " %")], ["0 % (0.1 or less, 95 %)"]),
    "not -0.0": ([estimate(mean, -0.2, 0.2).describe() for mean in (0.0, -1e-17)], ["0.0 ± 0.2 (95 %)"] * 2),
    "exact": ([estimate(0, 0, 0, 0).describe(), exactly(0.99995).describe(100, " %"), exactly(1.0).describe(100, " %")],
              ["0.00 (exact)", "> 99.99 % (exact)", "100 % (exact)"]),
    "what is known is not said to be nothing": ([exactly(3e-5).describe(100, " points")], ["0.003 points (exact)"]),
    "exact in a table": ([exactly(0.0).columns(100, 100)], [("0", "exact")]),
    "an interval that is no point": (
        [estimates.between(*one)
         for one in ((7.9978, 7.9991), (0.0, 0.0004), (85.604, 85.756), (8.0, 8.0), (279.01, 279.04, 1))],
        ["7.99 .. 8.00", "0.00 .. 0.01", "85.60 .. 85.76", "8.00 .. 8.00", "279.0 .. 279.1"]),
    "chances in a table": (
        [Chance(**vars(proportion(count, n, n == 1)), rollouts=n).columns()
         for count, n in ((0, 1024), (3, 1024), (1024, 1024), (50_000, 100_000), (1, 1))],
        [("0", "0.4 or less"), ("0.3", "0.0 .. 0.9"), ("100", "99.6 or more"), ("50.0", "49.6 .. 50.4"),
         ("100", "exact")]),
    "the unit where an interval is read": (
        [estimates.in_unit(one) for one in ("exact", "", "56.4 .. 56.6", "99.5 or more", "9 .. 12, certain")],
        ["exact", "", "56.4 .. 56.6 %", "99.5 % or more", "9 .. 12 %, certain"]),
    "sweeps": ([sweep_percent(estimate(0.0, 0.0, 0.3)), sweep_percent(exactly(0.85731))],
               ["0 (30.0 or less)", "85.73 (exact)"]),
    "no time is below 0": ([sweep_around(estimate(3.0, 0.0, 12.0, 4.0))], ["3.0 (0.0 .. 12.0)"]),
    "digits that the interval allows": (
        [estimate(0.85678, 0.85678 - half, 0.85678 + half).describe(100, " %") for half in (8e-4, 2.4e-4, 3e-3, 7e-3)],
        [f"{said} (95 %)" for said in ("85.7 % ± 0.1", "85.68 % ± 0.03", "85.7 % ± 0.3", "86 % ± 1")]),
    "the two largest units of a time": ([duration(s) for s in (0.2, 59, 60, 125, 3600, 4830)],
                                        ["1 s", "59 s", "1 min", "2 min 5 s", "1 h", "1 h 20 min"]),
    "numbers and their things": ([counted(1.0, "step"), counted(1.5, "step"), counted(1, "map")],
                                 ["1 step", "1.5 steps", "1 map"]),
    "steps": ([UNPACED.steps(1.2), UNPACED.steps(13.6), UNPACED.step(12.4)], ["1 step", "14 steps", "step 12"]),
    "at least": ([formatting.at_least_text(*of) for of in ((1, 3), (2, 3), (3, 3), (1, 1))],
                 ["at least 1 robot is", "at least 2 robots are", "every robot is", "the robot is"]),
}  # fmt: skip


@pytest.mark.parametrize("what", TEXTS)
def test_no_text_claims_more_than_is_known(what: str) -> None:
    found, said = TEXTS[what]
    assert found == said


SYMMETRIC = [
    ((0.0, 0.0, 0.3), "0 % (30 or less, 95 %)", "0 (30.0 or less)"),
    ((0.998, 0.995, 1.0, 0.002), "99.8 % (99.5 or more, 95 %)", "99.8 (99.5 or more)"),
    ((0.02, 0.0, 0.05, 0.02), "2 % (5 or less, 95 %)", "2.0 (5.0 or less)"),
    ((0.4, -0.2, 1.0, 0.4), "40 % (0 .. 100, 95 %)", "40.0 (0 .. 100)"),
    ((0.6735, 0.6721, 0.6749, 0.0007), "67.3 % ± 0.2 (95 %)", "67.3 ± 0.2"),
]


@pytest.mark.parametrize(("of", "said", "table"), SYMMETRIC)
def test_a_symmetric_interval_stays_in_what_is_possible(of: tuple[float, ...], said: str, table: str) -> None:
    found = estimate(*of)
    assert (found.describe(100, " %"), found.around(100, most=100)) == (said, table)


def test_no_printed_share_leaves_0_to_100() -> None:
    """Random estimates, parsed back: ± and intervals lie in 0 .. 100, and 0 and 100 are said of nothing else."""
    rng = np.random.default_rng(4)
    for _ in range(2000):
        mean = float(rng.choice([rng.beta(0.1, 0.1), rng.random() ** 8, 1 - rng.random() ** 8]))
        wide = float(10 ** rng.uniform(-6, 0))
        estimate = Estimate(mean, wide / 2, (max(mean - wide, 0.0), min(mean + wide * rng.random(), 1.0)))
        for text in (estimate.describe(100, " %"), estimate.around(100, most=100, digits=int(rng.integers(1, 3)))):
            first, *rest = re.findall(r"\d+(?:\.\d+)?", text.removesuffix("95 %)"))
            if "±" in text:
                assert float(first) - float(rest[0]) >= -1e-9 and float(first) + float(rest[0]) <= 100 + 1e-9, text
            assert all(0 <= float(number) <= 100 for number in (first, *rest)), text
            if text[0] not in "<>":
                assert (float(first) == 100) == (mean > 1 - 1e-12) and (float(first) == 0) == (mean == 0), (text, mean)


def test_a_mean_of_few_rollouts_has_its_interval() -> None:
    """Five rollouts that lose 0.2 of 2 on average: their interval allows no decimal, and it is said."""
    said = r"0\.2 of 2 robots \([\d.]+ or fewer\) lost on average; all in 0 % of runs, none in 80 %\."
    assert re.fullmatch(said, losses_text(evaluation_of([0, 1, 4])))


def test_what_was_cut_off_and_lost_agrees_with_its_number() -> None:
    whole = evaluation_of([0, 1])
    for runs, cut, said in (
        (1, 1, "1 of 1 rollout was"),
        (20, 1, "1 of 20 rollouts was"),
        (20, 7, "7 of 20 rollouts were"),
    ):
        outcomes = np.zeros_like(whole.tally.outcomes)
        outcomes[[Outcome.COMPLETE, Outcome.STEP_LIMIT]] = runs - cut, cut
        tally = replace(whole.tally, outcomes=outcomes, ids=((0, runs),))
        found = cut_off(whole.world, tally, whole.plan)
        assert found == (f"{said} cut off at the step limit: raise max_steps",)
    world, quiet = mrac.load([[0, 0, 0, 0.3, 0]]), {"advice": False, "band": False, "loop": "open"}
    for step, said in ((1, "(exact) visited, 0 of 1 robot lost on average."), (3, "0.30 of 1 robot lost on average.")):
        answer = mrac.evaluate(world, 1, rollouts=64, deadline=step, **quiet)
        (line,) = (line for found in answer.elements for line in found.opens)
        assert line.startswith(f"By step {step}: ") and line.endswith(said)


def test_numbers_and_their_things_agree() -> None:
    plan = make_plan(World.create([[0.0, 0.2, 0.0]]), [[0, 0]])
    assert ", shared once; " in plan_text(replace(plan, shares=1))
    two = make_plan(World.create([[0.0, 0.0]]), [[0, 0]])
    assert span_text(two, UNPACED) == "makespan 1 step, 1 move, 0 quarter turns"


def test_cells_out_of_reach_are_counted() -> None:
    world = World.create([[0.0, 0.2, np.nan, 0.0, 0.0]])
    answer = mrac.evaluate(world, mrac.plan(world, starts=[[0, 0]]), rollouts=64, advice=False)
    assert "Out of reach of every robot: 2 free cells, counted only in 'of all free cells'." in cells_text(answer)


# The terminal's answer: what comes first, what is folded away, and that it can be read at 80 columns.

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
MOST_LINES = 4


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(Path(WORLD))


@pytest.fixture(scope="module")
def answers(world: World) -> dict[str, Evaluation]:
    """Both loops, with everything that can be asked for."""

    def evaluated(rollouts: int = 200, loop: Any = "closed", **more: Any) -> Evaluation:
        return evaluate(world, plan, RolloutChoices(loop=loop, deadline=40, rollouts=rollouts), **more)

    plan = mrac.plan(world, 8)
    return {
        "closed": evaluated(threat_scale=(0.5, 2.0)),
        "controlled": evaluated(1024),
        "open": evaluated(loop="open", threat_scale=(0.5,)),
    }


def shown(evaluation: Evaluation, width: int, theory: bool = False) -> str:
    return as_text(lambda console: print_report(evaluation_report(evaluation, theory), console), width)


@pytest.mark.parametrize("loop", ["closed", "controlled", "open"])
def test_the_answer_losses_chances_and_time_come_first(loop: str, answers: dict[str, Evaluation]) -> None:
    answer = answers[loop]
    said = shown(answer, 200)
    wanted = [summary(answer), "Chances in %", "time, steps", "Coverage, %", losses_text(answer),
              "accessible,", "makespan", "rollouts,"]  # fmt: skip
    places = [said.index(words) for words in wanted]
    assert places == sorted(places) and places[0] == 0


def test_formulas_are_listed_only_when_asked_for(answers: dict[str, Evaluation]) -> None:
    said, listed = (shown(answers["closed"], 200, theory) for theory in (False, True))
    assert "Theorem 3" not in said and "FAILS" not in said
    assert "formula" not in said, "no concern of who asks for coverage"
    assert formulas_text(answers["closed"]) in listed
    assert listed.count("Theorem 3") == 4 and "eq. (2) as printed" in listed and "--theory" not in listed


@pytest.mark.parametrize("loop", ["closed", "controlled", "open", "check"])
@pytest.mark.parametrize("width", [80, 200])
def test_tables_fit_and_no_label_is_over_four_lines(
    loop: str, width: int, world: World, answers: dict[str, Evaluation]
) -> None:
    if loop == "check":
        checked = check_report(mrac.check(world, 2, rollouts=200))
        said = as_text(lambda console: print_report(checked, console), width)
    else:
        said = shown(answers[loop], width, theory=True)
    assert max(map(len, said.splitlines())) <= width and "\u2026" not in said
    assert most_lines(said) <= (MOST_LINES if width == 80 else 1), said


def most_lines(said: str) -> int:
    """Lines of the longest label of a table's rows: lines without a number in them that follow one that has some."""
    most = now = 0
    for line in said.splitlines():
        inside = line.startswith("  ")
        if inside and re.search(r"\s{2,}\S+.*\s{2,}\S+", line.strip() and line):
            now = 1
        elif inside and line.strip() and now:
            now += 1
        else:
            now = 0
        most = max(most, now)
    return most


def test_the_longest_label_is_found() -> None:
    assert most_lines("  a     1   2\n  b\n  c\n  d     3   4\n\n  words\n") == 3


def test_notes_come_last_and_the_width_of_a_pipe_can_be_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results on standard output, then on standard error how the map was read."""
    World.create(np.full((4, 6), 0.05), source="m").save(tmp_path / "m.npz")
    words, events = ["evaluate", str(tmp_path / "m.npz"), "--robots", "25", "--rollouts", "64"], list[str]()
    monkeypatch.setenv("COLUMNS", "80")
    with monkeypatch.context() as watched:
        watched.setattr("analysis.cli.console.say", events.extend)
        watched.setattr("analysis.report.result.print_report", lambda *_, **__: events.append("the answer"))
        assert run(words) == 0 and events[0] == "the answer"
    assert run([*words, "--theory"]) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80 and "Theorem 3" in said


# The band of coverage over time: the quantiles of the rollouts that were run, each cut off at each step.

CHOICES = [
    RolloutChoices(loop="closed", rollouts=120),
    RolloutChoices(loop="closed", rollouts=120, first_only=True, seed=5),
    RolloutChoices(loop="open", rollouts=120),
    RolloutChoices(loop="open", rollouts=120, seed=5, deadline=30),
]


@pytest.fixture(scope="module")
def plan(world: World) -> Plan:
    return mrac.plan(world, 3)


def assert_is_of(band: Band, cut: Callable[[int], Tally], places: Iterable[int]) -> None:
    """The band holds the quantiles of the tally that is cut off at each step."""
    for place in places:
        visited = cut(int(band.steps[place])).visited
        found = tuple(int(values[place]) for values in (band.low, band.median, band.high))
        assert found == tuple(quantile(visited, q) for q in estimates.QUANTILES), f"step {band.steps[place]}"


def band_of(world: World, plan: Plan, choices: RolloutChoices) -> Band:
    return evaluate(world, plan, choices, band=True).outputs["band"]


@pytest.mark.parametrize("choices", CHOICES, ids=lambda choices: f"{choices.loop}-{choices.seed}")
@pytest.mark.parametrize("wears", [False, True])
def test_the_band_is_that_of_the_same_ids_cut_off_at_every_step(
    world: World, plan: Plan, choices: RolloutChoices, wears: bool
) -> None:
    """Brute force: the first ids again for every step of the band, by the engines, and the quantiles of their tally."""
    if wears:
        plan = mrac.plan(world, 3, weibull_shape=3.0, hazard_multiplier=(1.0, 4.0, 0.5))
    band, roll_out = band_of(world, plan, choices), make_roll_out(world, plan, choices)
    assert band.rollouts == BAND_LEAST
    few, last = replace(choices, rollouts=BAND_LEAST), len(band.steps) - 1
    assert_is_of(band, lambda step: list(roll_out(few, step))[-1].tally, [*range(0, last, 25 if wears else 7), last])


def test_every_step_of_a_short_run_is_looked_at_and_the_end_of_the_longest(world: World, plan: Plan) -> None:
    choices = RolloutChoices(rollouts=300, deadline=1000)
    tallies = make_roll_out(world, plan, choices)
    band, tally = band_of(world, plan, choices), list(tallies(choices, None))[-1].tally
    assert {0, 1000, int(np.flatnonzero(tally.time).max())} <= set(band.steps.tolist())
    assert len(band.steps) <= STEPS + 2
    few = replace(choices, rollouts=band.rollouts)
    assert_is_of(band, lambda step: list(tallies(few, None))[-1].tally, [-1])


def test_no_more_rollouts_than_were_asked_for_and_few_of_many(world: World, plan: Plan) -> None:
    """Counted where they are run: the calls of the compiled simulator."""
    for asked, again in ((1, 1), (60, 60), (500, BAND_LEAST), (3000, 3000 // SHARE), (100_000, BAND_MOST)):
        choices = RolloutChoices(loop="open", rollouts=asked)
        assert band_of(world, plan, choices).rollouts == again


def test_other_planners_paths_that_wait_and_cross_have_a_band(world: World) -> None:
    start = next(int(cell) for cell in np.flatnonzero(world.free) if world.free.flat[cell + 1])
    walk = RobotPlan(start + np.array([0, 0, 1, 0, 0, 1]))
    plan = Plan(shape=world.shape, sha256="", settings=None, areas=(), areas_added=(), robots=(walk, walk))
    band = band_of(world, plan, RolloutChoices(loop="open", rollouts=50))
    assert band.steps.tolist() == list(range(6)) and band.median.tolist()[:2] == [1, 1] and band.high[-1] == 2


def test_the_evaluation_s_band_is_the_same_for_the_same_seed_and_every_chunk(world: World, plan: Plan) -> None:
    bands = [band_of(world, plan, RolloutChoices(rollouts=2000)) for _ in range(2)]
    for name in ("steps", "low", "median", "high", "rollouts"):
        assert np.array_equal(getattr(bands[0], name), getattr(bands[1], name))
    assert bands[0].rollouts == 200


@pytest.mark.parametrize("loop", ["open", "closed"])
def test_the_page_s_table_shows_the_band_only_where_it_was_looked_at(world: World, loop: str) -> None:
    """1 robot takes some hundred steps: more than are looked at."""
    answer = evaluate(world, mrac.plan(world, 1), RolloutChoices(loop=loop, rollouts=100), band=True)  # type: ignore[arg-type]
    band = answer.outputs["band"]
    assert len(band.steps) < band.steps[-1]
    rows = re.findall(r"<tr>(.*?)</tr>", chart_html(over_time(answer)), re.DOTALL)
    table = [re.findall(r"<t[hd][^>]*>([^<]*)</t[hd]>", html.unescape(row).replace("\xa0", " ")) for row in rows]
    name = next(place for place, words in enumerate(table[0]) if words.startswith("median of 100 rollouts"))
    said = {}
    for step, *values in np.array([band.steps, band.low, band.median, band.high]).T.tolist():
        low, median, high = (f"{100 * value / answer.tally.accessible:,.2f}" for value in values)
        said[f"{step:,}"] = median if low == high else f"{median} ({low} .. {high})"
    assert len(table) > 30 and all(row[name] == said[row[0]] for row in table[1:])
