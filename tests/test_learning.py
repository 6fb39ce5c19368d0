"""Robots that learn the map or the hazards: against twins written from the rules, and both ways."""

import hashlib
import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from math import hypot, inf
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from closed_loop_worlds import survey_worlds
from conftest import ANSWERS
from helpers import paths_of, play_both_ways
from numpy.typing import NDArray
from test_return_home import drawn as coming_home
from test_return_home import ways
from test_threats_over_time import POLICIES, changing

from planner.errors import InputError, WorldError
from planner.failure_model import own_key
from planner.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, final_odds, run_range, trace_rollouts
from planner.rollouts.engine import Rolling, closed_loop_engine, make_engine
from planner.rollouts.exact_tree import WHOLE, grow_tree
from planner.rollouts.single_run import PythonLoop, SingleRun
from planner.settings import Settings
from planner.simulator.codes import ALWAYS, NEVER, NO_AREA, Doing, EventKind, Outcome
from planner.simulator.jit import interpreted
from planner.simulator.state import ALARM, SILENCE
from planner.simulator.thresholds import threefry2x32
from planner.tally import Trace
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.map_knowledge import NAT, Sensor, chance_of
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.uncertain_maps import bounds_of
from planner.world.world import World

# Robots that are not told the map (docs/spec.md, section 15).

N = np.nan
MAPS = [
    ([[0, 0.3, 0, 0], [N, 0, 0.3, 0], [0, 0, 0, N]], [[0, 0, N, 0], [0, 0.3, 0, 0], [0, 0, 0.3, 0]]),
    ([[0, 0, 0, 0], [0, N, N, 0.2], [0, 0.2, 0, 0]], [[0, 0, 0, 0.2], [N, N, 0, 0], [0, 0.2, 0, 0.2]]),
    ([[0, 0, 0.1, 0.1, 0], [0, N, N, N, 0], [0, 0, 0, 0, 0]], [[0, 0, 0, 0, 0.1], [0, 0.1, 0, N, N], [0, 0, N, 0, 0]]),
    ([[0.1, 0.1, 0.1], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1]], [[0, 0.5, 0], [N, 0, N], [0, 0, 0.5]]),
    ([[0, N, 0, 0], [0, N, 0, 0], [0, 0, 0.2, 0]], [[0, 0, 0, 0], [0, 0, N, 0.2], [0, N, N, 0]]),
]  # fmt: skip
"""(believed, true)."""


def cells_of(world, indices):
    return [divmod(int(cell), world.shape[1]) for cell in indices]


def moves(path):
    """A path without the waiting after its last move."""
    path = [tuple(cell) for cell in path]
    while len(path) > 1 and path[-1] == path[-2]:
        path.pop()
    return path


class Script:
    """Robot i is stopped at its `stops[i]`-th visit of a cell that it may be stopped in; sure: all or none. What is
    consumed stops nobody any more."""

    def __init__(self, may, stops, uncertainty=None):
        self.may, self.stops, self.visits, self.known = may.ravel().copy(), stops, [0, 0], {}
        self.consumed = uncertainty is not None and uncertainty.kind == "consumed"
        self.sure = np.zeros(may.size) if self.consumed or uncertainty is None else uncertainty.h.ravel() == 1

    def hit(self, robot, step, cell):
        self.visits[robot] += self.may[cell]
        stopped = bool(self.may[cell] and self.visits[robot] == self.stops[robot])
        self.may[cell] &= not (stopped and self.consumed)
        return self.known.setdefault(cell, stopped) if self.sure[cell] else stopped


def written(run, world):
    """Paths, visited cells and outcome of a run, as JSON."""
    paths = [[list(map(int, cell)) for cell in moves(cells_of(world, path))] for path in paths_of(run)]
    return [paths, [list(cell) for cell in cells_of(world, np.flatnonzero(run.visited))], run.outcome.word]


def hash_of(runs):
    return hashlib.sha256(json.dumps(runs).encode()).hexdigest()[:16]


STOPS = [*itertools.product(range(4), repeat=2)]
SCRIPTS = pytest.mark.parametrize("most", [0, pytest.param(1, marks=pytest.mark.slow)])
"""Which visits stop the two robots: each of them once or twice, and all pairs; the position of their hash."""


@SCRIPTS
@pytest.mark.parametrize("number", range(len(MAPS)))
@pytest.mark.parametrize(("name", "sensor"), [("1", 1), ("2", 2), ("2.5 sight", {"range": 2.5, "sight": True})])
def test_every_scripted_run_is_that_of_a_twin_written_from_the_rules(number, name, sensor, most):
    (believed, truth), runs = map(np.array, MAPS[number]), []
    for one, other in ((believed, truth), (truth, believed)):
        world, free = World.create(one).with_true_map(other, sensor), np.argwhere(~np.isnan(other))
        for starts in (free[[0, -1]], free[[0, 0]]):
            loop = compile_closed_loop(make_plan(world, starts), world, interpreted=True)
            hits = [Script(other > 0, stops).hit for stops in (STOPS[::3], STOPS)[most]]
            runs += [written(SingleRun(loop, hit=hit).play(), world) for hit in hits]
    assert hash_of(runs) == ANSWERS["learning"][f"{number} {name}"][most]


def drawn(number, stream):
    """Two maps with little to do with each other, starts, and what is seen."""
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    levels = np.array([0.0, 0.0, 0.0, 0.1, 0.3, np.nan, np.nan])
    believed, truth = (levels[[stream.below(7) for _ in range(height * width)]].reshape(height, width) for _ in "ab")
    share = stream.below(3)  # of the cells that are as believed: none, half, most
    alike = np.array([stream.below(8) < 3 * share for _ in range(height * width)]).reshape(height, width)
    believed = np.where(alike, truth, believed)
    truth.flat[stream.below(height * width)] = 0.0
    if np.isnan(believed).all():
        believed.flat[0] = 0.1
    free = np.argwhere(~np.isnan(truth))
    starts = free[[stream.below(len(free)) for _ in range(1 + stream.below(5))]]
    sensor = {"range": (1, 1.5, 2, 3)[stream.below(4)], "sight": stream.below(2) == 1}
    return believed, truth, starts, sensor


