"""Robots that hear each other over a distance: engines against each other, everybody near against no limit, a tree."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mixed_teams import assert_as_enumerated, assert_engines_agree, drawn
from oracle_rows import everything

from planner.mrac.choose import in_contact
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range
from planner.tally import Outcome
from planner.world.world import World

KINDS: list[dict[str, Any]] = [
    {},
    {"policy": "per_cell"},
    {"policy": "per_cell", "reserve": 0.4, "worth": 30.0},
    {"policy": "watchful", "reserve": 0.4, "steps_per_move": (1, 2, 1, 3)},
    {"policy": "watchful", "types": ("a", "c", "b", "a")},
    {"range": 30, "deadline": 45},
    {"return_to": "nearest", "range": 40, "recharge": 4},
    {"return_to": "home", "policy": "per_cell", "deadline": 60},
]


def check_engines(seed: int, rollouts: int) -> None:
    world, starts, _ = drawn(seed, 4)
    plan = make_plan(world, starts, Settings(**KINDS[seed % len(KINDS)], radio=(1.5, 3.0, 4.5)[seed % 3]))
    assert_engines_agree(plan, world, seed, rollouts)


@pytest.mark.parametrize("part", range(len(KINDS)))
def test_engines_agree(part: int) -> None:
    for seed in range(part, 32, len(KINDS)):
        check_engines(seed, 3)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(20))
def test_engines_agree_on_a_thousand_worlds(part: int) -> None:
    for seed in range(1000 + part, 2000, 20):
        check_engines(seed, 4)


def test_everything_that_can_happen_on_rows() -> None:
    for seed in range(12):
        rng = np.random.default_rng(seed)
        size, robots = int(rng.integers(5, 9)), 2 + seed % 2
        p = np.float32(rng.choice([0, 0, 0.1, 0.2, 0.37], size))
        starts, radio = rng.integers(0, size, robots).tolist(), float(rng.integers(1, 4))
        plan = make_plan(World.create([p]), [[0, start] for start in starts], Settings(radio=radio, density=1e6))
        assert_as_enumerated(plan, World.create([p]), everything([p.tolist()] * robots, starts, radio=radio))


def test_a_chain_is_as_long_as_its_links_are_short() -> None:
    places, bases = np.array([[0, 3], [0, 6], [0, 10], [4, 13]]), np.array([[0, 0]])
    assert in_contact(places, bases, 9).tolist() == [True, True, False, False]
    assert in_contact(places, bases, 16).tolist() == [True, True, True, False]
    assert in_contact(places, bases, 25).tolist() == [True] * 4
    assert in_contact(places[1:], bases, 9).tolist() == [False] * 3


def test_who_hears_everybody_is_who_has_no_limit() -> None:
    world, starts, _ = drawn(4)
    plans = [make_plan(world, starts, Settings(policy="per_cell", radio=radio)) for radio in (100.0, None)]
    tallies = [run_range(compile_closed_loop(plan, world), 1, 0, 500)[0] for plan in plans]
    assert replace(tallies[0], key="") == replace(tallies[1], key="")


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_who_is_out_of_touch_drives_back_to_hear_of_what_is_left(policy: str) -> None:
    """Two robots cover their sides of a dangerous cell. The first is done four cells from its start, and the other one,
    three from its own, three from it: over three cells it hears of what is left; else it drives back as far as it must,
    or as its range of six moves lets it.
    """
    world = World.create([[0.0] * 5 + [0.5] + [0.0] * 5])
    back = {1.0: [3, 2, 1, 1, 2, 3, 4, 5], 2.0: [3, 2, 2, 3, 4, 5], 2.9: [3, 2, 2, 3, 4, 5], 3.0: [5]}
    for radio, then in back.items():
        plan = make_plan(world, [[0, 0], [0, 10]], Settings(radio=radio, policy=policy))
        assert plan.robots[0].path.tolist() == [0, 1, 2, 3, 4, *then]
        assert _ends(plan, world) == {(Outcome.COMPLETE, 11)}
    short = make_plan(world, [[0, 0], [0, 10]], Settings(radio=1.0, policy=policy, range=6))
    assert short.robots[0].path.tolist() == [0, 1, 2, 3, 4, 3, 2]
    assert _ends(short, world) == {(Outcome.NO_PROGRESS, 10)}


def _ends(plan: Plan, world: World) -> set[tuple[int, int]]:
    """(outcome, cells visited) of rollouts."""
    _, singles = run_range(compile_closed_loop(plan, world), 0, 0, 50, singles=True)
    assert singles is not None
    return set(zip(singles.outcome.tolist(), singles.visited.tolist(), strict=True))
