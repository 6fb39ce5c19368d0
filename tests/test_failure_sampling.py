"""Failure thresholds, wear, the generator, rollout groups that split."""

import itertools
import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from decimal import Context, Decimal
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from drawn_worlds import WORLDS
from helpers import play_both_ways, run_python, uniform
from numpy.typing import NDArray
from recordings import rewrite

import mrac_jax as mrac
from analysis.recording import contents
from analysis.recording.record import Request, record
from analysis.recording.replay import inspect, replay
from analysis.theory.exact import open_loop_exact
from planner.errors import PER_VISIT, InputError, PlanError, ScenarioError, StateError
from planner.failure_model import (
    PLAIN,
    FailureModel,
    exp1_thresholds,
    exposure_of,
    key_of,
    least_word,
    scaled_thresholds,
    threshold_key,
    weibull_nodes,
    weibull_thresholds,
)
from planner.make_plan import make_plan, read_plan
from planner.plan.plan import Plan
from planner.plan.state_file import parse_state
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.exact_tree import grow_tree
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator import failure_sampling as kernels
from planner.simulator.codes import Outcome
from planner.simulator.failure_sampling import MANY, split_many
from planner.simulator.jit import compiled, program
from planner.simulator.thresholds import CERTAIN, LEAST, MOST, exp1_hazard, threefry2x32, threshold_of
from planner.tally import WORDS_OF_0_3, Tally
from planner.world.generate import ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World

# Failure thresholds: numbers against an independent implementation's, engines against its rollouts and each other.

FOLDER = Path(__file__).parent / "fixtures_luck"
NAMES = sorted(path.stem for path in FOLDER.glob("tiny-*.json"))
WORDS: dict[str, Any] = json.loads((FOLDER / "words.json").read_text())
LOOPS: tuple[Literal["open", "closed"], ...] = ("open", "closed")
EXACTLY = Context(prec=40)


@compiled
def in_kernels(words, exposures, tolerance, least):
    """What kernels make of words and of exposures."""
    for place in range(len(words)):
        tolerance[place] = kernels.exp1_threshold(words[place])
    for place in range(len(exposures)):
        least[place] = kernels.least_word(exposures[place])


@cache
def known(name: str) -> dict[str, Any]:
    return json.loads((FOLDER / f"{name}.json").read_text())


def world_of(name: str) -> World:
    rows = [[np.nan if p is None else p for p in row] for row in known(name)["threat"]]
    return World.create(np.array(rows, dtype=np.float32), known(name)["starts"])


def test_words_tolerances_and_exposures_are_the_known_ones() -> None:
    assert {seed: list(threshold_key(int(seed))) for seed in WORDS["key"]} == WORDS["key"]
    words, found = np.array(WORDS["tolerance"]).T
    assert np.array_equal(threshold_of(words), found)
    twin = np.zeros_like(found)
    in_kernels(words.astype(np.uint32), found[:0], twin, found[:0])
    assert np.array_equal(twin, found)
    p, found = zip(*WORDS["exposure"], strict=True)
    assert exposure_of(np.array(p, dtype=np.float32)).tolist() == list(found)
    assert exposure_of([np.nan, 0.0, 1.0]).tolist() == [0, 0, CERTAIN]
    drawn = np.array(WORDS["random_seed0_ids0to9_k4"])
    assert np.array_equal(exp1_thresholds(0, range(len(drawn)), 4), threshold_of(drawn))


def test_wear_and_susceptibility_are_the_known_ones() -> None:
    for shape, pairs in WORDS["weibull_shape"]:
        before, after = np.array(pairs).T
        assert np.array_equal(weibull_thresholds(before, shape), after), shape
    for before, times, after in WORDS["susceptible"]:
        assert scaled_thresholds(before, times) == after
    anything = np.array([LEAST, 2, 12345678901, MOST])
    assert np.array_equal(scaled_thresholds(anything, 1.0), anything)


def test_a_tolerance_is_the_logarithm_and_an_exposure_is_rounded_right() -> None:
    words = np.unique(np.concatenate([np.arange(200), 2**32 - 1 - np.arange(200), np.arange(1, 400) * 10_737_400]))
    found = threshold_of(words)
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
        exposure = threshold_of(words) + more
        found = least_word(exposure)
        assert (threshold_of(np.minimum(found, 2**32 - 1)) <= exposure)[found < 2**32].all()
        assert (threshold_of(np.maximum(found - 1, 0)) > exposure)[found > 0].all()
        hazard = exposure[exposure > 0]
        twin = np.zeros_like(hazard)
        in_kernels(words[:0].astype(np.uint32), hazard, hazard[:0], twin)
        assert np.array_equal(twin, found[exposure > 0])
    assert least_word([0, MOST, CERTAIN]).tolist() == [2**32, 0, 0]


