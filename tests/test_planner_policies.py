"""Policies of docs/spec.md, section 11, orders within areas, orders of areas that are found.

Where there are no tables of distances: however they are found, rollouts are those that tables lead to.
"""

import json
import math
from dataclasses import replace
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from closed_loop_worlds import limited, survey_world
from conftest import FOLDER, load_fixture, worlds_with_starts
from helpers import VisitLoop, assert_same_trace, load_plan, play_both_ways
from hypothesis import example, given, settings
from hypothesis import strategies as st
from oracle_tree import closed_loop_exact
from validate import validate

import mrac_jax as mrac
from analysis.estimators.racing import order_areas
from analysis.sampling import RolloutChoices
from analysis.theory.exact import open_loop_exact
from analysis.theory.flow_programme import optimum
from planner.errors import InputError, PlanError, WorldError
from planner.make_plan import allocated_plan, make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.policies import RULES
from planner.policies.rules import Rule, most_at_risk, refusal_threshold
from planner.rollouts import tables as tables_module
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import closed_loop_engine
from planner.rollouts.exact_tree import WHOLE as MASS
from planner.rollouts.exact_tree import grow_tree
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.runners import KNOWN, Runner, singles_of
from planner.rollouts.single_run import PythonLoop, SingleRun
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.simulator.codes import NONE, EventKind, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.offers import NO_REFUSAL, Offer, is_refused
from planner.simulator.state import Work
from planner.tally import WORDS_OF_0_3
from planner.world.generate import ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# The policies of SPEC section 11, against two independent simulators and plain twins.

CODES = (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS, Outcome.STEP_LIMIT, Outcome.NOT_WORTH_THE_RISK)
"""What the fixtures' own codes mean."""
POLICIES = FOLDER / "policies"
TINY = sorted(path.stem for path in POLICIES.glob("tiny-*.json"))
PAPER = sorted(path.stem for path in POLICIES.glob("*.json") if path.stem not in TINY)
LARGE = [name for name in PAPER if name.endswith("k8")]
FEW = 1
"""Seeded runs of the simulator as Python on the paper's maps; 8 on the tiny ones, of the compiled one all 24."""
LIMITED: list[dict[str, Any]] = [
    {"policy": "per_cell", **limits}
    for limits in (
        {}, {"risk_cap": 0.25}, {"risk_cap": 1.0}, {"robot_value": 4.0}, {"robot_value": 40.0},
        {"risk_cap": 0.5, "robot_value": 9.0}, {"policy": "watchful"}, {"policy": "watchful", "risk_cap": 0.1},
        {"policy": "watchful", "risk_cap": 0.5, "robot_value": 9.0},
    )
]  # fmt: skip


def known(name: str) -> list[dict[str, Any]]:
    answers: list[dict[str, Any]] = json.loads((POLICIES / f"{name}.json").read_text())["policies"]
    return answers


def check_runs(name: str, case: dict[str, Any], runs: int) -> None:
    fixture = load_fixture(name)
    plan = make_plan(fixture.world, fixture.starts, Settings(**case["settings"]), fixture.allocation)
    nominal = case["nominal"]
    assert [robot.path.tolist() for robot in plan.robots] == nominal["paths"]
    assert plan.outcome == CODES[nominal["outcome"]].word
    assert (plan.time, plan.shares) == (nominal["time"], nominal["shares"])
    assert {item.rule for item in validate(plan, fixture.world)} <= {"area-order"}  # the allocation is the fixture's
    reference = (PythonLoop if "threshold_runs" in case else VisitLoop)(plan, fixture.world)
    fixed = case.get("threshold_runs") or case["seeded_runs"]
    for rollout, expected in enumerate(fixed["runs"][:runs]):
        assert columns_of(reference.run(fixed["seed"], rollout)) == expected, rollout
    python = PythonLoop(plan, fixture.world)
    for tabled in (True, False):
        loop = compile_closed_loop(plan, fixture.world, tabled=tabled)
        singles = run_range(loop, fixed["seed"], 0, len(fixed["runs"]), singles=True)[1]
        columns = (singles.visited, singles.survived, singles.time, singles.alive, map(CODES.index, singles.outcome))
        found = [list(row) for row in zip(*columns, strict=True)]
        if "threshold_runs" in case:
            assert found == fixed["runs"]
        else:
            assert found[:runs] == [columns_of(python.run(fixed["seed"], rollout)) for rollout in range(runs)]


def columns_of(run: SingleRun) -> list[int]:
    """A run as the fixtures have it."""
    counts = [int(run.visited.sum()), int(run.survived.sum()), run.step, int(run.alive.sum())]
    return [*counts, CODES.index(run.outcome)]


