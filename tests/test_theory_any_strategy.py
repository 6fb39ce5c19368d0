"""The bound for every strategy: above the optimum, above what is sampled, and proven whatever the solver says."""

from __future__ import annotations

import signal
from fractions import Fraction
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from oracle_strategy import best_of_one_robot, best_that_comes_home
from oracle_tree import closed_loop_exact

import mrac_jax as mrac
from analysis.checking.report import check_report
from analysis.cli.app import run
from analysis.evaluation.report import report as evaluation_report
from analysis.evaluation.report import rest_words
from analysis.report.answer import print_report
from analysis.theory import single_robot as single
from analysis.theory.flow_programme import contract, missing_ways, optimum, way_within
from analysis.theory.upper_bound import (
    ROUNDS,
    Dual,
    Programme,
    Row,
    Spend,
    any_strategy,
    certified,
    flow_bound,
    most_stopped,
    trimmed,
    value_bound,
    within,
)
from analysis.utils.folder import as_text
from planner.mrac.make_plan import allocated_plan, make_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World


def tiny_world(seed: int, height: int, width: int) -> World:
    draw = np.random.default_rng(seed)
    threat = draw.choice([0, 0, 0.1, 0.3, 0.6, np.nan], size=(height, width))
    threat[0, 0] = draw.choice([0, 0.2])
    return World.create(threat)


@pytest.mark.parametrize("seed", range(8))
def test_optimum_of_one_robot_is_the_plain_one(seed: int) -> None:
    world = tiny_world(seed, 2, 4)
    assert optimum(world, [[0, 0]]) == pytest.approx(best_of_one_robot(world), abs=1e-12)


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
    best = optimum(world, starts)
    assert best is not None
    mrac = closed_loop_exact(make_plan(world, starts), world).visited
    bound = any_strategy(world, starts)
    assert mrac <= best + 1e-9
    assert best <= min(bound.cells, bound.connected, bound.ideal) + 1e-9
    assert bound.flow is not None
    assert best <= bound.flow


@pytest.mark.parametrize(("kind", "robots"), [("contiguous", 1), ("contiguous", 8), ("scattered", 4)])
def test_sharper_than_the_ideals_and_above_what_is_sampled(kind: str, robots: int) -> None:
    world = random_world(pattern=ThreatPattern(kind=kind, seed=0))  # type: ignore[arg-type]
    starts = place_starts(world, robots)[0]
    bound = any_strategy(world, starts)
    assert bound.flow is not None
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
    count = len(nodes.weight)
    dangerous = np.flatnonzero(nodes.threat > 0)
    inside = np.arange(count) != np.flatnonzero(nodes.starts)
    rows: list[Row] = [Spend(dangerous, float(most_stopped(nodes.threat[dangerous], 1)[-1]))]
    rows += [way_within(nodes, node, inside) for node in np.flatnonzero(inside).tolist()]
    draw = np.random.default_rng(5)
    assert best is not None
    for _ in range(300):
        scale = 10.0 ** draw.uniform(-3, 2)
        dual = Dual(draw.random(count) * scale, draw.random(count) * 2, draw.random(len(rows)) * scale)
        assert certified(nodes, rows, dual) >= best
        with monkeypatch.context() as careless:  # prices that were not made feasible prove no more than that
            careless.setattr("analysis.theory.upper_bound._feasible", lambda nodes, dual, toll: dual.flow)
            assert certified(nodes, rows, dual) >= best
    nothing = Dual(np.zeros(count), np.zeros(count), np.zeros(len(rows)))
    assert certified(nodes, rows, nothing) == pytest.approx(nodes.weight @ nodes.reach, abs=1e-9)


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
    for seed in range(30):
        world, starts = tiny_world(seed, 2, 4), np.array([[0, 0]] * robots)
        best, nodes = optimum(world, starts), contract(world, starts)
        assert best is not None
        programme = Programme(nodes)
        for node in np.flatnonzero(nodes.starts == 0).tolist():
            for _ in range(8):
                inside = draw.random(len(nodes.weight)) < 0.6
                inside[node] = True
                programme.add([way_within(nodes, node, inside)])
        visited, dual = programme.solve()[1:]
        proven = certified(nodes, programme.rows, dual)
        assert best <= proven <= nodes.weight @ visited + 1e-5
        assert best <= flow_bound(nodes)


