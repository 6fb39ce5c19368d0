"""The plain oracle against the answers of an independent simulator, and the compiled closed loop against the oracle."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace
from conftest import FOLDER, NAMES, load_fixture
from oracle_simulator import Paper
from oracle_tree import plain_run

from planner.make_plan import make_plan
from planner.rollout_sampling import Luck
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.settings import Settings
from planner.simulator.codes import NO_AREA, Doing, EventKind, Outcome
from planner.tally import Trace
from planner.world.world import World

POLICIES = [path.stem for path in sorted((FOLDER / "policies").glob("*.json"))]
WORLDS, MANY = 100, 3000
"""Drawn, in quick tests and in slow ones."""


def luck_of(world: World, seed: int, rollout: int, *, first_only: bool = False) -> Callable[..., bool]:
    """Who is stopped in a rollout of the product."""
    luck, entered = Luck(world, seed, rollout), set()

    def stopped(robot: int, step: int, cell: tuple[int, int]) -> bool:
        again = cell in entered
        entered.add(cell)
        return not (first_only and again) and luck.hits(robot, step, cell[0] * world.shape[1] + cell[1])

    return stopped


def check_fixture(name: str, settings: dict[str, Any], answers: dict[str, Any], most: int | None) -> None:
    """The nominal run, and runs in which robots are stopped."""
    fixture = load_fixture(name)
    world, width = fixture.world, fixture.world.shape[1]
    begun = plain_run(make_plan(world, fixture.starts, Settings(**settings), fixture.allocation), world)
    run = begun.fork()
    assert Outcome[run.run(lambda *_: False).upper()] == answers["nominal"]["outcome"]
    assert run.step == answers["nominal"]["time"]
    for walker, path in zip(run.team, answers["nominal"]["paths"], strict=True):
        cells = [row * width + col for row, col in walker.path]
        assert cells == path + path[-1:] * (len(cells) - len(path))
    known = answers.get("threshold_runs", {"seed": 0, "runs": []})
    for rollout, expected in enumerate(known["runs"][:most]):
        run = begun.fork()
        outcome = Outcome[run.run(luck_of(world, known["seed"], rollout)).upper()]
        alive = sum(walker.doing != "dead" for walker in run.team)
        assert [len(run.visited), len(run.survived), run.step, alive, outcome] == expected, rollout


@pytest.mark.parametrize("most", [3, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_the_paper_s_rule_is_the_independent_simulator_s(name: str, most: int | None) -> None:
    check_fixture(name, {}, load_fixture(name).answers, most)


@pytest.mark.parametrize("most", [3, pytest.param(None, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", POLICIES)
def test_per_cell_is_the_independent_simulator_s(name: str, most: int | None) -> None:
    cases = json.loads((FOLDER / "policies" / f"{name}.json").read_text())["policies"]
    (case,) = (case for case in cases if case["settings"] == {"policy": "per_cell"})
    check_fixture(name, case["settings"], case, most)


def trace_of(run: Paper, width: int, rollout: int, stopped: Callable[..., bool]) -> Trace:
    """The oracle's run as the product writes one down."""
    frames, area_of = [], np.full(run.cells, NO_AREA, dtype=np.int32)

    def number(area: int | None) -> int:
        return NO_AREA if area is None else area

    while not run.outcome:
        run.play(stopped)
        alive = [walker.patch if walker.doing != "dead" else None for walker in run.team]
        frames.append(
            [
                (walker.at[0] * width + walker.at[1], Doing[walker.doing.upper()], number(patch))
                for walker, patch in zip(run.team, alive, strict=True)
            ]
        )
    for area, patch in enumerate(run.patches):
        area_of[[row * width + col for row, col in patch.cells]] = area
    events = [
        (step, robot, EventKind[what.upper()], number(area), of[0] * width + of[1] if isinstance(of, tuple) else of)
        for step, robot, what, area, of in run.events
    ]
    cells, doing, areas = np.array(frames, dtype=np.int32).transpose(2, 0, 1)
    happened = np.array(events, dtype=np.int32).reshape(-1, 5)
    return Trace(rollout, cells, doing.astype(np.int8), areas, happened, area_of, Outcome[run.outcome.upper()])


def drawn(number: int) -> tuple[World, np.ndarray, Settings, bool]:
    """A small world in one piece or several, a team on it, its policy, and whether first visits alone are checked."""
    luck = np.random.default_rng(number)
    threat = luck.choice([np.nan, 0.0, 0.1, 0.35], p=[0.15, 0.5, 0.2, 0.15], size=luck.integers(1, 9, size=2))
    threat.flat[0] = 0.0
    free = np.argwhere(~np.isnan(threat))
    starts = free[luck.integers(len(free), size=luck.integers(1, 6))]
    settings = Settings(
        policy=("mrac", "per_cell")[number % 2],
        transit=("grid", "area")[int(luck.random() < 0.2)],
        density=float(luck.choice([1.5, 4.0])),
        max_steps=int(luck.integers(1, 30)) if luck.random() < 0.1 else None,
    )
    return World.create(threat), starts, settings, bool(luck.random() < 0.2)


def compare(number: int) -> Counter[int | str]:
    """Rollouts of a drawn world, event for event; how often each event and outcome came about."""
    world, starts, settings, first_only = drawn(number)
    plan, found = make_plan(world, starts, settings), Counter[int | str]()
    begun = plain_run(plan, world)
    loop = compile_closed_loop(plan, world, first_only=first_only, tabled=number % 4 < 2)
    for trace in trace_rollouts(loop, number, range(4)):
        stopped = luck_of(world, number, trace.rollout, first_only=first_only)
        mine = trace_of(begun.fork(), world.shape[1], trace.rollout, stopped)
        assert_same_trace(trace, mine, f"world {number}")
        found.update([*trace.events[:, 2].tolist(), trace.outcome.word])
    return found


def check_drawn(first: int, count: int) -> None:
    found = sum(map(compare, range(first, first + count)), Counter[int | str]())
    kinds = (
        EventKind.COMPLETED, EventKind.HIT, EventKind.REALLOCATED, EventKind.ALLOCATED, EventKind.SHARED,
        EventKind.LOOKED_AGAIN,
    )  # fmt: skip
    assert min(found[kind] for kind in kinds) >= count // 20
    assert all(found[word] for word in ("complete", "all_robots_lost", "no_progress", "step_limit"))


def test_the_compiled_closed_loop_is_the_oracle_s_event_for_event() -> None:
    check_drawn(0, WORLDS)


@pytest.mark.slow
def test_so_it_is_on_thousands_more() -> None:
    check_drawn(WORLDS, MANY)