@pytest.mark.parametrize("name", NAMES)
def test_rollouts_are_those_of_an_independent_simulator(name: str) -> None:
    answers, world = known(name), world_of(name)
    seed, robots = answers["seed"], len(answers["starts"])
    assert exp1_thresholds(seed, range(16), robots)[: len(answers["tolerance"])].tolist() == answers["tolerance"][:16]
    assert {str(cell): int(world.exposures[0][cell]) for cell in map(int, answers["exposure"])} == answers["exposure"]
    plan = make_plan(world, world.starts)
    python, loop = PythonLoop(plan, world), compile_closed_loop(plan, world)
    _, singles = run_range(loop, seed, 0, len(answers["rollouts"]), singles=True, threads=1)
    for one in answers["rollouts"]:
        rollout, run = one["id"], python.run(seed, one["id"])
        expected = [one[what] for what in ("visited", "survived", "time", "alive")]
        assert [run.visited.sum(), run.survived.sum(), run.step, run.alive.sum()] == expected
        found = [getattr(singles, what)[rollout] for what in ("visited", "survived", "time", "alive")]
        assert found == expected
        ended = WORDS_OF_0_3.get(one["outcome"], one["outcome"])
        assert Outcome(singles.outcome[rollout]).word == run.outcome.word == ended
        events = run.trace.events
        assert events[events[:, 2] == 1][:, [0, 1, 4]].tolist() == one["hits"]


def mean(counts: np.ndarray) -> tuple[float, float]:
    """The mean of a histogram, and its standard error."""
    values, total = np.arange(len(counts)), counts.sum()
    middle = float(counts @ values / total)
    return middle, float(np.sqrt(counts @ (values - middle) ** 2)) / total


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
    counts = replace(found.tally, by_threshold=np.empty(0, np.int64))  # its sums by luck: test_statistics
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
    assert np.array_equal(exp1_thresholds(4, range(9), 2), exp1_thresholds(4, range(9), 7)[:, :2])
    assert np.array_equal(exp1_thresholds(4, [8], 2), exp1_thresholds(4, range(9), 2)[8:])


# Robots that wear, and robots that differ: known answers, every engine, the law by enumeration, closed forms.

FIGURES = ("visited", "survived", "time", "alive")
ROW = World.create(np.array([[0.2, 0.3, 0.0, 0.4, 0.1, 0.3]], dtype=np.float32), [[0, 2], [0, 2]])


@cache
def worn_plan(name: str) -> tuple[World, Plan]:
    world, weibull_shape = world_of(name), known(name)["weibull_shape"]
    settings = Settings(
        weibull_shape=weibull_shape["shape"], hazard_multiplier=tuple(weibull_shape["hazard_multiplier"])
    )
    return world, make_plan(world, world.starts, settings)


def counts_of(tally: Tally) -> list[list[int]]:
    return [getattr(tally, what).tolist() for what in (*FIGURES, "visits", "stops", "covered_visited")]


@pytest.mark.parametrize("shape", [0.25, 1.0, 2.0, 16.0])
@pytest.mark.parametrize("times", [1 / 64, 0.5, 1.0, 1.3, 64.0])
def test_an_exposure_reaches_the_tolerances_that_wear_brings_down_to_it(shape: float, times: float) -> None:
    words = np.random.default_rng(3).integers(0, 2**32, 3000)
    drawn = np.concatenate([np.arange(1, 500), threshold_of(words), [MOST]])
    units, nodes = round(times * 2**16), weibull_nodes(shape)

    def hazard(tolerance: np.ndarray) -> np.ndarray:
        return scaled_thresholds(weibull_thresholds(tolerance, shape), units / 2**16)

    for more in (-1, 0, 1):
        exposure = hazard(drawn) + more
        reached = np.minimum(exp1_hazard(exposure, nodes, units), MOST)
        assert (hazard(np.maximum(reached, 1)) <= exposure)[reached > 0].all()
        assert (hazard(np.minimum(reached + 1, MOST)) > exposure)[reached < MOST].all()
    assert exp1_hazard(np.array([0, CERTAIN, CERTAIN + 2**37]), nodes, units)[0] == 0
    assert (exp1_hazard(np.array([CERTAIN, CERTAIN + 2**37]), nodes, units) >= 2 * MOST).all()


