"""What cells are worth and show: closed forms and counts against enumeration and the readable simulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import load_fixture, worlds_with_starts
from doubt import expected, one_of
from hypothesis import given
from hypothesis import strategies as st
from test_analysis_control import fitted
from test_analysis_exact import fates_of

import mrac_jax as mrac
from analysis.estimators.trial import mean_value
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.value import ROWS, Units, found_chances, value_table
from analysis.sampling import RolloutChoices
from analysis.statistics.control_variate import LEAST
from analysis.statistics.differences import CommonLuck
from analysis.statistics.estimates import Estimate, tail_mean, times_to
from analysis.theory.exact import Worth, open_loop_found
from planner.errors import UsageError
from planner.formatting import percent
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import simulate
from planner.plan.plan import Plan
from planner.rollout_sampling import Luck
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.threshold_classes import CLASSES_A_NAT, luck_classes
from planner.settings import Settings
from planner.simulator.state import MOST_PASSES
from planner.tally import Tally
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

GRID = World.create([[0, 0.3, 0, 0.2], [0.4, np.nan, 0.1, 0], [0, 0.2, 0, 0.3]])
VALUE = np.array([[1, 5, 0, 2], [3, 9, 1, 1], [0.5, 4, 2, 7]])
DETECT = np.array([[0.5, 0.3, 1, 0.9], [0.8, 0.5, 0.2, 0], [0.25, 0.6, 0.4, 0.7]])


def survived_visits(world: World, plan: Plan, seed: int, rollout: int) -> np.ndarray:
    """int64 `[N]`, of one rollout of the readable simulator: entries of each cell that stopped nobody."""
    luck, passes = Luck(world, seed, rollout), np.zeros(world.threat.size, dtype=np.int64)

    def hit(robot: int, step: int, cell: int) -> bool:
        stopped = luck.hits(robot, step, cell)
        passes[cell] += not stopped
        return stopped

    assert plan.settings is not None
    simulate(prepare(world, plan.starts, plan.settings), plan.areas, hit=hit)
    return passes


@given(worlds_with_starts(most_side=4, most_robots=3), st.integers(0, 2**32 - 1))
def test_the_open_loop_s_chance_to_find_is_the_sum_over_every_luck(given_world, seed: int) -> None:
    world, starts = given_world
    detect = np.random.default_rng(seed).choice([0.0, 0.3, 0.8, 1.0], world.shape)
    world = world.with_values(detect=detect)
    plan = make_plan(world, starts)
    fates = [fates_of(robot, world.threat.ravel().astype(np.float64)) for robot in plan.robots]
    if np.prod([len(fate) for fate in fates]) > 2000:
        return
    found = np.zeros(world.threat.size)
    for combination in product(*fates):
        passes = np.zeros(world.threat.size, dtype=int)
        for _, _, cells, stopped in combination:
            for cell in cells[:-1] if stopped else cells:
                passes[cell] += 1
        missed = [float(np.prod([1 - d] * n)) for d, n in zip(detect.ravel(), passes, strict=True)]
        found += np.prod([chance for chance, *_ in combination]) * (1 - np.array(missed))
    np.testing.assert_allclose(open_loop_found(plan, world), found, rtol=0, atol=1e-9)


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
@pytest.mark.parametrize("robots", [1, 3])
def test_survived_visits_are_those_of_the_readable_simulator(policy: str, robots: int) -> None:
    """Of each rollout, so also of the ones that a set is parted into."""
    fixture = load_fixture("contiguous-14x23-1000-k8")
    world = fixture.world.with_values(np.arange(14 * 23).reshape(14, 23) % 5, 0.4)
    plan = make_plan(world, fixture.starts[:robots], Settings(policy=policy))
    units = Units.of(Worth.of(world))
    engine = make_engine(plan, world, Rolling(seed=3), "numba")
    tally, singles = engine.weighing(units.covered, units.found).run(0, 12)
    passes = np.array([survived_visits(world, plan, 3, rollout) for rollout in range(12)])
    assert passes.max() > 3
    at_least = [(passes >= times).sum(axis=0) for times in range(1, MOST_PASSES + 1)]
    assert np.array_equal(tally.passes.reshape(-1, MOST_PASSES), np.stack(at_least, axis=1))
    cells = np.arange(passes.shape[1])
    assert singles.worth_found.tolist() == units.found[cells, np.minimum(passes, MOST_PASSES)].sum(axis=1).tolist()
    plain = engine.tally(0, 12)
    assert plain.passes.size == 0
    for name, counts in plain.counts().items():
        assert np.array_equal(counts, getattr(tally, name)), name
    assert singles.worth_covered.sum() == (tally.covered_visited * units.covered).sum()


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_engines_count_survived_visits_alike(policy: str) -> None:
    """Also of rollouts that begin on the nominal run, or never leave it: a map of little danger."""
    fixture = load_fixture("contiguous-14x23-1000-k8")
    for scale in (1.0, 0.02):
        world = World.create(fixture.world.threat * np.float32(scale))
        world = world.with_values(np.arange(14 * 23).reshape(14, 23) % 5, 0.4)
        plan = make_plan(world, fixture.starts[:3], Settings(policy=policy))
        units = Units.of(Worth.of(world))
        runs = [
            make_engine(plan, world, Rolling(seed=4), name).weighing(units.covered, units.found).run(100, 700)
            for name in ("numba", "jax")
        ]
        (tally, singles), (other, theirs) = runs
        assert other == tally and other.passes.size == 14 * 23 * MOST_PASSES
        assert np.array_equal(singles.worth_found, theirs.worth_found)
        assert np.array_equal(singles.worth_covered, theirs.worth_covered)


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_the_closed_loop_against_every_pattern_of_hits(policy: str) -> None:
    """Value covered and found, each within 5 standard errors of what all runs together come to, exactly."""
    world = GRID.with_values(VALUE, DETECT)
    plan = make_plan(world, [[0, 0], [2, 3]], Settings(policy=policy))
    problem = prepare(world, plan.starts, plan.settings)

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        passes = np.zeros(12)

        def judge(robot: int, step: int, cell: int) -> bool:
            stopped = hit(robot, step, cell)
            passes[cell] += not stopped
            return stopped

        done = simulate(problem, plan.areas, hit=judge)
        return np.stack([done.visited, 1 - (1 - world.detect.ravel()) ** passes])

    visited, found = expected(play, one_of([world.threat.ravel()]))
    answer = evaluate(world, plan, RolloutChoices(rollouts=40_000, seed=11), band=False, advice=False)
    value = answer.outputs.get("value")
    assert value is not None and value.metrics == "coverage"
    for estimate, chance in ((value.covered, visited), (value.found, found)):
        truth = float(world.value.ravel() @ chance)
        assert abs(estimate.mean - truth) < 5 * estimate.se + 1e-9
    assert value.covered.half_width == 0, "of a tree the value covered is known, what is found is not"
    assert value.found.ci95[0] < value.found.mean < value.found.ci95[1]
    spread = np.sqrt(found * (1 - found) / 40_000)
    assert (np.abs(value.found_by_cell - found) <= 5 * spread + 1e-6).all()
    assert value.left.mean == pytest.approx(world.value.sum() - value.found.mean)


def test_the_remainder_holds_what_the_cap_leaves_out() -> None:
    """A corridor that is crossed again and again: more survived visits than are told apart."""
    rng, cells = np.random.default_rng(1), 40
    passes = rng.integers(0, 3 * MOST_PASSES, (500, cells))
    detect = rng.uniform(0.01, 1.0, cells)
    at_least = np.stack([(passes >= times).sum(axis=0) for times in range(1, MOST_PASSES + 1)], axis=1)
    zeros = {name: np.zeros(cells, np.int64) for name in Tally.axes()}
    counts = zeros | {"visits": passes.sum(axis=0) + 7, "stops": np.full(cells, 7), "passes": at_least.ravel()}
    tally = Tally("t", (1, cells), ((0, 500),), **counts)
    worth = Worth(np.ones(cells), detect)
    found, rest = found_chances(tally, worth)
    truth = (1 - (1 - detect) ** passes).mean(axis=0)
    assert (truth <= found + 1e-12).all() and (found.sum() - rest) <= truth.sum()
    assert (found - truth).sum() < 0.5 * rest  # nearer than without what is beyond the cap


def test_where_nothing_is_said_of_values_nothing_is_told() -> None:
    plan = make_plan(GRID, [[0, 0]])
    answer = evaluate(GRID, plan, RolloutChoices(rollouts=512), band=False)
    assert answer.outputs.get("value") is None
    asked = evaluate(GRID, plan, RolloutChoices(rollouts=512), band=False, value="search").outputs.get("value")
    assert asked is not None
    # each cell is worth 1, and is found; of one robot all of it is known
    assert asked.covered.mean == pytest.approx(answer.closed_form.visited, rel=1e-9)
    assert asked.found.mean == pytest.approx(answer.closed_form.survived, rel=1e-9)
    with pytest.raises(UsageError, match="metrics='finding'"):
        evaluate(GRID, plan, RolloutChoices(rollouts=512), value="finding")


def test_search_and_clearance_are_the_same_numbers_in_other_words() -> None:
    world = mrac.load(GRID.threat, value=VALUE / 50, detect=DETECT, route=[[0, 2], [2, 2]])
    plan = make_plan(world, [[0, 0], [2, 3]])
    answer = mrac.evaluate(world, plan, loop="open", rollouts=4096, band=False, metrics="search")
    value = answer.outputs.get("value")
    assert value is not None and value.metrics == "search"
    said = value.as_json()
    found, shares = open_loop_found(plan, world), world.value.ravel()
    assert said["search"]["success"] == pytest.approx(shares @ found)  # chances: they add up to less than 1
    assert said["search"]["success"] == pytest.approx(said["search"]["containment"] * said["search"]["detection"])
    assert said["clearance"]["cleared"] == pytest.approx(shares @ found / shares.sum())
    left = (shares * (1 - found))[[2, 6, 10]]
    shown = {name: figure for name, figure, _ in ROWS["search"](value)}
    assert shown["chance that it lies on the route and is not found"] == percent(left.sum(), 2)
    assert said["clearance"]["route"] == {"remaining": left.sum(), "risk": [left.max(), left.sum()]}
    assert said["covered"]["ci95"] == [said["covered"]["mean"]] * 2
    assert [chance["mean"] for chance in said["robots_left"]] == pytest.approx(
        [1 - answer.closed_form.alive_chance[0], answer.closed_form.alive_chance[2]]
    )


def test_the_worst_runs_and_the_time_to_a_share() -> None:
    assert tail_mean(np.ones(100, dtype=np.int64)) == pytest.approx((0 + 1 + 2 + 3 + 4) / 5)  # the worst in twenty
    counts = np.array([1, 2, 0, 17])
    assert tail_mean(counts, 0.05) == 0.0
    assert tail_mean(counts, 0.1) == pytest.approx((0 + 1) / 2)
    assert tail_mean(counts, 0.175) == pytest.approx((0 + 1 + 1 + 1.5) / 3.5)
    assert tail_mean(counts, 1.0) == pytest.approx((2 + 51) / 20)
    fixture = load_fixture("contiguous-14x23-1000-k2")
    tally = make_engine(make_plan(fixture.world, fixture.starts), fixture.world, Rolling(), "numba").tally(0, 256)
    curve = np.cumsum(tally.new_visited) / 256 / tally.accessible
    for share, step in times_to(tally, (0.1, 0.25, 1.0)).items():
        assert (step is None and curve[-1] < share) or curve[step] >= share > curve[step - 1]


@pytest.mark.parametrize("loop", ["closed", "open"])
def test_size_and_front_tell_the_value_that_evaluate_tells(loop: str) -> None:
    """Of the same rollouts; nothing else of what they say depends on it."""
    plain = World.create(np.where(np.arange(24).reshape(4, 6) % 5 == 4, 0.2, 0.0), [[0, 0], [3, 5]])
    value, rollouts = np.arange(24.0).reshape(4, 6), 2000
    how: dict[str, Any] = {"rollouts": rollouts, "exact": "never"}
    world = plain.with_values(value)

    def told(robots: int, **settings: object) -> float:
        team = world.with_starts(plain.starts[:robots])  # type: ignore[index]
        plan = mrac.plan(team, **settings)  # type: ignore[arg-type]
        answer = mrac.evaluate(team, plan, **how, loop=loop, bound=False)  # type: ignore[arg-type]
        return float(answer.outputs["value"].covered.mean / value.sum())

    sizes = {each.value is None: mrac.size(each, target=0.99, **how, loop=loop) for each in (world, plain)}
    for point in sizes[False].points:
        if point.rollouts:  # of one robot alone `evaluate` knows it
            near = 1e-9 if point.robots > 1 or loop == "open" else 5 * (point.value.se if point.value else 0.0)
            assert point.value is not None and point.value.mean == pytest.approx(told(point.robots), abs=near)
    curves = [[{**one, "value": 0} for one in size.to_json()["curve"]] for size in sizes.values()]
    assert curves[0] == curves[1] and any(point.rollouts for point in sizes[False].points)
    if loop == "closed":
        fronts = [mrac.front(each, **how, worths=(5.0,), reserves=()) for each in (world, plain)]
        whole = next(point for point in fronts[0].points if point.setting == ("mrac", None, None, None))
        assert whole.value is not None and whole.value.mean == pytest.approx(told(2), abs=1e-9)
        assert all("value" in one for one in fronts[0].to_json()["points"]) and fronts[0].notes
        assert not any("value" in one for one in fronts[1].to_json()["points"]) and not fronts[1].notes


def test_what_many_passes_find_is_aimed_at_not_bounded_from_below() -> None:
    """Twelve passes of a cell, each survived with .98, each finds with .05: the mean is that of all twelve."""
    runs, d, reached = 10**9, 0.05, 0.98 ** np.arange(1, 13)
    passes = np.rint(runs * reached).astype(np.int64)
    stops = runs - passes[-1]
    tally = SimpleNamespace(
        passes=passes[:MOST_PASSES],
        visits=np.array([passes.sum() + stops]),
        stops=np.array([stops]),
        rollouts=runs,
    )
    found, rest = found_chances(tally, Worth(np.ones(1), np.array([d])))  # type: ignore[arg-type]
    truth = d * (reached @ (1 - d) ** np.arange(12))
    assert rest > 0.02 and found[0] - rest < truth - 0.02
    assert truth <= found[0] < truth + 0.02 * rest


def test_counts_leave_nothing_over_and_totals_are_in_their_intervals() -> None:
    """Where no cell is passed more than eight times the remainder is 0, not -8e-18."""
    often = -np.sort(-np.random.default_rng(0).integers(0, 300, size=(200, MOST_PASSES)), axis=1)
    tally = SimpleNamespace(passes=often.ravel(), visits=often.sum(axis=1) + 7, stops=np.full(200, 7), rollouts=300)
    assert found_chances(tally, Worth(np.ones(200), np.full(200, 0.3)))[1] == 0  # type: ignore[arg-type]
    total = 0.7
    short, over = (mean_value(np.full(100, 2**40 + units), total, 50, certain=False) for units in (-20, 20))
    assert short.ci95[1] == total and over.mean <= total  # each cell's units are rounded


def valued(kind: Kind, seed: int, robots: int, policy: str = "mrac", side: int = 20) -> tuple[World, Plan]:
    """A random world whose cells are worth and show all sorts of things, and its plan."""
    plain = random_world(side, side, ThreatPattern(kind, seed=seed))
    draws = np.random.default_rng(1)
    value, detect = draws.exponential(size=plain.shape), draws.uniform(0.2, 0.9, size=plain.shape)
    world = plain.with_values(value, detect)
    return world, make_plan(world, place_starts(world, robots)[0], Settings(policy=policy))


def means(world: World, plan: Plan, seed: int, samples: int = 1) -> list[list[Estimate]]:
    """Value covered and found (up to MOST_PASSES visits), as `evaluate` states them: of so many times 1,024 rollouts,
    one after the other, and of them all."""
    units, robots = Units.of(Worth.of(world)), len(plan.robots)
    engine = make_engine(plan, world, Rolling(seed=seed), "numba").weighing(units.covered, units.found)
    results, classes = engine.results(0, samples * LEAST), luck_classes(seed, 0, samples * LEAST, robots)
    told = []
    for own in [*(slice(start, start + LEAST) for start in range(0, samples * LEAST, LEAST)), slice(None)]:
        pairs = [(column[own], classes[own]) for column in (results.worth_covered, results.worth_found)]
        lucks = [CommonLuck.of(robots, luck, column, column) for column, luck in pairs]
        told.append(
            [
                mean_value(x, units.worth.total, world.threat.size, False, y)
                for (x, _), y in zip(pairs, lucks, strict=True)
            ]
        )
    return told


def test_value_is_put_right_by_luck() -> None:
    """Least squares over single rollouts gives the same means and errors, with less spread than without."""
    world, plan = valued("contiguous", 0, 8)
    units = Units.of(Worth.of(world))
    results = make_engine(plan, world, Rolling(seed=3), "numba").weighing(units.covered, units.found).results(0, LEAST)
    total = (luck_classes(3, 0, LEAST, 8) + 0.5) / CLASSES_A_NAT
    for found, column in zip(means(world, plan, 3)[0], (results.worth_covered, results.worth_found), strict=True):
        value = column / 2**40 * Worth.of(world).total
        mean, error, _ = fitted(value, total, 8)
        assert (found.mean, found.se) == (pytest.approx(mean, rel=1e-7), pytest.approx(error, rel=1e-5))
        assert found.se < 0.8 * value.std() / np.sqrt(LEAST)
    answer = evaluate(world, plan, RolloutChoices(seed=3, rollouts=LEAST), bound=False).outputs["value"]
    assert answer.covered == means(world, plan, 3)[0][0]


VALUED = [*enumerate(product((2, 4, 8, 12, 20), ("contiguous", "scattered")))]
CELLS = [(*world, figure) for world in VALUED for figure in ("covered", "found")]


@cache
def sampled(seed: int, robots: int, kind: Kind) -> list[list[Estimate]]:
    """Covered and found, of 1,000 samples of 1,024 rollouts and of them all; worlds 4 and 5 by `per_cell`."""
    world, plan = valued(kind, seed, robots, "per_cell" if seed in (4, 5) else "mrac", side=14)
    return means(world, plan, seed, 1000)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "team", "figure"), CELLS)
def test_intervals_of_value_hold(seed: int, team: tuple[int, Kind], figure: str) -> None:
    """.925 of the samples or more hold the mean of them all."""
    *found, whole = [one[figure == "found"] for one in sampled(seed, *team)]
    assert np.mean([one.ci95[0] <= whole.mean <= one.ci95[1] for one in found]) >= 0.925


@pytest.mark.parametrize("detect", [0.5, 1.0])
def test_what_a_tree_knows_is_what_the_value_table_says(detect: float) -> None:
    """Value covered, losses and robots left are exact where the closed loop is; of one robot all of it."""
    world = GRID.with_values(VALUE, np.full(GRID.shape, detect))
    answer = mrac.evaluate(world, mrac.plan(world, 2), rollouts=400, metrics="coverage", advice=False)
    found, known = answer.outputs["value"], answer.to_json()["exact"]["closed_loop"]
    assert known["how"] == "tree"
    assert found.robots_left[0].mean == pytest.approx(known["some_left"]) and found.robots_left[0].half_width == 0
    assert found.losses.mean == pytest.approx(known["losses"]) and found.covered.half_width == 0
    assert (found.found.half_width == 0) == (detect == 1)
    sampled = Units.of(Worth.of(world)).covered @ answer.tally.covered_visited / 400 * found.worth.total / 2**40
    assert abs(found.covered.mean - sampled) < 5 * found.worth.total / 2 / np.sqrt(400)
    rows = dict(zip(*(list(column.cells) for column in value_table(found).columns[:2]), strict=True))
    assert rows["chance that at least 1 robot is left"] == percent(known["some_left"], 2)
    assert {"m2 covered per robot lost", "value covered per robot lost"} <= set(rows)
