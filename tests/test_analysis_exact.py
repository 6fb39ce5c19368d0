"""The closed form and the paper's formulas against the fixtures, brute force, and each other."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from conftest import Fixture, load_fixture, worlds_with_starts
from hypothesis import given

from analysis.theory.bounds import Theorem3, all_bounds, ideal_team
from analysis.theory.exact import open_loop_exact, poisson_binomial
from analysis.theory.own_bounds import reach_chances
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan, entries
from planner.settings import Settings
from planner.world.world import World


def plans_of(fixture: Fixture) -> list[Plan]:
    """The plan fed with the fixture's allocation and, for one robot, the planner's own."""
    fed = make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)
    return [fed, make_plan(fixture.world, fixture.starts)] if len(fed.robots) == 1 else [fed]


def test_closed_form_and_every_formula_are_the_fixtures(fixture: Fixture) -> None:
    known = fixture.answers
    for plan in plans_of(fixture):
        exact, bounds = open_loop_exact(plan, fixture.world), all_bounds(plan, fixture.world)
        near = {"rel": 0, "abs": 1e-9}
        assert exact.visited == pytest.approx(known["open_loop_exact"]["visited"], **near)
        assert exact.survived == pytest.approx(known["open_loop_exact"]["survived"], **near)
        assert bounds.eq2_printed == pytest.approx(known["eq2"]["printed"], **near)
        assert bounds.team_survival == pytest.approx(known["eq2"]["team_survival"], **near)
        assert bounds.ideal_eq7 == pytest.approx(known["ideal_eq7"], **near)
        assert bounds.ideal_team == pytest.approx(known["ideal_team"], **near)
        for gain, expected in zip(bounds.eq4, known["eq4"], strict=True):
            assert (gain.visited, gain.survived) == pytest.approx((expected["visited"], expected["survived"]), **near)
        if "eq5" in known:
            for bound, expected in zip(bounds.eq5, known["eq5"], strict=True):
                assert bound.printed == pytest.approx(expected["printed"], **near)
                assert bound.with_c00 == pytest.approx(expected["with_c00"], **near)
        for meaning in ("visited", "survived"):
            theorem = getattr(bounds, f"theorem3_{meaning}")
            for reading in Theorem3.__dataclass_fields__:
                assert getattr(theorem, reading) == pytest.approx(known["theorem3"][meaning][reading], **near)


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
    visited, survived, time, curve = 0.0, 0.0, 0.0, np.zeros(plan.makespan + 1)
    for combination in product(*fates):
        chance = float(np.prod([fate[0] for fate in combination]))
        reached: dict[int, int] = {}
        for _, steps, cells, _ in combination:
            for step, cell in zip(steps, cells, strict=True):
                reached[cell] = min(step, reached.get(cell, step))
        passed = {cell for _, _, cells, stopped in combination for cell in (cells[:-1] if stopped else cells)}
        visited += chance * len(reached)
        survived += chance * len(passed)
        time += chance * max(int(steps[-1]) for _, steps, _, _ in combination)
        for step in reached.values():
            curve[step:] += chance
    assert exact.visited == pytest.approx(visited, abs=1e-9)
    assert exact.survived == pytest.approx(survived, abs=1e-9)
    assert exact.mean_time == pytest.approx(time, abs=1e-9)
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


def test_equation_2_as_printed_is_not_the_team_s_survival() -> None:
    """Two robots, p = .5, two steps: printed .5625, truth .4375."""
    world = World.create(np.full((2, 2), 0.5))
    plan = Plan((2, 2), world.sha256, None, (RobotPlan(np.array([0, 1])), RobotPlan(np.array([2, 3]))))
    bounds = all_bounds(plan, world)
    assert bounds.eq2_printed == pytest.approx(0.5625)
    assert bounds.team_survival == pytest.approx(0.4375)
    assert bounds.theorem3_visited is None
    assert bounds.eq5[0].printed is None


def test_per_cell_values_add_up() -> None:
    fixture = load_fixture("contiguous-14x23-1001-k8")
    plan = make_plan(fixture.world, fixture.starts)
    exact = open_loop_exact(plan, fixture.world)
    assert exact.visited_curve[-1] == pytest.approx(exact.visited, abs=1e-9)
    assert exact.survived_curve[-1] == pytest.approx(exact.survived, abs=1e-9)
    assert exact.stops_by_cell.sum() == pytest.approx(exact.expected_losses, abs=1e-9)
    assert exact.alive_chance @ np.arange(9) == pytest.approx(exact.survival.sum(), abs=1e-9)
    assert exact.time_chance.sum() == pytest.approx(1.0, abs=1e-9)
    assert exact.by_deadline(10**6) == pytest.approx((exact.visited, exact.survived))
    assert exact.by_deadline(0)[0] == pytest.approx(len(np.unique(fixture.starts, axis=0)))


def test_a_waiting_robot_is_hit_once() -> None:
    world = World.create([[0.5, 0.0]])
    plan = Plan((1, 2), world.sha256, None, (RobotPlan(np.array([0, 0, 0, 1])),))
    exact = open_loop_exact(plan, world)
    assert exact.visited == pytest.approx(1.5)
    assert exact.visited_curve.tolist() == [1.0, 1.0, 1.0, 1.5]


def test_ideal_of_a_team_counts_hits_over_the_poisson_binomial() -> None:
    threat = np.array([0.0, 0.2, 0.5, 0.3])
    ordered = np.sort(threat)
    for robots in (1, 2, 3):
        direct = sum(poisson_binomial(ordered[:j])[:robots].sum() for j in range(4))
        assert ideal_team(threat, robots) == pytest.approx(direct)


def test_chances_below_what_1_minus_a_product_can_hold_are_kept() -> None:
    """Two robots on 17 cells of p = .9 each: each survives with 1e-17, of which 1 - (1 - 1e-17)^2 keeps nothing."""
    world = World.create(np.full((2, 18), 0.9, dtype=np.float32))
    p = float(np.float32(0.9))
    paths = tuple(RobotPlan(np.arange(row * 18, row * 18 + 17)) for row in (0, 1))
    plan = replace(make_plan(world, [[0, 0], [1, 0]]), robots=paths, areas=(), areas_added=(), settings=None)
    exact, survival = open_loop_exact(plan, world), (1 - p) ** 17
    assert exact.some_left == pytest.approx(2 * survival, rel=1e-9)
    assert all_bounds(plan, world).team_survival == pytest.approx(2 * survival, rel=1e-9)
    assert exact.visited_by_cell[16] == pytest.approx((1 - p) ** 16, rel=1e-9)
    both = replace(plan, robots=(paths[0], paths[0]))
    assert open_loop_exact(both, world).visited_by_cell[16] == pytest.approx(2 * (1 - p) ** 16, rel=1e-9)
    reach = reach_chances(world, [[0, 0], [0, 0]])
    assert reach[17] == pytest.approx(2 * (1 - p) ** 17, rel=1e-9) and reach[0] == 1


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
    assert sum(len(np.unique(robot.path)) == 1 for robot in plan.robots) >= 3
    theorem = all_bounds(plan, world).theorem3_visited
    alone = sum(len(np.unique(robot.path)) for robot in plan.robots)
    assert theorem is not None
    assert (theorem.travel_multiset, theorem.travel_set) == (alone - 4, alone - 3)
    plan = make_plan(world, [[0, 0], [0, 0]])
    theorem = all_bounds(plan, world).theorem3_survived
    assert theorem is not None and (theorem.travel_multiset, theorem.travel_set) == (3 + 1 - 2, 3 + 1 - 1)
