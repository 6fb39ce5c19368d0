"""Formulas, bounds and exact values against enumeration, rollouts and independent solvers."""

import signal
from fractions import Fraction
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture, worlds_with_starts
from drawn_worlds import tiny_world
from hypothesis import given
from oracle_enumeration import best_of_one_robot, best_that_comes_home
from oracle_tree import closed_loop_exact
from test_house import imports_of

import mrac_jax as mrac
from analysis.checking.report import check_report
from analysis.cli.app import run
from analysis.evaluation.evaluate import Evaluation
from analysis.evaluation.report import remainder_text
from analysis.evaluation.report import report as evaluation_report
from analysis.report.result import print_report
from analysis.theory import bounds as theory_bounds
from analysis.theory import flow_programme as single
from analysis.theory import upper_bound
from analysis.theory.bounds import CorrectedTheorem3, all_bounds, corrected_theorem3, ideal_connected, until_first_loss
from analysis.theory.exact import open_loop_exact, poisson_binomial
from analysis.theory.flow_programme import contract, missing_ways, optimum, way_within
from analysis.theory.upper_bound import Dual, Programme, any_strategy, certified, flow_bound, most_stopped, value_bound
from analysis.utils.tables import as_text
from planner.errors import PlanError
from planner.make_plan import allocated_plan, make_plan
from planner.plan.plan import Plan, RobotPlan, entries
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# The closed form and the paper's formulas against the fixtures, brute force, and each other.


NEAR = 1e-9


def test_closed_form_and_every_formula_are_the_fixtures(fixture: Fixture) -> None:
    """The plan fed with the fixture's allocation and, for one robot, the planner's own."""
    known, near = fixture.answers, {"rel": 0, "abs": NEAR}
    own = [make_plan(fixture.world, fixture.starts)] if len(fixture.starts) == 1 else []
    for plan in (fixture.plan, *own):
        exact, bounds = open_loop_exact(plan, fixture.world), all_bounds(plan, fixture.world)
        for found, wanted in (
            ((exact.visited, exact.survived), map(known["open_loop_exact"].get, ("visited", "survived"))),
            ((bounds.ideal_eq7, bounds.ideal_team), map(known.get, ("ideal_eq7", "ideal_team"))),
            ((bounds.eq2_printed, bounds.team_survival), map(known["eq2"].get, ("printed", "team_survival"))),
        ):
            assert found == pytest.approx(tuple(wanted), **near)
        for gain, one in zip(bounds.eq4, known["eq4"], strict=True):
            assert (gain.visited, gain.survived) == pytest.approx((one["visited"], one["survived"]), **near)
        for bound, one in zip(bounds.eq5, known["eq5"], strict=True) if "eq5" in known else ():
            assert (bound.printed, bound.with_c00) == pytest.approx((one["printed"], one["with_c00"]), **near)
        for meaning in ("visited", "survived"):
            assert vars(getattr(bounds, f"theorem3_{meaning}")) == pytest.approx(known["theorem3"][meaning], **near)


def test_eq5_with_c00_counts_the_ways_that_were_given_up_before_the_first_area() -> None:
    """Robot 2 turns back twice; one way leads through p = .3, and its area of one cell is left with p = .9 passed."""
    world = World.create([[0.9, 0, 0.3], [0, 0.5, 0.3], [0.3, 0, 0.1]])
    plan = make_plan(world, [(1, 0), (0, 1), (1, 0)], Settings(policy="per_cell"))
    kinds = [leg.kind for leg in plan.robots[2].legs]
    assert kinds.index("cover") > 1  # several ways before the first area
    assert all_bounds(plan, world).eq5[2].with_c00 == pytest.approx(1 + 0.7 * 0.1)


@given(worlds_with_starts(most_side=4, most_robots=3))
def test_closed_form_is_the_sum_over_every_luck(given_world: tuple[World, np.ndarray]) -> None:
    """Exhaustive enumeration: every combination of the entry at which each robot is stopped."""
    world, starts = given_world
    plan = make_plan(world, starts)
    threat = world.threat.ravel().astype(np.float64)
    fates = [fates_of(robot, threat) for robot in plan.robots]
    if np.prod([len(f) for f in fates]) > 3000:
        return
    exact = open_loop_exact(plan, world)
    expected, curve = np.zeros(3), np.zeros(plan.makespan + 1)
    for combination in product(*fates):
        chance = float(np.prod([fate[0] for fate in combination]))
        reached: dict[int, int] = {}
        for _, steps, cells, _ in combination:
            for step, cell in zip(steps, cells, strict=True):
                reached[cell] = min(step, reached.get(cell, step))
        passed = {cell for _, _, cells, stopped in combination for cell in (cells[:-1] if stopped else cells)}
        last = max(int(steps[-1]) for _, steps, _, _ in combination)
        expected += chance * np.array([len(reached), len(passed), last])
        for step in reached.values():
            curve[step:] += chance
    assert [exact.visited, exact.survived, exact.mean_time] == pytest.approx(expected.tolist(), abs=1e-9)
    np.testing.assert_allclose(exact.visited_curve, curve, rtol=0, atol=1e-9)


