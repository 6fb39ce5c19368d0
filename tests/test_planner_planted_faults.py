"""The comparison of the compiled simulator with the readable one fails when a fault is planted in the readable one.

The other way round, faults in the compiled simulator: `test_mrac_jax_planted_faults`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

import pytest
import test_planner_closed_loop as comparison
from closed_loop_worlds import SurveyWorld, survey_world

from planner.mrac import executive, simulate

NAMES = ("contiguous-8", "combs-8", "crossings-0")
"""Of the survey: robots lost, areas left in several parts, shares of both kinds, and ties."""
FAULTS = {
    "tie order": (
        "        rank[goals] = 0\n",
        "        rank[goals] = len(self.visited) - goals\n",
    ),
    "hit before completion": (
        "        robot.status = Doing.DEAD\n",
        "        robot.status, self.visited[robot.cell] = Doing.DEAD, False\n",
    ),
    "component lost": (
        "        parts = self.cut(number)\n",
        "        parts = self.cut(number)[: None if split else 1]\n",
    ),
}
"""Text that stands once in the source, and what takes its place."""


@pytest.fixture(scope="module")
def worlds() -> list[SurveyWorld]:
    return [survey_world(name) for name in NAMES]


def plant(old: str, new: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison's readable simulator becomes one of which the executive has the text replaced."""
    text = Path(executive.__file__).read_text()
    assert text.count(old) == 1, "the simulator has changed: plant the fault anew"
    around = Path(simulate.__file__).read_text().replace(executive.__name__, "faulty_executive")
    for name, source in (("faulty_executive", text.replace(old, new)), ("faulty_simulate", around)):
        module = ModuleType(name)
        monkeypatch.setitem(sys.modules, name, module)
        exec(compile(source, name, "exec"), module.__dict__)
    monkeypatch.setattr(comparison, "simulate", module.simulate)


def compare(worlds: list[SurveyWorld]) -> None:
    """Every count of some rollouts of each world, in both simulators."""
    for one in worlds:
        comparison.compare(one.world, one.plan(), 24, seed=one.seed, first_only=one.first_only)


def test_no_fault_no_difference(worlds: list[SurveyWorld], monkeypatch: pytest.MonkeyPatch) -> None:
    line = FAULTS["tie order"][0]
    plant(line, line, monkeypatch)
    compare(worlds)


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found(name: str, worlds: list[SurveyWorld], monkeypatch: pytest.MonkeyPatch) -> None:
    plant(*FAULTS[name], monkeypatch)
    with pytest.raises(AssertionError, match=r"^\d+\nassert \[|Arrays are not equal"):
        compare(worlds)
