"""Our own bounds against exact values, enumeration, the best of all strategies, rollouts, and numbers made by hand."""

from __future__ import annotations

from functools import cache
from itertools import combinations, product

import numpy as np
import pytest
from conftest import NAMES, Fixture, load_fixture, worlds_with_starts
from hypothesis import given

from analysis.theory.bounds import all_bounds, ideal_team
from analysis.theory.exact import open_loop_exact
from analysis.theory.own_bounds import MendedTheorem3, ideal_connected, mended_theorem3, reach_chances, until_first_loss
from planner.mrac.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.world.world import World

ENUMERATED = [name for name in NAMES if "closed_loop_exact" in load_fixture(name).answers]
NEAR = 1e-9


def plan_of(fixture: Fixture) -> Plan:
    return plan_named(fixture.name)


@cache
def plan_named(name: str) -> Plan:
    fixture = load_fixture(name)
    return make_plan(fixture.world, fixture.starts, allocation=fixture.allocation)


def paths(world: World, *cells: list[int]) -> Plan:
    return Plan(world.shape, world.sha256, None, tuple(RobotPlan(np.array(path)) for path in cells))


def in_order(bound: MendedTheorem3, truth: float) -> bool:
    return bound.count <= bound.largest + NEAR and bound.largest <= bound.spread + NEAR and bound.spread <= truth + NEAR


# --- Theorem 3, mended ---


def test_theorem_3_mended_holds_on_every_fixture(fixture: Fixture) -> None:
    bound, truth = mended_theorem3(plan_of(fixture), fixture.world), fixture.answers["open_loop_exact"]
    assert in_order(bound.visited, truth["visited"])
    assert in_order(bound.survived, truth["survived"])
    if fixture.answers["k"] <= 2:
        assert bound.visited.spread == pytest.approx(truth["visited"], abs=NEAR)
        assert bound.survived.spread == pytest.approx(truth["survived"], abs=NEAR)


@given(worlds_with_starts())
def test_theorem_3_mended_holds_on_random_worlds(given_world: tuple[World, np.ndarray]) -> None:
    world, starts = given_world
    plan = make_plan(world, starts)
    bound, truth = mended_theorem3(plan, world), open_loop_exact(plan, world)
    assert in_order(bound.visited, truth.visited)
    assert in_order(bound.survived, truth.survived)
    expected = sum(alone.visited for alone in all_bounds(plan, world).eq4)
    on_path = [cell for robot in plan.robots for cell in np.unique(robot.path)]
    shared = len(on_path) - len(np.unique(on_path))
    assert bound.visited.count == pytest.approx(expected - shared, abs=NEAR)
    if shared == 0:
        assert bound.visited.count == pytest.approx(truth.visited, abs=NEAR)


def test_theorem_3_mended_by_hand() -> None:
    """Three robots through the cells 0 and 2 (p = .5) to cell 1; E(R) = 2, 2, 1.5; cell 1 has chances .5, .5, .5."""
    world = World.create([[0.5, 0.0, 0.5]])
    plan = paths(world, [0, 1], [0, 1], [2, 1])
    bound = mended_theorem3(plan, world)
    # visited: cell 0 twice for certain, cell 1 three times with chance .5
    assert bound.visited == MendedTheorem3(count=4.5 - 1 - 2, largest=4.5 - 1 - 1, spread=2 + 1 - 0.5**3)
    assert bound.visited.spread == open_loop_exact(plan, world).visited == 2.875
    # survived: cell 0 with .5 and .5, cell 1 with .5 three times, cell 2 with .5
    assert bound.survived == MendedTheorem3(count=3 - 1 - 2, largest=3 - 0.5 - 1, spread=0.75 + 0.875 + 0.5)