@pytest.mark.parametrize("name", NAMES)
def test_worn_rollouts_are_those_of_an_independent_simulator(name: str) -> None:
    (world, plan), weibull_shape, seed = worn_plan(name), known(name)["weibull_shape"], known(name)["seed"]
    found = plan.failure_model.thresholds(seed, range(len(weibull_shape["tolerance"])), len(plan.robots))
    assert found.tolist() == weibull_shape["tolerance"]
    python, loop = PythonLoop(plan, world), compile_closed_loop(plan, world)
    _, singles = run_range(loop, seed, 0, len(weibull_shape["rollouts"]), singles=True, threads=1)
    for one in weibull_shape["rollouts"]:
        expected = [one[what] for what in FIGURES]
        run = python.run(seed, one["id"])
        assert [run.visited.sum(), run.survived.sum(), run.step, run.alive.sum()] == expected
        assert [getattr(singles, what)[one["id"]] for what in FIGURES] == expected
        hits = run.trace.events
        assert hits[hits[:, 2] == 1][:, [0, 1, 4]].tolist() == one["hits"]


@pytest.mark.parametrize("name", NAMES)
def test_worn_means_are_those_of_everything_that_can_happen(name: str) -> None:
    (world, plan), exact = worn_plan(name), known(name)["weibull_shape"]["exact"]
    tree = grow_tree(compile_closed_loop(plan, world), 1e-6, 10**6)
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
        hazard, before, mine = 0.0, 1.0, []
        for place, cell in enumerate(path):
            hazard -= math.log(1 - float(threat[cell]))
            left = weibull(hazard, shape, of)
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
    plan = make_plan(ROW, ROW.starts, Settings(weibull_shape=shape, hazard_multiplier=tuple(times), policy="per_cell"))
    visited, survived, alive = everything(plan, ROW.threat.ravel(), shape, times)
    exact = open_loop_exact(plan, ROW)
    found = [exact.visited, exact.survived, float(exact.survival.sum())]
    assert found == pytest.approx([visited, survived, alive], abs=1e-6)  # the scale is a multiple of 2**-20
    tally = make_engine(plan, ROW, Rolling("open", seed=5), "numba").tally(0, 60_000)
    for what, value in (("visited", visited), ("survived", survived), ("alive", alive), ("time", exact.mean_time)):
        middle, se = mean(getattr(tally, what))
        assert abs(middle - value) <= 5 * se, what


def test_doses_along_a_path_add_up_and_the_first_visit_is_not_p() -> None:
    failure_model = FailureModel(shape=2.0, hazard_multiplier=(1.0, 0.5))
    for robot, times in enumerate((1.0, 0.5)):
        assert failure_model.first_chance(0.2, robot) == pytest.approx(
            1 - weibull(-math.log(0.8), 2.0, times), abs=1e-6
        )
    assert PLAIN.first_chance(0.2) == pytest.approx(0.2)
    assert failure_model.first_chance(0.2) < 0.2


def test_shape_1_and_susceptibility_1_change_no_bit() -> None:
    world = random_world(8, 8, ThreatPattern("scattered", 4, seed=4))
    starts = place_starts(world, 3)[0]
    for loop in ("closed", "open"):
        plain, ones = (
            make_engine(make_plan(world, starts, settings), world, Rolling(loop, seed=1), "numba")
            for settings in (Settings(), Settings(weibull_shape=1.0, hazard_multiplier=(1.0, 1.0, 1.0)))
        )
        assert counts_of(plain.tally(0, 3000)) == counts_of(ones.tally(0, 3000))
    assert Settings(weibull_shape=1.0, hazard_multiplier=1).to_json() == Settings().to_json()


@pytest.mark.parametrize("name", ["persistent", "level"])
def test_worn_robots_on_maps_in_doubt(name: str) -> None:
    world = WORLDS[name]
    plan = make_plan(world, place_starts(world, 2)[0], Settings(weibull_shape=2.0, hazard_multiplier=(0.5, 3.0)))
    play_both_ways(plan, world, 5, 20)
    opened = make_engine(plan, world, Rolling("open", seed=5), "numba")
    alone = opened.results(0, 40)
    for trace in opened.traces(range(40)):
        assert trace.time == alone.time[trace.rollout]
        assert int((trace.doing[-1] != 4).sum()) == alone.alive[trace.rollout] or trace.time == 0