POLICIES_UNKNOWN: tuple[dict[str, Any], ...] = (
    {"policy": "mrac"}, {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.5},
    {"policy": "per_cell", "robot_value": 3.0}, {"policy": "frontier"}, {"policy": "frontier", "risk_cap": 0.5},
    {"policy": "watchful"},
)  # fmt: skip


def fuzz(number):
    """One run in a drawn world ends as Theorem 2 says."""
    stream = Stream(number, 1515)
    believed, truth, starts, sensor = drawn(number, stream)
    world = World.create(believed).with_true_map(truth, sensor)
    settings = Settings(**POLICIES_UNKNOWN[number % len(POLICIES_UNKNOWN)])
    if number % 5 == 0:
        settings = replace(settings, range=4 + stream.below(12))
    run = PythonLoop(make_plan(world, starts, settings), world).run(number, 0)
    accessible = world.accessible(starts).ravel()
    assert not (run.visited & ~accessible).any()
    left = accessible & ~run.visited
    expected = {Outcome.COMPLETE: not left.any(), Outcome.ALL_ROBOTS_LOST: not run.alive.any()}
    if run.outcome in expected:
        assert expected[run.outcome]
        return
    assert left.any() and run.alive.any()
    assert run.outcome in (Outcome.NO_PROGRESS, Outcome.NOT_WORTH_THE_RISK)
    if settings.range is None and settings.robot_value is None and settings.risk_cap is None:
        trace = run.trace
        looked = np.unique(trace.cells[trace.doing != Doing.DEAD])
        seen = np.zeros(accessible.size, dtype=np.bool_)
        seen[world.knowledge.sensor.views(world.knowledge.free, looked)[1]] = True
        known = np.where(seen, world.met.ravel(), world.threat.ravel()).reshape(world.shape)
        # of what is known in the end, whoever is left can reach nothing that is unvisited
        in_reach = World.create(known).accessible(np.stack(divmod(trace.cells[-1][run.alive], world.shape[1]), axis=1))
        assert not (in_reach.ravel() & ~run.visited).any()


@pytest.mark.parametrize("numbers", [range(40), pytest.param(range(40, 1000), marks=pytest.mark.slow)], ids=str)
def test_whatever_appears_or_vanishes_runs_end_complete_stuck_or_lost(numbers):
    for number in numbers:
        fuzz(number)


@pytest.mark.parametrize("policy", ["mrac", "per_cell", "frontier"])
def test_who_believes_the_truth_runs_as_told(policy):
    told = random_world(12, 12, ThreatPattern(seed=3))
    starts, _ = place_starts(told, 4)
    plan = make_plan(told, starts, Settings(policy=policy))
    for sensor in (0, 1, {"range": 4, "sight": True}, inf):
        world = told.with_true_map(told.threat, sensor)
        assert make_plan(world, starts, plan.settings).to_json() == plan.to_json()
        mine, theirs = (trace_rollouts(compile_closed_loop(plan, one), 7, range(5)) for one in (world, told))
        assert mine == theirs


def test_what_an_area_would_show_is_counted_cell_by_cell():
    world = random_world(7, 9, ThreatPattern(seed=2)).with_prior_map(0.04, sensor_range=1.5)
    starts, _ = place_starts(world, 2)
    problem = prepare(world, starts, Settings(policy="frontier"))
    run = PythonLoop(make_plan(world, starts, problem.settings), world).begin(0, 0)
    run.advance()

    def near(cell, cells):
        return any(hypot(*np.subtract(divmod(cell, 9), divmod(int(other), 9))) <= 1.5 for other in cells)

    unseen = [cell for cell in np.flatnonzero(problem.unknown.within) if not near(cell, problem.starts)]
    to_do = np.where(run.visited, NO_AREA, run.area_of)
    shown = [sum(near(cell, np.flatnonzero(to_do == number)) for cell in unseen) for number in range(run.s.marks.areas)]
    assert [interpreted("policy").frontier(run.p, run.s, number) for number in range(len(shown))] == shown
    assert len(set(shown)) > 1 and max(shown) == len(unseen)


def mixed_up(world, stream):
    """A belief with the same chances in other places."""
    threat = world.threat.ravel().copy()
    return threat[np.argsort(stream.words(threat.size), kind="stable")].reshape(world.shape)


def sees_all(one, policy):
    """A survey world's runs by robots that see everything at once are those of robots that were told."""
    settings = replace(one.settings, policy=policy)
    mixed = replace(one.world, threat=mixed_up(one.world, Stream(11, 1516)), starts=None)
    world = mixed.with_true_map(one.world.threat, inf)
    problem, told = prepare(world, one.starts, settings), prepare(one.world, one.starts, settings)
    if len(problem.levels.values) != len(told.levels.values):
        return False  # some level is out of reach: another scale of costs
    plans = [(make_plan(where, one.starts, settings), where) for where in (world, one.world)]
    mine, theirs = (compile_closed_loop(*both, first_only=one.first_only) for both in plans)
    assert trace_rollouts(mine, one.seed, range(4)) == trace_rollouts(theirs, one.seed, range(4))
    return True


@pytest.mark.parametrize("part", [pytest.param(0), pytest.param(1, marks=pytest.mark.slow)])
def test_who_sees_everything_runs_as_told(part):
    worlds = [one for one in survey_worlds() if one.settings.transit == "grid"]
    chosen = worlds[::20] if part == 0 else worlds
    policies = itertools.cycle(("mrac", "per_cell", "frontier", "watchful"))
    compared = sum(sees_all(one, policy) for one, policy in zip(chosen, policies, strict=False))
    assert compared > len(chosen) // 2