def test_theorem_3_mended_is_short_only_where_the_others_differ() -> None:
    """One cell with chances 1/2, 1/2, 1/4: 1 - 1/2 (1 - 3/8)^2 for the truth, 1 - 1/2 * 1/2 * 3/4."""
    world = World.create([[0.5, 0.0, 0.5], [0.75, 0.0, 0.0]])
    plan = paths(world, [0, 1], [2, 1], [3, 4, 1])
    expected, on_cell_1 = 2 * 1.5 + 1.5, 1.25
    assert mended_theorem3(plan, world).visited.spread == expected - (on_cell_1 - (1 - 0.5 * 0.625**2))
    assert open_loop_exact(plan, world).visited == expected - (on_cell_1 - (1 - 0.5 * 0.5 * 0.75))


def test_without_threats_every_form_counts_the_cells() -> None:
    world = World.create(np.zeros((3, 5)))
    plan = make_plan(world, [[0, 0], [0, 0], [2, 4]])
    bound = mended_theorem3(plan, world)
    assert bound.visited == bound.survived == MendedTheorem3(15.0, 15.0, 15.0)


# --- until the first loss ---


def test_until_the_first_loss_by_hand() -> None:
    """Robot 0 enters cells 0, 1 (p = .5), 2; robot 1 cells 5, 4 (p = .25), 3, acting second in each step."""
    world = World.create([[0.0, 0.5, 0.0], [0.0, 0.25, 0.0]])
    bound = until_first_loss(paths(world, [0, 1, 2], [5, 4, 3]), world)
    assert bound.visited == 1 + 1 + 1 + 0.5 + 0.375 + 0.375
    assert bound.survived == 1 + 1 + 0.5 + 0.375 + 0.375 + 0.375


def test_until_the_first_loss_is_below_both_loops(fixture: Fixture) -> None:
    bound, answers = until_first_loss(plan_of(fixture), fixture.world), fixture.answers
    for key in {"open_loop_exact", "closed_loop_exact"} & set(answers):
        assert bound.visited <= answers[key]["visited"] + NEAR
        assert bound.survived <= answers[key]["survived"] + NEAR
    if answers["k"] == 1:
        assert bound.visited == pytest.approx(answers["open_loop_exact"]["visited"], abs=NEAR)
        assert bound.survived == pytest.approx(answers["open_loop_exact"]["survived"], abs=NEAR)


# --- the ideal of a map ---


def test_ideal_of_a_map_by_hand() -> None:
    world = World.create([[0.0, 0.5, 0.0]])
    assert reach_chances(world, [[0, 0]]).tolist() == [1, 1, 0.5]
    assert ideal_connected(world, [[0, 0]]) == 2.5  # what the only path attains
    assert ideal_team(world.threat.ravel().astype(np.float64), 1) == 3
    assert reach_chances(world, [[0, 0], [0, 0]]).tolist() == [1, 1, 0.75]
    assert reach_chances(world, [[0, 0], [0, 2]]).tolist() == [1, 1, 1]
    assert reach_chances(world, [[0, 1], [0, 0]]).tolist() == [1, 1, 0.75]  # the start's own threat counts
    walled = World.create([[0.0, np.nan, 0.0]])
    assert reach_chances(walled, [[0, 0]]).tolist() == [1, 0, 0]
    assert ideal_connected(walled, [[0, 0]]) == 1


@given(worlds_with_starts())
def test_ideal_of_a_map_lies_between_the_open_loop_and_the_ideal_of_the_team(
    given_world: tuple[World, np.ndarray],
) -> None:
    world, starts = given_world
    plan = make_plan(world, starts)
    bound, exact, paper = ideal_connected(world, starts), open_loop_exact(plan, world), all_bounds(plan, world)
    assert exact.survived - NEAR <= exact.visited <= bound + NEAR <= paper.ideal_team + 2 * NEAR
    assert len(starts) > 1 or paper.ideal_team == paper.ideal_eq7
    assert (exact.visited_by_cell <= reach_chances(world, starts) + NEAR).all()


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