def test_the_rest_of_a_mission_goes_on_from_its_hazard() -> None:
    plan = make_plan(ROW, ROW.starts[:1], Settings(weibull_shape=1.5, hazard_multiplier=0.5))
    whole, step = PythonLoop(plan, ROW), 3
    state = next(filter(None, (whole.state_at(step, 1, rollout) for rollout in range(50))))
    hazard = state.robots[0].exposure
    assert hazard == sum(ROW.exposures[0][cell] for cell in plan.robots[0].path[: step + 1]) > 0
    saved = parse_state(json.loads(json.dumps(state.to_json())), ROW, "state")
    assert saved.robots[0].exposure == hazard
    rest = make_plan(ROW, saved.starts, plan.settings, state=saved)
    loop = compile_closed_loop(rest, ROW)
    tally, singles = run_range(loop, 9, 0, 20_000, singles=True)
    run = PythonLoop(rest, ROW).run(9, 7)
    assert [run.visited.sum(), run.step] == [singles.visited[7], singles.time[7]]
    exact = open_loop_exact(rest, ROW)
    for what, value in (("visited", exact.visited), ("survived", exact.survived), ("alive", exact.survival.sum())):
        middle, se = mean(getattr(tally, what))
        assert abs(middle - value) <= 5 * se, what
    _, singles = run_range(compile_closed_loop(plan, ROW), 2, 0, 20_000, singles=True)
    alike = singles.visited[(singles.time > step) | (singles.alive > 0)]
    assert abs(alike.mean() - exact.visited) <= 5 * alike.std() / math.sqrt(len(alike))


def test_states_without_exposure_are_refused_where_robots_wear() -> None:
    given = {"format": "mrac-state", "version": 1, "step": 2, "visited": [2], "robots": [{"cell": 3}]}
    given |= {"world": {"shape": [1, 6], "sha256": ROW.sha256}}
    state = parse_state(given, ROW, "state")
    make_plan(ROW, state.starts, Settings(), state=state)
    with pytest.raises(StateError, match="robot 0 has no exposure"):
        make_plan(ROW, state.starts, Settings(weibull_shape=2.0), state=state)
    given["robots"][0]["exposure"] = 99.0
    state = parse_state(given, ROW, "state")
    with pytest.raises(StateError, match="an exposure of 99 nat"):
        make_plan(ROW, state.starts, Settings(weibull_shape=2.0), state=state)
    with pytest.raises(StateError, match="exposure` is -1"):
        parse_state(given | {"robots": [{"cell": 3, "exposure": -1}]}, ROW, "state")


def test_plan_files_and_paths_of_others_keep_what_robots_bear(tmp_path: Path) -> None:
    plan = make_plan(ROW, ROW.starts, Settings(weibull_shape=2.0, hazard_multiplier=(1.0, 0.5)))
    plan.save(tmp_path / "plan.json")
    again = read_plan(tmp_path / "plan.json", ROW)
    assert again.failure_model == plan.failure_model == FailureModel(2.0, (1.0, 0.5))
    assert again.of_robots(hazard_multiplier=1.0).failure_model == FailureModel(2.0, 1.0)
    paths = [[[0, 2], [0, 3], [0, 4]], [[0, 2], [0, 1]]]
    (tmp_path / "paths.json").write_text(json.dumps({"paths": paths, "hazard_multiplier": [1, 0.5]}))
    foreign = read_plan(tmp_path / "paths.json", ROW)
    assert foreign.failure_model == FailureModel(1.0, (1.0, 0.5))
    foreign.save(tmp_path / "saved.json")
    assert read_plan(tmp_path / "saved.json", ROW).failure_model == foreign.failure_model
    tallies = [
        make_engine(one, ROW, Rolling(loop, seed=1), "numba").tally(0, 500)
        for one in (foreign, foreign.of_robots(hazard_multiplier=1.0))
        for loop in ("open", "closed")
    ]
    assert len({tally.key for tally in tallies}) == 4
    assert counts_of(tallies[0]) != counts_of(tallies[2])
    with pytest.raises(PlanError, match="3 robots for a team of 2"):
        foreign.of_robots(hazard_multiplier=(1.0, 1.0, 2.0))


