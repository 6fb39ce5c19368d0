"""Every formula on one map: from a world and a plan to checks, rolling out the closed loop where it is not known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

from analysis.estimators.trial import closed_truth
from analysis.report.answer import Answer, json_end
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.theory.bounds import all_bounds
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.upper_bound import any_strategy, trimmed
from analysis.theory.verdicts import (
    FIGURES,
    MEANINGS,
    Check,
    ClosedTruth,
    Truth,
    Verdict,
    closed_checks,
    doubt_of_each,
    nominal_checks,
    of_formula,
    own_bounds,
    own_checks,
    paper_checks,
    proven_failures,
    sampled_truth,
    worst_of_robots,
)
from analysis.utils.notes import ProgressCallback
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import Json
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan
from planner.simulator.tables import AllPairs
from planner.tally import Tally
from planner.world.world import World


@dataclass(frozen=True, eq=False, repr=False)
class MapCheck(Answer):
    """Every formula on one map.

    Attributes:
        world, plan: on what. exact: the open loop. closed: the closed loop, or None where there is none to look at.
        checks: of every robot, formula, meaning and loop. left_out: what could not be checked, and why.
        doubt: chance that the interval of one sampled figure misses it. seed: of the rollouts.
        partial: True if the rollouts were interrupted.
        theory: what the table lists: "main", a row for each formula; "all", every reading and meaning.
    """

    reported_by = "analysis.checking.report:check_report"
    listed = "checks"

    world: World
    plan: Plan
    exact: OpenLoopExact
    closed: ClosedTruth | None
    checks: tuple[Check, ...]
    left_out: tuple[str, ...]
    doubt: float
    seed: int = 0
    partial: bool = False
    theory: Literal["main", "all"] = "main"

    @cached_property
    def cells(self) -> int:
        """Accessible cells."""
        return int(self.world.accessible(self.plan.starts).sum())

    @property
    def faults(self) -> list[Check]:
        """Failures of what is marked as proven."""
        return proven_failures(self.checks)

    @property
    def rows(self) -> list[Check]:
        """One check for each formula, meaning and loop: the worst of the robots'."""
        return worst_of_robots(self.checks)


def check_world(world: World) -> None:
    """Raise WorldError for a world that the formulas are not about."""
    world.check_settled("what a check holds against each other")


def check_map(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    sample: Callable[[], Tally | None],
    *,
    alone: Plan | None = None,
    figures: int = FIGURES,
    bound: bool | None = None,
    kept: AllPairs | None = None,
) -> MapCheck:
    """Every formula on one map.

    Args:
        choices: of the closed loop: which visits are checked, and how long its exact values are looked for.
        sample: rolls out the closed loop; asked only where it is not known exactly. None: not to be had.
        alone: the plan of the first robot by itself, where the caller has it.
        figures: sampled figures whose intervals are to hold together with 95 % confidence, these three among them.
        bound: whether the bound for every strategy is worked out, as `flow` of `any_strategy`.
        kept: where all-pairs tables are kept.
    """
    check_world(world)
    exact, bounds = open_loop_exact(plan, world), all_bounds(plan, world)
    cells = float(world.accessible(plan.starts).sum())
    limit = any_strategy(trimmed(world, plan), plan.starts, bound)
    own = own_bounds(plan, world, bounds, limit)
    truths = {meaning: Truth.known(getattr(exact, meaning)) for meaning in MEANINGS}
    checks = [*paper_checks(plan, world, exact, bounds), *own_checks(own, truths, "open", cells)]
    if alone is None and not plan.is_foreign:
        alone = make_plan(world, plan.starts[:1], plan.settings and plan.settings.alone)
    checks += nominal_checks(plan, world, alone)
    doubt, closed = doubt_of_each(figures), None
    if not plan.is_foreign:
        closed = closed_truth(plan, world, exact, choices, kept)
        if closed is None:
            tally = sample()
            closed = None if tally is None else sampled_truth(plan, world, tally, doubt)
    if closed is not None:
        checks += closed_checks(plan, world, bounds, own, closed, choices.first_only)
    no_bound = (
        f"the bound for every strategy is left out: {argument('bound')} works it out, "
        "which may take a minute on a large map"
    )
    left_out = (*_left_out(plan, checks, closed), *(() if limit.flow is not None else (no_bound,)))
    return MapCheck(world, plan, exact, closed, tuple(checks), left_out, doubt)


