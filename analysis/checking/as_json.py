"""A map's check as JSON."""

from __future__ import annotations

from analysis.checking.check_map import MapCheck
from analysis.report.answer import json_end
from analysis.theory.truth import Truth
from analysis.theory.verdicts import Check, Verdict
from planner.files import Json


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
