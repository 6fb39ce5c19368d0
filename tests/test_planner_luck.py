"""Failure thresholds: numbers against an independent implementation's, engines against its rollouts and each other."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from decimal import Context, Decimal
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from doubt import WORLDS
from recordings import rewrite

import mrac_jax as mrac
from analysis.recording import contents
from analysis.recording.record import Request, record
from analysis.recording.replay import inspect, replay
from planner.errors import PER_VISIT, InputError
from planner.failure_model import (
    CERTAIN,
    LEAST,
    MOST,
    exposure_of,
    key_of_luck,
    least_word,
    susceptible,
    tolerance_of,
    tolerances,
    worn,
)
from planner.jit import compiled
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.simulator import failure_sampling as kernels
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.tally import WORDS_OF_0_3, Outcome
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

FOLDER = Path(__file__).parent / "fixtures_luck"
NAMES = sorted(path.stem for path in FOLDER.glob("tiny-*.json"))
WORDS: dict[str, Any] = json.loads((FOLDER / "words.json").read_text())
LOOPS: tuple[Literal["open", "closed"], ...] = ("open", "closed")
EXACTLY = Context(prec=40)


@compiled
def in_kernels(words, exposures, tolerance, least):
    """What kernels make of words and of exposures."""
    for place in range(len(words)):
        tolerance[place] = kernels.tolerance(words[place])
    for place in range(len(exposures)):
        least[place] = kernels.least_word(exposures[place])


@cache
def known(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def world_of(name: str) -> World:
    rows = [[np.nan if p is None else p for p in row] for row in known(name)["threat"]]
    return World.create(np.array(rows, dtype=np.float32), known(name)["starts"])


def test_words_tolerances_and_exposures_are_the_known_ones() -> None:
    assert {seed: list(key_of_luck(int(seed))) for seed in WORDS["key"]} == WORDS["key"]
    words, found = np.array(WORDS["tolerance"]).T
    assert np.array_equal(tolerance_of(words), found)
    twin = np.zeros_like(found)
    in_kernels(words.astype(np.uint32), found[:0], twin, found[:0])
    assert np.array_equal(twin, found)
    p, found = zip(*WORDS["exposure"], strict=True)
    assert exposure_of(np.array(p, dtype=np.float32)).tolist() == list(found)
    assert exposure_of([np.nan, 0.0, 1.0]).tolist() == [0, 0, CERTAIN]
    drawn = np.array(WORDS["random_seed0_ids0to9_k4"])
    assert np.array_equal(tolerances(0, range(len(drawn)), 4), tolerance_of(drawn))


def test_wear_and_susceptibility_are_the_known_ones() -> None:
    for shape, pairs in WORDS["wear"]:
        before, after = np.array(pairs).T
        assert np.array_equal(worn(before, shape), after), shape
    for before, times, after in WORDS["susceptible"]:
        assert susceptible(before, times) == after
    anything = np.array([LEAST, 2, 12345678901, MOST])
    assert np.array_equal(susceptible(anything, 1.0), anything)


def test_a_tolerance_is_the_logarithm_and_an_exposure_is_rounded_right() -> None:
    words = np.unique(np.concatenate([np.arange(200), 2**32 - 1 - np.arange(200), np.arange(1, 400) * 10_737_400]))
    found = tolerance_of(words)
    assert (np.diff(found) < 0).all()
    assert (found[0], found[-1]) == (MOST, LEAST)
    for word, units in zip(words[::7].tolist(), found[::7].tolist(), strict=True):
        exact = -EXACTLY.ln((Decimal(word) + Decimal("0.5")) / 2**32) * 2**32
        assert abs(units - exact) <= Decimal("0.52")
    threats = np.random.default_rng(1).random(300, dtype=np.float32)
    for p, units in zip(threats.tolist(), exposure_of(threats).tolist(), strict=True):
        assert units == int((-EXACTLY.ln(1 - Decimal(p)) * 2**32).to_integral_value())


def test_the_least_word_that_stops_is_where_tolerances_reach_the_exposure() -> None:
    rng = np.random.default_rng(2)
    words = np.concatenate([np.arange(50), 2**32 - 1 - np.arange(50), rng.integers(0, 2**32, 400)])
    for more in (-1, 0, 1):
        exposure = tolerance_of(words) + more
        found = least_word(exposure)
        assert (tolerance_of(np.minimum(found, 2**32 - 1)) <= exposure)[found < 2**32].all()
        assert (tolerance_of(np.maximum(found - 1, 0)) > exposure)[found > 0].all()
        borne = exposure[exposure > 0]
        twin = np.zeros_like(borne)
        in_kernels(words[:0].astype(np.uint32), borne, borne[:0], twin)
        assert np.array_equal(twin, found[exposure > 0])
    assert least_word([0, MOST, CERTAIN]).tolist() == [2**32, 0, 0]


@pytest.mark.parametrize("name", NAMES)
def test_rollouts_are_those_of_an_independent_simulator(name: str) -> None:
    answers, world = known(name), world_of(name)
    seed, robots = answers["seed"], len(answers["starts"])
    assert tolerances(seed, range(16), robots)[: len(answers["tolerance"])].tolist() == answers["tolerance"][:16]
    assert {str(cell): int(world.exposures[0][cell]) for cell in map(int, answers["exposure"])} == answers["exposure"]
    plan = make_plan(world, world.starts)
    readable = ReferenceLoop(plan, world)
    loop = compile_closed_loop(plan, world)
    _, singles = run_range(loop, seed, 0, len(answers["rollouts"]), singles=True, threads=1)
    assert singles is not None
    for one in answers["rollouts"]:
        rollout, run = one["id"], readable.run(seed, one["id"])
        expected = [one[what] for what in ("visited", "survived", "time", "alive")]
        assert [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum()] == expected
        found = [getattr(singles, what)[rollout] for what in ("visited", "survived", "time", "alive")]
        assert found == expected
        ended = WORDS_OF_0_3.get(one["outcome"], one["outcome"])
        assert Outcome(singles.outcome[rollout]).word == run.outcome.word == ended
        trace = readable.trace(seed, rollout)
        assert trace.events[trace.events[:, 2] == 1][:, [0, 1, 4]].tolist() == one["hits"]


def mean(counts: np.ndarray) -> tuple[float, float]:
    """The mean of a histogram, and its standard error."""
    values, total = np.arange(len(counts)), counts.sum()
    middle = float(counts @ values / total)
    return middle, float(np.sqrt(counts @ (values - middle) ** 2)) / total


CASES: tuple[tuple[dict[str, Any], dict[str, Any]], ...] = (
    ({}, {}),
    ({}, {"first_only": True}),
    ({}, {"tabled": False}),
    ({"range": 25}, {}),
    ({"policy": "per_cell"}, {}),
    ({"policy": "per_cell", "reserve": 0.5, "worth": 9.0}, {}),
)


@pytest.mark.parametrize(("settings", "how"), CASES, ids=lambda one: ",".join(one) or "plain")
def test_compiled_rollouts_are_the_readable_ones(
    settings: dict[str, Any], how: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("planner.simulator.runners.LEAST_SHARED", 1)
    for seed in range(3):
        world = random_world(8, 9, ThreatPattern(("contiguous", "scattered")[seed % 2], 4, seed=seed))
        plan = make_plan(world, place_starts(world, (2, 5, 9)[seed])[0], Settings(**settings))
        loop = compile_closed_loop(plan, world, **how)
        readable = ReferenceLoop(plan, world, first_only=how.get("first_only", False))
        for trace in trace_rollouts(loop, 5, range(8)):
            assert trace == readable.trace(5, trace.rollout), (seed, trace.rollout)
        whole, singles = run_range(loop, 5, 0, 600, threads=1, singles=True)
        assert singles is not None
        for rollout in range(8, 20):
            run = readable.run(5, rollout)
            found = [getattr(singles, what)[rollout] for what in ("visited", "survived", "time", "alive", "outcome")]
            assert found == [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum(), run.outcome]
        parts = [run_range(loop, 5, start, 200, threads=threads)[0] for start, threads in ((0, 1), (200, 2), (400, 2))]
        assert parts[0] + parts[1] + parts[2] == whole


@pytest.mark.parametrize("name", WORLDS)
def test_maps_in_doubt_are_borne_rollout_by_rollout(name: str) -> None:
    world = WORLDS[name]
    plan = make_plan(world, place_starts(world, 4)[0], Settings())
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    tally, singles = run_range(loop, 5, 0, 300, singles=True, threads=1)
    assert singles is not None
    for rollout in range(50):
        run = readable.run(5, rollout)
        found = [getattr(singles, what)[rollout] for what in ("visited", "survived", "time", "alive", "outcome")]
        assert found == [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum(), run.outcome], rollout
    assert trace_rollouts(loop, 5, [7])[0] == readable.trace(5, 7)
    assert run_range(loop, 5, 0, 100, threads=2)[0] + run_range(loop, 5, 100, 200)[0] == tally


@pytest.mark.parametrize("name", ["persistent", "level", None])
def test_open_and_closed_loop_of_one_robot_share_their_luck(name: str | None) -> None:
    world = random_world(9, 9, ThreatPattern("scattered", 4, seed=2)) if name is None else WORLDS[name]
    plan = make_plan(world, place_starts(world, 1)[0])
    one, other = (make_engine(plan, world, Rolling(loop, seed=8), "numba").results(0, 400) for loop in LOOPS)
    for what in ("visited", "survived", "alive"):
        assert np.array_equal(getattr(one, what), getattr(other, what)), what
    assert len(np.unique(one.visited)) > 5


def scattered() -> tuple[World, Plan]:
    world = random_world(8, 8, ThreatPattern("scattered", 4, seed=4))
    return world, make_plan(world, place_starts(world, 3)[0])


@pytest.mark.parametrize("loop", LOOPS)
def test_answers_are_the_engine_s(loop: Any) -> None:
    world, plan = scattered()
    found = mrac.evaluate(world, plan, loop=loop, rollouts=2000, advice=False, engine="numba")
    engine = make_engine(plan, world, Rolling(loop, seed=0), "numba")
    counts = replace(found.tally, by_luck=np.empty(0, np.int64))  # its sums by luck: test_analysis_control
    assert counts == engine.tally(0, 2000)
    band = found.outputs["band"]
    middle = -(-band.rollouts // 2) - 1
    assert band.median[-1] == np.sort(engine.results(0, band.rollouts).visited)[middle]


def test_a_recording_that_names_no_randomness_is_opened_and_not_replayed(tmp_path: Path) -> None:
    world, plan = scattered()
    for loop in LOOPS:
        path = tmp_path / f"{loop}.mcap"
        record(world, plan, Request(ids=(3, 5), loop=loop, seed=9), path)
        found = replay(path)
        assert found.identical, found.difference
    said = found.settings.to_json()
    assert said["luck"] == "tolerance"
    for words in ({"luck": "step"}, {}):
        data = json.dumps({name: value for name, value in said.items() if name != "luck"} | words).encode()
        assert contents.read_settings(data, "old").per_visit
        rewrite(path, tmp_path / "old.mcap", attachments={contents.SETTINGS: data})
        assert inspect(tmp_path / "old.mcap").settings.to_json()["luck"] == "step"
        with pytest.raises(InputError, match=re.escape(PER_VISIT)):
            replay(tmp_path / "old.mcap")


def test_a_robot_bears_the_same_in_teams_of_every_size() -> None:
    assert np.array_equal(tolerances(4, range(9), 2), tolerances(4, range(9), 7)[:, :2])
    assert np.array_equal(tolerances(4, [8], 2), tolerances(4, range(9), 2)[8:])
