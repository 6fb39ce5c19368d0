"""Robots that wear, and robots that differ: known answers, every engine, the law by enumeration, closed forms."""

from __future__ import annotations

import itertools
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from doubt import WORLDS
from test_planner_luck import NAMES, known, mean, world_of

from analysis.theory.exact import open_loop_exact
from planner.errors import PlanError, ScenarioError, StateError
from planner.failure_model import CERTAIN, MOST, PLAIN, Bearing, tolerance_of, unworn, wear_nodes, worn
from planner.failure_model import susceptible as made_susceptible
from planner.mrac.make_plan import make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.plan_team import read_plan
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.simulator.exact_tree import grow_tree
from planner.tally import Tally
from planner.world.generate import ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.scenario import load_input
from planner.world.world import World

FIGURES = ("visited", "survived", "time", "alive")
ROW = World.create(np.array([[0.2, 0.3, 0.0, 0.4, 0.1, 0.3]], dtype=np.float32), [[0, 2], [0, 2]])


@cache
def worn_plan(name: str) -> tuple[World, Plan]:
    world, wear = world_of(name), known(name)["wear"]
    settings = Settings(wear=wear["shape"], susceptibility=tuple(wear["susceptibility"]))
    return world, make_plan(world, world.starts, settings)


def counts_of(tally: Tally) -> list[list[int]]:
    return [getattr(tally, what).tolist() for what in (*FIGURES, "visits", "stops", "covered_visited")]


@pytest.mark.parametrize("shape", [0.25, 1.0, 2.0, 16.0])
@pytest.mark.parametrize("times", [1 / 64, 0.5, 1.0, 1.3, 64.0])
def test_an_exposure_reaches_the_tolerances_that_wear_brings_down_to_it(shape: float, times: float) -> None:
    words = np.random.default_rng(3).integers(0, 2**32, 3000)
    drawn = np.concatenate([np.arange(1, 500), tolerance_of(words), [MOST]])
    units, nodes = round(times * 2**16), wear_nodes(shape)

    def borne(tolerance: np.ndarray) -> np.ndarray:
        return made_susceptible(worn(tolerance, shape), units / 2**16)

    for more in (-1, 0, 1):
        exposure = borne(drawn) + more
        reached = np.minimum(unworn(exposure, nodes, units), MOST)
        assert (borne(np.maximum(reached, 1)) <= exposure)[reached > 0].all()
        assert (borne(np.minimum(reached + 1, MOST)) > exposure)[reached < MOST].all()
    assert unworn(np.array([0, CERTAIN, CERTAIN + 2**37]), nodes, units)[0] == 0
    assert (unworn(np.array([CERTAIN, CERTAIN + 2**37]), nodes, units) >= 2 * MOST).all()


@pytest.mark.parametrize("name", NAMES)
def test_worn_rollouts_are_those_of_an_independent_simulator(name: str) -> None:
    (world, plan), wear, seed = worn_plan(name), known(name)["wear"], known(name)["seed"]
    found = plan.bearing.tolerances(seed, range(len(wear["tolerance"])), len(plan.robots))
    assert found.tolist() == wear["tolerance"]
    readable, loop = ReferenceLoop(plan, world), compile_closed_loop(plan, world)
    _, singles = run_range(loop, seed, 0, len(wear["rollouts"]), singles=True, threads=1)
    assert singles is not None
    for one in wear["rollouts"]:
        expected = [one[what] for what in FIGURES]
        run = readable.run(seed, one["id"])
        assert [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum()] == expected
        assert [getattr(singles, what)[one["id"]] for what in FIGURES] == expected
        hits = readable.trace(seed, one["id"]).events
        assert hits[hits[:, 2] == 1][:, [0, 1, 4]].tolist() == one["hits"]


@pytest.mark.parametrize("name", NAMES)
def test_worn_means_are_those_of_everything_that_can_happen(name: str) -> None:
    (world, plan), exact = worn_plan(name), known(name)["wear"]["exact"]
    tree = grow_tree(compile_closed_loop(plan, world), 1e-6, 10**6)
    assert tree is not None
    for figure in ("visited", "survived"):
        low, high = tree.covered(figure)
        assert low - 1e-4 <= exact[figure] <= high + 1e-4


def weibull(exposure: float, shape: float, times: float) -> float:
    """The chance to bear so many nats: mean 1, exposure counted `times`-fold."""
    return math.exp(-((times * exposure * math.gamma(1 + 1 / shape)) ** shape))


def everything(plan: Plan, threat: np.ndarray, shape: float, times: list[float]) -> tuple[float, float, float]:
    """(visited, survived, alive) expected, by every pattern of stops along the paths."""
    ways = []
    for robot, of in zip(plan.robots, times, strict=True):
        path = [int(robot.path[0])]
        path += [int(b) for a, b in itertools.pairwise(robot.path) if a != b]
        borne, before, mine = 0.0, 1.0, []
        for place, cell in enumerate(path):
            borne -= math.log(1 - float(threat[cell]))
            left = weibull(borne, shape, of)
            mine.append((before - left, set(path[: place + 1]), set(path[:place]), 0))
            before = left
        ways.append([*mine, (before, set(path), set(path), 1)])
    sums = np.zeros(3)
    for team in itertools.product(*ways):
        visited, survived = set().union(*(w[1] for w in team)), set().union(*(w[2] for w in team))
        chance = math.prod(w[0] for w in team)
        sums += chance * np.array([len(visited), len(survived), sum(w[3] for w in team)])
    return float(sums[0]), float(sums[1]), float(sums[2])