def test_a_scenario_says_what_its_robots_bear(tmp_path: Path) -> None:
    (tmp_path / "map.csv").write_text("0,0.2,0.3\n")
    text = "map: map.csv\nweibull_shape: {}\nrobots: {{count: 2, hazard_multiplier: {}}}\n"
    file = tmp_path / "scenario.yaml"
    file.write_text(text.format(2, "[1, 0.5]"))
    world = load_input(file)
    assert world.team.settings == {"weibull_shape": 2.0, "hazard_multiplier": (1.0, 0.5)}
    for shape, times in ((0.1, "1"), (17, "1"), (2, "0"), (2, "[1, 65]"), (2, "high")):
        file.write_text(text.format(shape, times))
        with pytest.raises(ScenarioError, match=r"weibull_shape|robots.hazard_multiplier"):
            load_input(file)


def test_susceptibilities_of_another_team_are_refused() -> None:
    with pytest.raises(PlanError, match="2 robots for a team of 1"):
        make_plan(ROW, ROW.starts[:1], Settings(hazard_multiplier=(1.0, 0.5)))


# The generator against the published known-answer vectors and the fixtures' values.

# Random123's known answers for threefry2x32, 20 rounds: (counter, key, result).
KNOWN = [
    ((0x00000000, 0x00000000), (0x00000000, 0x00000000), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
    ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), (0xC4923A9C, 0x483DF7A0)),
]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_known_answers(counter: tuple[int, int], key: tuple[int, int], expected: tuple[int, int]) -> None:
    words = threefry2x32(key, counter[0], counter[1])
    assert tuple(int(word) for word in words) == expected


def test_draws_are_the_fixtures() -> None:
    known = {
        (1, 0, 0, 0): 0.70394366979599,
        (1, 0, 1, 0): 0.4450523853302002,
        (1, 3, 17, 5): 0.9260450601577759,
        (1, 4095, 200, 7): 0.15700453519821167,
        (7 * 2**32 + 5, 2, 3, 4): 0.15028107166290283,
    }
    for (seed, rollout, step, robot), value in known.items():
        assert float(uniform(seed, rollout, step, robot)) == value


def test_draws_are_uniform_and_address_what_they_say() -> None:
    draws = uniform(3, np.arange(200_000), 5, 2)
    assert draws.dtype == np.float32
    assert 0 <= draws.min() <= draws.max() < 1
    counts = np.bincount((draws * 64).astype(int), minlength=64)
    assert ((counts - 3125) ** 2 / 3125).sum() < 63 + 5 * np.sqrt(2 * 63)
    assert uniform(3, 7, 5, 2) == draws[7]
    assert key_of(2**32 + 5) == (5, 1)


# Sets of rollouts parted several at a time: who is hit is whom a plain loop over the project's Threefry hits.

Part = Callable[..., int]


@program
def parted(ids, words, key0, key1, counter, limit):  # type: ignore[no-untyped-def]
    return split_many(ids, words, key0, key1, counter, limit)


def check(part: Part, sizes: range) -> int:
    """Compare sets of these sizes, of disordered ids, at every kind of limit; returns how many rollouts were hit."""
    random, hits = np.random.default_rng(5), 0
    for size in sizes:
        for limit in np.uint32([0, 1, 2**20, 2**31, 2**32 - 2**20, 2**32 - 1]):
            key0, key1, counter = random.integers(2**32, size=3, dtype=np.uint32)
            around = random.integers(2**32, size=size + 2, dtype=np.uint32)
            ids, words = around.copy(), np.zeros(size, dtype=np.uint32)
            mine: NDArray[np.uint32] = around[1:-1]
            hit = threefry2x32((int(key0), int(key1)), mine, counter)[0] >= limit
            kept = part(ids[1:-1], words, key0, key1, counter, limit)
            assert kept == size - hit.sum()
            assert ids.tolist() == [around[0], *mine[~hit], *mine[hit], around[-1]], (size, limit)
            hits += int(hit.sum())
    return hits


def test_the_sets_are_those_of_a_plain_loop() -> None:
    assert check(parted, range(1, 3 * len(MANY))) > 10_000
    assert check(parted, range(5000, 5003)) > 10_000


@pytest.mark.parametrize(
    "environment",
    [{"NUMBA_CPU_NAME": "generic"}, pytest.param({"NUMBA_DISABLE_JIT": "1"}, marks=pytest.mark.slow)],
    ids=["a plain processor", "uncompiled"],
)
def test_where_lanes_cannot_be_permuted(environment: dict[str, str]) -> None:
    code = "import test_failure_sampling as tests; print(tests.check(tests.parted, range(1, 70)))"
    environment = environment | {"MRAC_JAX_NO_CACHE": "1"}
    assert int(run_python(code, options=("-W", "ignore:overflow"), **environment)) > 5000