# --- what is seen ---


def test_a_corner_that_is_touched_hides_nothing_and_a_crossed_cell_does():
    free = np.ones((3, 4), dtype=np.bool_)
    free[0, 1] = free[1, 0] = free[1, 2] = False

    def seen(sensor, cell):
        return set(sensor.views(free, np.array([cell]))[1].tolist())

    assert {5, 1, 4} <= seen(Sensor(3, True), 0)  # past two obstacles that meet in a corner; obstacles themselves too
    assert not {2, 3, 8} & seen(Sensor(3, True), 0)
    assert seen(Sensor(3, False), 0) == {0, 1, 2, 3, 4, 5, 6, 8, 9, 10}
    assert seen(Sensor(1.4, False), 5) == {1, 4, 5, 6, 9}
    assert seen(Sensor(1.5, False), 5) == {0, 1, 2, 4, 5, 6, 8, 9, 10}


def crosses(start, end, cell):
    """Whether the segment of two centres has a point strictly inside the cell: by a fine walk along it."""
    wide = abs(end[0] - start[0]) + abs(end[1] - start[1])
    # Between two places where the segment meets a grid line it is inside one cell: halfway between such places.
    marks = {0.0, 1.0}
    for axis in (0, 1):
        span = end[axis] - start[axis]
        marks |= {(k + 0.5) / abs(span) for k in range(abs(span))} if span else set()
    places = sorted(marks)
    for a, b in itertools.pairwise(places):
        if b - a > 1e-9 / max(wide, 1):
            at = [start[axis] + (end[axis] - start[axis]) * (a + b) / 2 for axis in (0, 1)]
            if all(abs(at[axis] - cell[axis]) < 0.5 - 1e-9 for axis in (0, 1)):
                return True
    return False


@pytest.mark.parametrize("radius", [2, 5, 20])
def test_sight_is_that_of_a_walk_along_the_segment(radius):
    stream, shape = Stream(radius, 1517), (9, 11)
    free = np.array([stream.below(4) > 0 for _ in range(99)]).reshape(shape)
    for source in (0, 37, 49, 98):
        at = divmod(source, 11)
        expected = {
            row * 11 + col
            for row, col in np.ndindex(shape)
            if (row - at[0]) ** 2 + (col - at[1]) ** 2 <= radius**2
            and not any(
                crosses(at, (row, col), tuple(wall))
                for wall in np.argwhere(~free).tolist()
                if tuple(wall) not in (at, (row, col))
            )
        }
        assert set(Sensor(radius, True).views(free, np.array([source]))[1].tolist()) == expected


# --- what is refused ---


def test_worlds_say_what_is_wrong_with_them(tmp_path):
    world = World.create([[0.0, 0.1], [np.nan, 0.0]])
    with pytest.raises(WorldError, match=r"wrong about an obstacle at \[1, 0\] \(1 such cells\)"):
        world.with_prior_map(0.1)
    with pytest.raises(WorldError, match="0, or a number of cells from 1 on"):
        world.with_prior_map(0.1, "known", 0.5)
    with pytest.raises(WorldError, match="the cells of the prior map"):
        world.with_true_map([[0.0]], 1)
    with pytest.raises(WorldError, match="a sensor range has no effect"):
        world.with_sensor_range(2)
    with pytest.raises(WorldError, match=r"robot 0 starts at .* an obstacle"):
        make_plan(world.with_prior_map(0.1, sensor_range=1), [[1, 0]])


def test_a_world_file_keeps_what_robots_are_not_told(tmp_path):
    from planner.world.scenario import load_input

    world = random_world(6, 6, ThreatPattern(seed=2)).with_prior_map(0.1, sensor_range={"range": 2, "sight": True})
    world.save(tmp_path / "w.npz")
    again = load_input(tmp_path / "w.npz")
    assert again.randomness_sha256 == world.randomness_sha256 and again.knowledge.sensor == Sensor(2, True)
    for sensor in (2, 3):
        assert world.with_sensor_range(sensor).randomness_sha256 != world.randomness_sha256


# Robots that are not told the map: counts, and the tree.


def paper_like(policy="mrac", sensor=2, side=12, robots=4, **more):
    world = random_world(side, side, ThreatPattern(seed=5)).with_prior_map(0.04, sensor_range=sensor)
    starts, _ = place_starts(world, robots)
    return world, make_plan(world, starts, Settings(policy=policy, **more))


@pytest.mark.parametrize("policy", ["mrac", "frontier"])
def test_robots_learn_which_of_several_maps_is_true(policy):
    base = random_world(8, 8, ThreatPattern(areas=3, seed=1))
    maps = [random_world(8, 8, ThreatPattern(areas=3, seed=seed)).threat for seed in range(1, 5)]
    maps = [np.where(base.free, np.nan_to_num(one), np.nan) for one in maps]
    starts, _ = place_starts(base.with_maps(maps), 3)
    for world in (
        base.with_maps(maps),
        base.with_maps(maps).with_prior_map(0.04, sensor_range=2),
        base.with_spread("beta", 9),
    ):
        world = world.with_sensor_range(1.5)
        plan = make_plan(world, starts, Settings(policy=policy))
        play_both_ways(plan, world, 2, 4)
        tally, results = run_range(compile_closed_loop(plan, world), 2, 0, 12, threads=1, singles=True)
        assert tally.visited @ np.arange(len(tally.visited)) == results.visited.sum()


