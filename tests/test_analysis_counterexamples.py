"""The smallest worlds known on which each formula fails: exact values, small enough to follow by hand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from counterexamples import COUNTEREXAMPLES, SHUT_IN, Counterexample

from analysis.cli.app import run
from analysis.theory.bounds import Theorem3, all_bounds, connecting_cells
from analysis.theory.exact import open_loop_exact
from analysis.theory.formulas import FORMULAS
from analysis.theory.upper_bound import any_strategy
from analysis.theory.verdicts import Truth, Verdict, own_bounds, own_checks, paper_checks
from planner.mrac.make_plan import make_plan


def named(example: Counterexample) -> str:
    return f"{example.name}: {example.fails}"


@pytest.mark.parametrize("example", COUNTEREXAMPLES, ids=named)
def test_a_handful_of_cells_is_enough_to_fail(
    example: Counterexample, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example.world.save(tmp_path / "w.npz")
    assert len(example.threat) <= 7
    assert run(["check", str(tmp_path / "w.npz"), "--rollouts", "64", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    checks = [check for check in found["checks"] if check["key"] == example.fails and check["verdict"] == "fails"]
    said = [(check["value"], check["truth"]["value"]) for check in checks]
    assert said == [(pytest.approx(example.value), example.truth)]
    assert checks[0]["truth"]["how"] == "exact"
    assert found["faults"] == []


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
    spread = [check for check in proven if check.formula == "mended_spread"]
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
