"""Every formula and exact value on every fixture, through the public command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER, NAMES, Fixture

from analysis.cli.app import run
from planner.mrac.make_plan import make_plan

CELLS = {"rel": 0, "abs": 1e-9}
EVERY = [pytest.param(name, marks=() if name in NAMES[::13] else pytest.mark.slow) for name in NAMES]
"""Of all of them `test_analysis_exact` asks the functions that this command calls."""


@pytest.mark.parametrize("fixture", EVERY, indirect=True)
def test_evaluate_says_what_the_independent_simulator_found(
    fixture: Fixture, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = fixture.answers
    plan = tmp_path / "plan.json"
    make_plan(fixture.world, fixture.starts, allocation=fixture.allocation).save(plan)
    world = str(FOLDER / known["world"])
    assert run(["evaluate", world, "--plan", str(plan), "--rollouts", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    bounds = found["bounds"]
    open_loop = found["exact"]["open_loop"]
    assert {key: open_loop[key] for key in known["open_loop_exact"]} == pytest.approx(known["open_loop_exact"], **CELLS)
    assert bounds["eq2_printed"] == pytest.approx(known["eq2"]["printed"], **CELLS)
    assert bounds["team_survival"] == pytest.approx(known["eq2"]["team_survival"], **CELLS)
    assert bounds["ideal_eq7"] == pytest.approx(known["ideal_eq7"], **CELLS)
    assert bounds["ideal_team"] == pytest.approx(known["ideal_team"], **CELLS)
    for gain, expected in zip(bounds["eq4"], known["eq4"], strict=True):
        assert gain == pytest.approx({meaning: expected[meaning] for meaning in gain}, **CELLS)
    for meaning, readings in known["theorem3"].items():
        assert bounds["theorem3"][meaning] == pytest.approx(readings, **CELLS)
    if "eq5" in known:
        for bound, expected in zip(bounds["eq5"], known["eq5"], strict=True):
            assert bound == pytest.approx(expected, **CELLS)
    closed = found["exact"]["closed_loop"]
    if "closed_loop_exact" in known:
        for meaning in ("visited", "survived"):
            low, high = np.broadcast_to(closed[meaning], 2)
            expected = known["closed_loop_exact"][meaning]
            assert np.clip(expected, low, high) == pytest.approx(expected, **CELLS)
            assert high - low <= 1e-4 * found["cells"]["accessible"]
    else:
        assert closed is None or closed["how"] == "tree"
