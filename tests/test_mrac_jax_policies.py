"""The JAX closed loop by policies (SPEC section 11), against the compiled simulator; one compiled shape for all."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import partial
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
from closed_loop_worlds import CELL_BUCKETS, SurveyWorld, first_worlds, survey_worlds
from conftest import LANES, load_fixture
from test_mrac_jax_closed_loop import same

from mrac_jax.closed_loop import engine as engine_module
from mrac_jax.closed_loop.engine import TRACED, JaxClosedLoop
from mrac_jax.closed_loop.rules import Candidate, is_before
from mrac_jax.closed_loop.tables import LARGEST_DENOMINATOR, LaneTables, lane_tables
from planner.errors import WorldError
from planner.make_plan import make_plan
from planner.policies.rule import Rule
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.rollouts.engine import closed_loop_engine
from planner.rollouts.loop import ClosedLoop
from planner.settings import Settings
from planner.simulator.codes import EventKind, Outcome
from planner.simulator.offers import Offer

SHAPE = (150, 8)
"""Least room for cells and robots: that of all quick worlds here."""
LIMITED: list[dict[str, Any]] = [
    {}, {"reserve": 0.25}, {"worth": 4.0}, {"reserve": 1.0}, {"worth": 40.0}, {"reserve": 0.5, "worth": 9.0},
    {"policy": "watchful", "reserve": 0.1}, {"policy": "watchful", "reserve": 0.5, "worth": 9.0},
]  # fmt: skip


def loop_of(one: SurveyWorld, **asked: Any) -> ClosedLoop:
    plan = make_plan(one.world, one.starts, replace(one.settings, **{"policy": "per_cell"} | asked))
    return compile_closed_loop(plan, one.world, first_only=one.first_only)


def test_counts_are_the_compiled_simulator_s(monkeypatch: pytest.MonkeyPatch) -> None:
    def roomy(loop: ClosedLoop, seed: int, least: tuple[int, int] = SHAPE) -> LaneTables:
        return lane_tables(loop, seed, least)

    monkeypatch.setattr(engine_module, "lane_tables", roomy)
    first = JaxClosedLoop(loop_of(first_worlds(1)[0]), 1, streams=1, lanes=LANES)
    program = engine_module._program(first.pace)
    shares, called_off, kinds, sizes = 0, 0, set(), set()
    for number, one in enumerate(first_worlds(18, cells=80)):
        if one.kind == "extreme":
            continue
        results = same(loop_of(one, **LIMITED[number % 6]), one.seed, 40, f"{one.name}, {LIMITED[number % 6]}")
        shares += int(results.bisected.sum() + results.divided.sum())
        called_off += int((results.outcome == Outcome.NOT_WORTH_THE_RISK).sum())
        kinds.add(one.kind)
        sizes.add(program._cache_size())
    assert len(sizes) == 1  # limits are numbers in the program
    assert len(kinds) >= 17
    assert shares > 500 and called_off > 100


@pytest.mark.slow
def test_who_breaks_off_is_followed_event_for_event() -> None:
    for one in first_worlds(5, cells=80):
        same(loop_of(one, policy="watchful", reserve=0.1), one.seed, 100, one.name, traced=(0, 99))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(LIMITED)), ids=lambda number: str(LIMITED[number]))
def test_the_whole_survey_event_for_event(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every world of the survey under one of the limits, every kind under nearly all: a step of a reserve is dear.

    As many rollouts as there are lanes, and as many traced as are traced at a time, in one room for all of the worlds.
    """
    monkeypatch.setattr(engine_module, "TRACE_CELLS", CELL_BUCKETS[-1] - 1)
    limits, traced, refused = LIMITED[number], tuple(range(TRACED)), 0
    events = np.zeros(len(EventKind), dtype=np.int64)
    for place, one in enumerate(survey_worlds()):
        if (place + place // len(LIMITED)) % len(LIMITED) != number:  # every limit meets every choice of the worlds
            continue
        try:
            loop = loop_of(one, **limits)
            same(loop, one.seed, LANES, f"{one.name}, {limits}", traced=traced)
        except WorldError as error:
            assert one.kind == "extreme", error
            refused += 1
            continue
        for trace in trace_rollouts(loop, one.seed, traced):
            events += np.bincount(trace.events[:, 2], minlength=len(EventKind))
    assert refused <= 1
    assert events[EventKind.LOOKED_AGAIN] > 50 and events[EventKind.SHARED] > 50
    assert (events[EventKind.REFUSED] > 50) == ("worth" in limits)


@pytest.mark.slow
def test_a_rule_of_the_user_s_own() -> None:
    fixture = load_fixture("scattered-14x23-1000-k2")
    for order in (
        lambda offer: ((-offer.level, 1), (offer.cost, 1)),
        lambda offer: ((offer.cost * 3 - offer.unvisited, offer.unvisited), (-offer.unvisited, 7)),
    ):
        plan = make_plan(fixture.world, fixture.starts, Settings(policy=Rule("own", order)), fixture.allocation)
        same(compile_closed_loop(plan, fixture.world), 5, 200, "own rule", traced=(0, 199))


def test_fractions_are_compared_exactly() -> None:
    random = np.random.default_rng(0)
    tops = random.integers(-(2**31), 2**31, (2, 4000)).astype(np.int32)
    bottoms = random.integers(1, LARGEST_DENOMINATOR + 1, (2, 4000)).astype(np.int32)
    tops[1, :2000] = np.clip(tops[0, :2000] // bottoms[0, :2000] * bottoms[1, :2000], -(2**31), 2**31 - 2)  # close ones
    tops[:, :2] = [[2**31 - 1, -(2**31)], [2**31 - 2, -(2**31)]]
    bottoms[:, :2] = [[LARGEST_DENOMINATOR, 1], [LARGEST_DENOMINATOR, 1]]
    same = np.zeros(4000, dtype=np.int32), np.ones(4000, dtype=np.int32)
    one, other = (Candidate(same[0], same[0], (tops[i], bottoms[i]), same) for i in (0, 1))
    expected = [
        Fraction(int(a), int(b)) < Fraction(int(c), int(d))
        for a, b, c, d in zip(tops[0], bottoms[0], tops[1], bottoms[1], strict=True)
    ]
    assert np.asarray(jax.jit(partial(is_before, SimpleNamespace(policy=None)))(one, other)).tolist() == expected
    assert 1000 < sum(expected) < 3000


def too_wide(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    return (offer.cost * 2**30, offer.unvisited), (0, 1)


def too_long(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    return (offer.cost, offer.unvisited + 2**16), (0, 1)


def with_an_if(offer: Offer) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    return ((offer.cost, 1) if offer.level == 0 else (offer.level, 1)), (0, 1)


@pytest.mark.parametrize(
    ("order", "words"),
    [
        (too_wide, "prices of areas too large for policy own to be compared in 32 bits"),
        (too_long, "prices of areas too large for policy own to be compared in 32 bits"),
        (with_an_if, "the order of rule own cannot be traced by JAX; expected arithmetic alone"),
    ],
)
def test_what_the_lanes_cannot_follow_is_numba_s(order: Any, words: str) -> None:
    loop = loop_of(first_worlds(1)[0])
    assert loop.policy is not None
    loop = replace(loop, rule=Rule("own", order))
    with pytest.raises(WorldError, match=words + ".*engine='numba'"):
        closed_loop_engine(loop, 1, "jax")
    assert closed_loop_engine(loop, 1, "auto").name == "numba"