@pytest.mark.parametrize(("shape", "times"), [(2.0, [1.0, 1.0]), (0.5, [1.0, 4.0]), (1.0, [0.25, 3.0])])
def test_the_closed_form_is_everything_that_can_happen_and_what_rollouts_show(shape: float, times: list[float]) -> None:
    plan = make_plan(ROW, ROW.starts, Settings(wear=shape, susceptibility=tuple(times), policy="per_cell"))
    visited, survived, alive = everything(plan, ROW.threat.ravel(), shape, times)
    exact = open_loop_exact(plan, ROW)
    found = [exact.visited, exact.survived, float(exact.survival.sum())]
    assert found == pytest.approx([visited, survived, alive], abs=1e-6)  # the scale is a multiple of 2**-20
    tally = make_engine(plan, ROW, Rolling("open", seed=5), "numba").tally(0, 60_000)
    for what, value in (("visited", visited), ("survived", survived), ("alive", alive), ("time", exact.mean_time)):
        middle, se = mean(getattr(tally, what))
        assert abs(middle - value) <= 5 * se, what


def test_doses_along_a_path_add_up_and_the_first_visit_is_not_p() -> None:
    bearing = Bearing(shape=2.0, susceptibility=(1.0, 0.5))
    for robot, times in enumerate((1.0, 0.5)):
        assert bearing.first_chance(0.2, robot) == pytest.approx(1 - weibull(-math.log(0.8), 2.0, times), abs=1e-6)
    assert PLAIN.first_chance(0.2) == pytest.approx(0.2)
    assert bearing.first_chance(0.2) < 0.2


def test_shape_1_and_susceptibility_1_change_no_bit() -> None:
    world = random_world(8, 8, ThreatPattern("scattered", 4, seed=4))
    starts = place_starts(world, 3)[0]
    for loop in ("closed", "open"):
        plain, ones = (
            make_engine(make_plan(world, starts, settings), world, Rolling(loop, seed=1), "numba")
            for settings in (Settings(), Settings(wear=1.0, susceptibility=(1.0, 1.0, 1.0)))
        )
        assert counts_of(plain.tally(0, 3000)) == counts_of(ones.tally(0, 3000))
    assert Settings(wear=1.0, susceptibility=1).to_json() == Settings().to_json()


@pytest.mark.parametrize("settings", [{}, {"policy": "per_cell", "worth": 9.0}])
def test_compiled_rollouts_of_worn_robots_are_the_readable_ones(settings: dict[str, Any]) -> None:
    for seed in range(2):
        world = random_world(8, 9, ThreatPattern(("contiguous", "scattered")[seed], 4, seed=seed))
        bears = Settings(wear=(3.0, 0.5)[seed], susceptibility=(1.0, 0.3, 5.0), **settings)
        plan = make_plan(world, place_starts(world, 3)[0], bears)
        loop, readable = (
            compile_closed_loop(plan, world),
            ReferenceLoop(plan, world),
        )
        for trace in trace_rollouts(loop, 5, range(6)):
            assert trace == readable.trace(5, trace.rollout), (seed, trace.rollout)
        whole, singles = run_range(loop, 5, 0, 600, threads=1, singles=True)
        assert singles is not None
        for rollout in range(6, 30):
            run = readable.run(5, rollout)
            found = [getattr(singles, what)[rollout] for what in FIGURES]
            assert found == [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum()]
        assert run_range(loop, 5, 0, 200, threads=2)[0] + run_range(loop, 5, 200, 400)[0] == whole


@pytest.mark.parametrize("name", ["persistent", "level"])
def test_worn_robots_on_maps_in_doubt(name: str) -> None:
    world = WORLDS[name]
    plan = make_plan(world, place_starts(world, 2)[0], Settings(wear=2.0, susceptibility=(0.5, 3.0)))
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    _, singles = run_range(loop, 5, 0, 100, singles=True, threads=1)
    assert singles is not None
    opened = make_engine(plan, world, Rolling("open", seed=5), "numba")
    alone = opened.results(0, 40)
    for rollout in range(40):
        run = readable.run(5, rollout)
        found = [getattr(singles, what)[rollout] for what in FIGURES]
        assert found == [run.visited.sum(), run.survived.sum(), run.time, run.alive.sum()], rollout
    for trace in opened.traces(range(40)):
        assert trace.time == alone.time[trace.rollout]
        assert int((trace.doing[-1] != 4).sum()) == alone.alive[trace.rollout] or trace.time == 0