def test_robots_that_are_told_look_ahead_at_nothing():
    """Then `frontier` is `per_cell`."""
    for seed in range(6):
        world = random_world(9, 9, ThreatPattern(seed=seed))
        starts, _ = place_starts(world, 3)
        loops = [
            compile_closed_loop(make_plan(world, starts, Settings(policy=name)), world)
            for name in ("per_cell", "frontier")
        ]
        one, other = (trace_rollouts(loop, seed, range(10)) for loop in loops)
        assert one == other


def test_a_tree_of_what_robots_learn_is_what_rollouts_come_to():
    world, plan = paper_like(side=9, robots=2, sensor=1)
    loop = compile_closed_loop(plan, world)
    tree = grow_tree(loop, 1e-3, 10**7)
    low, high = tree.covered("visited")
    results = run_range(loop, 1, 0, 20_000, singles=True)[1]
    error = results.visited.std() / np.sqrt(20_000)
    assert low - 5 * error < results.visited.mean() < high + 5 * error
    complete = tree.counts.outcomes[Outcome.COMPLETE] / WHOLE
    share = (results.outcome == Outcome.COMPLETE).mean()
    assert abs(share - complete) < 5 * np.sqrt(complete * (1 - complete) / 20_000) + 1e-6


def test_what_a_sensor_is_worth():
    """The order of a trial with 120 rollouts: three cells are worth nearly the map, and not to look costs much."""
    world = random_world(pattern=ThreatPattern(seed=1))
    starts, _ = place_starts(world, 8)
    covered = {}
    for name, one in {
        "told": world.with_prior_map(0.04, sensor_range=inf), 1: world.with_prior_map(0.04, sensor_range=1),
        3: world.with_prior_map(0.04, sensor_range=3), "blind": world.with_prior_map(0.04, "known"),
    }.items():  # fmt: skip
        loop = compile_closed_loop(make_plan(one, starts), one)
        tally = run_range(loop, 1, 0, 500)[0]
        covered[name] = tally.visited @ np.arange(len(tally.visited)) / 500 / loop.accessible
    assert covered["told"] - 0.04 < covered[3] < covered["told"] + 0.02
    assert covered["blind"] + 0.1 < covered[1] < covered[3]


def test_knowledge_is_part_of_the_identity_and_jax_says_no():
    world, plan = paper_like()
    loops = [
        compile_closed_loop(plan, world.with_sensor_range(sensor)) for sensor in (2, 3, {"range": 2, "sight": True})
    ]
    assert len({loop.identity for loop in loops}) == 3
    assert make_engine(plan, world, Rolling(), "numba").accessible == loops[0].accessible
    pytest.importorskip("jax")
    with pytest.raises(WorldError, match="robots that learn the map"):
        closed_loop_engine(loops[0], 0, "jax")


@pytest.mark.parametrize("settings", [{"transit": "area"}])
def test_what_robots_that_learn_do_not_do(settings):
    world, plan = paper_like()
    plan = make_plan(world, plan.starts, Settings(**settings))
    with pytest.raises(WorldError, match="legs that stay in their area, requires a known map"):
        compile_closed_loop(plan, world)


# Robots that learn the map and come home: by what is believed, as both engines and the plainest search say.

Believed = Callable[[int], NDArray[Any]]
"""p `[N]`, NaN = obstacle, as robots believe the map at the end of a step; asked of steps in order."""
HOMES: list[dict[str, Any]] = [
    {"return_to": "home"},
    {"return_to": "nearest", "range": 12},
    {"return_to": "home", "range": 10, "recharge": 2},
    {"return_to": "nearest", "deadline": 18},
    {"return_to": "home", "range": 14, "recharge": 3, "deadline": 40},
]


def as_seen(trace: Trace, world: World, plan: Plan) -> Believed:
    """What was seen from where robots were is as it is, all else as they were told."""
    cells = np.stack(np.indices(world.shape)).reshape(2, -1)
    true, belief = world.met.ravel(), world.threat.ravel().astype(np.float64).copy()

    def look(robots: list[int]) -> None:
        for place in np.stack(np.divmod(robots, world.shape[1]), axis=1):
            seen = ((cells - place[:, None]) ** 2).sum(axis=0) <= world.knowledge.sensor.range**2
            belief[seen] = true[seen]

    def believed(step: int) -> NDArray[np.float64]:
        look([cell for cell, doing in zip(trace.cells[step], trace.doing[step], strict=True) if doing != Doing.DEAD])
        return belief

    look((plan.starts @ [world.shape[1], 1]).tolist())
    return believed


def check_ways(trace: Trace, world: World, plan: Plan, believed: Believed) -> None:
    """Who is on its way home goes by the safest way, as the map is believed at the end of the step before."""
    problem, starts = prepare(world, plan.starts, plan.settings or Settings()), plan.starts
    values = problem.levels.values
    for step in range(trace.time):
        free = {cell: float(p) for cell, p in enumerate(believed(step)) if not np.isnan(p)}
        level = {cell: int(np.abs(values - p).argmin()) for cell, p in free.items()}
        entry = {cell: int(problem.entry[of]) for cell, of in level.items() if abs(values[of] - free[cell]) < 1e-6}
        assert all(cell in entry for cell in free if problem.unknown.within[cell])  # others' p may have no price
        for robot in np.flatnonzero(trace.doing[step] == Doing.RETURNING):
            own = starts[robot : robot + 1] if plan.settings.return_to == "home" else starts  # type: ignore[union-attr]
            bases = [int(row * world.shape[1] + col) for row, col in own]
            found = ways(world, [base for base in bases if base in entry], entry)
            before, after = int(trace.cells[step, robot]), int(trace.cells[step + 1, robot])
            assert found[after] == (found[before][0] - entry[after], found[before][1] - 1)


