"""Formulas against the truth: `check`, counterexamples, the fixtures, scaled threats."""

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, NAMES, Fixture, load_fixture
from counterexamples import COUNTEREXAMPLES, SHUT_IN, Counterexample
from helpers import answer_of, error_of
from oracle_tree import closed_loop_exact
from page_reader import refused

import analysis.checking.check
import analysis.theory.upper_bound
import mrac_jax as mrac
from analysis.checking.check import PANELS, Survey, check_input, make_survey, run_survey
from analysis.checking.report import check_report, figure
from analysis.cli.app import run
from analysis.estimators.trial import closed_truth
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.what_if import scaled_threats
from analysis.evaluation.tables import WORDS
from analysis.sampling import RolloutChoices
from analysis.theory.bounds import Theorem3, all_bounds, connecting_cells
from analysis.theory.exact import open_loop_exact
from analysis.theory.upper_bound import any_strategy
from analysis.theory.verdicts import (
    FORMULAS,
    Check,
    Direction,
    Truth,
    Verdict,
    badness,
    judge,
    make_check,
    of_formula,
    overall,
    own_bounds,
    own_checks,
    paper_checks,
    worst_of_robots,
)
from planner.errors import UsageError
from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.settings import Choices, Settings
from planner.simulator.codes import Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.world import World

# Formulas against the true_map: verdicts, the command, planted faults, surveys, and the smallest worlds that fail.

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
TINY_MAP = str(FOLDER / "tiny-3x7-01.npz")  # with three robots
LOWER, UPPER, EQUAL, EVERY = Direction.LOWER, Direction.UPPER, Direction.EQUAL, Direction.EVERY_RUN
KNOWN, SAMPLED = Truth.known(5.0), Truth(5.0, 4.0, 6.0, "sampled")