def fates_of(robot: RobotPlan, threat: np.ndarray) -> list[tuple[float, list[int], list[int], bool]]:
    """(chance, steps entered, cells entered, stopped at the last?) of every way a robot's run can go."""
    steps = entries(robot.path)
    cells = robot.path[steps]
    fates, alive = [], 1.0
    for index, cell in enumerate(cells):
        if threat[cell] > 0:
            fates.append((alive * threat[cell], steps[: index + 1].tolist(), cells[: index + 1].tolist(), True))
            alive *= 1.0 - threat[cell]
    return [*fates, (alive, steps.tolist(), cells.tolist(), False)]


def paths(world: World, *cells: list[int]) -> Plan:
    return Plan(world.shape, world.sha256, None, tuple(RobotPlan(np.array(path)) for path in cells))


def test_equation_2_as_printed_is_not_the_team_s_survival() -> None:
    """Two robots, p = .5, two steps: printed .5625, truth .4375."""
    world = World.create(np.full((2, 2), 0.5))
    bounds = all_bounds(paths(world, [0, 1], [2, 3]), world)
    assert (bounds.eq2_printed, bounds.team_survival) == pytest.approx((0.5625, 0.4375))
    assert bounds.theorem3_visited is bounds.eq5[0].printed is None


def test_per_cell_values_add_up() -> None:
    fixture = load_fixture("contiguous-14x23-1001-k8")
    exact = open_loop_exact(make_plan(fixture.world, fixture.starts), fixture.world)
    for found, whole in (
        (exact.visited_curve[-1], exact.visited), (exact.survived_curve[-1], exact.survived),
        (exact.stops_by_cell.sum(), exact.expected_losses), (exact.time_chance.sum(), 1.0),
        (exact.alive_chance @ np.arange(9), exact.survival.sum()),
    ):  # fmt: skip
        assert found == pytest.approx(whole, abs=1e-9)
    assert exact.by_deadline(10**6) == pytest.approx((exact.visited, exact.survived))
    assert exact.by_deadline(0)[0] == pytest.approx(len(np.unique(fixture.starts, axis=0)))


def test_a_waiting_robot_is_hit_once() -> None:
    world = World.create([[0.5, 0.0]])
    exact = open_loop_exact(paths(world, [0, 0, 0, 1]), world)
    assert exact.visited == pytest.approx(1.5) and exact.visited_curve.tolist() == [1.0, 1.0, 1.0, 1.5]


def test_ideal_of_a_team_counts_hits_over_the_poisson_binomial() -> None:
    threat = np.array([0.0, 0.2, 0.5, 0.3])
    ordered = np.sort(threat)
    for robots in (1, 2, 3):
        direct = sum(poisson_binomial(ordered[:j])[:robots].sum() for j in range(4))
        assert theory_bounds.ideal_team(threat, robots) == pytest.approx(direct)


def test_chances_below_what_1_minus_a_product_can_hold_are_kept() -> None:
    """Two robots on 17 cells of p = .9 each: each survives with 1e-17, of which 1 - (1 - 1e-17)^2 keeps nothing."""
    world, q = World.create(np.full((2, 18), 0.9, dtype=np.float32)), 1 - float(np.float32(0.9))
    apart, both = (paths(world, list(range(17)), list(range(first, first + 17))) for first in (18, 0))
    exact, reach = open_loop_exact(apart, world), theory_bounds.reach_chances(world, [[0, 0], [0, 0]])
    for found, chance in (
        (exact.some_left, 2 * q**17), (all_bounds(apart, world).team_survival, 2 * q**17),
        (exact.visited_by_cell[16], q**16), (open_loop_exact(both, world).visited_by_cell[16], 2 * q**16),
        (reach[17], 2 * q**17), (reach[0], 1),
    ):  # fmt: skip
        assert found == pytest.approx(chance, rel=1e-9)


def test_losses_by_a_step_add_up_to_those_of_the_run() -> None:
    world = World.create([[0.0, 0.2, 0.1], [0.3, 0.0, 0.4]])
    plan = make_plan(world, [[0, 0], [1, 1]])
    exact = open_loop_exact(plan, world)
    assert exact.losses_by(10**6) == pytest.approx(exact.expected_losses) and exact.losses_by(0) == 0
    first = [plan.robots[k].path[1] for k in (0, 1)]
    assert exact.losses_by(1) == pytest.approx(sum(float(world.threat.ravel()[cell]) for cell in first))


def test_theorem_3_counts_the_start_of_a_robot_that_never_moves() -> None:
    """Four robots, one area of three cells: three of them stay where they start, and C (travel) has all four starts."""
    world = World.create(np.zeros((1, 3)))
    plan = make_plan(world, [[0, 0], [0, 0], [0, 1], [0, 2]])
    entered = [len(np.unique(robot.path)) for robot in plan.robots]
    theorem, two = (all_bounds(one, world) for one in (plan, make_plan(world, [[0, 0], [0, 0]])))
    found, alone = theorem.theorem3_visited, sum(entered)
    assert entered.count(1) >= 3 and (found.travel_multiset, found.travel_set) == (alone - 4, alone - 3)
    assert (two.theorem3_survived.travel_multiset, two.theorem3_survived.travel_set) == (3 + 1 - 2, 3 + 1 - 1)