def test_a_way_home_that_is_not_as_believed_by_hand() -> None:
    """A ring of eight cells around an obstacle: on the far side the robot sees that the way ahead is blocked."""
    blocked = np.array([[0, 0, 0], [0, np.nan, 0], [0, 0, np.nan]])
    world = World.create([[0, 0, 0], [0, np.nan, 0], [0, 0, 0]]).with_true_map(blocked, {"range": 1, "sight": False})
    plan = make_plan(world, [[0, 0]], Settings(return_to="home"))
    trace = trace_rollouts(compile_closed_loop(plan, world), 0, [0])[0]
    assert trace.cells[-1, 0] == 0 and len(np.unique(trace.cells)) == 7
    assert trace.events[-1, 2] == EventKind.HOME


def test_the_tree_of_robots_that_learn_and_come_home() -> None:
    world = World.create([[0, 0.1, 0.1], [0, np.nan, 0.3], [0.2, 0, 0]]).with_prior_map(0.1, sensor_range=1)
    plan = make_plan(world, [[0, 0], [2, 2]], Settings(return_to="nearest", range=14))
    loop = compile_closed_loop(plan, world)
    tree = grow_tree(loop, 0.0, 10**6)
    assert tree is not None and not tree.left
    chances, sampled = tree.counts.home / WHOLE, run_range(loop, 5, 0, 20_000)[0].home / 20_000
    assert (np.abs(sampled - chances) <= 5 * np.sqrt(chances * (1 - chances) / 20_000) + 1e-9).all()
    assert 0.05 < chances[2] < 0.95


# Robots that learn about hazards from what happens to them (docs/spec.md, section 15).

TINY = [
    ([[0, 0.3, 0], [0.3, 0, 0.6], [0, 0.2, 0]], 0.5),
    ([[0, 0.3, 0.3, 0], [N, 0.3, N, 0.2]], 1.0),
    ([[0.4, 0.1, 0], [0, 0.1, N], [0.2, 0, 0.7]], [[0.5, 0.9, 0], [0, 0.9, 0], [1, 0, 0.5]]),
]
"""q, h."""
DETECTORS = (None, (1.5, 0.9, 0.2), (1, 1.0, 0.1), (2, 0.6, 0.0))


def taught(q, h, kind, detector=None):
    """A world of robots that learn."""
    q = np.array(q, dtype=np.float64)
    world = World.create(np.where(np.isnan(q), N, 0)).with_latent_hazard(kind, q, h, learn=True)
    if detector is None:
        return world
    return world.with_sensor_range(dict(zip(("range", "detect", "false_alarm"), detector, strict=True)))


def wants(robot, step, cell):
    """A scripted reading: one in four is an alarm."""
    return (7 * robot + 5 * step + 3 * cell) % 4 == 0


def nothing(robot, step, cell):
    """No alarm: where a reading may be certain, one that contradicts what happened would be none."""
    return False


def played(loop, hit, alarm):
    """The run by these judges of visits and readings."""
    beliefs = interpreted("map_belief")

    def read(t, s, how, rollout, robot):
        here = s.robots[robot].cell
        for cell in t.in_view[t.view_begin[here] : t.view_begin[here + 1]].tolist():
            heard = alarm(robot, int(s.marks.step), int(loop.cells[cell]))
            beliefs.add(s, cell, t.evidence[ALARM] if heard else -t.evidence[SILENCE])

    with patch.object(beliefs, "read", read):
        return SingleRun(loop, hit=hit).play()


@pytest.mark.parametrize("number", range(len(TINY)))
@pytest.mark.parametrize("kind", ["persistent", "consumed"])
@pytest.mark.parametrize("which", range(len(DETECTORS)))
@SCRIPTS
def test_every_scripted_run_is_that_of_a_twin_written_from_the_rules_experience(most, number, kind, which):
    (q, h), detector, runs = TINY[number], DETECTORS[which], []
    world, free = taught(q, h, kind, detector), np.argwhere(~np.isnan(np.array(q, dtype=float)))
    readings = wants if detector and detector[2] > 0 and detector[1] < 1 else nothing
    for starts in (free[[0, -1]], free[[0, 0]]):
        plan = make_plan(world, starts, Settings(levels=64))  # the twin knows no bins
        loop = compile_closed_loop(plan, world, interpreted=True)
        for stops in (STOPS[::3], STOPS)[most]:
            run = played(loop, Script(world.threat > 0, stops, world.uncertainty).hit, readings)
            runs.append([*written(run, world), run.raw.odds.tolist()])
    assert hash_of(runs) == ANSWERS["lessons"][f"{number} {kind} {which}"][most]


@pytest.mark.parametrize(("detect", "false_alarm", "robot_value", "time"), [(0.7, 0.3, 8, 6), (0.6, 0.3, 32, 9)])
def test_a_detector_that_changes_the_map_keeps_a_waiting_team_up(detect, false_alarm, robot_value, time):
    """`0 q 0 0`, q = .5, h = .9: nobody goes at first. Each silent step takes ln((1 - a) / (1 - b)) nats off, and in
    the steps in which that is another class the map changes; at the least class, or before, the robot goes.
    """
    world = taught([[0, 0.5, 0, 0]], np.full((1, 4), 0.9), "persistent", (1, detect, false_alarm))
    plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", robot_value=robot_value))
    assert (plan.outcome, plan.time) == ("not_worth_the_risk", 2)  # in the nominal run nobody learns
    loop = compile_closed_loop(plan, world, interpreted=True)
    run = played(loop, nothing, nothing)
    assert (run.outcome.name, run.step, int(run.visited.sum())) == ("COMPLETE", time, 4)
    play_both_ways(plan, world, robot_value, 12)


