"""`make bench-gpu` says where there is nothing to measure, and measures to the end where it is made to."""

from __future__ import annotations

import sys

import pytest

from analysis.bench import accelerator, race
from analysis.bench.race import Contender
from planner.errors import MracError
from planner.mrac.make_plan import make_plan
from planner.rollouts.engine import Chosen, Rolling
from planner.tally import Tally
from planner.worlds.generate import random_world
from planner.worlds.starts import place_starts


def test_without_an_accelerator_nothing_is_measured(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(accelerator, "choose_engine", lambda _: Chosen("numba", "the fastest on a CPU"))
    monkeypatch.setattr(sys, "argv", ["accelerator"])
    accelerator.main()
    assert capsys.readouterr().out == "no accelerator here: not measured\n"


def test_every_engine_has_a_row(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    world = random_world(6, 6)
    case = (world, make_plan(world, place_starts(world, 2)[0]))
    for owner, name, value in (
        (accelerator, "cases", lambda: {"small": case}), (accelerator, "HOWS", (Rolling("open", luck="tolerance"),)),
        (sys, "argv", ["accelerator", "--device", "cpu"]),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, value)
    monkeypatch.setattr(race, "SECONDS", 0.01)
    accelerator.main()
    rows = [row.split() for row in capsys.readouterr().out.splitlines() if row.startswith("small")]
    assert [row[2] for row in rows] == ["numba", "jax"]
    assert all(float(row[3].replace(",", "")) > 0 for row in rows)


def test_engines_that_count_differently_are_not_timed() -> None:
    def contender(number: int) -> Contender:
        tally = Tally.empty(f"{number:064d}", (2, 2), 1, 4)
        return Contender(f"number {number}", lambda: (lambda count: count, 1, tally))

    with pytest.raises(MracError, match="number 1 counts differently"):
        race.race([contender(0), contender(0), contender(1)])