# Our own bounds against exact values, enumeration, the best of all strategies, rollouts, and numbers made by hand.


def in_order(bound: CorrectedTheorem3, truth: float) -> bool:
    return bound.count <= bound.largest + NEAR and bound.largest <= bound.spread + NEAR and bound.spread <= truth + NEAR


# --- Theorem 3, mended ---


def test_theorem_3_mended_holds_on_every_fixture(fixture: Fixture) -> None:
    bound, truth = corrected_theorem3(fixture.plan, fixture.world), fixture.answers["open_loop_exact"]
    for meaning in ("visited", "survived"):
        found = getattr(bound, meaning)
        assert in_order(found, truth[meaning])
        assert fixture.answers["k"] > 2 or found.spread == pytest.approx(truth[meaning], abs=NEAR)


@given(worlds_with_starts())
def test_theorem_3_mended_holds_on_random_worlds(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    plan = make_plan(world, starts)
    bound, truth = corrected_theorem3(plan, world), open_loop_exact(plan, world)
    assert in_order(bound.visited, truth.visited) and in_order(bound.survived, truth.survived)
    on_path = [cell for robot in plan.robots for cell in np.unique(robot.path)]
    shared = len(on_path) - len(np.unique(on_path))
    expected = sum(alone.visited for alone in all_bounds(plan, world).eq4) - shared
    assert bound.visited.count == pytest.approx(expected, abs=NEAR)
    assert shared > 0 or bound.visited.count == pytest.approx(truth.visited, abs=NEAR)


def test_theorem_3_mended_by_hand() -> None:
    """Three robots through the cells 0 and 2 (p = .5) to cell 1; E(R) = 2, 2, 1.5; cell 1 has chances .5, .5, .5."""
    world = World.create([[0.5, 0.0, 0.5]])
    plan = paths(world, [0, 1], [0, 1], [2, 1])
    bound = corrected_theorem3(plan, world)
    # visited: cell 0 twice for certain, cell 1 three times with chance .5
    assert bound.visited == CorrectedTheorem3(count=4.5 - 1 - 2, largest=4.5 - 1 - 1, spread=2 + 1 - 0.5**3)
    assert bound.visited.spread == open_loop_exact(plan, world).visited == 2.875
    # survived: cell 0 with .5 and .5, cell 1 with .5 three times, cell 2 with .5
    assert bound.survived == CorrectedTheorem3(count=3 - 1 - 2, largest=3 - 0.5 - 1, spread=0.75 + 0.875 + 0.5)


def test_theorem_3_mended_is_short_only_where_the_others_differ() -> None:
    """One cell with chances 1/2, 1/2, 1/4: 1 - 1/2 (1 - 3/8)^2 for the truth, 1 - 1/2 * 1/2 * 3/4."""
    world = World.create([[0.5, 0.0, 0.5], [0.75, 0.0, 0.0]])
    plan = paths(world, [0, 1], [2, 1], [3, 4, 1])
    expected, on_cell_1 = 2 * 1.5 + 1.5, 1.25
    assert corrected_theorem3(plan, world).visited.spread == expected - (on_cell_1 - (1 - 0.5 * 0.625**2))
    assert open_loop_exact(plan, world).visited == expected - (on_cell_1 - (1 - 0.5 * 0.5 * 0.75))


def test_without_threats_every_form_counts_the_cells() -> None:
    world = World.create(np.zeros((3, 5)))
    plan = make_plan(world, [[0, 0], [0, 0], [2, 4]])
    bound = corrected_theorem3(plan, world)
    assert bound.visited == bound.survived == CorrectedTheorem3(15.0, 15.0, 15.0)


# --- until the first loss ---


def test_until_the_first_loss_by_hand() -> None:
    """Robot 0 enters cells 0, 1 (p = .5), 2; robot 1 cells 5, 4 (p = .25), 3, acting second in each step."""
    world = World.create([[0.0, 0.5, 0.0], [0.0, 0.25, 0.0]])
    bound = until_first_loss(paths(world, [0, 1, 2], [5, 4, 3]), world)
    assert bound.visited == 1 + 1 + 1 + 0.5 + 0.375 + 0.375
    assert bound.survived == 1 + 1 + 0.5 + 0.375 + 0.375 + 0.375


def test_until_the_first_loss_is_below_both_loops(fixture: Fixture) -> None:
    bound, answers = until_first_loss(fixture.plan, fixture.world), fixture.answers
    for meaning in ("visited", "survived"):
        found = getattr(bound, meaning)
        for key in {"open_loop_exact", "closed_loop_exact"} & set(answers):
            assert found <= answers[key][meaning] + NEAR
        assert answers["k"] > 1 or found == pytest.approx(answers["open_loop_exact"][meaning], abs=NEAR)


# --- the ideal of a map ---


def test_ideal_of_a_map_by_hand() -> None:
    world, walled = World.create([[0.0, 0.5, 0.0]]), World.create([[0.0, np.nan, 0.0]])
    for of, starts, chances in (
        (world, [[0, 0]], [1, 1, 0.5]), (world, [[0, 0], [0, 0]], [1, 1, 0.75]), (world, [[0, 0], [0, 2]], [1, 1, 1]),
        (world, [[0, 1], [0, 0]], [1, 1, 0.75]),  # the start's own threat counts
        (walled, [[0, 0]], [1, 0, 0]),
    ):  # fmt: skip
        assert theory_bounds.reach_chances(of, starts).tolist() == chances
    assert ideal_connected(world, [[0, 0]]) == 2.5  # what the only path attains
    assert theory_bounds.ideal_team(world.threat.ravel().astype(np.float64), 1) == 3
    assert ideal_connected(walled, [[0, 0]]) == 1


@given(worlds_with_starts())
def test_ideal_of_a_map_is_between_open_loop_and_that_of_the_team(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    plan = make_plan(world, starts)
    bound, exact, paper = ideal_connected(world, starts), open_loop_exact(plan, world), all_bounds(plan, world)
    assert exact.survived - NEAR <= exact.visited <= bound + NEAR <= paper.ideal_team + 2 * NEAR
    assert len(starts) > 1 or paper.ideal_team == paper.ideal_eq7
    assert (exact.visited_by_cell <= theory_bounds.reach_chances(world, starts) + NEAR).all()


@pytest.mark.parametrize("robots", [1, 2])
@pytest.mark.parametrize("seed", range(6))
def test_ideal_of_a_map_bounds_the_best_strategy(seed: int, robots: int) -> None:
    world = World.create(np.random.default_rng(seed).choice([0.0, 0.0, 0.3, 0.6, np.nan], (2, 3)))
    free = np.argwhere(~np.isnan(world.threat))
    starts = free[np.arange(robots) % len(free)]
    best = best_strategy(world, starts)
    assert best <= ideal_connected(world, starts) + NEAR
    assert open_loop_exact(make_plan(world, starts), world).visited <= best + 1e-6


def best_strategy(world: World, starts: np.ndarray) -> float:
    """Expected cells visited by the best adaptive strategy, one robot moving at a time: value iteration from below."""
    threat, cells = world.threat.ravel().astype(np.float64), world.threat.size
    free = [cell for cell in range(cells) if not np.isnan(threat[cell])]
    near = [
        [b for b in range(cells) if abs(a // 3 - b // 3) + abs(a % 3 - b % 3) == 1 and not np.isnan(threat[b])]
        for a in range(cells)
    ]
    dead = cells
    places = [sorted(place) for place in product(range(cells + 1), repeat=len(starts))]
    seen_cells = [sum(1 << cell for cell in some) for n in range(len(free), -1, -1) for some in combinations(free, n)]
    alive = [tuple(place) for place in places if {dead, *free} >= {*place}]
    value = {(mask, place): 0.0 for mask in seen_cells for place in alive}

    def enter(mask: int, place: tuple[int, ...], robot: int, cell: int) -> float:
        seen = mask | 1 << cell
        alive, lost = (tuple(sorted((*place[:robot], to, *place[robot + 1 :]))) for to in (cell, dead))
        found = float(seen != mask)
        return found + (1 - threat[cell]) * value[seen, alive] + threat[cell] * value[seen, lost]

    moves = {place: [(i, to) for i, at in enumerate(place) if at != dead for to in near[at]] for place in alive}
    for mask in seen_cells:  # what is seen only grows: from everything to nothing
        gain = 1.0
        while gain > 1e-12:
            better = {place: max([enter(mask, place, *move) for move in moves[place]], default=0.0) for place in alive}
            gain = max(better[place] - value[mask, place] for place in alive)
            value |= {(mask, place): better[place] for place in alive}
    expected = 0.0
    own = [int(row * 3 + col) for row, col in starts]
    for fates in product([False, True], repeat=len(own)):
        chance = float(np.prod([threat[c] if lost else 1 - threat[c] for c, lost in zip(own, fates, strict=True)]))
        place = tuple(sorted(dead if lost else c for c, lost in zip(own, fates, strict=True)))
        expected += chance * value[sum(1 << c for c in set(own)), place]
    return expected + len(set(own))


def test_until_the_first_loss_with_a_walled_off_robot() -> None:
    """Robot 0 may be lost (p = .5) as it steps onto cell 1 at t = 1, when robot 1, walled off, has not moved yet."""
    world = World.create([[0.0, 0.5, 0.0], [np.nan] * 3, [0.0] * 3, [np.nan, np.nan, 0.0]])
    first = until_first_loss(make_plan(world, [[0, 0], [2, 0]]), world)
    assert first.visited == 0.5 * 3 + 0.5 * 7


# The tree of everything that can happen against the fixtures' enumeration, runs from the start, and rollouts.

QUICK = ("tiny", "contiguous-14x23-1001", "scattered-20x20-1001-k1")
ENUMERATED_TREE = [
    pytest.param(name, marks=() if name.startswith(QUICK) else pytest.mark.slow)
    for name in NAMES
    if "closed_loop_exact" in load_fixture(name).answers
]


@pytest.mark.parametrize("name", ENUMERATED_TREE)
def test_enumeration_is_the_fixtures(name: str) -> None:
    fixture = load_fixture(name)
    found = closed_loop_exact(fixture.plan, fixture.world)
    for key, value in fixture.answers["closed_loop_exact"].items():
        assert getattr(found, key) == pytest.approx(value, rel=0, abs=1e-9), key
    for key in ("visited", "survived", "alive", "time"):
        chance = getattr(found, f"{key}_chance")
        assert chance.sum() == pytest.approx(1.0, abs=1e-9)
        assert chance @ np.arange(len(chance)) == pytest.approx(getattr(found, key), abs=1e-9)


def test_plans_that_have_no_closed_loop_are_refused() -> None:
    world = World.create([[0.0, 0.1]])
    with pytest.raises(PlanError, match="another map"):
        closed_loop_exact(make_plan(world, [[0, 0]]), World.create([[0.0, 0.2]]))


def test_the_oracles_see_no_engine() -> None:
    """`test_house` looks at those of `analysis.theory`."""
    for path in Path(__file__).parent.glob("oracle_*.py"):
        engines = ("planner.mrac", "planner.rollouts", "planner.simulator", "mrac_jax", "jax")
        seen = {module for module in imports_of(path) if not module.startswith("planner.simulator.codes")}
        assert not [module for module in seen if module.startswith(engines)]


# The bound for every strategy: above the optimum, above what is sampled, and proven whatever the solver says.


def test_optimum_of_a_corridor() -> None:
    """Two robots before a door of p: the second goes only if the first is lost, and the room behind counts 3 cells."""
    world = World.create([[0.0, 0.4, 0.0, 0.0, 0.0]])
    p = float(np.float32(0.4))
    assert optimum(world, [[0, 0]]) == pytest.approx(2 + 3 * (1 - p))
    assert optimum(world, [[0, 0], [0, 0]]) == pytest.approx(2 + 3 * (1 - p * p))
    assert optimum(world, [[0, 0]] * 3) is None
    assert optimum(World.create(np.full((5, 5), 0.1)), [[0, 0]]) is None


def test_optimum_ends_where_next_to_nothing_is_dangerous() -> None:
    """Who goes round among such cells gained by rounding, over and over."""

    def too_long(*_: object) -> None:
        raise TimeoutError

    usual = signal.signal(signal.SIGPROF, too_long)
    signal.setitimer(signal.ITIMER_PROF, 20)
    try:
        best = optimum(World.create(np.full((3, 3), 1e-12)), [[0, 0], [0, 0]])
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, usual)
    assert best is not None and 9 - 1e-9 < best <= 9


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("robots", [1, 2])
def test_no_policy_is_above_the_optimum_and_no_bound_below_it(seed: int, robots: int) -> None:
    world, starts = tiny_world(seed, 2, 4), [[0, 0]] * robots
    best, bound = optimum(world, starts), any_strategy(world, starts)
    assert robots == 2 or best == pytest.approx(best_of_one_robot(world), abs=1e-12)
    assert closed_loop_exact(make_plan(world, starts), world).visited <= best + 1e-9
    assert best <= min(bound.cells, bound.connected, bound.ideal) + 1e-9 and best <= bound.flow


@pytest.mark.parametrize(("kind", "robots"), [("contiguous", 1), ("contiguous", 8), ("scattered", 4)])
def test_sharper_than_the_ideals_and_above_what_is_sampled(kind: str, robots: int) -> None:
    world = random_world(pattern=ThreatPattern(kind=kind, seed=0))  # type: ignore[arg-type]
    starts = place_starts(world, robots)[0]
    bound = any_strategy(world, starts)
    assert bound.cells == bound.flow < bound.connected - 5 < bound.ideal
    tally = make_engine(make_plan(world, starts), world, Rolling()).tally(0, 2000)
    assert tally.visited @ np.arange(len(tally.visited)) / 2000 < bound.cells


@pytest.mark.slow
def test_the_bound_is_never_below_what_is_sampled_on_1000_worlds() -> None:
    draw = np.random.default_rng(2)
    for seed in range(1000):
        kind = ("contiguous", "scattered")[seed % 2]
        world = random_world(9, 10, ThreatPattern(kind=kind, areas=5, seed=seed), threats=draw.uniform(0.05, 0.4))  # type: ignore[arg-type]
        starts = place_starts(world, int(draw.integers(1, 13)))[0]
        tally = make_engine(allocated_plan(world, starts, Settings()), world, Rolling()).tally(0, 2000)
        values = np.arange(len(tally.visited))
        mean = tally.visited @ values / 2000
        spread = tally.visited @ values**2 / 2000 - mean**2
        error = np.sqrt(max(spread, 1 / 2000) / 2000)  # where all came to the same, one may still differ by a cell
        assert mean - 4 * error <= any_strategy(world, starts).cells, seed


def test_whatever_the_prices_what_they_prove_is_true(monkeypatch: pytest.MonkeyPatch) -> None:
    """Random prices, the solver's spoilt, and none: never below the optimum; the solver's own lose next to nothing."""
    world, starts = tiny_world(3, 2, 4), np.array([[0, 0]])
    best, nodes = optimum(world, starts), contract(world, starts)
    count, dangerous = len(nodes.weight), np.flatnonzero(nodes.threat > 0)
    inside = np.arange(count) != np.flatnonzero(nodes.starts)
    rows = [upper_bound.spend(nodes, dangerous, float(most_stopped(nodes.threat[dangerous], 1)[-1]))]
    rows += [way_within(nodes, node, inside) for node in np.flatnonzero(inside).tolist()]
    draw = np.random.default_rng(5)
    for _ in range(300):
        scale = 10.0 ** draw.uniform(-3, 2)
        dual = Dual(draw.random(count) * scale, draw.random(count) * 2, draw.random(len(rows)) * scale)
        assert certified(nodes, rows, dual) >= best
        with monkeypatch.context() as careless:  # prices that were not made feasible prove no more than that
            careless.setattr("analysis.theory.upper_bound._feasible", lambda nodes, dual, toll: dual.flow)
            assert certified(nodes, rows, dual) >= best
    nothing = Dual(np.zeros(count), np.zeros(count), np.zeros(len(rows)))
    assert certified(nodes, rows, nothing) == pytest.approx(nodes.weight @ nodes.reach, abs=1e-9)


@pytest.mark.usefixtures("full_effort")
def test_the_certificate_loses_next_to_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rounds end when ten of them together gain less than 2e-4 of the cells, and no sooner."""
    world = random_world(pattern=ThreatPattern(seed=1))
    nodes, optima, solve = contract(world, place_starts(world, 4)[0]), [], Programme.solve

    def noted(programme: Programme) -> tuple[np.ndarray, np.ndarray, Dual]:
        moves, visited, dual = solve(programme)
        optima.append(float(nodes.weight @ visited))
        return moves, visited, dual

    monkeypatch.setattr(Programme, "solve", noted)
    bound = flow_bound(nodes)
    assert optima[-1] - 1e-6 <= bound <= optima[-1] + 1e-4
    gains = np.subtract(optima[:-10], optima[10:])
    assert len(gains) > 1 and gains[:-1].min() >= 2e-4 * nodes.weight.sum() > gains[-1]


@pytest.mark.parametrize("robots", [1, 2])
def test_whatever_the_nodes_a_way_holds_of_the_best_strategy(robots: int) -> None:
    """Rows of any far side of any node leave the optimum in."""
    draw = np.random.default_rng(8)
    for seed in range(10):
        world, starts = tiny_world(seed, 2, 4), np.array([[0, 0]] * robots)
        best, nodes = optimum(world, starts), contract(world, starts)
        programme = Programme(nodes)
        for node in np.repeat(np.flatnonzero(nodes.starts == 0), 8).tolist():
            inside = draw.random(len(nodes.weight)) < 0.6
            inside[node] = True
            programme.add([way_within(nodes, node, inside)])
        visited, dual = programme.solve()[1:]
        assert best <= certified(nodes, programme.rows, dual) <= nodes.weight @ visited + 1e-5


def test_half_a_robot_does_not_fill_a_room_by_going_round_in_it() -> None:
    """Beyond a door of p a ring of danger: what gets in is what is visited there, however often it goes round."""
    world = World.create([[0.0, 0.5, 0.1, 0.1], [np.nan, np.nan, 0.1, 0.0], [0.0, 0.5, 0.1, 0.1], [0.0, 0.0, 0.0, 0.0]])
    nodes = contract(world, np.array([[3, 0]]))
    moves, visited, _ = Programme(nodes).solve()
    found = list(missing_ways(nodes, moves, visited))
    assert found and all(visited[way.nodes[0]] > way.most + way.share @ moves[way.moves] for way in found)


@pytest.mark.parametrize("robots", [1, 2])
@pytest.mark.parametrize("seed", range(12))
def test_no_walks_bring_more_than_prices_prove(seed: int, robots: int, monkeypatch: pytest.MonkeyPatch) -> None:
    world, draw = tiny_world(seed, 3, 3 if robots == 2 else 4), np.random.default_rng(seed)
    nodes, best = contract(world, np.array([[0, 0]] * robots)), optimum(world, [[0, 0]] * robots)
    programme = Programme(nodes)
    moves, visited, _ = programme.solve()
    rows = [upper_bound.spend(nodes, np.flatnonzero(nodes.threat), robots), *missing_ways(nodes, moves, visited)]
    monkeypatch.setattr(single, "REMEMBERED", seed % 3)
    for rounds, classes in ((1, 1), (2, 2), (5, 4), (60, 2)):
        monkeypatch.setattr(single, "ROUNDS", rounds)
        monkeypatch.setattr(single, "CLASSES", {robots: classes})
        arrive, prices = draw.exponential(0.5, len(nodes.weight)), draw.exponential(0.2, len(rows))
        assert best is None or best <= single.walk_bound(nodes, rows, arrive, prices)


def test_a_walk_is_held_to_one_order_of_two_rooms() -> None:
    """Left and right of the start a door of .5 before 6 cells: the second room is had by who passed three times.

    1 + (1 + 6 / 2) + (1 + 6 / 2) / 4 cells; the programme sends half a robot each way first.
    """
    world = World.create([[0.0] * 6 + [0.5, 0.0, 0.5] + [0.0] * 6])
    assert optimum(world, [[0, 7]]) == 6.0
    before = flow_bound(contract(world, np.array([[0, 7]])), rounds=upper_bound.ROUNDS - 1)
    assert 6.0 <= any_strategy(world, [[0, 7]]).flow < 6.2 < before


@pytest.mark.usefixtures("full_effort")
def test_ways_are_what_makes_it_sharp() -> None:
    """2 points or more on the map of the other test, and whoever asks for none has the rest."""
    starts = place_starts(world := random_world(pattern=ThreatPattern(kind="scattered", seed=0)), 4)[0]
    with_ways, without = (any_strategy(world, starts, ways=ways).flow for ways in (True, False))
    assert with_ways < without - 0.02 * world.accessible(starts).sum()


def test_most_stopped_is_the_expectation_rounded_up() -> None:
    threat = np.array([0.1, 0.25, 0.5, 0.9, 0.03])
    for robots in (1, 2, 5):
        exact = Fraction(0)
        for hits in product((0, 1), repeat=len(threat)):
            chance = Fraction(1)
            for p, hit in zip(map(Fraction, threat.tolist()), hits, strict=True):
                chance *= p if hit else 1 - p
            exact += chance * min(robots, sum(hits))
        found = Fraction(float(most_stopped(threat, robots)[-1]))
        assert exact <= found <= exact + Fraction(1, 10**12)


def test_unasked_on_a_larger_map_in_fewer_rounds_and_not_among_many_dangers(monkeypatch: pytest.MonkeyPatch) -> None:
    rounds: list[int] = []
    monkeypatch.setattr("analysis.theory.upper_bound.flow_bound", lambda nodes, most, *_: rounds.append(most) or 0.0)
    for side, danger in ((20, 0.1), (30, 0.1), (40, 0.1), (40, 0.0)):
        for flow in (None, True):
            any_strategy(World.create(np.full((side, side), danger)), [[0, 0]] * 2, flow)
    assert rounds == [200, 200, 12, 200, 200, 12, 200]


def test_where_nothing_is_dangerous_every_cell_may_be_visited() -> None:
    assert any_strategy(World.create([[0.0, 0.0, np.nan, 0.0]]), [[0, 0]]).cells == 2


def said_of(answer: Evaluation, theory: bool = False) -> str:
    """What the terminal says, in one line."""
    report = evaluation_report(answer, theory=theory)
    return " ".join(as_text(lambda console: print_report(report, console)).split())


def test_evaluate_says_it_where_it_holds() -> None:
    """In the sentence, the JSON and the answer; not where only first visits are checked, nor where it is not wanted."""
    world = random_world(10, 10, ThreatPattern(areas=4, seed=1))
    answer = mrac.evaluate(world, 2, rollouts=64)
    limit = any_strategy(world, answer.plan.starts).cells
    assert answer.to_json()["bounds"]["any_strategy"] == limit == answer.bounds.least.cells
    share = f"{np.ceil(1e4 * limit / answer.tally.accessible) / 100:.2f} %"
    assert f"No strategy visits more than {share} on average" in said_of(answer)
    for choice in ({"threat_checks": "first_visit"}, {"bound": False}):
        other = mrac.evaluate(world, 2, rollouts=64, **choice)
        assert other.to_json()["bounds"]["any_strategy"] is None and "No strategy" not in said_of(other)


@pytest.mark.usefixtures("one_picture")
def test_the_bound_is_on_the_mean_wherever_it_is_said(tmp_path: Path) -> None:
    """Half of the runs on this row visit more than the bound: terminal, summary, page and value say "on average"."""
    world = World.create([[0, 0.5, 0, 0, 0, 0]])
    answer = mrac.evaluate(world, 1, rollouts=400, value=True, deadline=3)
    bound, tally = answer.bounds.least.cells, answer.tally
    assert tally.visited[int(bound) + 1 :].sum() > 0.4 * tally.rollouts
    answer.save(tmp_path)
    pages, checked = [page.read_text() for page in tmp_path.rglob("*.html")], check_report(mrac.check(world, 1))
    told = said_of(answer, theory=True)
    for text in (told, str(answer), *pages, as_text(lambda console: print_report(checked, console))):
        for words in text.split("trategy exceeds")[1:] + text.split("trategy visits more")[1:]:
            assert "average" in words[:60], words[:60]
    assert "it ignores the deadline" in told


def test_of_a_range_the_bound_knows_what_is_too_far() -> None:
    """Seven safe cells, moves for two: three can be visited, and no strategy does more."""
    world = World.create([[0.0, 0.1, 0, 0, 0, 0, 0]])
    answer = mrac.evaluate(world, mrac.plan(world, 1, range=2), rollouts=64)
    assert 2.7 < answer.bounds.least.cells <= 3
    said = "% on average with this team on this map (proven; of the range it uses only which cells are too far)"
    assert said in said_of(answer)


@pytest.mark.parametrize("seed", range(12))
def test_of_robots_that_come_home_the_bound_knows_the_way_home(seed: int) -> None:
    """Above the optimum of a robot that comes home, also recharged, to its start or a base elsewhere; and it is less
    than that of a robot that stays where it ends, where cells are too far to come home from.
    """
    world, draw = tiny_world(seed, 2, 4), np.random.default_rng(seed)
    free = [tuple(cell) for cell in np.argwhere(world.accessible([[0, 0]])).tolist()]
    for bases in ([(0, 0)], [free[int(draw.integers(len(free)))], (0, 0)]):
        for moves, recharge in ((2, None), (3, None), (2, 3), (4, 1), (5, None)):
            home = "home" if bases == [(0, 0)] else tuple(bases)
            settings = Settings(range=moves, return_to=home, recharge=recharge)
            plan = allocated_plan(world, [[0, 0]], settings)
            best, can = best_that_comes_home(world, moves, bases, recharge is not None)
            assert {tuple(cell) for cell in np.argwhere(upper_bound.within(world, plan)).tolist()} == can
            assert best <= any_strategy(upper_bound.trimmed(world, plan), [[0, 0]]).cells + 1e-9
            # of one robot both loops are the same
            assert open_loop_exact(make_plan(world, [[0, 0]], settings), world).visited <= best + 1e-9


def test_what_is_too_far_to_come_home_from_is_not_in_the_bound() -> None:
    """Seven safe cells, moves for four: the third cell is the last from which a robot comes home, charged or not."""
    world = World.create([[0.0, 0.1, 0, 0, 0, 0, 0]])
    for recharge in (None, 2):
        plan = mrac.plan(world, 1, range=4, return_to="home", recharge=recharge)
        answer = mrac.evaluate(world, plan, rollouts=64)
        assert 2.7 < answer.bounds.least.cells <= 3
        said = next(iter(remainder_text(answer, answer.rest)))
        assert said == "Too far for any robot to visit and return: 4 accessible cells (57.1 %)."
    ends = mrac.evaluate(world, mrac.plan(world, 1, range=4), rollouts=64)
    assert 4.4 < ends.bounds.least.cells <= 5


def test_check_says_the_optimum_of_a_tiny_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In table, JSON and page, above both loops; not where it is dear, and not of first visits in the closed loop."""
    world, file, out = tiny_world(3, 2, 4), str(tmp_path / "map.npz"), tmp_path / "out"
    world.save(file)
    checks = {check.key: check for check in mrac.check(world, 1).checks if check.formula == "optimum"}
    assert set(checks) == {"optimum/visited/open", "optimum/visited/closed"}
    best, said = optimum(world, [[0, 0]]), "coverage of the best strategy"
    assert all(check.value == best and check.verdict == "holds" for check in checks.values())
    assert run(["check", file, "--out", str(out)]) == 0
    assert any(said in line and f"{best:.2f}" in line for line in capsys.readouterr().out.splitlines())
    assert '"key": "optimum/visited/closed"' in (out / "check.json").read_text()
    assert said in (out / "index.html").read_text()
    large = mrac.check(random_world(10, 10, ThreatPattern(areas=4, seed=1)), 2, rollouts=64)
    assert "optimum" not in {check.formula for check in large.checks}
    assert run(["check", file, "--threat-checks", "first_visit", "--json"]) == 0
    assert "optimum/visited/closed" not in capsys.readouterr().out


@pytest.mark.parametrize("seed", range(6))
def test_no_strategy_covers_more_value(seed: int) -> None:
    rng = np.random.default_rng(seed)
    threat = rng.choice([0.0, 0.1, 0.4, 0.7], (2, 4)).astype(np.float32)
    value = rng.choice([0.0, 1.0, 3.5, 1e6], (2, 4))
    value[0, 0] = 1.0
    world, ones = (World.create(threat, value=one) for one in (value, np.ones((2, 4))))
    bound, plain = (value_bound(one, [[0, 0]]) for one in (world, ones))
    assert best_of_one_robot(world) <= bound * (1 + 1e-12) and bound <= value.sum() * (1 + 1e-12)
    assert plain == pytest.approx(value_bound(World.create(threat), [[0, 0]]), rel=1e-9)
    assert best_of_one_robot(ones) <= plain + 1e-9


# The bound for every strategy against the best strategy there is, on worlds so small that it can be found.


@pytest.mark.parametrize("seeds", [range(24), pytest.param(range(10_000), marks=pytest.mark.slow)])
def test_bounds_are_never_below_the_optimum(seeds: range) -> None:
    """One or two robots anywhere, in a third of the worlds values of the cells; thresholds remove something."""
    removed = 0.0
    for seed in seeds:
        draw = np.random.default_rng(seed)
        threat = draw.choice([0, 0, 0, np.nan, 0.04, 0.2, 0.9, draw.uniform(0, 0.7)], (3, draw.integers(3, 6)))
        threat[0, 0] = 0.1 * draw.integers(3)
        value = draw.choice([0, 1, 2.5, 7], threat.shape) if seed % 3 == 0 else None
        cells = np.argwhere(~np.isnan(threat))
        world, starts = World.create(threat), cells[draw.integers(len(cells), size=1 + seed % 2)]
        nodes, best = contract(world, starts, value), optimum(world, starts, value)
        plain, walks = (flow_bound(nodes, thresholds=thresholds) for thresholds in (False, True))
        assert (best or 0.0) <= walks <= plain, seed
        removed += plain - walks
    assert removed > 0.01 * len(seeds)