def test_the_rest_of_a_mission_goes_on_from_what_was_borne() -> None:
    plan = make_plan(ROW, ROW.starts[:1], Settings(wear=1.5, susceptibility=0.5))
    whole, step = ReferenceLoop(plan, ROW), 3
    state = next(filter(None, (whole.state_at(step, 1, rollout) for rollout in range(50))))
    borne = state.robots[0].exposure
    assert borne == sum(ROW.exposures[0][cell] for cell in plan.robots[0].path[: step + 1]) > 0
    saved = parse_state(json.loads(json.dumps(state.to_json())), ROW, "state")
    assert saved.robots[0].exposure == borne
    rest = make_plan(ROW, saved.starts, plan.settings, state=saved)
    loop = compile_closed_loop(rest, ROW)
    tally, singles = run_range(loop, 9, 0, 20_000, singles=True)
    assert singles is not None
    run = ReferenceLoop(rest, ROW).run(9, 7)
    assert [run.visited.sum(), run.time] == [singles.visited[7], singles.time[7]]
    exact = open_loop_exact(rest, ROW)
    for what, value in (("visited", exact.visited), ("survived", exact.survived), ("alive", exact.survival.sum())):
        middle, se = mean(getattr(tally, what))
        assert abs(middle - value) <= 5 * se, what
    _, singles = run_range(compile_closed_loop(plan, ROW), 2, 0, 20_000, singles=True)
    assert singles is not None
    alike = singles.visited[(singles.time > step) | (singles.alive > 0)]
    assert abs(alike.mean() - exact.visited) <= 5 * alike.std() / math.sqrt(len(alike))


def test_states_without_exposure_are_refused_where_robots_wear() -> None:
    given = {"format": "mrac-state", "version": 1, "step": 2, "visited": [2], "robots": [{"cell": 3}]}
    given |= {"world": {"shape": [1, 6], "sha256": ROW.sha256}}
    state = parse_state(given, ROW, "state")
    make_plan(ROW, state.starts, Settings(), state=state)
    with pytest.raises(StateError, match="robot 0 has no exposure"):
        make_plan(ROW, state.starts, Settings(wear=2.0), state=state)
    given["robots"][0]["exposure"] = 99.0
    state = parse_state(given, ROW, "state")
    with pytest.raises(StateError, match="an exposure of 99 nat"):
        make_plan(ROW, state.starts, Settings(wear=2.0), state=state)
    with pytest.raises(StateError, match="exposure` is -1"):
        parse_state(given | {"robots": [{"cell": 3, "exposure": -1}]}, ROW, "state")


def test_plan_files_and_paths_of_others_keep_what_robots_bear(tmp_path: Path) -> None:
    plan = make_plan(ROW, ROW.starts, Settings(wear=2.0, susceptibility=(1.0, 0.5)))
    plan.save(tmp_path / "plan.json")
    again = read_plan(tmp_path / "plan.json", ROW)
    assert again.bearing == plan.bearing == Bearing(2.0, (1.0, 0.5))
    assert again.of_robots(susceptibility=1.0).bearing == Bearing(2.0, 1.0)
    paths = [[[0, 2], [0, 3], [0, 4]], [[0, 2], [0, 1]]]
    (tmp_path / "paths.json").write_text(json.dumps({"paths": paths, "susceptibility": [1, 0.5]}))
    foreign = read_plan(tmp_path / "paths.json", ROW)
    assert foreign.bearing == Bearing(1.0, (1.0, 0.5))
    foreign.save(tmp_path / "saved.json")
    assert read_plan(tmp_path / "saved.json", ROW).bearing == foreign.bearing
    tallies = [
        make_engine(one, ROW, Rolling(loop, seed=1), "numba").tally(0, 500)
        for one in (foreign, foreign.of_robots(susceptibility=1.0))
        for loop in ("open", "closed")
    ]
    assert len({tally.key for tally in tallies}) == 4
    assert counts_of(tallies[0]) != counts_of(tallies[2])
    with pytest.raises(PlanError, match="3 robots for a team of 2"):
        foreign.of_robots(susceptibility=(1.0, 1.0, 2.0))


def test_a_scenario_says_what_its_robots_bear(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("0,0.2,0.3\n")
    text = "map: map.csv\nwear: {{shape: {}}}\nrobots: {{count: 2, susceptibility: {}}}\n"
    file = tmp_path / "scenario.yaml"
    file.write_text(text.format(2, "[1, 0.5]"))
    world = load_input(file)
    assert world.team.settings == {"wear": 2.0, "susceptibility": (1.0, 0.5)}
    for shape, times in ((0.1, "1"), (17, "1"), (2, "0"), (2, "[1, 65]"), (2, "high")):
        file.write_text(text.format(shape, times))
        with pytest.raises(ScenarioError, match=r"wear.shape|robots.susceptibility"):
            load_input(file)


def test_susceptibilities_of_another_team_are_refused() -> None:
    with pytest.raises(PlanError, match="2 robots for a team of 1"):
        make_plan(ROW, ROW.starts[:1], Settings(susceptibility=(1.0, 0.5)))