def answer(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict:
    return answer_of(capsys, "check", *words, status=status)


# --- verdicts on numbers made by hand: cells, 0 to 10 ---


VERDICTS = {
    (KNOWN, LOWER): {4.9: "holds", 5.0: "holds", 5.0 + 1e-10: "holds", 5.0 + 1e-6: "fails", 0.0: "vacuous",
                     -3.0: "vacuous", 11.0: "fails"},
    (KNOWN, UPPER): {5.1: "holds", 4.9: "fails", 10.0: "vacuous", 12.0: "vacuous", -1.0: "fails"},
    (KNOWN, EQUAL): {5.0: "holds", 5.1: "fails", 4.9: "fails"},
    (SAMPLED, LOWER): {3.9: "holds", 4.5: "undecided", 5.5: "undecided", 6.1: "fails", -0.1: "vacuous"},
    (SAMPLED, UPPER): {6.1: "holds", 5.5: "undecided", 3.9: "fails", 10.5: "vacuous"},
    (SAMPLED, EQUAL): {5.0: "undecided", 6.1: "fails", 3.9: "fails"},
    (Truth.known(1.0), EVERY): {1.0: "holds"},
    (Truth.known(0.999), EVERY): {1.0: "fails"},
    (Truth(1.0, 0.99, 1.0), EVERY): {1.0: "undecided"},
    (Truth(0.999, 0.99, 0.999), EVERY): {1.0: "fails"},
}  # fmt: skip
"""Of a value, by the truth and the direction."""


@pytest.mark.parametrize(("truth", "direction"), VERDICTS)
def test_verdicts(truth: Truth, direction: Direction) -> None:
    known = VERDICTS[truth, direction]
    assert {value: judge(value, truth, direction, 0.0, 10.0) for value in known} == known


def test_margins_point_one_way() -> None:
    """Above 0 it holds by so much, below 0 it fails by so much, whatever the direction."""
    margins = {
        formula: make_check(formula, 3.0, Truth.known(5.0), "open", 10.0).margin
        for formula in ("corrected_count", "ideal_team", "eq4")
    }
    assert margins == {"corrected_count": 2.0, "ideal_team": -2.0, "eq4": -2.0}
    above = make_check("ideal_team", 7.0, Truth.known(5.0), "open", 10.0)
    assert (above.margin, above.tightness) == (2.0, 1.4)
    assert make_check("ideal_team", 7.0, Truth.known(0.0), "open", 10.0).tightness is None


def test_the_worst_robot_speaks_for_the_team() -> None:
    def of(*values: float) -> list[Check]:
        known = Truth.known(5.0)
        return [make_check("eq5_printed", x, known, "open", 10.0, "survived", k) for k, x in enumerate(values)]

    assert [[c.robot for c in worst_of_robots(of(*values))] for values in ((1, 6, 5.5), (-9, 4, 3))] == [[1], [1]]
    assert [overall(of(*values)) for values in ((-1, 4), (-1,), ())] == [Verdict.HOLDS, Verdict.VACUOUS, None]


# --- the command on one map ---


@pytest.mark.parametrize("robots", [1, 2, 8])
def test_fixtures_through_the_command(robots: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Values, truths and verdicts from the answers of an independent simulator."""
    known = load_fixture(f"contiguous-14x23-1000-k{robots}").answers
    found = answer(capsys, WORLD, "--robots", str(robots), "--rollouts", "4096")
    checks = {check["key"]: check for check in found["checks"] if check["robot"] is None}
    for meaning in ("visited", "survived"):
        exact = known["open_loop_exact"][meaning]
        for reading, value in known["theorem3"][meaning].items():
            check = checks[f"theorem3_{reading}/{meaning}/open"]
            assert check["value"] == pytest.approx(value, abs=1e-6)
            assert check["truth"] == {"value": pytest.approx(exact, abs=1e-6), "interval": [pytest.approx(exact)] * 2,
                                      "how": "exact"}  # fmt: skip
            assert check["verdict"] == ("vacuous" if value <= 0 else "fails" if value > exact + 1e-6 else "holds")
    printed = checks["eq2_printed/open"]
    assert printed["value"] == pytest.approx(known["eq2"]["printed"])
    assert printed["truth"]["value"] == pytest.approx(known["eq2"]["team_survival"])
    assert printed["verdict"] == ("holds" if robots == 1 else "fails")
    assert checks["eq7_team/visited/open"]["value"] == pytest.approx(known["ideal_eq7"], abs=1e-6)
    assert checks["ideal_team/visited/open"]["verdict"] == "holds"
    for bound, check in zip(
        known.get("eq5", []), [c for c in found["checks"] if c["key"].startswith("eq5_printed")], strict=False
    ):
        assert check["value"] == pytest.approx(bound["printed"], abs=1e-6)
        gain = known["eq4"][check["robot"]]["survived"]
        assert check["verdict"] == ("fails" if bound["printed"] > gain + 1e-6 else "holds")
    assert found["faults"] == []
    closed = checks["ideal_team/visited/closed"]["truth"]
    assert closed["how"] == {1: "exact", 2: "tree", 8: "sampled"}[robots]
    if robots == 2:
        assert closed["value"] == pytest.approx(known["closed_loop_exact"]["visited"], abs=1e-9)
    if robots == 8:
        mean, se = known["closed_loop_sampled"]["visited"]
        assert closed["interval"][0] - 5 * se <= mean <= closed["interval"][1] + 5 * se


def test_the_first_line_is_the_answer(capsys: pytest.CaptureFixture[str]) -> None:
    words = (TINY_MAP, "--rollouts", "512")
    assert run(["check", *words]) == 0
    first = " ".join(capsys.readouterr().out.split())
    failing = {FORMULAS[key.split("/")[0]].title for key in answer(capsys, *words)["failing"]}
    assert first.startswith(f"{len(failing)} of the paper's ") and "Of our" in first
    assert all(title in first for title in failing)


def test_a_plan_of_another_planner_has_open_loop_checks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    World.create([[0.0, 0.2, 0.0]]).save(tmp_path / "world.npz")
    (tmp_path / "other.json").write_text('{"paths": [[[0, 0], [0, 1], [0, 2]], [[0, 2], [0, 1]]]}')
    found = answer(capsys, str(tmp_path / "world.npz"), "--plan", str(tmp_path / "other.json"))
    assert {check["loop"] for check in found["checks"]} == {"open"} and found["truth"]["closed_loop"] is None
    assert "external plan" in found["left_out"][0]


@pytest.mark.parametrize("starts", [[[0, 0]], [[0, 0], [0, 3]]])
def test_theorem_2_is_of_runs_that_nothing_cuts_off(starts: list[list[int]]) -> None:
    world = World.create([[0.0, 0.5, 0.0, 0.25]])
    for more, verdicts in (({}, [Verdict.HOLDS]), ({"deadline": 3}, []), ({"max_steps": 3}, [])):
        found = check_input(world, make_plan(world, starts, Settings(**more)), RolloutChoices(rollouts=64))
        assert [check.verdict for check in of_formula(found.checks, "theorem2")] == verdicts, more


def test_a_tiny_map_has_an_exact_closed_loop() -> None:
    world = World.create([[0.0, 0.5, 0.0, 0.25]])
    plan = make_plan(world, [[0, 0], [0, 2]])
    truth = closed_truth(plan, world, open_loop_exact(plan, world), RolloutChoices())
    assert truth.visited.how == "tree" and truth.as_stated == Truth.known(1.0, "tree")
    tally = run_range(compile_closed_loop(plan, world), 3, 0, 40_000)[0]
    assert_mean(tally.visited, truth.visited.value)
    left = 1.0 - tally.alive[0] / 40_000
    assert abs(truth.some_left.value - left) <= 5 * np.sqrt(left * (1 - left) / 40_000)


def assert_mean(counts: np.ndarray, truth: float) -> None:
    """The mean of a histogram of rollouts is the truth, within 5 standard errors."""
    values, rollouts = np.arange(len(counts)), counts.sum()
    mean = counts @ values / rollouts
    assert abs(mean - truth) <= 5 * np.sqrt(counts @ (values - mean) ** 2) / rollouts


def test_what_depends_on_histories_that_were_left_is_undecided() -> None:
    """The tree of three robots leaves some out: what is not true of both its ends is not said."""
    world = random_world(20, 20, ThreatPattern("contiguous", seed=1))
    checked = check_input(world, mrac.plan(world, 3), RolloutChoices(rollouts=1))
    closed = checked.closed
    assert (closed.visited.how, closed.rollouts) == ("tree", 0)
    assert closed.visited.low < closed.visited.value < closed.visited.high
    (theorem2,) = of_formula(checked.checks, "theorem2")
    assert theorem2.verdict is Verdict.HOLDS  # in all that was followed, as in all rollouts where it is sampled
    assert theorem2.truth == Truth.known(1.0, "tree")
    assert {check.verdict for check in of_formula(checked.checks, "ideal_team")} == {Verdict.HOLDS}
    for direction in (LOWER, UPPER, EQUAL):
        assert judge(closed.visited.value, closed.visited, direction, 0.0, 400.0) is Verdict.UNDECIDED
    assert "undecided: these decide" not in " ".join(check_report(checked).parts[0].notes)


def test_a_wrong_bound_that_is_marked_as_proven_is_a_fault(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    right = analysis.theory.upper_bound.ideal_connected
    monkeypatch.setattr("analysis.theory.upper_bound.ideal_connected", lambda *given: 0.5 * right(*given))
    found = answer(capsys, WORLD, "--robots", "1", "--rollouts", "512", status=1)
    assert found["faults"] == ["ideal_connected/visited/closed", "ideal_connected/visited/open"]
    assert found["answer"].startswith("FAULT: proven, but fails: upper bound, this map")
    assert run(["check", "--worlds", "2", "--robots", "1", "--size", "6x6", "--processes", "1"]) == 1
    assert capsys.readouterr().out.startswith("FAULT: ")


def test_every_mark_of_theorem_2_counts(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """One rollout in 4,096 that ends stuck on a map of one part is a failure."""
    sampled = analysis.checking.check.sampled_truth

    def one_stuck(plan, world, tally, doubt):  # type: ignore[no-untyped-def]
        outcomes = tally.outcomes.copy()
        outcomes[1:3] += [-1, 1]
        return sampled(plan, world, replace(tally, outcomes=outcomes), doubt)

    monkeypatch.setattr("analysis.checking.check.sampled_truth", one_stuck)
    found = answer(capsys, WORLD, "--robots", "8", "--rollouts", "4096", status=1)
    assert found["faults"] == ["theorem2/closed"]


def test_what_is_next_to_nothing_is_not_said_to_be_nothing() -> None:
    assert [figure(x, "chance") for x in (0.0, 1.04e-17, 3e-8, 0.25, 1 - 1e-9, 1.0)] == [
        "0.0000", "1.0e-17", "3.0e-08", "0.2500", "> 0.9999", "1.0000",
    ]  # fmt: skip
    assert (figure(1e-6, "cells"), figure(3.456, "cells"), figure(311.0, "steps")) == ("1.0e-06", "3.46", "311")
    world = World.create(np.concatenate([[0.0], np.full(17, 0.9)])[None].astype(np.float32))
    checked = mrac.check(world, mrac.plan(world, starts=[[0, 0]]))
    said = check_report(checked)
    lines = [*said.findings, *said.heading]
    assert "a robot survives with chance 1.0e-17" in " ".join(lines) and "0.0000" not in " ".join(lines)
    left = [check for check in checked.checks if check.formula in ("eq1", "eq2_event") and check.loop == "open"]
    assert all(check.truth.value == pytest.approx(1e-17, rel=1e-4) for check in left) and len(left) == 2


def test_a_statement_has_a_row_and_its_readings_are_asked_for() -> None:
    world = World.create([[0.0, 0.2, 0.0, 0.1], [0.0, 0.0, 0.3, 0.0]])
    few, every = (mrac.check(world, 2, rollouts=64, theory=theory) for theory in ("main", "all"))
    few_rows, rows = (check_report(one).parts[0].tables[0] for one in (few, every))
    names, sources, shown = (list(few_rows.columns[place].cells) for place in (0, 1, 4))
    assert len(names) == len(set(names)) and few.to_json() == every.to_json()
    theorem3 = names.index("lower bound on coverage, the team")
    assert sources[names.index("upper bound on coverage, one robot")] == "eq. (7)"
    assert sources[theorem3] == "Theorem 3" and sum("Theorem 3" in source for source in sources) == 1
    assert len({(check.formula, check.meaning) for check in every.rows}) == len(rows.rows) > len(few_rows.rows)
    worst = min((c for c in few.checks if c.formula.startswith("theorem3")), key=badness)
    assert shown[theorem3] == figure(worst.value, "cells"), "of its readings the one that holds least"
    with pytest.raises(UsageError, match="'main' or 'all'"):
        mrac.check(world, 2, theory="both")


# --- surveys ---

TINY = ("--worlds", "3", "--size", "7x8", "--robots", "1,3", "--rollouts", "512", "--seed", "40")


@cache
def small_survey(processes: int, worlds: int = 3) -> Survey:
    choices = make_survey(worlds, "scattered", "7x8", (1, 8), Choices())
    return run_survey(choices, RolloutChoices(rollouts=512, seed=40), processes=processes)


def test_robots_of_one_range_each_are_held_against_the_first_by_itself(capsys: pytest.CaptureFixture[str]) -> None:
    """It was refused: two ranges for the one robot of T_1."""
    assert answer(capsys, "example:paper", "--robots", "2", "--range", "40,30", "--rollouts", "64")["checks"]


@pytest.mark.usefixtures("full_effort")
def test_a_survey_is_the_same_however_many_processes() -> None:
    one, fewer, two = small_survey(1), small_survey(1, worlds=2), small_survey(2, worlds=2)
    assert fewer.entries == two.entries
    assert [(entry.seed, entry.robots) for entry in one.entries] == [(40 + i, k) for i in range(3) for k in (1, 8)]
    assert any(check.truth.how == "sampled" for entry in one.entries for check in entry.checks)
    # Intervals alone depend on how many comparisons there are.
    values = [[(c.key, c.value, c.truth.value) for c in e.checks] for e in fewer.entries]
    assert values == [[(c.key, c.value, c.truth.value) for c in e.checks] for e in one.entries[:4]]


def test_rows_count_the_entries() -> None:
    found = small_survey(1)
    for row in found.rows:
        checks = [c for e in found.entries if e.robots == row.robots for c in e.checks if c.key == row.check.key]
        assert row.worlds == len(checks) == sum(row.verdicts.values())
        assert row.verdicts[Verdict.FAILS] == sum(check.verdict is Verdict.FAILS for check in checks)
        failing = [check.margin for check in checks if check.verdict is Verdict.FAILS]
        assert row.check.margin == min(failing or [check.margin for check in checks])
    assert {row.check.key for row in found.rows} >= set(PANELS) - {"eq5_printed/survived/open"}


def test_the_worst_world_is_saved_and_fails_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = answer(capsys, *TINY, "--processes", "1", "--out", str(tmp_path))
    assert {path.name for path in tmp_path.iterdir()} == {
        "index.html", "survey.txt", "survey.json", "survey.csv", "bound_against_truth.png",
        "over_robots.png", "worst",
    }  # fmt: skip
    assert "eq2_printed/open" in found["worst"]
    rows = {(row["key"], row["robots"]): row for row in found["rows"]}
    answers: dict[tuple[bytes, int], dict] = {}  # a world may be the worst for several formulas
    for key, where in found["worst"].items():
        file = tmp_path / "worst" / f"{key.replace('/', '-')}.npz"
        same = file.read_bytes(), where["seed"]
        if same not in answers:
            answers[same] = answer(capsys, str(file), "--seed", str(where["seed"]), "--rollouts", "512")
        again = answers[same]
        margins = [check["margin"] for check in again["checks"] if check["key"] == key]
        assert min(margins) < 0
        if not key.endswith("closed"):  # those are exact in the one place, sampled in the other
            assert min(margins) == pytest.approx(rows[key, where["robots"]]["worst"]["margin"], abs=1e-9), key
    with (tmp_path / "survey.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert sum(line["verdict"] == "fails" for line in lines) == sum(row["fails"] for row in found["rows"])


def test_a_sampled_failure_counts_only_beyond_the_shared_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(analysis.checking.check, "EXACT", "never")
    few, many = small_survey.__wrapped__(1, worlds=1), make_survey(100, "scattered", "7x8", (1, 8), Choices())
    narrow, wide = (
        np.array([c.truth.high - c.truth.low for entry in entries for c in entry.checks if c.loop == "closed"])
        for entries in (few.entries, analysis.checking.check.look_at(many, few.rollouts, 40))
    )
    assert many.figures == 100 * few.choices.figures == 300
    assert (wide >= narrow).all() and wide.sum() > 1.1 * narrow.sum()


def test_an_interrupted_survey_prints_what_is_there(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = analysis.checking.check.look_at

    def interrupted(choices: object, rollouts: object, seed: int) -> list:
        if seed == 42:
            raise KeyboardInterrupt
        return whole(choices, rollouts, seed)  # type: ignore[arg-type]

    monkeypatch.setattr(analysis.checking.check, "look_at", interrupted)
    found = answer(capsys, *TINY, "--processes", "1", status=130)
    assert (found["partial"], found["worlds"]) == (True, 2)


WRONG = {
    "": "an INPUT, --worlds or --paper", "nowhere.npz": "no such file", "WORLD --worlds 3": "one of them",
    "WORLD --kind scattered": "--kind is for --worlds",
    "WORLD --size 3x3 --processes 2": "--size and --processes are for --worlds",
    "WORLD --robots 1,2": "whole number", "WORLD --robots 0": "--robots 0", "WORLD --rollouts 0": "--rollouts 0",
    "WORLD --seed -1": "--seed -1", "WORLD --levels 1": "--levels 1; expected a whole number, 2 to 1024",
    "WORLD --out WORLD": "is a file", "--worlds 0": "--worlds 0", "--worlds x": "whole number",
    "--worlds 2 --robots 0,1": "--robots 0; expected a whole number, 1 to 1024",
    "--worlds 2 --robots a": "--robots 'a'; expected a whole number", "--worlds 2 --size 20": "HxW",
    "--worlds 2 --size 0x4": "at least 1 x 1", "--worlds 2 --kind dense": "contiguous or scattered",
    "--worlds 2 --starts 0,0": "--starts is for an INPUT", "--worlds 2 --plan p.json": "--plan is for an INPUT",
    "--worlds 2 --processes 0": "--processes 0", "--worlds 2 --seed 18446744073709551615": "--seed",
    "--worlds 2 --engine jax": "--engine jax", "--worlds 2 --density 1": "--density 1; expected",
}  # fmt: skip


@pytest.mark.parametrize("words", WRONG)
def test_wrong_usage_is_one_line_and_status_2(words: str, capsys: pytest.CaptureFixture[str]) -> None:
    line = refused(capsys, "check", *(WORLD if word == "WORLD" else word for word in words.split()))
    assert WRONG[words].lower() in line.lower()


def test_the_words_of_the_table_are_the_verdicts() -> None:
    fails, holds, below = (
        make_check("theorem3_travel_set", value, Truth.known(2.0), "open", 9.0, "visited") for value in (3.0, 1.0, -1.0)
    )
    said = [WORDS[overall(checks)] for checks in ([fails, holds], [holds], [below], [below, holds])]
    assert said == ["FAILS", "holds", "says nothing", "holds"]


def test_evaluate_takes_its_verdicts_from_the_checks(capsys: pytest.CaptureFixture[str]) -> None:
    verdicts = answer_of(capsys, "evaluate", TINY_MAP, "--loop", "open", "--rollouts", "64")["verdicts"]
    checked = {c["key"]: c["verdict"] for c in answer(capsys, TINY_MAP, "--rollouts", "64")["checks"]}
    of_team = {key for key in verdicts if not key.startswith(("eq1", "eq4", "eq5", "eq7_robot"))}
    assert all(checked[key] == verdicts[key] for key in of_team) and "fails" in verdicts.values()


# The smallest worlds known on which each formula fails: exact values, small enough to follow by hand.


def named(example: Counterexample) -> str:
    return f"{example.name}: {example.fails}"


@pytest.mark.parametrize("example", COUNTEREXAMPLES, ids=named)
def test_a_handful_of_cells_is_enough_to_fail(example: Counterexample) -> None:
    assert len(example.threat) <= 7
    found = mrac.check(example.world, rollouts=64)
    (failed,) = [check for check in found.checks if check.key == example.fails and check.verdict is Verdict.FAILS]
    assert (failed.value, failed.truth.value) == (pytest.approx(example.value), example.truth)
    assert failed.truth.how == "exact" and found.to_json()["faults"] == []


def test_proven_is_all_but_what_has_a_counterexample() -> None:
    """And the reading of Theorem 3 of which neither is known. Ours are all proven."""
    fail = {example.fails.split("/")[0] for example in COUNTEREXAMPLES}
    assert {key for key, formula in FORMULAS.items() if not formula.proven} == {*fail, "theorem3_travel_multiset"}
    assert all(FORMULAS[key].paper for key in fail)


@pytest.mark.parametrize("example", COUNTEREXAMPLES, ids=named)
def test_what_is_proven_holds_there(example: Counterexample) -> None:
    """The mended Theorem 3 and the ideals, on the very worlds on which the printed ones fail."""
    world = example.world
    plan = make_plan(world, world.starts)
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    own = own_bounds(plan, world, bounds, any_strategy(world, plan.starts))
    cells = float(world.free.sum())
    truths = {meaning: Truth.known(getattr(exact, meaning)) for meaning in ("visited", "survived")}
    checks = [*paper_checks(plan, world, exact, bounds), *own_checks(own, truths, "open", cells)]
    proven = [check for check in checks if check.about.proven]
    assert len(proven) > 12
    assert {check.verdict for check in proven} <= {Verdict.HOLDS, Verdict.VACUOUS}
    spread = [check for check in proven if check.formula == "corrected_spread"]
    assert all(check.margin >= -1e-9 for check in spread)


def test_a_robot_that_is_shut_in_starts_on_a_cell_of_c() -> None:
    """By the reading of C as what is travelled, starts included; what a robot enters on its way has no such cell."""
    plan = make_plan(SHUT_IN, SHUT_IN.starts)
    assert [robot.path.tolist() for robot in plan.robots][1] == [6]
    bounds, exact, found = all_bounds(plan, SHUT_IN), open_loop_exact(plan, SHUT_IN), connecting_cells(plan)
    assert sorted(found.travel.tolist()) == [0, 2, 6] and not len(found.interior)
    assert bounds.theorem3_visited == Theorem3(4.0, 4.0, 4.0 - 3.0, 4.0 - 3.0)
    assert exact.visited == 4.0
    survived = pytest.approx([3.7, 3.7, 0.7, 0.7])
    assert bounds.theorem3_survived is not None and list(vars(bounds.theorem3_survived).values()) == survived


# Every formula and exact value on every fixture, through the public command.

CELLS = {"rel": 0, "abs": 1e-9}
EVERY_FIXTURES = [pytest.param(name, marks=() if name in NAMES[::13] else pytest.mark.slow) for name in NAMES]
"""Of all of them `test_theory` asks the functions that this command calls."""


@pytest.mark.parametrize("fixture", EVERY_FIXTURES, indirect=True)
def test_evaluate_says_what_the_independent_simulator_found(fixture: Fixture) -> None:
    known = fixture.answers
    found = mrac.evaluate(fixture.world, fixture.plan, rollouts=1, advice=False).to_json()
    bounds, exact = found["bounds"], found["exact"]
    said = {name: bounds[name] for name in ("ideal_eq7", "ideal_team")} | exact["open_loop"]
    said |= {"printed": bounds["eq2_printed"], "team_survival": bounds["team_survival"]}
    wanted = known["open_loop_exact"] | {name: known[name] for name in ("ideal_eq7", "ideal_team")} | known["eq2"]
    assert {name: said[name] for name in wanted} == pytest.approx(wanted, **CELLS)
    for gain, expected in zip(bounds["eq4"], known["eq4"], strict=True):
        assert gain == pytest.approx({meaning: expected[meaning] for meaning in gain}, **CELLS)
    for meaning, readings in known["theorem3"].items():
        assert bounds["theorem3"][meaning] == pytest.approx(readings, **CELLS)
    for bound, expected in zip(bounds["eq5"], known["eq5"], strict=True) if "eq5" in known else ():
        assert bound == pytest.approx(expected, **CELLS)
    closed = exact["closed_loop"]
    for meaning in ("visited", "survived") if "closed_loop_exact" in known else ():
        low, high = np.broadcast_to(closed[meaning], 2)
        expected = known["closed_loop_exact"][meaning]
        assert low - 1e-9 <= expected <= high + 1e-9 and high - low <= 1e-4 * found["cells"]["accessible"]
    assert "closed_loop_exact" in known or closed is None or closed["how"] == "tree"


# How wrong may the threat map be? The same plan under scaled threats.

COUNTS = ("visited", "survived", "time", "alive", "outcomes", "stops", "visits")


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_the_map_s_own_threats_change_nothing(loop) -> None:
    world = load_fixture("scattered-14x23-1000-k8").world
    answer = evaluate(world, mrac.plan(world, 8), RolloutChoices(loop=loop, rollouts=2048, seed=9), threat_scale=(1.0,))
    (scaled,) = answer.outputs["threat_scale"].scaled
    for name in COUNTS:
        assert np.array_equal(getattr(scaled.tally, name), getattr(answer.tally, name)), name
    assert scaled.exact.visited == answer.closed_form.visited


@pytest.mark.usefixtures("few_lanes")
@pytest.mark.parametrize("engine", ["numba", "jax"])
def test_no_threats_lose_nobody_and_more_lose_more(engine) -> None:
    world = World.create(np.where(np.indices((5, 6)).sum(axis=0) % 3 == 1, 0.2, 0.0))
    plan = make_plan(world, [[0, 0], [4, 5], [0, 5]])
    choices = RolloutChoices(rollouts=1024, seed=4, engine=engine)
    scales = (0.0, 0.5, 1.0, 4.9) if engine == "numba" else (0.0, 1.0, 4.9)
    answer = evaluate(world, plan, choices, threat_scale=scales)
    none, *others = (scaled.tally for scaled in answer.outputs["threat_scale"].scaled)
    assert none.rollouts == none.outcomes[Outcome.COMPLETE] == none.alive[3] == 1  # every run is the same: one is run
    means = [tally.alive @ np.arange(4) / 1024 for tally in others]
    assert means == sorted(set(means), reverse=True) and len(means) == len(scales) - 1


def test_the_open_loop_is_the_closed_form_of_those_threats() -> None:
    world = load_fixture("contiguous-14x23-1000-k2").world
    plan = mrac.plan(world, 2)
    answer = evaluate(world, plan, RolloutChoices(loop="open", rollouts=65_536, seed=3), threat_scale=(0.5, 2.0))
    for scaled in answer.outputs["threat_scale"].scaled:
        exact = open_loop_exact(plan, World.create(world.threat * np.float32(scaled.scale)))
        assert scaled.exact.visited == pytest.approx(exact.visited, rel=1e-6)
        assert_mean(scaled.tally.visited, exact.visited)


def test_the_closed_loop_decides_by_the_map_and_loses_by_the_scale() -> None:
    """With one level of threat, twice the threat is another map with the same plan: its enumeration is the truth."""
    threat = np.zeros((4, 6), dtype=np.float32)
    threat[1:3, 1:5] = 0.125
    world, twice = World.create(threat), World.create(2 * threat)
    plan, other = (make_plan(one, [[0, 0], [3, 5]]) for one in (world, twice))
    assert [r.path.tolist() for r in plan.robots] == [r.path.tolist() for r in other.robots]
    answer = evaluate(world, plan, RolloutChoices(rollouts=65_536, seed=6), threat_scale=(2.0,))
    assert_mean(answer.outputs["threat_scale"].scaled[0].tally.visited, closed_loop_exact(other, twice).visited)


def test_the_command_and_its_errors(capsys: pytest.CaptureFixture[str]) -> None:
    words = [WORLD, "--robots", "4", "--rollouts", "512", "--exact", "never", "--no-advice", "--threat-scale"]
    found = answer_of(capsys, "evaluate", *words, "0.5,1,2")
    assert [entry["scale"] for entry in found["threat_scale"]] == [0.5, 1, 2]
    assert found["threat_scale"][1]["coverage"] == found["coverage"]
    assert run(["evaluate", *words, "2"]) == 0 and "Results with scaled threats" in capsys.readouterr().out
    wrong = dict.fromkeys(("x", "1,,2", "-1", "nan", "inf"), "error: --threat-scale")
    wrong |= {"6": "a scale of at most 4.99", ",".join(["1"] * 101): "100 at most"}
    for scales, said in wrong.items():
        assert said in error_of(capsys, "evaluate", *words, scales)
    with pytest.raises(UsageError, match=r"a scale of at most 1\.99"):
        scaled_threats(World.create([[0.5, 0.0]]), 2.0)
