"""The answer as the JSON object that `mrac-jax evaluate` prints (SPEC section 9)."""

from __future__ import annotations

import numpy as np

from analysis.evaluation.answer import Evaluation
from analysis.report.answer import json_end
from analysis.theory.bounds import Theorem3
from analysis.theory.exact import OpenLoopExact
from analysis.theory.truth import ClosedTruth, Truth
from analysis.theory.verdicts import MEANINGS
from planner.files import Json
from planner.plans.plan import Plan
from planner.plans.turns import drive_of
from planner.tally import Outcome


def to_json(evaluation: Evaluation) -> Json:
    """The JSON object of SPEC section 9; undefined values are None."""
    tally, plan, known = evaluation.tally, evaluation.plan, evaluation.exact
    cells, found = evaluation.cells, evaluation.figures
    drive = drive_of(robot.path for robot in plan.robots)
    lost = None if known.alive is None else tally.robots - known.alive
    out: Json = {
        "loop": evaluation.loop,
        "mode": evaluation.mode,
        "luck": evaluation.choices.luck,
        "engine": evaluation.engine,
        "robots": len(plan.robots),
        "starts": plan.starts,
        "cells": cells,
        "policy": _policy_json(plan),
        "plan_for": plan.plan_for,
        "rollouts": tally.rollouts,
        "seed": evaluation.seed,
        "certain": evaluation.certain,
        "coverage": found.coverage_json(),
        "best": {figure: getattr(evaluation, figure) for figure in (*MEANINGS, "losses")},
        "coverage_of_free_cells": {m: getattr(found, m).mean.mean / cells["free"] for m in MEANINGS},
        "time": found.time.to_json() | {"max": int(np.flatnonzero(tally.time).max())},
        "outcomes": {outcome.name.lower(): int(tally.outcomes[outcome]) for outcome in Outcome},
        "complete": found.complete,
        "alive": {"mean": found.alive.mean},
        "losses": found.losses.to_json() | {"exact": lost},
        "some_left": evaluation.shown.some_left,
        "control": _control_json(evaluation),
        "bounds": _bounds_json(evaluation),
        "verdicts": {check.key: str(check.verdict) for check in evaluation.worst_checks},
        "exact": {
            "open_loop": _open_json(evaluation.closed_form),
            "closed_loop": _closed_json(evaluation.closed),
            "alive": known.alive,
            "time": known.time,
        },
        "plan": {
            "settings": plan.settings,
            "areas": len(plan.areas),
            "levels": len({area.level for area in plan.areas}),
            **{name: getattr(plan, name) for name in ("makespan", "outcome", "shares")},
            "moves": int(drive.moves.sum()),
            "quarter_turns": int(drive.turns.sum()),
        },
        "rollouts_per_second": tally.rollouts / evaluation.seconds if evaluation.seconds > 0 else None,
        "compile_seconds": evaluation.compile_seconds,
        "advice": None,
    }
    if found.home is not None:
        out["home"] = found.home
    for name in ("movers", "phases"):
        if (of := getattr(evaluation.world, name)) is not None:
            out[name] = of.to_json()
    said = {key: found.as_json() for key, found in evaluation.outputs.items()}
    out |= {key: value for key, value in said.items() if value is not None}
    return out | json_end(evaluation, evaluation.notes)


def _control_json(evaluation: Evaluation) -> Json | None:
    """By figure: how many times smaller the variance is, and what a nat of S weighs where; None: no control."""
    found = evaluation.control
    said = {"gain": {key: one.gain for key, one in found.items()}, "weights": {k: v.weights for k, v in found.items()}}
    return said if found else None


def _policy_json(plan: Plan) -> Json | None:
    if plan.settings is None:
        return None
    return {"name": plan.settings.rule.name, "reserve": plan.settings.reserve, "worth": plan.settings.worth} | (
        {} if plan.settings.range is None else {"range": plan.settings.range}
    )


def _bounds_json(evaluation: Evaluation) -> Json:
    """The formulas of SPEC section 7."""
    bounds, limit = evaluation.formulas, evaluation.bounds.any_strategy
    undefined = dict.fromkeys(Theorem3.__dataclass_fields__)
    return {
        **{name: getattr(bounds, name) for name in ("eq1", "eq2_printed", "team_survival", "eq4", "eq5")},
        "theorem3": {
            "visited": bounds.theorem3_visited or undefined,
            "survived": bounds.theorem3_survived or undefined,
        },
        "ideal_eq7": bounds.ideal_eq7,
        "ideal_team": bounds.ideal_team,
        "any_strategy": None if limit is None else limit.cells,
    }


def _open_json(exact: OpenLoopExact) -> Json:
    """The open loop's expected values, whichever loop was evaluated; NaN what is not known."""
    return {
        "visited": exact.visited,
        "survived": exact.survived,
        "alive": float(exact.survival.sum()),
        "losses": exact.expected_losses,
        "time": exact.mean_time,
    }


def _closed_json(closed: ClosedTruth | None) -> Json | None:
    """The closed loop's expected values where they are known exactly, and how."""
    if closed is None:
        return None
    return closed.further | {
        "visited": _known_json(closed.visited),
        "survived": _known_json(closed.survived),
        "some_left": _known_json(closed.some_left),
        "alive": closed.alive,
        "time": closed.time,
        "how": closed.visited.how,
    }


def _known_json(truth: Truth) -> float | list[float]:
    """A value, or the two between which it is certain to be."""
    return truth.value if truth.low == truth.high else [truth.low, truth.high]