@pytest.mark.parametrize(
    "number, kind", [(0, "persistent"), (0, "consumed"), pytest.param(2, "persistent", marks=pytest.mark.slow)]
)
def test_all_that_can_happen_on_a_hidden_map_is_what_rollouts_come_to(number, kind):
    """Every hidden map and every hit, by the twin, against rollouts: visited cells, and the mean posterior."""
    count = 5_000
    world, exact = taught(*TINY[number], kind), np.array(ANSWERS["hidden"][f"{number} {kind}"])
    loop = compile_closed_loop(make_plan(world, [[0, 0], [0, 0]], Settings(levels=64)), world)
    _, singles = run_range(loop, 3, 0, count, singles=True)
    posterior = np.zeros((count, world.threat.size))
    posterior[:, loop.cells] = chance_of(final_odds(loop, 3, 0, count))
    for found, wanted in ((singles.visited, exact[-1:]), (posterior, exact[:-1])):
        error = found.std(axis=0) / np.sqrt(count) + 1e-6
        assert (np.abs(found.mean(axis=0) - wanted) < 5 * error).all(), (number, kind)
    if kind == "persistent":  # what is learned is right on average: the law of total probability
        np.testing.assert_allclose(exact[:-1], np.nan_to_num(world.uncertainty.q.ravel()), atol=1e-6)


# --- calibration ---

FIELD = random_world(9, 9, ThreatPattern("scattered", 4, (0.1, 0.3, 0.5), 5), obstacles=0.1, threats=0.4)
Q = np.where(FIELD.threat > 0, np.nan_to_num(FIELD.threat), 0.1)


def hidden(world, seed, count):
    """Where a hazard is at first in each rollout, bool `[count, N]`, drawn as docs/spec.md, section 13, says."""
    cells = np.arange(world.threat.size)
    words, _ = threefry2x32(own_key(seed, 0), np.arange(count)[:, None], cells)
    return (words >> np.uint32(8)) < bounds_of(world.uncertainty.q).ravel()


@pytest.mark.parametrize("detector", [None, (2, 0.7, 0.2)])
def test_posteriors_are_calibrated_and_their_mean_is_the_prior_in_every_cell(detector):
    count = 1500
    world = taught(np.where(np.isnan(FIELD.threat), N, Q), 0.4, "persistent", detector)
    plan = make_plan(world, place_starts(world, 3)[0])
    loop = compile_closed_loop(plan, world)
    posterior, visits = chance_of(final_odds(loop, 17, 0, count)), run_range(loop, 17, 0, count)[0].visits[loop.cells]
    there, prior = hidden(world, 17, count)[:, loop.cells], world.uncertainty.q.ravel()[loop.cells].astype(float)
    often = visits * prior * 0.4 > 40  # stops expected: with few a mean is skewed, and cells are tested together
    apart = np.column_stack([(posterior - prior)[:, often], (posterior - prior)[:, ~often].sum(axis=1)])
    assert often.sum() > 30
    assert (np.abs(apart.mean(axis=0)) < 5 * apart.std(axis=0) / np.sqrt(count) + 1e-6).all()
    for low, high in itertools.pairwise(np.linspace(0, 1, 11)):
        inside = (posterior >= low) & (posterior <= high)
        if inside.sum() > 100:
            spread = np.sqrt((posterior * (1 - posterior))[inside].sum()) + 1e-9
            assert abs((there[inside] - posterior[inside]).sum()) < 5 * spread, low


def test_what_is_known_for_certain_runs_as_before():
    for kind in ("persistent", "consumed"):
        q = np.where(FIELD.threat > 0.2, 1.0 if kind == "persistent" else 0.0, 0.0)
        plain = FIELD.with_latent_hazard(kind, q, 0.4)
        for world in (
            FIELD.with_latent_hazard(kind, q, 0.4, learn=True),
            FIELD.with_latent_hazard(kind, q, 0.4, learn=True).with_sensor_range(
                {"range": 3, "detect": 0.9, "false_alarm": 0.1}
            ),
        ):
            starts = place_starts(plain, 3)[0]
            for policy in ("mrac", "per_cell"):
                plan = make_plan(plain, starts, Settings(policy=policy))
                assert make_plan(world, starts, plan.settings).to_json() == plan.to_json()
                loops = [compile_closed_loop(plan, one) for one in (plain, world)]
                assert trace_rollouts(loops[0], 4, range(9)) == trace_rollouts(loops[1], 4, range(9))


# --- engines ---


def drawn_experience(number):
    """A world of robots that learn, drawn, their starts and settings."""
    stream = Stream(number, 3301)
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    chances, stops = np.array([0, 0, 0.05, 0.3, 0.6, 1, N, N]), (0.2, 0.5, 0.9, 1.0)
    q = chances[[stream.below(8) for _ in range(height * width)]].reshape(height, width)
    q.flat[stream.below(height * width)] = 0.0
    h = np.where(q == 1, 0.5, np.array([stops[stream.below(4)] for _ in range(q.size)]).reshape(q.shape))
    world = World.create(np.where(np.isnan(q), N, 0)).with_latent_hazard(
        ("persistent", "consumed")[number % 2], q, h, True
    )
    if number % 3:
        rates = ((0.9, 0.1), (0.5, 0.3), (1, 0.1), (0.7, 0))[stream.below(4)]
        sensor = {"range": (1, 1.5, 2, 3)[stream.below(4)], "sight": stream.below(2) == 1}
        world = world.with_sensor_range(sensor | {"detect": rates[0], "false_alarm": rates[1]})
    free = np.argwhere(~np.isnan(q))
    starts = free[[stream.below(len(free)) for _ in range(1 + stream.below(5))]]
    settings = Settings(**POLICIES_UNKNOWN[number % len(POLICIES_UNKNOWN)])
    if number % 5 == 0:
        settings = replace(settings, range=4 + stream.below(12))
    return world, starts, settings