def test_half_a_robot_does_not_fill_a_room_by_going_round_in_it() -> None:
    """Beyond a door of p a ring of danger: what gets in is what is visited there, however often it goes round."""
    world = World.create([[0.0, 0.5, 0.1, 0.1], [np.nan, np.nan, 0.1, 0.0], [0.0, 0.5, 0.1, 0.1], [0.0, 0.0, 0.0, 0.0]])
    nodes = contract(world, np.array([[3, 0]]))
    moves, visited, _ = Programme(nodes).solve()
    found = list(missing_ways(nodes, moves, visited))
    assert found and all(visited[way.node] > way.free + way.share @ moves[way.moves] for way in found)


@pytest.mark.parametrize("seed", range(12))
def test_whatever_the_prices_no_walk_of_one_robot_brings_more_than_they_prove(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    world, draw = tiny_world(seed, 3, 4), np.random.default_rng(seed)
    nodes = contract(world, np.array([[0, 0]]))
    programme = Programme(nodes)
    moves, visited, _ = programme.solve()
    rows = [Spend(np.flatnonzero(nodes.threat), 1.0), *missing_ways(nodes, moves, visited)]
    best = optimum(world, [[0, 0]])
    monkeypatch.setattr(single, "REMEMBERED", seed % 3)
    for rounds in (1, 2, 5, 60):
        monkeypatch.setattr(single, "ROUNDS", rounds)
        arrive, prices = draw.exponential(0.5, len(nodes.weight)), draw.exponential(0.2, len(rows))
        assert best is None or best <= single.single_bound(nodes, rows, arrive, prices)


def test_a_walk_is_held_to_one_order_of_two_rooms() -> None:
    """Left and right of the start a door of .5 before 6 cells: the second room is had by who passed three times.

    1 + (1 + 6 / 2) + (1 + 6 / 2) / 4 cells; the programme sends half a robot each way first.
    """
    world = World.create([[0.0] * 6 + [0.5, 0.0, 0.5] + [0.0] * 6])
    assert optimum(world, [[0, 7]]) == 6.0
    flow = any_strategy(world, [[0, 7]]).flow
    assert flow is not None and 6.0 <= flow < 6.2 < flow_bound(contract(world, np.array([[0, 7]])), rounds=ROUNDS - 1)


def test_ways_are_what_makes_it_sharp() -> None:
    """2 points or more on the map of the other test, and whoever asks for none has the rest."""
    world = random_world(pattern=ThreatPattern(kind="scattered", seed=0))
    starts = place_starts(world, 4)[0]
    with_ways, without = (any_strategy(world, starts, ways=ways).flow for ways in (True, False))
    assert with_ways is not None and without is not None
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
    monkeypatch.setattr("analysis.theory.upper_bound.flow_bound", lambda nodes, most, ways: rounds.append(most) or 0.0)
    for side, danger in ((20, 0.1), (30, 0.1), (40, 0.1), (40, 0.0)):
        for flow in (None, True):
            any_strategy(World.create(np.full((side, side), danger)), [[0, 0]] * 2, flow)
    assert rounds == [200, 200, 12, 200, 200, 12, 200]


def test_where_nothing_is_dangerous_every_cell_may_be_visited() -> None:
    assert any_strategy(World.create([[0.0, 0.0, np.nan, 0.0]]), [[0, 0]]).cells == 2


def test_evaluate_says_it_where_it_holds() -> None:
    """In the sentence, the JSON and the answer; not where only first visits are checked, nor where it is not wanted."""
    world = random_world(10, 10, ThreatPattern(areas=4, seed=1))
    answer = mrac.evaluate(world, 2, rollouts=64)
    limit = any_strategy(world, answer.plan.starts).cells
    assert answer.to_json()["bounds"]["any_strategy"] == limit == answer.bounds.least.cells
    said = as_text(lambda console: print_report(evaluation_report(answer), console))
    assert (
        f"No strategy visits more than {np.ceil(1e4 * limit / answer.tally.accessible) / 100:.2f} % on average" in said
    )
    for choice in ({"first_visit": True}, {"bound": False}):
        other = mrac.evaluate(world, 2, rollouts=64, **choice)
        assert other.to_json()["bounds"]["any_strategy"] is None
        assert "No strategy" not in as_text(
            lambda console, shown=other: print_report(evaluation_report(shown), console)
        )


def test_the_bound_is_on_the_mean_wherever_it_is_said(tmp_path: Path) -> None:
    """Half of the runs on this row visit more than the bound: terminal, summary, page and value say "on average"."""
    world = World.create([[0, 0.5, 0, 0, 0, 0]])
    answer = mrac.evaluate(world, 1, rollouts=400, metrics="coverage", deadline=3)
    bound, tally = answer.bounds.least.cells, answer.tally
    assert tally.visited[int(bound) + 1 :].sum() > 0.4 * tally.rollouts
    answer.save(tmp_path)
    said = (
        as_text(lambda console: print_report(evaluation_report(answer, theory=True), console)),
        str(answer),
        *(page.read_text() for page in tmp_path.rglob("*.html")),
        as_text(lambda console: print_report(check_report(mrac.check(world, 1)), console)),
    )
    for text in said:
        for words in text.split("trategy exceeds")[1:] + text.split("trategy visits more")[1:]:
            assert "average" in words[:60], words[:60]
    assert "it does not know the deadline" in " ".join(said[0].split())


def test_of_a_range_the_bound_knows_what_is_too_far() -> None:
    """Seven safe cells, moves for two: three can be visited, and no strategy does more."""
    world = World.create([[0.0, 0.1, 0, 0, 0, 0, 0]])
    answer = mrac.evaluate(world, mrac.plan(world, 1, range=2), rollouts=64)
    assert 2.7 < answer.bounds.least.cells <= 3
    said = " ".join(as_text(lambda console: print_report(evaluation_report(answer), console)).split())
    assert (
        "% on average with this team on this map (proven; of the range it knows only which cells are too far)" in said
    )


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
            assert {tuple(cell) for cell in np.argwhere(within(world, plan)).tolist()} == can
            assert best <= any_strategy(trimmed(world, plan), [[0, 0]]).cells + 1e-9
            assert closed_loop_exact(make_plan(world, [[0, 0]], settings), world).visited <= best + 1e-9


def test_what_is_too_far_to_come_home_from_is_not_in_the_bound() -> None:
    """Seven safe cells, moves for four: the third cell is the last from which a robot comes home, charged or not."""
    world = World.create([[0.0, 0.1, 0, 0, 0, 0, 0]])
    for recharge in (None, 2):
        plan = mrac.plan(world, 1, range=4, return_to="home", recharge=recharge)
        answer = mrac.evaluate(world, plan, rollouts=64)
        assert 2.7 < answer.bounds.least.cells <= 3
        assert answer.rest is not None
        said = next(iter(rest_words(answer, answer.rest)))
        assert "4 accessible cells (57.1 %) are too far for any robot to visit and come home" in said
    ends = mrac.evaluate(world, mrac.plan(world, 1, range=4), rollouts=64)
    assert 4.4 < ends.bounds.least.cells <= 5


def test_check_says_the_optimum_of_a_tiny_world(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In table, JSON and page, above both loops; not where it is dear, and not of first visits in the closed loop."""
    world = tiny_world(3, 2, 4)
    world.save(tmp_path / "map.npz")
    found = mrac.check(world, 1)
    checks = {check.key: check for check in found.checks if check.formula == "optimum"}
    assert set(checks) == {"optimum/visited/open", "optimum/visited/closed"}
    best = optimum(world, [[0, 0]])
    assert all(check.value == best and check.verdict == "holds" for check in checks.values())
    assert run(["check", str(tmp_path / "map.npz"), "--out", str(tmp_path / "out")]) == 0
    assert f"{best:.2f}" in next(
        line for line in capsys.readouterr().out.splitlines() if "coverage of the best strategy" in line
    )
    assert '"key": "optimum/visited/closed"' in (tmp_path / "out" / "check.json").read_text()
    assert "coverage of the best strategy" in (tmp_path / "out" / "index.html").read_text()
    large = mrac.check(random_world(10, 10, ThreatPattern(areas=4, seed=1)), 2, rollouts=64)
    assert "optimum" not in {check.formula for check in large.checks}
    assert run(["check", str(tmp_path / "map.npz"), "--threat-checks", "first_visit", "--json"]) == 0
    assert "optimum/visited/closed" not in capsys.readouterr().out


@pytest.mark.parametrize("seed", range(6))
def test_no_strategy_covers_more_value(seed: int) -> None:
    rng = np.random.default_rng(seed)
    threat = rng.choice([0.0, 0.1, 0.4, 0.7], (2, 4)).astype(np.float32)
    value = rng.choice([0.0, 1.0, 3.5, 1e6], (2, 4))
    value[0, 0] = 1.0
    world = World.create(threat, value=value)
    bound = value_bound(world, [[0, 0]])
    best = best_of_one_robot(world)
    assert best <= bound * (1 + 1e-12)
    assert bound <= value.sum() * (1 + 1e-12)
    ones = World.create(threat, value=np.ones((2, 4)))
    assert value_bound(ones, [[0, 0]]) == pytest.approx(value_bound(World.create(threat), [[0, 0]]), rel=1e-9)
    assert best_of_one_robot(ones) <= value_bound(ones, [[0, 0]]) + 1e-9
