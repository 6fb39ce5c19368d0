"""`make bench` has a row for every engine that is asked for, and times none that counts differently."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from open_loop_reference import fixture

from analysis.bench import engines
from analysis.bench import engines as race
from analysis.bench.engines import Contender, naive_rollouts
from planner.errors import MracError
from planner.mrac.make_plan import make_plan
from planner.rollouts.open_loop import compile_plan
from planner.tally import Tally
from planner.world.generate import random_world
from planner.world.levels import place_starts


@pytest.mark.parametrize(
    ("loop", "asked", "rows"),
    [("open", ["numba", "jax"], ["numba", "numba", "jax"]), ("closed", ["readable"], ["readable"])],
)
def test_every_engine_has_a_row(
    loop: str, asked: list[str], rows: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    world = random_world(6, 6)
    plan = make_plan(world, place_starts(world, 2)[0])
    for owner, name, value in (
        (engines, "cases", lambda: iter([("small", world, plan)])), (engines, "LOOPS", (loop,)),
        (sys, "argv", ["engines", *asked]), (race, "SECONDS", 0.01),
    ):  # fmt: skip
        monkeypatch.setattr(owner, name, value)
    engines.main()
    printed = [row.replace(" 1 thread", "").split() for row in capsys.readouterr().out.splitlines()]
    found = [row for row in printed if row[0] == "small"]
    assert [row[2].rstrip(",") for row in found] == rows
    assert all(float(row[3].replace(",", "")) > 0 for row in found)


def test_engines_that_count_differently_are_not_timed() -> None:
    def contender(number: int) -> Contender:
        tally = Tally.empty(f"{number:064d}", (2, 2), 1, 4)
        return Contender(f"number {number}", lambda: (lambda count: count, 1, tally))

    with pytest.raises(MracError, match="number 1 counts differently"):
        race.race([contender(0), contender(0), contender(1)])


def test_naive_program_agrees_with_the_closed_form() -> None:
    import jax

    plan, world, numbers = fixture("tiny-6x3-20", 5)
    compiled = compile_plan(plan, world)
    paths = [robot.path[: compiled.last_step + 1] for robot in plan.robots]
    (visited, survived, _, _), _ = naive_rollouts(paths, world.threat.reshape(-1), 2048)(jax.random.key(1))
    for found, meaning in ((visited, "visited"), (survived, "survived")):
        error = np.std(found) / np.sqrt(len(found))
        assert abs(np.mean(found) - numbers["open_loop_exact"][meaning]) <= 5 * error
