"""Robots that are not told the map (docs/spec.md, section 15), in the readable simulator."""

import itertools
from collections import Counter
from dataclasses import replace
from math import hypot, inf
from typing import Any

import numpy as np
import pytest
from closed_loop_worlds import survey_worlds
from oracle_unknown import Twin

from planner.errors import WorldError
from planner.ids import NO_ROBOT
from planner.mrac.board import Recorder
from planner.mrac.choose import frontier
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop, make_team, simulate
from planner.settings import Settings
from planner.tally import Doing, Outcome
from planner.world.features import with_prior, with_sense, with_truth
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.map_knowledge import Sense
from planner.world.world import World

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


def script(truth, stops):
    """Robot i is stopped at its `stops[i]`-th visit of a dangerous cell, never by 0."""
    visits = Counter()

    def stopped(robot, step, cell):
        visits[robot] += truth[tuple(cell)] > 0
        return bool(truth[tuple(cell)] > 0) and visits[robot] == stops[robot]

    return stopped


def both(believed, truth, starts, sense, stops):
    """A scripted run by the simulator and by the twin: paths, visited cells, outcome of each."""
    world = with_truth(World.create(believed), truth, sense)
    plan = make_plan(world, starts)
    problem = prepare(world, starts, plan.settings)
    hit, width = script(truth, stops), world.shape[1]
    run = simulate(problem, plan.areas, hit=lambda i, t, cell: hit(i, t, divmod(cell, width)), truth=0)
    areas = [
        (area.level, None if area.robot == NO_ROBOT else area.robot, cells_of(world, area.cells)) for area in plan.areas
    ]
    believed, truth = world.threat.astype(np.float64), world.met.astype(np.float64)
    seen = sense if isinstance(sense, dict) else {"range": sense, "sight": False}
    twin = Twin(believed, truth, [tuple(s) for s in starts], seen["range"], seen["sight"], areas, script(truth, stops))
    ended = twin.run()
    ours = [moves(cells_of(world, path)) for path in run.paths], set(cells_of(world, np.flatnonzero(run.visited)))
    theirs = [moves(walker.path) for walker in twin.team], twin.visited
    return (*ours, run.outcome.word), (*theirs, ended)


@pytest.mark.parametrize("number", range(len(MAPS)))
@pytest.mark.parametrize("sense", [1, 2, {"range": 2.5, "sight": True}])
def test_every_scripted_run_is_that_of_a_twin_written_from_the_rules(number, sense):
    believed, truth = (np.array(one) for one in MAPS[number])
    for one, other in ((believed, truth), (truth, believed)):
        free = np.argwhere(~np.isnan(other))
        for starts in (free[[0, -1]], free[[0, 0]]):
            for stops in itertools.product(range(4), repeat=2):
                ours, theirs = both(one, other, starts, sense, stops)
                assert ours == theirs, (stops, starts.tolist())


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
    sense = {"range": (1, 1.5, 2, 3)[stream.below(4)], "sight": stream.below(2) == 1}
    return believed, truth, starts, sense


POLICIES: tuple[dict[str, Any], ...] = (
    {"policy": "mrac"}, {"policy": "per_cell"}, {"policy": "per_cell", "reserve": 0.5},
    {"policy": "per_cell", "worth": 3.0}, {"policy": "frontier"}, {"policy": "frontier", "reserve": 0.5},
    {"policy": "watchful"},
)  # fmt: skip


def fuzz(number):
    """One run in a drawn world ends as Theorem 2 says."""
    stream = Stream(number, 1515)
    believed, truth, starts, sense = drawn(number, stream)
    world = with_truth(World.create(believed), truth, sense)
    settings = Settings(**POLICIES[number % len(POLICIES)])
    if number % 5 == 0:
        settings = replace(settings, range=4 + stream.below(12))
    recorder, loop = Recorder(), ReferenceLoop(make_plan(world, starts, settings), world)
    run = loop.run(number, 0, recorder)
    accessible = world.accessible(starts).ravel()
    assert not (run.visited & ~accessible).any()
    left = accessible & ~run.visited
    expected = {Outcome.COMPLETE: not left.any(), Outcome.ALL_ROBOTS_LOST: not run.alive.any()}
    if run.outcome in expected:
        assert expected[run.outcome]
        return
    assert left.any() and run.alive.any()
    assert run.outcome in (Outcome.NO_PROGRESS, Outcome.NOT_WORTH_THE_RISK)
    if settings.range is None and settings.worth is None and settings.reserve is None:
        trace = recorder.trace(0, run.area_of, run.outcome)
        looked = np.unique(trace.cells[trace.doing != Doing.DEAD])
        seen = np.zeros(accessible.size, dtype=np.bool_)
        seen[world.knowledge.sense.views(world.knowledge.free, looked)[1]] = True
        known = np.where(seen, world.met.ravel(), world.threat.ravel()).reshape(world.shape)
        # of what is known in the end, whoever is left can reach nothing that is unvisited
        in_reach = World.create(known).accessible(np.stack(divmod(trace.cells[-1][run.alive], world.shape[1]), axis=1))
        assert not (in_reach.ravel() & ~run.visited).any()


@pytest.mark.parametrize("first", range(0, 300, 50))
def test_whatever_appears_or_vanishes_runs_end_complete_stuck_or_lost(first):
    for number in range(first, first + 50):
        fuzz(number)


@pytest.mark.slow
def test_so_they_do_in_two_thousand_worlds():
    for number in range(300, 2300):
        fuzz(number)


def same(one, other):
    return one.outcome == other.outcome and one.time == other.time and all(map(np.array_equal, one.paths, other.paths))