@pytest.mark.parametrize("what", ["mrac", "frontier", "hazards", "detector"])
def test_no_count_depends_on_threads_or_chunks(what, monkeypatch):
    monkeypatch.setattr("planner.rollouts.runners.LEAST_SHARED", 1)
    if what in ("mrac", "frontier"):
        world, plan = paper_like(what)
    else:
        detector = (2, 0.7, 0.2) if what == "detector" else None
        world = taught(np.where(np.isnan(FIELD.threat), N, Q), 0.4, "consumed", detector)
        plan = make_plan(world, place_starts(world, 3)[0], Settings(policy="per_cell"))
    loop = compile_closed_loop(plan, world)
    tally = run_range(loop, 5, 0, 60, threads=2)[0]
    apart = [run_range(loop, 5, start, 20, threads=threads)[0] for start, threads in ((0, 1), (20, 2), (40, 1))]
    assert apart[0] + apart[1] + apart[2] == tally
    assert len(tally.visited) == loop.accessible + 1 == int(world.accessible(plan.starts).sum()) + 1
    play_both_ways(plan, world, 5, 1)


# --- what is said, and refused ---


def test_bayes_rule_in_whole_numbers():
    evidence = taught([[0.2, 1, 0]], [[0.5, 0.5, 1]], "persistent", (1, 0.8, 0.1)).uncertainty.evidence
    assert evidence.prior.tolist() == [round(np.log(0.25) * NAT), ALWAYS, NEVER]
    after = evidence.read(evidence.prior, np.array([0, 0, 1, 2]), np.array([True, False, False, True]))
    q = float(np.float32(0.2))
    wanted = [q * 0.8 / (q * 0.8 + (1 - q) * 0.1), q * 0.2 / (q * 0.2 + (1 - q) * 0.9), 1, 0]
    np.testing.assert_allclose(chance_of(after), wanted, atol=1e-6)
    classes = [evidence.class_of(evidence.prior + lost * NAT // 2, np.array([0]))[0] - 6 for lost in range(-11, 12)]
    assert classes == [4, 4, 4, 4, 3, 3, 2, 2, 1, 1, 0, 0, 0, -1, -1, -2, -2, -3, -3, -4, -4, -4, -4]


def test_worlds_say_what_is_wrong_with_them_experience(tmp_path):
    world = taught([[0.2, 0.1], [0, 0]], 0.5, "persistent")
    with pytest.raises(WorldError, match="detectors, not seen"):
        world.with_sensor_range(2)
    with pytest.raises(WorldError, match="has no effect"):
        world.with_sensor_range({"range": 2, "detect": 0.1, "false_alarm": 0.1})
    with pytest.raises(WorldError, match="drawn independently"):
        world.with_latent_hazard("independent", 0.1, learn=True)
    with pytest.raises(WorldError, match="do not support this uncertainty"):
        world.with_prior_map(0.1, sensor_range=1)
    with pytest.raises(WorldError, match="learn: true"):
        replace(world, uncertainty=replace(world.uncertainty, learn=False)).with_sensor_range(1)
    plan = make_plan(world, [[0, 0]])
    with pytest.raises(WorldError, match=r"first_visit.*leave `learn` out"):
        compile_closed_loop(plan, world, first_only=True)
    with pytest.raises(InputError, match="robots that learn the map"):
        closed_loop_engine(compile_closed_loop(plan, world), 1, "jax")


def test_scenarios_and_world_files_keep_it(tmp_path):
    world = taught([[0.2, 0.1], [0, 0]], 0.5, "consumed").with_sensor_range(
        {"range": 2, "detect": 0.8, "false_alarm": 0.1, "sight": True}
    )
    world.save(tmp_path / "w.npz")
    again = load_input(tmp_path / "w.npz")
    assert again.randomness_sha256 == world.randomness_sha256
    assert again.uncertainty.detector == world.uncertainty.detector
    World.create(world.uncertainty.q).save(tmp_path / "q.npz")
    text = "map: q.npz\nlatent_hazard: {kind: consumed, h: 0.5, learn: true}\nsensor_range: {range: 2, %s}\n"
    (tmp_path / "s.yaml").write_text(text % "sight: true, detect: 0.8, false_alarm: 0.1")
    assert load_input(tmp_path / "s.yaml").randomness_sha256 == world.randomness_sha256
    for wrong in ("detect: 0.8", "detect: 2, false_alarm: 0"):
        (tmp_path / "s.yaml").write_text(text % wrong)
        with pytest.raises(InputError, match="sensor_range"):
            load_input(tmp_path / "s.yaml")


# Robots that come home while hazards teach them, or threats change: by what is believed by then.

LEVELS = 512
"""More than a world of hazards has values: none is quantised, and what is believed can be told by its p."""


def unseen(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world of robots that see the map."""
    believed, truth, starts, sensor = drawn(number, Stream(number, 1515))
    settings = Settings(**POLICIES_UNKNOWN[number % len(POLICIES_UNKNOWN)] | HOMES[number % 5])
    in_area = "boustrophedon" if number % 4 == 1 else "nearest"
    return World.create(believed).with_true_map(truth, sensor), starts, replace(settings, in_area=in_area)


def hazards(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world of robots that learn, with a detector or without one."""
    world, starts, settings = drawn_experience(number)
    return world, starts, replace(settings, levels=LEVELS, **{"range": None} | HOMES[number // 3 % 5])


def phases(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world of threats that change, and that robots are told of."""
    world, starts = changing(3 * number, Stream(number, 1616))
    policy = POLICIES[number % len(POLICIES)] | {"range": None}
    return world, starts, Settings(**policy | HOMES[number // 3 % 5])


def as_happened(trace: Trace, world: World, *_: Any) -> Believed:
    """p by Bayes' rule, of what visits and stops told: three survived visits of a cell at most."""
    hazard: Any = world.uncertainty
    hits, sure = hazard.h.ravel().astype(np.float64), {0.0, 1.0}
    first = hazard.q.ravel().astype(np.float64)
    chance, passed = first.copy(), np.zeros(first.size, dtype=int)

    def believed(step: int) -> NDArray[np.float64]:
        for robot, (cell, doing) in enumerate(zip(trace.cells[step].tolist(), trace.doing[step].tolist(), strict=True)):
            was = trace.doing[step - 1, robot] if step else None
            if doing == Doing.DEAD != was:
                chance[cell] = float(hazard.kind == "persistent")
            elif doing != Doing.DEAD and (step == 0 or cell != trace.cells[step - 1, robot]):
                passed[cell] += 1
                if chance[cell] not in sure and passed[cell] <= 3:
                    chance[cell] = chance[cell] * (1 - hits[cell]) / (1 - chance[cell] * hits[cell])
        p = np.where(np.isnan(world.threat.ravel()), np.nan, chance * hits)
        return np.where(p == 1, np.nan, p)

    return believed


def as_told(trace: Trace, world: World, *_: Any) -> Believed:
    """p of the phase that the next step is in."""
    changes: Any = world.phases

    def believed(step: int) -> NDArray[np.float32]:
        return changes.threats[max(n for n, begin in enumerate(changes.begins) if begin <= step + 1)].ravel()

    return believed


def wrecks(number: int) -> tuple[World, NDArray[np.int64], Settings]:
    """A drawn world in which lost robots block their cells."""
    policy = POLICIES[number % len(POLICIES)] | {"range": None}
    return *coming_home(number), Settings(**policy | HOMES[number // 3 % 5], wrecks="block")


def as_blocked(trace: Trace, world: World, *_: Any) -> Believed:
    """The map without the cells of lost robots, once nobody else is there; nobody enters them then."""
    p = world.threat.ravel().astype(np.float64).copy()

    def believed(step: int) -> NDArray[np.float64]:
        lost = trace.doing[step] == Doing.DEAD
        assert not np.isnan(p[trace.cells[step, ~lost]]).any()
        p[np.setdiff1d(trace.cells[step, lost], trace.cells[step, ~lost])] = np.nan
        return p

    return believed


DRAWN = {"seen": (unseen, as_seen), "hazards": (hazards, as_happened), "phases": (phases, as_told)}
DRAWN |= {"wrecks": (wrecks, as_blocked)}


def agree(kind: str, number: int) -> NDArray[np.int64]:
    """Robots in a drawn world; how often they were surprised, came home, and went there as was checked."""
    make, by = DRAWN[kind]
    world, starts, settings = make(number)
    plan = make_plan(world, starts, settings)
    loop = compile_closed_loop(plan, world)
    traces = trace_rollouts(loop, number, range(2))
    if kind == "wrecks":
        play_both_ways(plan, world, number, 2)
    tally, singles = run_range(loop, number, 0, 64, threads=2, singles=True)
    np.testing.assert_array_equal(tally.home, np.bincount(singles.home, minlength=len(starts) + 1))
    limits = settings.range, settings.deadline
    if settings.return_to == "home" and limits == (None, None) and kind not in ("hazards", "wrecks"):
        np.testing.assert_array_equal(singles.home, singles.alive)  # where it came from it can always go back
    events = np.concatenate([trace.events[:, 2] for trace in traces])
    found = [int((events == event).sum()) for event in (EventKind.SURPRISED, EventKind.HOME)]
    is_told = not world.knowledge.sensor.sight if kind == "seen" else loop.learns
    if not is_told or (kind == "hazards" and world.uncertainty.detector is not None):
        return np.array([*found, 0])
    for trace in traces:
        check_ways(trace, world, plan, by(trace, world, plan))
    return np.array([*found, sum(int((trace.doing == Doing.RETURNING).sum()) for trace in traces)])


BELIEFS = [
    ("seen", range(24), 40), ("hazards", range(12), 6), ("phases", range(12), 6), ("wrecks", range(12), 6),
    pytest.param("seen", range(24, 1024), 1000, marks=pytest.mark.slow),
    pytest.param("hazards", range(24, 524), 200, marks=pytest.mark.slow),
    pytest.param("phases", range(24, 524), 200, marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "numbers", "least"), BELIEFS)
def test_robots_come_home_by_what_is_believed(kind: str, numbers: range, least: int) -> None:
    assert (sum(agree(kind, number) for number in numbers) > least).all()


@pytest.mark.parametrize(("wrecks", "visited", "alive"), [("ignore", 4.75, 1.25), ("block", 4.5, 1.5)])
def test_a_lost_robot_blocks_a_corridor_by_hand(wrecks: Any, visited: float, alive: float) -> None:
    """The robot next to the threat enters it first: if it is lost there, the other goes after it, or has no way."""
    world = World.create([[0, 0, 0, 0.5, 0]])
    plan = make_plan(world, [[0, 0], [0, 2]], Settings(wrecks=wrecks))
    tree = grow_tree(compile_closed_loop(plan, world), 0.0, 10**6)
    assert tree is not None and (*tree.covered("visited"), tree.mean_alive) == pytest.approx((visited, visited, alive))
    assert compile_closed_loop(plan, world).learns == (wrecks == "block")


def test_a_phase_that_begins_turns_who_is_on_its_way_home_by_hand() -> None:
    """Two by six cells, all visited at step 11 in [1, 0], home in [0, 5]: from step 14 on danger is above."""
    later = np.zeros((2, 6))
    later[0, 2:5] = 0.5
    world = World.create(np.zeros((2, 6))).with_phases([(14, later)])
    plan = make_plan(world, [[0, 0]], Settings(return_to=((0, 5),)))
    assert plan.robots[0].path.tolist() == [0, 1, 2, 3, 4, 5, 11, 10, 9, 8, 7, 6, 0, 1, 7, 8, 9, 10, 11, 5]