@pytest.mark.parametrize("runs", [2, pytest.param(8, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", TINY)
def test_tiny_worlds_are_the_fixtures(name: str, runs: int) -> None:
    for case in known(name):
        check_runs(name, case, runs)


@pytest.mark.parametrize("name", PAPER)
def test_the_paper_s_maps_are_the_fixtures(name: str) -> None:
    for case in known(name):
        check_runs(name, case, 0 if name in LARGE else FEW)


@pytest.mark.parametrize("name", [name for name in TINY if name.endswith(("k1", "k2"))])
def test_enumeration_is_the_fixtures(name: str) -> None:
    """Of the limits, which the oracle does not know, the compiled tree is held against them."""
    fixture = load_fixture(name)
    for case in known(name):
        plan = make_plan(fixture.world, fixture.starts, Settings(**case["settings"]), fixture.allocation)
        known_exact = case["closed_loop_exact"].items()
        exact = {WORDS_OF_0_3.get(key, key): value for key, value in known_exact if isinstance(value, float)}
        assert {"visited", "not_worth_the_risk"} <= set(exact)
        tree = grow_tree(compile_closed_loop(plan, fixture.world), 0.0, 10**7)
        assert tree is not None and not tree.left
        for key, value in exact.items():
            counts = tree.counts.outcomes if key.upper() in Outcome.__members__ else getattr(tree.counts, key)
            mean = counts[Outcome[key.upper()]] if counts is tree.counts.outcomes else counts @ np.arange(len(counts))
            assert mean / MASS == pytest.approx(value, rel=0, abs=1e-7), key
        if len(case["settings"]) > 1:
            continue
        found = closed_loop_exact(plan, fixture.world)
        for key, value in exact.items():
            assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key


# --- the compiled simulator ---


def test_compiled_counts_deadlines_and_other_truths() -> None:
    """Every count is that of the rollouts one by one; cut off, and under other threats, decisions stay as they are."""
    fixture = load_fixture("contiguous-14x23-1001-k2")
    plan = make_plan(fixture.world, fixture.starts, Settings(policy="per_cell", risk_cap=0.5), fixture.allocation)
    loop = compile_closed_loop(plan, fixture.world)
    tally, singles = run_range(loop, 3, 0, 400, singles=True)
    assert np.array_equal(np.bincount(singles.visited, minlength=len(tally.visited)), tally.visited)
    traces = trace_rollouts(loop, 3, range(400))
    visits = sum(np.bincount(first.cells[0], minlength=tally.visits.size) for first in traces)
    for trace in traces:
        moved = trace.cells[1:] != trace.cells[:-1]
        visits = visits + np.bincount(trace.cells[1:][moved], minlength=tally.visits.size)
    assert np.array_equal(tally.visits.ravel(), visits)
    assert run_range(loop, 3, 0, 150)[0] + run_range(loop, 3, 150, 250, threads=3)[0] == tally
    cut = run_range(loop.truncated_at(20), 3, 0, 400)[0]
    assert cut.new_visited.tolist() == tally.new_visited[: len(cut.new_visited)].tolist()
    safe = World.create(np.where(fixture.world.free, 0.0, np.nan))
    unharmed = run_range(loop.with_threat(safe), 3, 0, 1, singles=True)[1]
    assert unharmed is not None and unharmed.time[0] == plan.time


@pytest.mark.parametrize("valued", [False, True])
@pytest.mark.parametrize("kept", [128, 2])
def test_areas_are_ranked_by_the_least_price_per_cell(kept: int, valued: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """As exact fractions say, as many as are kept; where those run out the others are found too."""
    monkeypatch.setattr(tables_module, "RANKED", kept)
    fixture = load_fixture("scattered-20x20-1000-k8")
    draw, world = np.random.default_rng(5), fixture.world
    if valued:  # some cells, and all of some areas, are worth nothing
        world = replace(
            world, value=(draw.integers(0, 4, world.shape) * draw.integers(0, 2, world.shape)).astype(float)
        )
    plan = make_plan(world, fixture.starts, Settings(policy="per_cell"))
    loop, problem = compile_closed_loop(plan, world), prepare(world, fixture.starts, plan.settings)
    given, sizes = range(len(loop.tables.level)), np.diff(loop.tables.begin).tolist()
    robot_value = np.ones(world.threat.size, dtype=int) if problem.value is None else problem.value
    best = [int(robot_value[area.cells].max()) for area in plan.areas]
    assert not valued or (0 in best and len(set(best)) > 2)
    entries = problem.entry[loop.tables.level].tolist()
    for row, costs in zip(loop.tables.foremost.tolist(), loop.tables.area_cost.tolist(), strict=True):
        price = [max(costs[m], entries[m]) + (sizes[m] - 1) * entries[m] for m in given]
        least = [Fraction(price[m], sizes[m] * best[m] or 1) for m in given]
        reached = sorted((m for m in given if costs[m] >= 0), key=lambda m: (best[m] == 0, least[m]))
        assert row == reached[: len(row)] + [len(given)] * (len(row) - len(reached))
    searched = compile_closed_loop(plan, world, tabled=False)
    assert run_range(loop, 3, 0, 300)[0] == run_range(searched, 3, 0, 300)[0]


def test_an_area_of_one_cell_stays_first_until_another_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the simulator leaves out (`replanning.make_first_choice`): one that looks each time finds the same."""
    replanning, settled = interpreted("replanning"), list[bool]()
    honest = replanning.make_first_choice

    def looks_each_time(t: Any, p: Any, s: Any, robot: int, area: int) -> None:
        honest(t, p, s, robot, area)
        settled.append(s.robots[robot].sure != NONE)
        s.robots[robot].sure = NONE

    monkeypatch.setattr(replanning, "make_first_choice", looks_each_time)
    for name in ("scattered-20x20-1000-k8", "scattered-14x23-1001-k8"):
        fixture = load_fixture(name)
        play_both_ways(make_plan(fixture.world, fixture.starts, Settings(policy="per_cell")), fixture.world, 3, 2)
    assert sum(settled) > 100


def test_an_own_area_that_is_not_offered_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """The comparison bites: next to a simulator as Python with this fault, compiled runs differ."""
    replanning = interpreted("replanning")
    honest = replanning.first_area
    without_own = lambda t, p, s, w, robot, _, refusing: honest(t, p, s, w, robot, NONE, refusing)  # noqa: E731
    monkeypatch.setattr(replanning, "first_area", without_own)
    with pytest.raises(AssertionError, match="traces differ"):
        for name in TINY:
            fixture = load_fixture(name)
            play_both_ways(make_plan(fixture.world, fixture.starts, Settings(policy="per_cell")), fixture.world, 5, 6)


@pytest.mark.parametrize("cost", [lambda offer: offer._asdict()["cost"], lambda offer: offer.cost * 0.5])
def test_a_rule_that_is_no_whole_number_arithmetic_is_refused(cost: Any) -> None:
    world = World.create(LINE)
    rule = Rule("odd", lambda offer: ((cost(offer), 1), (0, 1)))
    plan = allocated_plan(world, [[0, 0]], Settings(policy=rule))
    with pytest.raises(PlanError, match="the order of rule odd cannot be compiled; expected whole-number arithmetic"):
        compile_closed_loop(plan, world)


# --- the rules, each beside its plain twin ---

WHOLE = st.integers(0, 2**31)
BEYOND = 2**70
"""More than any price of OFFERS."""


def offer_of(level: int, cost: int, unvisited: int, entry: int, value: int | None = None, shown: int = 0) -> Offer:
    """An area whose cells to do are worth `value`, None: 1 each, and would show so many."""
    return Offer(level, cost, unvisited, entry, unvisited if value is None else value, BEYOND, shown)


OFFERS = st.lists(
    st.builds(
        offer_of, st.integers(0, 15), WHOLE, st.integers(1, 2**26), st.integers(1, 2**31),
        st.none() | st.integers(0, 3) | st.integers(0, 1000 * 2**26), st.just(0) | st.integers(0, 2**26),
    ),
    min_size=1, max_size=6,
)  # fmt: skip


def mrac_twin(areas: list[tuple[int, Offer]]) -> list[int]:
    return [number for number, _ in sorted(areas, key=lambda item: (item[1].level, item[1].cost, item[0]))]


def per_cell_twin(areas: list[tuple[int, Offer]]) -> list[int]:
    def key(item: tuple[int, Offer]) -> tuple[bool, Fraction, int, int]:
        number, (_, cost, unvisited, entry, value, *_) = item
        price = cost + (unvisited - 1) * entry
        return value == 0, Fraction(price, value) if value else Fraction(price), cost, number

    return [number for number, _ in sorted(areas, key=key)]


def frontier_twin(areas: list[tuple[int, Offer]]) -> list[int]:
    def key(item: tuple[int, Offer]) -> tuple[bool, Fraction, int, int]:
        number, (_, cost, unvisited, entry, value, _, shown, _) = item
        price, gain = Fraction(cost + (unvisited - 1) * entry), value + Fraction(shown, 4)
        return gain == 0, price / gain if gain else price, cost, number

    return [number for number, _ in sorted(areas, key=key)]


TWINS = {"mrac": mrac_twin, "per_cell": per_cell_twin, "frontier": frontier_twin, "watchful": per_cell_twin}


@pytest.mark.parametrize("name", RULES)
@given(offers=OFFERS, step=st.integers(1, 9))
@example(offers=[offer_of(0, 2**31, 2**26, 2**31), offer_of(0, 2**31 - 1, 2**26, 2**31)], step=1)
@example(offers=[offer_of(1, 7, 3, 4), offer_of(1, 15, 5, 4)], step=2)
@example(offers=[offer_of(0, 0, 1, 1, 0), offer_of(0, 9, 1, 1, 5)], step=1)
def test_a_rule_is_its_plain_twin(name: str, offers: list[Offer], step: int) -> None:
    """Also compared as a kernel does, by products; and in the same order when areas have other ids."""
    rule, areas = RULES[name], list(enumerate(offers))
    order = sorted(areas, key=lambda item: (rule.key(item[1]), item[0]))
    assert [number for number, _ in order] == TWINS[name](areas)
    renamed = [(number * step, offer) for number, offer in areas]
    assert [number // step for number in TWINS[name](renamed)] == [number for number, _ in order]
    for (_, one), (_, other) in pairwise(order):
        for (top, bottom), (top_other, bottom_other) in zip(rule.order(one), rule.order(other), strict=True):
            if top * bottom_other != top_other * bottom:
                assert top * bottom_other < top_other * bottom
                break


@given(
    offer=OFFERS.map(lambda offers: offers[0]), theta=st.integers(0, NO_REFUSAL), cells=st.integers(1, 2**26),
    scale=st.sampled_from([1, 1000]),
)  # fmt: skip
def test_refusal_is_the_comparison_without_the_product(offer: Offer, theta: int, cells: int, scale: int) -> None:
    price = offer.cost + (offer.unvisited - 1) * offer.entry
    assert bool(is_refused(offer, cells, theta, scale)) == (price >= cells and scale * price > theta * offer.value)


@pytest.mark.parametrize(("theta", "value"), [(0, 1), (7, 1), (250, 40), (NO_REFUSAL, 1), (NO_REFUSAL, 0), (0, 0)])
@pytest.mark.parametrize("scale", [1, 1000])
def test_refused_is_what_costs_more_than_theta_and_not_what_costs_as_much(theta: int, value: int, scale: int) -> None:
    """At the price up to which an area is taken and one above; worth nothing: refused wherever it is dangerous."""
    last = theta * value // scale
    offers = [offer_of(1, price, 1, 1, value) for price in (last, last + 1)]
    assert [bool(is_refused(offer, 0, theta, scale)) for offer in offers] == [False, True]
    assert not is_refused(offers[1], last + 2, theta, scale)


def test_the_limits_on_a_team() -> None:
    assert [most_at_risk(0.25, alive) for alive in (1, 4, 5, 8, 9)] == [1, 1, 2, 2, 3]
    assert refusal_threshold(40, 400, 0.04, "paper") == math.floor(400 / (0.04 * 40)) == 250
    assert refusal_threshold(40, 400, 0.04, "log") == math.floor(400 / (-math.log(0.96) * 40))
    assert refusal_threshold(None, 400, 0.04, "paper") == refusal_threshold(40, 400, 0.0, "paper") == NO_REFUSAL
    assert refusal_threshold(1e-300, 400, 0.04, "paper") == NO_REFUSAL


def test_the_nearest_area_is_the_first_by_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    fixed, areas, state, asked = interpreted("fixed_paths"), interpreted("areas"), interpreted("state"), 0
    honest = fixed.find_next_area

    def by_key(t: Any, s: Any, w: Any, robot: int) -> tuple[int, int]:
        nonlocal asked
        costs, offers, asked = np.asarray(areas.costs_from(t, s, w, robot)), [], asked + 1
        for number in (number for number in range(s.marks.areas) if state.holds(s.open, number)):
            cost = int(costs[np.flatnonzero(s.home[:-1] >> state.AREA_BITS == number)].min())
            offers.append((RULES["mrac"].key(offer_of(s.areas[number].level, cost, 1, 1)), number))
        found = honest(t, s, w, robot)
        assert found[0] == min(offers, default=(0, NONE))[1]
        return found

    monkeypatch.setattr(fixed, "find_next_area", by_key)
    for name in ("tiny-4x8-12-k2", "contiguous-14x23-1001-k2"):
        fixture = load_fixture(name)
        loop = PythonLoop(fixture.plan, fixture.world)
        assert loop.run(5, 1).visited.any()
    assert asked > 10


# --- runs end, and say how ---


@settings(max_examples=40)
@given(worlds_with_starts(), st.sampled_from(LIMITED), st.integers(0, 99), st.sampled_from(["grid", "area"]))
def test_no_run_ends_at_the_limit(given_world: tuple[World, np.ndarray], limits: Any, rollout: int, way: Any) -> None:
    world, starts = given_world
    plan = make_plan(world, starts, Settings(transit=way, **limits))
    assert plan.outcome == "complete" or (plan.outcome == "not_worth_the_risk" and "robot_value" in limits)
    assert validate(plan, world) == []
    run = PythonLoop(plan, world).run(5, rollout)
    assert run.outcome is not Outcome.STEP_LIMIT
    assert run.outcome is not Outcome.NOT_WORTH_THE_RISK or "robot_value" in limits


def test_events_say_who_looked_again_and_what_was_refused() -> None:
    counts = np.zeros(len(EventKind), dtype=np.int64)
    for name, limits in (("contiguous-20x20-1000-k2", {}), ("scattered-14x23-1000-k2", {"robot_value": 40.0})):
        fixture = load_fixture(name)
        plan = make_plan(fixture.world, fixture.starts, Settings(policy="per_cell", **limits), fixture.allocation)
        for rollout in range(4):
            trace = PythonLoop(plan, fixture.world).trace(1, rollout)
            counts += np.bincount(trace.events[:, 2], minlength=len(EventKind))
            for step, robot, kind, area, other in trace.events.tolist():
                if kind == EventKind.LOOKED_AGAIN:
                    assert trace.areas[step - 1, robot] == area
                    assert fixture.world.threat.ravel()[other] > 0
    assert counts[EventKind.LOOKED_AGAIN] > 0 and counts[EventKind.REFUSED] > 0


# --- settings, files, errors ---

LINE = [[0.0, 0.0, 0.1, 0.1, 0.3]]


BAD_POLICIES = [
    ({"risk_cap": 0.25}, "risk_cap is 0.25 with policy mrac; expected policy per_cell"),
    ({"robot_value": 40.0}, "robot_value is 40 with policy mrac; expected policy per_cell"),
    ({"policy": "per_cell", "risk_cap": 0.0}, "risk_cap is 0; expected a number above 0, at most 1"),
    ({"policy": "per_cell", "risk_cap": float("nan")}, "risk_cap is nan"),
    ({"policy": "per_cell", "robot_value": float("inf")}, "robot_value is inf; expected a number above 0"),
    ({"policy": "per_cell", "robot_value": float("nan")}, "robot_value is nan"),
    ({"policy": "percell"}, "did you mean 'per_cell'"),
    ({"policy": 3}, "policy"),
    ({"in_area": "spiral"}, "in_area='spiral'; expected 'nearest' or"),
]


@pytest.mark.parametrize(("asked", "words"), BAD_POLICIES)
def test_bad_policies_are_one_clear_error(asked: dict[str, Any], words: str) -> None:
    with pytest.raises(PlanError, match=words):
        make_plan(World.create(LINE), [[0, 0]], Settings(**asked))


def test_plan_files_know_policies_and_old_ones_are_mrac(tmp_path: Path) -> None:
    world = World.create(LINE)
    old = make_plan(world, [[0, 0]])
    assert set(old.to_json()["settings"]) == {"levels", "density", "risk", "transit", "max_steps"}
    plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", robot_value=4))
    plan.save(tmp_path / "plan.json")
    read = load_plan(tmp_path / "plan.json", world)
    assert (read.settings, read.outcome) == (Settings(policy="per_cell", robot_value=4.0), "not_worth_the_risk")
    said = plan.to_json()
    said["settings"] = {"robot_value": 4}
    with pytest.raises(PlanError, match="robot_value is 4 with policy mrac"):
        parse_plan(said, world, "p.json")
    with pytest.raises(PlanError, match="`policy` is 'per_cell'; expected paths only"):
        parse_plan({"paths": [[[0, 0]]], "policy": "per_cell"}, world, "p.json")


def test_scenarios_name_a_policy(tmp_path: Path) -> None:
    np.save(tmp_path / "m.npy", np.array(LINE, dtype=np.float32))
    scenario = tmp_path / "s.yaml"
    scenario.write_text("map: m.npy\npolicy: per_cell\nrisk_cap: 0.5\nrobot_value: 40\n")
    assert mrac.plan(mrac.load(scenario)).settings == Settings(policy="per_cell", risk_cap=0.5, robot_value=40.0)
    assert mrac.plan(mrac.load(scenario), policy="mrac").settings == Settings()
    for line, words in (("policy: bold", "policy"), ("risk_cap: 2", "risk_cap"), ("robot_value: .nan", "robot_value")):
        scenario.write_text(f"map: m.npy\n{line}\n")
        with pytest.raises(InputError, match=words):
            load_input(scenario)


def test_prices_that_do_not_fit_are_refused() -> None:
    threat = np.full((60, 60), 0.5)
    threat[0, 0], threat[0, 1] = 0.0, 1e-11
    world = World.create(threat)
    make_plan(world, [[0, 0]], Settings(max_steps=1))
    with pytest.raises(WorldError, match="too expensive for policy per_cell"):
        make_plan(world, [[0, 0]], Settings(policy="per_cell"))


def dearest_first(offer: Offer) -> tuple[tuple[int, int], tuple[int, int]]:
    return (-offer.level, 1), (offer.cost, 1)


dearest_rule = Rule("dearest", dearest_first)


@pytest.mark.slow
def test_a_rule_of_the_user_s_own_is_compiled() -> None:
    """Once in every process."""
    fixture = load_fixture("tiny-4x8-12-k2")
    for rule in (dearest_rule, Rule("nearest", lambda offer: ((offer.cost, 1), (0, 1)))):
        play_both_ways(make_plan(fixture.world, fixture.starts, Settings(policy=rule)), fixture.world, 5, 12)


def test_a_comparison_tells_policies_apart() -> None:
    world = World.create([[0.3, 0.0, 0.0, 0.1]])
    plans = [mrac.plan(world, starts=[[0, 1]], policy=policy) for policy in ("mrac", "per_cell", dearest_rule, None)]
    sides = [(world, plan) for plan in plans]
    for other in sides[1:3]:
        found = mrac.compare(sides[0], other, loop="open", rollouts=4096)
        assert [words[0].split()[0] for words in found.differing] == ["policy", "policy"]
    assert mrac.compare(sides[0], sides[3], loop="open", rollouts=4096).differing == ((), ())


# Orders within areas: which neighbour goes first, in every engine alike; elsewhere all is as it was.

WIDE = [
    "......",
    "..#...",
    "......",
]  # fmt: skip
PATHS = {
    "nearest": [0, 1, 2, 3, 4, 5, 11, 10, 9, 15, 14, 13, 7, 6, 12, 13, 14, 15, 16, 17],
    "rows": [0, 1, 2, 3, 4, 5, 11, 10, 9, 15, 14, 13, 12, 6, 7, 13, 14, 15, 16, 17],
    "columns": [0, 6, 12, 13, 7, 1, 2, 3, 9, 15, 14, 15, 16, 10, 4, 5, 11, 17],
}
"""By hand, from SPEC section 20, of a robot that begins upper left."""


def drawn(rows: list[str]) -> World:
    """`.` is safe, `#` an obstacle, a digit so many tenths of danger."""
    values = {".": 0.0, "#": np.nan} | {str(n): n / 10 for n in range(1, 10)}
    return World.create(np.array([[values[one] for one in row] for row in rows], dtype=np.float32))


@pytest.mark.parametrize("order", PATHS)
def test_paths_by_hand(order: str) -> None:
    world = drawn(WIDE)
    assert mrac.plan(world, 1, in_area=order).robots[0].path.tolist() == PATHS[order]


def test_boustrophedon_goes_along_those_straight_runs_of_which_there_are_fewer() -> None:
    wide = mrac.plan(drawn(WIDE), 1, in_area="boustrophedon").robots[0].path.tolist()
    high = drawn(["".join(column) for column in zip(*WIDE, strict=True)])
    found = mrac.plan(high, 1, in_area="boustrophedon").robots[0].path.tolist()
    assert wide == PATHS["rows"]  # 4 runs in rows, 7 in columns
    assert found == mrac.plan(high, 1, in_area="columns").robots[0].path.tolist() != wide
    square = mrac.plan(drawn(["...", "...", "..."]), 1, in_area="boustrophedon").robots[0].path.tolist()
    assert square == [0, 1, 2, 5, 4, 3, 6, 7, 8]  # as many: rows
    # of two safe areas each goes by its own shape
    both = drawn(["....1..", "....1..", "##111..", "#####.."])
    path = mrac.plan(both, 1, in_area="boustrophedon").robots[0].path.tolist()
    assert path[:8] == [0, 1, 2, 3, 10, 9, 8, 7]
    assert [cell for cell in path if cell % 7 >= 5] == [12, 5, 6, 13, 20, 27, 26, 19]


def test_dangerous_areas_are_covered_as_before() -> None:
    """A robot that comes in from above into a dangerous field: the order is for safe areas alone."""
    world = drawn(["...", "222", "222", "222"])
    paths = [mrac.plan(world, 1, in_area=order).robots[0].path.tolist() for order in PATHS]
    assert [path[:3] for path in paths] == [[0, 1, 2]] * 3
    assert len({tuple(path[3:]) for path in paths}) == 1


def test_a_scenario_a_plan_file_and_an_identity_know_it(tmp_path: Any) -> None:
    np.save(tmp_path / "field.npy", np.zeros((3, 6)))
    (tmp_path / "field.yaml").write_text("map: field.npy\nin_area: columns\n")
    world = mrac.load(tmp_path / "field.yaml")
    plan = mrac.plan(world, 2)
    assert plan.settings.in_area == "columns"
    plan.save(tmp_path / "plan.json")
    assert mrac.read_plan(tmp_path / "plan.json", world).settings == plan.settings
    assert "in_area" not in Settings().to_json()
    assert Settings(in_area="rows").to_json()["in_area"] == "rows"


# An order of areas that is found: how near the optimum it comes, and that all engines follow it as they do values.

BASE = Settings(policy="watchful")


def test_on_tiny_worlds_it_closes_most_of_what_the_rule_lacks_to_the_optimum() -> None:
    lacks = []
    for seed in range(1, 7):
        kind = ThreatPattern("scattered", levels=(0.04, 0.12, 0.2, 0.3, 0.4), seed=seed)
        world = random_world(4, 4, kind, obstacles=0.2, threats=0.5)
        starts = place_starts(world, 1)[0]
        most = optimum(world, starts)
        found = order_areas(world, starts, BASE, RolloutChoices(), AllPairs(), 150, lambda: True)
        # of one robot both loops are the same
        covered = [open_loop_exact(make_plan(world, starts, one), world).visited for one in (BASE, found)]
        assert covered[0] <= covered[1] + 1e-9 <= most + 2e-9
        lacks.append(most - np.array(covered))
    before, after = np.sum(lacks, axis=0)
    assert before > 0.05 and after < before / 2


def ordered(seed: int, policy: str) -> tuple[World, Plan, Plan]:
    """A world, its plan by numbers for cells, and the plan for the world in which cells are worth these."""
    world = random_world(9, 8, ThreatPattern("scattered" if seed % 2 else "contiguous", 4, seed=seed), threats=0.35)
    first = 1 + np.arange(world.threat.size) * (7 + seed) % 11
    starts, by = place_starts(world, 3)[0], Settings(policy=policy, risk_cap=0.5)
    plan = make_plan(world, starts, replace(by, priority=tuple(first.tolist())))
    return world, plan, make_plan(valued(world, plan), starts, by)


def valued(world: World, plan: Plan) -> World:
    return world.with_values(np.where(world.free, np.reshape(plan.settings.priority, world.shape), 0.0))


def test_cells_count_in_decisions_as_if_they_were_worth_as_much(tmp_path: Path) -> None:
    differs = 0
    for seed in range(4):
        world, plan, other = ordered(seed, ("watchful", "per_cell")[seed // 2])
        assert plan.to_json()["robots"] == other.to_json()["robots"]
        differs += plan.to_json()["robots"] != make_plan(world, plan.starts, BASE).to_json()["robots"]
        plan.save(tmp_path / "plan.json", force=True)
        loaded = load_plan(tmp_path / "plan.json", world)
        assert loaded.settings == plan.settings
        python, compiled = PythonLoop(loaded, world), closed_loop_engine(compile_closed_loop(loaded, world), 3)
        by_value = closed_loop_engine(compile_closed_loop(other, valued(world, plan)), 3)
        for mine, theirs in zip(compiled.traces(range(3)), by_value.traces(range(3)), strict=True):
            assert_same_trace(mine, python.trace(3, mine.rollout))
            assert_same_trace(mine, theirs)
    assert differs


def test_what_does_not_go_with_it_is_refused(tmp_path: Path) -> None:
    world, plan, _ = ordered(1, "watchful")
    settings = plan.settings
    for wrong, said in (
        (replace(settings, risk_cap=None, policy="mrac"), "priority found by a search with --policy mrac|policy mrac"),
        (replace(settings, robot_value=5.0), "priority with"),
        (replace(settings, priority=(1, 2)), "priority of 2 cells; expected one number, or one for each of 72 cells"),
    ):
        with pytest.raises(PlanError, match=said):
            make_plan(world, plan.starts, wrong)
    data = plan.to_json()
    data["settings"]["priority"] = [1001, *data["settings"]["priority"][1:]]
    (tmp_path / "wrong.json").write_text(json.dumps(data))
    with pytest.raises(PlanError, match=r"wrong\.json: `settings\.priority` is"):
        load_plan(tmp_path / "wrong.json", world)


# Where there are no tables of distances: however they are found, rollouts are those that tables lead to.


WAYS = {
    "near": (10**6, 1_000, 255),
    "far": (0, 1_000, 255),
    "far, past wide components": (0, 0, 255),
    "rows": (0, 1_000, 0),
    "rows of who asks again": (0, 1_000, 1),
}
"""`nearby`, `wide` and `patience` of `Tables`."""
SEED, ROLLOUTS = 3, 300
SURVEYED = ("contiguous-8", "combs-8", "crossings-0", "scattered-8", "many-levels-2", "disconnected-1")


def planned(policy: str, transit: Literal["grid", "area"] = "grid") -> list[tuple[World, ClosedLoop, ClosedLoop]]:
    """Worlds, with closed loops by tables and by searches."""
    made = [(one.world, one.starts, one.settings) for one in map(survey_world, SURVEYED)]
    for seed, (height, width, robots) in enumerate([(17, 19, 3), (9, 30, 6)]):
        pattern = ThreatPattern(("contiguous", "scattered")[seed], 5, seed=seed)
        world = random_world(height, width, pattern, obstacles=0.1)
        made.append((world, place_starts(world, robots)[0], Settings()))
    loops = []
    for world, starts, chosen in made:
        plan = allocated_plan(world, starts, replace(chosen, policy=policy, transit=transit))
        tabled, searched = (compile_closed_loop(plan, world, tabled=tabled) for tabled in (True, False))
        loops.append((world, tabled, searched))
    return loops


def worked(loop: ClosedLoop) -> Work:
    """The scratch of a thread that has run the rollouts."""
    runner = Runner(loop, SEED, ROLLOUTS)
    runner.run(0, ROLLOUTS, singles_of(loop, 0, 0))
    return runner.work


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_every_way_to_find_distances_leads_to_the_same_rollouts(policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    loops = planned(policy)
    for room in (2**28, 0):
        monkeypatch.setattr("planner.simulator.state.ROWS_BYTES", room)
        for way, limits in WAYS.items():
            far = rows = paths = replaced = 0
            for world, tabled, searched in loops:
                loop = limited(searched, *limits)
                assert run_range(loop, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0], (way, world)
                work = worked(loop)
                far += int(work.touched.max())
                rows += int((work.source_of >= 0).sum())
                paths += int(work.remembered[0]) - 1
                replaced += len(work.rows) == 2 and bool((work.source_of >= 0).all())
            if policy == "mrac":
                assert (far > 0) == (way != "near") and paths > 20
                assert (rows > 100 if room else replaced == len(loops)) if way == "rows" else rows >= 0
            else:
                assert rows > 100 if room else replaced > 3


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_what_earlier_calls_found_out_of_a_map_changes_no_rollout(policy: str) -> None:
    calls = (SEED, 0), (SEED + 1, 100), (SEED, 0)
    for world, tabled, searched in planned(policy):
        expected = [run_range(tabled, seed, first, 100)[0] for seed, first in calls]
        found = [
            (run_range(searched, seed, first, 100, threads=1)[0], KNOWN[searched][0].rows) for seed, first in calls
        ]
        assert [tally for tally, _ in found] == expected, world
        # They went on with the same rows, and what is known of one map alone is kept.
        assert found[0][1] is found[1][1] is found[2][1] and tabled not in KNOWN


@pytest.mark.parametrize("words", [0, 64, 512])
def test_room_for_coverage_paths_changes_no_rollout(words: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planner.simulator.state.REMEMBERED", words)
    for _, tabled, searched in planned("mrac"):
        assert run_range(searched, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0]


def test_legs_that_stay_in_their_area_are_not_remembered() -> None:
    for _, tabled, searched in planned("mrac", "area"):
        assert run_range(searched, SEED, 0, ROLLOUTS)[0] == run_range(tabled, SEED, 0, ROLLOUTS)[0]
        assert len(worked(searched).paths) == len(worked(tabled).paths) == 0


def test_a_path_of_more_moves_than_16_bits_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is found a leg at a time."""
    world = random_world(270, 270, ThreatPattern("scattered", seed=1), obstacles=0.11, threats=0.0)
    plan = allocated_plan(world, place_starts(world, 1)[0], Settings())
    loop = compile_closed_loop(plan, world)
    assert loop.first_state(8).home.dtype == np.uint16
    runner = Runner(loop, SEED, 1)
    tally = runner.run_one(0)
    assert runner.work.remembered[0] == 2
    monkeypatch.setattr("planner.simulator.state.REMEMBERED", 0)
    assert tally.tolist() == Runner(loop, SEED, 1).run_one(0).tolist()
    assert tally[2] > 2**16