@pytest.mark.parametrize("policy", ["mrac", "per_cell", "frontier"])
def test_who_believes_the_truth_runs_as_told(policy):
    told = random_world(12, 12, ThreatPattern(seed=3))
    starts, _ = place_starts(told, 4)
    plan = make_plan(told, starts, Settings(policy=policy))
    for sense in (0, 1, {"range": 4, "sight": True}, inf):
        world = with_truth(told, told.threat, sense)
        assert make_plan(world, starts, plan.settings).to_json() == plan.to_json()
        for rollout in range(5):
            assert ReferenceLoop(plan, world).trace(7, rollout) == ReferenceLoop(plan, told).trace(7, rollout)


def test_what_an_area_would_show_is_counted_cell_by_cell():
    world = with_prior(random_world(7, 9, ThreatPattern(seed=2)), 0.04, sense=1.5)
    starts, _ = place_starts(world, 2)
    problem = prepare(world, starts, Settings(policy="frontier"))
    team = make_team(problem, make_plan(world, starts, problem.settings).areas, truth=0)

    def near(cell, cells):
        return any(hypot(*np.subtract(divmod(cell, 9), divmod(int(other), 9))) <= 1.5 for other in cells)

    unseen = [cell for cell in np.flatnonzero(problem.unknown.within) if not near(cell, problem.starts)]
    shown = [sum(near(cell, area.cells) for cell in unseen) for area in team.areas]
    assert [frontier(team, number) for number in range(len(team.areas))] == shown
    assert len(set(shown)) > 1 and max(shown) == len(unseen)


def mixed_up(world, stream):
    """A belief with the same chances in other places."""
    threat = world.threat.ravel().copy()
    return threat[np.argsort(stream.words(threat.size), kind="stable")].reshape(world.shape)


def sees_all(one):
    """A survey world's runs by robots that see everything at once are those of robots that were told."""
    stream = Stream(11, 1516)
    world = with_truth(replace(one.world, threat=mixed_up(one.world, stream), starts=None), one.world.threat, inf)
    problem, told = prepare(world, one.starts, one.settings), prepare(one.world, one.starts, one.settings)
    if len(problem.levels.values) != len(told.levels.values):
        return False  # some level is out of reach: another scale of costs
    plan, expected = make_plan(world, one.starts, one.settings), one.plan()
    rollouts = [(ReferenceLoop(p, w), ReferenceLoop(q, v)) for p, w, q, v in ((plan, world, expected, one.world),)]
    assert all(same(a.run(one.seed, 1), b.run(one.seed, 1)) for a, b in rollouts)
    return True


@pytest.mark.parametrize("part", [pytest.param(0), pytest.param(1, marks=pytest.mark.slow)])
def test_who_sees_everything_runs_as_told(part):
    worlds = [one for one in survey_worlds() if one.settings.transit == "grid"]
    chosen = worlds[::20] if part == 0 else worlds
    compared = sum(sees_all(one) for one in chosen)
    assert compared > len(chosen) // 2


# --- what is seen ---


def test_a_corner_that_is_touched_hides_nothing_and_a_crossed_cell_does():
    free = np.ones((3, 4), dtype=np.bool_)
    free[0, 1] = free[1, 0] = free[1, 2] = False

    def seen(sense, cell):
        return set(sense.views(free, np.array([cell]))[1].tolist())

    assert {5, 1, 4} <= seen(Sense(3, True), 0)  # past two obstacles that meet in a corner; obstacles themselves too
    assert not {2, 3, 8} & seen(Sense(3, True), 0)
    assert seen(Sense(3, False), 0) == {0, 1, 2, 3, 4, 5, 6, 8, 9, 10}
    assert seen(Sense(1.4, False), 5) == {1, 4, 5, 6, 9}
    assert seen(Sense(1.5, False), 5) == {0, 1, 2, 4, 5, 6, 8, 9, 10}


@pytest.mark.parametrize("radius", [2, 5, 20])
def test_sight_is_that_of_a_walk_along_the_segment(radius):
    from oracle_unknown import crosses

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
        assert set(Sense(radius, True).views(free, np.array([source]))[1].tolist()) == expected


# --- what is refused ---


def test_worlds_say_what_is_wrong_with_them(tmp_path):
    world = World.create([[0.0, 0.1], [np.nan, 0.0]])
    with pytest.raises(WorldError, match=r"wrong about an obstacle at \[1, 0\] \(1 such cells\)"):
        with_prior(world, 0.1)
    with pytest.raises(WorldError, match="0, or a number of cells from 1 on"):
        with_prior(world, 0.1, "known", 0.5)
    with pytest.raises(WorldError, match="the cells that robots are told of"):
        with_truth(world, [[0.0]], 1)
    with pytest.raises(WorldError, match="nothing to sense"):
        with_sense(world, 2)
    with pytest.raises(WorldError, match=r"robot 0 starts at .* an obstacle"):
        make_plan(with_prior(world, 0.1, sense=1), [[1, 0]])


def test_a_world_file_keeps_what_robots_are_not_told(tmp_path):
    from planner.world.scenario import load_input

    world = with_prior(random_world(6, 6, ThreatPattern(seed=2)), 0.1, sense={"range": 2, "sight": True})
    world.save(tmp_path / "w.npz")
    again = load_input(tmp_path / "w.npz")
    assert again.luck_sha256 == world.luck_sha256 and again.knowledge.sense == Sense(2, True)
    assert with_sense(world, 3).luck_sha256 != world.luck_sha256 != with_sense(world, 2).luck_sha256