def _left_out(plan: Plan, checks: list[Check], closed: ClosedTruth | None) -> tuple[str, ...]:
    """What is missing, in words."""
    if plan.is_foreign:
        return (f"the {plan.origin} has no areas: eq. (5), the theorems and the closed loop are left out",)
    made, out = {check.formula for check in checks}, []
    robots = {check.robot for check in of_formula(checks, "eq5_printed")}
    ranged = plan.settings is not None and plan.settings.range is not None
    if ranged or plan.comes_home:
        whom = "robots with a range" if ranged else "robots that come home, nor are Theorems 3 and 4"
        out.append(f"eq. (5) is left out: it is not about {whom}")
    elif plan.shares:
        out.append("eq. (5) is undefined here: areas are shared in the run without losses")
    elif len(robots) < len(plan.robots):
        without = len(plan.robots) - len(robots)
        out.append(f"eq. (5) is undefined for {without} of {len(plan.robots)} robots: a dangerous start, or no area")
    with_worth = plan.settings is not None and plan.settings.worth is not None
    if with_worth or ranged:
        why = "the rest may not be worth the risk (worth)" if with_worth else "robots have a range"
        out.append(f"Theorems 1, 2 and 4 are left out: they are not about runs in which {why}")
    elif "theorem4_most" not in made and not plan.comes_home:
        out.append("Theorem 4 is left out: one robot alone cannot cover these cells, or the run was cut off")
    if closed is None:
        out.append("the closed loop is left out: nothing was rolled out")
    elif closed.as_stated is None and not (with_worth or ranged):
        out.append("Theorem 2 is left out: max_steps may cut runs off")
    return tuple(out)


def check_input(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    progress: ProgressCallback | None = None,
    bound: bool | None = None,
    theory: Literal["main", "all"] = "main",
) -> MapCheck:
    """Every formula on one map; the closed loop by `choices`, where it is not known exactly; `bound` as of `check_map`.

    An interruption (KeyboardInterrupt) of the rollouts leaves what was done, `partial`. Raises InputError.
    """
    plan.bearing.check_known("what a check holds against each other")
    if plan.settings is not None:
        plan.settings.check_alike("what a check holds against each other")
    if plan.state is not None:
        raise UsageError(
            "the plan is the rest of a mission; the formulas are about whole ones", fix="check one from a start"
        )
    partial, kept = False, AllPairs()

    def sample() -> Tally | None:
        nonlocal partial
        tally = None
        try:
            for stage in make_roll_out(world, plan, choices, kept=kept)(choices, None):
                tally = stage.tally
                if progress is not None:
                    progress(tally.rollouts, choices.rollouts, stage.seconds)
        except KeyboardInterrupt:
            partial = True
        return tally

    checked = check_map(world, plan, choices, sample, bound=bound, kept=kept)
    return replace(checked, seed=choices.seed, partial=partial, theory=theory)


# A map's check as JSON.


def check_json(checked: MapCheck) -> Json:
    """The JSON object of `check INPUT`, but for its sentence. Values are in the unit that a check names."""
    world, plan, exact, closed = checked.world, checked.plan, checked.exact, checked.closed
    return {
        "robots": len(plan.robots),
        "starts": plan.starts,
        "cells": {"total": world.threat.size, "accessible": checked.cells},
        "shares": plan.shares,
        "plan_for": plan.plan_for,
        "rollouts": 0 if closed is None else closed.rollouts,
        "seed": checked.seed,
        "doubt": checked.doubt,
        "truth": {
            "open_loop": {"visited": exact.visited, "survived": exact.survived},
            "closed_loop": None
            if closed is None
            else {name: truth_json(getattr(closed, name)) for name in ("visited", "survived", "some_left")},
        },
        "checks": [check_row(check) for check in checked.checks],
        "failing": [check.key for check in checked.rows if check.verdict is Verdict.FAILS],
        "faults": sorted({check.key for check in checked.faults}),
        "left_out": checked.left_out,
        **json_end(checked),
    }


def truth_json(truth: Truth) -> Json:
    """A truth with its interval."""
    return {"value": truth.value, "interval": [truth.low, truth.high], "how": truth.how}


def check_head(check: Check) -> Json:
    """What a check is about, as JSON."""
    about = check.about
    return {
        "key": check.key,
        "formula": about.name,
        "reading": about.reading,
        "paper": about.paper,
        "proven": about.proven,
        "direction": about.direction,
        "unit": about.unit,
        "meaning": check.meaning or None,
        "loop": check.loop,
    }


def check_row(check: Check) -> Json:
    """One check as JSON."""
    return check_head(check) | {
        "robot": check.robot,
        "value": check.value,
        "truth": truth_json(check.truth),
        "verdict": check.verdict,
        "margin": check.margin,
    }
