"""What cells are robot_value: estimates, scenario keys, policies."""

import json
import runpy
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import shapely
import yaml
from conftest import load_fixture, worlds_with_starts
from drawn_worlds import expected, one_of
from helpers import ROOT, play_both_ways
from hypothesis import given
from hypothesis import strategies as st
from page_reader import refused
from test_planner_policies import LIMITED
from test_rasters import tif
from test_statistics import fitted
from test_theory import fates_of

import mrac_jax as mrac
from analysis.estimators.trial import mean_value
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.outputs.value import Units, found_chances, value_table
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate, tail_mean, times_to
from analysis.statistics.variance_reduction import LEAST, CommonThresholds
from analysis.theory.exact import CellValues, open_loop_found
from planner.errors import RenamedWarning, WorldError
from planner.formatting import percent
from planner.json_objects import as_json
from planner.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.plan.plan import Plan
from planner.rollout_sampling import LossDraws
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.single_run import SingleRun
from planner.rollouts.threshold_classes import CLASSES_A_NAT, classes_by_threshold
from planner.settings import Settings
from planner.simulator.state import MOST_PASSES
from planner.tally import Tally
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.scenario import load_input, route_over
from planner.world.start_rule import place_starts
from planner.world.world import World, load_world_file

# What cells are worth and show: closed forms and counts against enumeration and the simulator as Python.

GRID = World.create([[0, 0.3, 0, 0.2], [0.4, np.nan, 0.1, 0], [0, 0.2, 0, 0.3]])
VALUE = np.array([[1, 5, 0, 2], [3, 9, 1, 1], [0.5, 4, 2, 7]])
DETECT = np.array([[0.5, 0.3, 1, 0.9], [0.8, 0.5, 0.2, 0], [0.25, 0.6, 0.4, 0.7]])


def survived_visits(world: World, plan: Plan, seed: int, rollout: int) -> np.ndarray:
    """int64 `[N]`, of one rollout of the simulator as Python: entries of each cell that stopped nobody."""
    luck, passes = LossDraws(world, seed, rollout), np.zeros(world.threat.size, dtype=np.int64)

    def hit(robot: int, step: int, cell: int) -> bool:
        stopped = luck.hits(robot, step, cell)
        passes[cell] += not stopped
        return stopped

    SingleRun(compile_closed_loop(plan, world, interpreted=True), hit=hit).play()
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
def test_survived_visits_are_those_of_the_simulator_as_python(policy: str, robots: int) -> None:
    """Of each rollout, so also of the ones that a set is parted into."""
    fixture = load_fixture("contiguous-14x23-1000-k8")
    world = fixture.world.with_values(np.arange(14 * 23).reshape(14, 23) % 5, 0.4)
    plan = make_plan(world, fixture.starts[:robots], Settings(policy=policy))
    units = Units.of(CellValues.of(world))
    engine = make_engine(plan, world, Rolling(seed=3), "numba")
    tally, singles = engine.with_cell_weights(units.covered, units.found).run(0, 12)
    passes = np.array([survived_visits(world, plan, 3, rollout) for rollout in range(12)])
    assert passes.max() > 3
    at_least = [(passes >= times).sum(axis=0) for times in range(1, MOST_PASSES + 1)]
    assert np.array_equal(tally.passes.reshape(-1, MOST_PASSES), np.stack(at_least, axis=1))
    cells = np.arange(passes.shape[1])
    assert singles.value_found.tolist() == units.found[cells, np.minimum(passes, MOST_PASSES)].sum(axis=1).tolist()
    plain = engine.tally(0, 12)
    assert plain.passes.size == 0
    for name, counts in plain.counts().items():
        assert np.array_equal(counts, getattr(tally, name)), name
    assert singles.value_covered.sum() == (tally.covered_visited * units.covered).sum()


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_the_closed_loop_against_every_pattern_of_hits(policy: str) -> None:
    """Value covered and found, each within 5 standard errors of what all runs together come to, exactly."""
    world = GRID.with_values(VALUE, DETECT)
    plan = make_plan(world, [[0, 0], [2, 3]], Settings(policy=policy))
    loop = compile_closed_loop(plan, world, interpreted=True)

    def play(hit: Callable[[int, int, int], bool]) -> np.ndarray:
        passes = np.zeros(12)

        def judge(robot: int, step: int, cell: int) -> bool:
            stopped = hit(robot, step, cell)
            passes[cell] += not stopped
            return stopped

        done = SingleRun(loop, hit=judge).play()
        return np.stack([done.visited, 1 - (1 - world.detect.ravel()) ** passes])

    visited, found = expected(play, one_of([world.threat.ravel()]))
    answer = evaluate(world, plan, RolloutChoices(rollouts=40_000, seed=11), band=False, advice=False)
    value = answer.outputs.get("value")
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
    robot_value = CellValues(np.ones(cells), detect)
    found, rest = found_chances(tally, robot_value)
    truth = (1 - (1 - detect) ** passes).mean(axis=0)
    assert (truth <= found + 1e-12).all() and (found.sum() - rest) <= truth.sum()
    assert (found - truth).sum() < 0.5 * rest  # nearer than without what is beyond the cap


def test_where_nothing_is_said_of_values_nothing_is_told() -> None:
    plan = make_plan(GRID, [[0, 0]])
    answer = evaluate(GRID, plan, RolloutChoices(rollouts=512), band=False)
    assert answer.outputs.get("value") is None
    asked = evaluate(GRID, plan, RolloutChoices(rollouts=512), band=False, value=True).outputs.get("value")
    # each cell is worth 1, and is found; of one robot all of it is known
    assert asked.covered.mean == pytest.approx(answer.closed_form.visited, rel=1e-9)
    assert asked.found.mean == pytest.approx(answer.closed_form.survived, rel=1e-9)


def test_search_and_clearance_are_the_same_numbers() -> None:
    world = mrac.load(GRID.threat, value=VALUE / 50, detect=DETECT, route=[[0, 2], [2, 2]])
    plan = make_plan(world, [[0, 0], [2, 3]])
    answer = mrac.evaluate(world, plan, loop="open", rollouts=4096, band=False)
    value = answer.outputs.get("value")
    said = as_json(value)
    found, shares = open_loop_found(plan, world), world.value.ravel()
    assert said["search"]["success"] == pytest.approx(shares @ found)  # chances: they add up to less than 1
    assert said["search"]["success"] == pytest.approx(said["search"]["containment"] * said["search"]["detection"])
    assert said["clearance"]["cleared"] == pytest.approx(shares @ found / shares.sum())
    left = (shares * (1 - found))[[2, 6, 10]]
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
        fronts = [mrac.front(each, **how, robot_values=(5.0,), risk_caps=()) for each in (world, plain)]
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
        passes=passes[:MOST_PASSES], visits=np.array([passes.sum() + stops]), stops=np.array([stops]), rollouts=runs
    )
    found, rest = found_chances(tally, CellValues(np.ones(1), np.array([d])))  # type: ignore[arg-type]
    truth = d * (reached @ (1 - d) ** np.arange(12))
    assert rest > 0.02 and found[0] - rest < truth - 0.02
    assert truth <= found[0] < truth + 0.02 * rest


def test_counts_leave_nothing_over_and_totals_are_in_their_intervals() -> None:
    """Where no cell is passed more than eight times the remainder is 0, not -8e-18."""
    often = -np.sort(-np.random.default_rng(0).integers(0, 300, size=(200, MOST_PASSES)), axis=1)
    tally = SimpleNamespace(passes=often.ravel(), visits=often.sum(axis=1) + 7, stops=np.full(200, 7), rollouts=300)
    assert found_chances(tally, CellValues(np.ones(200), np.full(200, 0.3)))[1] == 0  # type: ignore[arg-type]
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
    units, robots = Units.of(CellValues.of(world)), len(plan.robots)
    engine = make_engine(plan, world, Rolling(seed=seed), "numba").with_cell_weights(units.covered, units.found)
    results, classes = engine.results(0, samples * LEAST), classes_by_threshold(seed, 0, samples * LEAST, robots)
    told = []
    for own in [*(slice(start, start + LEAST) for start in range(0, samples * LEAST, LEAST)), slice(None)]:
        pairs = [(column[own], classes[own]) for column in (results.value_covered, results.value_found)]
        lucks = [CommonThresholds.of(robots, luck, column, column) for column, luck in pairs]
        told.append(
            [
                mean_value(x, units.cell_values.total, world.threat.size, False, y)
                for (x, _), y in zip(pairs, lucks, strict=True)
            ]
        )
    return told


def test_value_is_put_right_by_luck() -> None:
    """Least squares over single rollouts gives the same means and errors, with less spread than without."""
    world, plan = valued("contiguous", 0, 8)
    units = Units.of(CellValues.of(world))
    engine = make_engine(plan, world, Rolling(seed=3), "numba")
    results = engine.with_cell_weights(units.covered, units.found).results(0, LEAST)
    total = (classes_by_threshold(3, 0, LEAST, 8) + 0.5) / CLASSES_A_NAT
    for found, column in zip(means(world, plan, 3)[0], (results.value_covered, results.value_found), strict=True):
        value = column / 2**40 * CellValues.of(world).total
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
    answer = mrac.evaluate(world, mrac.plan(world, 2), rollouts=400, advice=False)
    found, known = answer.outputs["value"], answer.to_json()["exact"]["closed_loop"]
    assert known["how"] == "tree"
    assert found.robots_left[0].mean == pytest.approx(known["some_left"]) and found.robots_left[0].half_width == 0
    assert found.losses.mean == pytest.approx(known["losses"]) and found.covered.half_width == 0
    assert (found.found.half_width == 0) == (detect == 1)
    sampled = Units.of(found.cell_values).covered @ answer.tally.covered_visited / 400 * found.cell_values.total / 2**40
    assert abs(found.covered.mean - sampled) < 5 * found.cell_values.total / 2 / np.sqrt(400)
    rows = dict(zip(*(list(column.cells) for column in value_table(found).columns[:2]), strict=True))
    assert rows["chance that at least 1 robot is left"] == percent(known["some_left"], 2)
    assert {"m2 covered per robot lost", "value covered per robot lost"} <= set(rows)


# The keys `value`, `detect`, `metrics` and `route` of scenarios, and the world files that hold values.

THREAT = [[0, 0.1, 0, 0.2], [0, np.nan, 0.1, 0], [0, 0, 0, 0.3]]
SQUARE = [[[1, 1], [4, 1], [4, 3], [1, 3], [1, 1]]]


def scenario(folder: Path, keys: dict[str, Any], polygons: Any = 5, points: str = "0.5,0.5,2\n0.5,0.5,3\n") -> Path:
    """A map of 3 x 4 metres, a raster of 0 .. 11 on it, a polygon on its upper right 2 x 3 cells, two points."""
    World.create(THREAT).save(folder / "map.npz", force=True)
    np.save(folder / "raster.npy", np.arange(12.0).reshape(3, 4))
    feature = {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": SQUARE}}
    properties = {} if polygons is None else {"value": polygons, "detect": polygons}
    (folder / "areas.geojson").write_text(json.dumps(feature | {"properties": properties}))
    (folder / "points.csv").write_text(points)
    (folder / "s.yaml").write_text(yaml.safe_dump({"map": "map.npz", "robots": {"count": 1}} | keys))
    return folder / "s.yaml"


RASTER = np.where(np.isnan(THREAT), 0, np.arange(12.0).reshape(3, 4))
LAYERS = [
    (3, np.full((3, 4), 3.0)),
    ([{"raster": "raster.npy"}], RASTER),
    ([{"polygons": "areas.geojson"}], np.array([[1, 5, 5, 5], [1, 5, 5, 5], [1, 1, 1, 1]])),
    ([{"everywhere": 2}, {"points": "points.csv"}], np.array([[2, 2, 2, 2], [2, 2, 2, 2], [5, 2, 2, 2]])),
    (
        [{"everywhere": 0}, {"points": "points.csv", "falloff": {"kind": "disc", "radius": 1.2}}],
        np.array([[0, 0, 0, 0], [5, 0, 0, 0], [5, 5, 0, 0]]),
    ),
    ([{"polygons": "areas.geojson"}, {"raster": "raster.npy"}], RASTER),
]


@pytest.mark.parametrize(("value", "expected"), LAYERS)
def test_the_last_source_that_covers_a_cell_counts(tmp_path: Path, value: Any, expected: np.ndarray) -> None:
    world = load_input(scenario(tmp_path, {"value": value}))
    assert world.detect is None
    assert np.array_equal(world.value, np.where(np.isnan(THREAT), 0, expected))


@pytest.mark.parametrize(("rows", "cols"), [(12, 16), (6, 8), (3, 4), (12, 8)])
def test_values_on_other_pixels_are_the_same_amounts(tmp_path: Path, rows: int, cols: int) -> None:
    """On pixels of half, or twice, the side of the map's, and on oblong ones."""
    tif(tmp_path / "map.tif", np.full((6, 8), 0.05), (10, 0, 500000, 0, -10, 5400000), "EPSG:32633")
    amounts = np.kron(np.arange(12.0).reshape(3, 4), np.ones((4, 4)))
    values = amounts.reshape(rows, 12 // rows, cols, 16 // cols).sum(axis=(1, 3))
    tif(tmp_path / "value.tif", values, (80 / cols, 0, 500000, 0, -60 / rows, 5400000), "EPSG:32633")
    (tmp_path / "s.yaml").write_text("map: map.tif\nvalue: [{raster: value.tif}]\nrobots: {count: 1}\n")
    assert np.allclose(load_input(tmp_path / "s.yaml").value, 4 * amounts[::2, ::2], rtol=1e-9)


def test_values_in_degrees_keep_their_sum(tmp_path: Path) -> None:
    """But for pixels on the edge, whose middle is outside of the map."""
    place = (0.0002, 0, 15.0, 0, -0.0001, 52.0)
    tif(tmp_path / "map.tif", np.full((100, 120), 0.05), place, "EPSG:4326")
    tif(tmp_path / "value.tif", np.full((100, 120), 1 / 12000), place, "EPSG:4326")
    (tmp_path / "s.yaml").write_text("map: map.tif\nvalue: [{raster: value.tif}]\nrobots: {count: 1}\n")
    assert 0.98 < load_input(tmp_path / "s.yaml").value.sum() <= 1 + 1e-9


def test_values_of_pixels_add_up_and_chances_are_averaged(tmp_path: Path) -> None:
    """A cell of 2 x 2 pixels."""
    World.create(np.zeros((2, 4))).save(tmp_path / "fine.npz")
    np.save(tmp_path / "r.npy", np.array([[0.1, 0.2, 0.3, 0.4], [0.5, 0.6, 0.7, 0.8]]))
    layers = {"value": [{"raster": "r.npy"}], "detect": [{"raster": "r.npy"}]}
    world = load_input(scenario(tmp_path, {"map": "fine.npz", "cell_size": 2} | layers))
    assert world.value == pytest.approx(np.array([[1.4, 2.2]]))
    assert world.detect == pytest.approx(np.array([[0.35, 0.55]]))
    named = World.create(np.zeros((2, 4)), value=np.arange(8.0).reshape(2, 4), detect=0.5)
    named.save(tmp_path / "fine.npz", force=True)
    world = load_input(scenario(tmp_path, {"map": "fine.npz", "cell_size": 2}))
    assert world.value.tolist() == [[10, 18]] and world.detect.tolist() == [[0.5, 0.5]]


def test_a_world_file_keeps_its_values(tmp_path: Path) -> None:
    world = World.create(THREAT, value=RASTER, detect=0.25)
    world.save(tmp_path / "w.npz")
    again = load_world_file(tmp_path / "w.npz")
    assert np.array_equal(again.value, RASTER)
    assert np.array_equal(again.detect, np.where(np.isnan(THREAT), 0, 0.25))
    assert again.sha256 == World.create(THREAT).sha256  # no part of the map's identity


WRONG: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({"value": -1}, {}, "`value` is -1; expected a number, 0 to 1e+09"),
    ({"value": float("nan")}, {}, "`value` is nan; expected"),
    ({"value": 0}, {}, "value is 0 in every free cell; expected a cell with a value above 0"),
    ({"value": [{"everywhere": 0}]}, {}, "value is 0 in every free cell"),
    ({"value": [{"raster": "no.npy"}]}, {}, "`value[0].raster`: no such file"),
    ({"value": [{"raster": "small.npy"}]}, {}, "expected the map's 3 x 4 pixels or its 3 x 4 cells; the raster has"),
    ({"value": [{"raster": "holes.npy"}]}, {}, "names holes.npy, which is nan (no data) at [0, 0] (1 such cell)"),
    ({"value": [{"raster": "negative.npy"}]}, {}, "with value = -1 at [0, 0] (1 such cell); expected a number, 0"),
    ({"value": [{"polygons": "areas.geojson"}]}, {"polygons": -2}, "property value is -2; expected a number, 0"),
    ({"value": [{"polygons": "areas.geojson"}]}, {"polygons": None}, "or give value in the scenario"),
    ({"value": [{"points": "points.csv"}]}, {"points": "0.5,0.5,-3\n"}, "line 1: strength is -3; expected a number, 0"),
    ({"value": [{"points": "points.csv"}]}, {"points": "900,1,3\n"}, "covers no cell: x 900 .. 900"),
    ({"value": [{"polygon": "areas.geojson"}]}, {}, "did you mean 'polygons'?"),
    ({"value": [{"raster": "raster.npy", "rule": {}}]}, {}, "unknown key `value[0].rule`"),
    ({"detect": 1.5}, {}, "`detect` is 1.5; expected a chance, 0 to 1"),
    ({"detect": [{"raster": "raster.npy"}]}, {}, "with detect = 2 at [0, 2] (9 such cells); expected a chance, 0 to 1"),
    ({"route": [[0, 0]]}, {}, "`route` is [[0, 0]]; expected a list of two [row, col] or more"),
    ({"route": [[0, 0], [0, 9]]}, {}, "`route`: leaves the map"),
    ({"route": [[1, 0], [1, 3]]}, {}, "`route`: meets an obstacle at [1, 1]; expected free cells all the way"),
    ({"route": [[0, 0], [0, 1]], "route_xy": [[0, 0], [1, 1]]}, {}, "expected route or route_xy, not both"),
]


@pytest.mark.parametrize(("keys", "files", "said"), WRONG)
def test_bad_values_are_one_line_and_nothing_is_written(tmp_path: Path, capsys, keys, files, said: str) -> None:
    path = scenario(tmp_path, keys, **files)
    np.save(tmp_path / "small.npy", np.ones((2, 4)))
    for name, value in (("holes", np.nan), ("negative", -1.0)):
        np.save(tmp_path / f"{name}.npy", np.where(np.arange(12).reshape(3, 4) == 0, value, 1.0))
    assert said in refused(capsys, "evaluate", str(path), "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


BAD_ARRAYS = [
    ({"value": np.full((3, 4), -1.0)}, "value is -1 at [0, 0] (11 such cells)"),
    ({"value": np.full((3, 4), np.nan)}, "value is nan at [0, 0]"),
    ({"value": np.ones((4, 3))}, "value has shape (4, 3); expected one number, or one in every free"),
    ({"value": np.zeros((3, 4))}, "value is 0 in every free cell"),
    ({"value": [["a"]]}, "value holds <U1; expected numbers"),
    ({"detect": 1.01}, "detect is 1.01 at [0, 0]"),
]


@pytest.mark.parametrize(("layers", "said"), BAD_ARRAYS)
def test_bad_arrays(layers: dict[str, Any], said: str) -> None:
    with pytest.raises(WorldError) as raised:
        World.create(THREAT, **layers)
    assert said in str(raised.value)


def test_a_route_is_the_cells_that_its_line_meets(tmp_path: Path) -> None:
    world = World.create(np.zeros((4, 6)))
    assert route_over(world, [[0.5, 0.5], [0.5, 2.5], [2.5, 2.5]]).tolist() == [[0, 0], [0, 1], [0, 2], [1, 2], [2, 2]]
    keys = {"route_xy": [[0.5, 0.5], [3.5, 0.5]], "metrics": "clearance"}
    with pytest.warns(RenamedWarning, match="`metrics` left with release 0.4"):
        team = load_input(scenario(tmp_path, keys)).team
    assert team.route is not None and team.route.tolist() == [[2, 0], [2, 1], [2, 2], [2, 3]]


# Policies that count what cells are worth (SPEC section 13): `per_cell` and `worth` by value, `mrac` as ever.


def values_of(world: World, seed: int) -> np.ndarray:
    """Many worth nothing, some a little, some much."""
    return np.random.default_rng(seed).choice([0, 0, 1, 5, 300.5, 1e5], world.shape)


def path_of(world: World, start: int, **asked: Any) -> list[int]:
    return make_plan(world, [[0, start]], Settings(policy="per_cell", **asked)).robots[0].path.tolist()


def test_the_next_area_is_the_one_of_least_cost_by_value() -> None:
    """A row: the robot's own safe area in the middle, dangerous cells to the left, others to the right."""
    row = [[0.2, 0.2, 0, 0, 0.1, 0.1]]
    world = World.create(row)
    assert path_of(world, 2)[:4] == [2, 3, 4, 5]  # the lower threats first
    left = World.create(row, value=[[9, 9, 1, 1, 1, 1]])
    assert path_of(left, 2)[:5] == [2, 3, 2, 1, 0]  # twice the danger, nine times the value
    worthless = World.create(row, value=[[9, 9, 1, 1, 0, 0]])
    assert path_of(worthless, 2)[-2:] == [4, 5]
    only = World.create(row, value=[[1, 1, 1, 1, 0, 0]])
    assert path_of(only, 2)[-2:] == [4, 5]  # whatever they cost


def test_worth_refuses_by_value() -> None:
    """n = 4 and p = 0.1: two cells next to the robot cost C = 8, theta = 40 / V: refused iff 8,000 > 40 U / V."""
    row = [[0, 0, 0.1, 0.1]]
    cases = ((5.0, 1.0, False), (9.9, 1.0, False), (10.1, 1.0, True), (4.9, 0.5, False), (5.1, 0.5, True))
    for robot_value, share, unsafe in cases:  # U = 2000 times the share
        world = World.create(row, value=[[7, 1, 7 * share, 7 * share]])
        plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", robot_value=robot_value))
        assert (plan.outcome == "not_worth_the_risk") is unsafe, (robot_value, share)
    row = [[0.1, 0.1, 0, 0, 0.1, 0.1]]
    cheap = World.create(row, value=[[1, 1, 1, 1, 0, 0]])
    plan = make_plan(cheap, [[0, 2]], Settings(policy="per_cell", robot_value=2.0))
    assert plan.outcome == "not_worth_the_risk"
    assert set(plan.robots[0].path.tolist()) == {0, 1, 2, 3}  # nothing is risked for cells worth nothing
    assert make_plan(World.create(row), [[0, 2]], Settings(policy="per_cell", robot_value=2.0)).outcome == "complete"


def test_whole_numbers_of_values() -> None:
    world = World.create([[0, 0, 0.1, 0, np.nan, 0]], value=[[2, 1e-9, 0, 1, 7, 50]])
    problem = prepare(world, [[0, 0]], Settings(policy="per_cell"))
    assert problem.value.tolist() == [1000, 1, 0, 500, 0, 0]  # the last cell is out of reach
    assert prepare(world, [[0, 0]], Settings()).value is None
    nothing = World.create([[0, 0.1, np.nan, 0]], value=[[0, 0, 0, 3]])
    assert make_plan(nothing, [[0, 0]], Settings(policy="per_cell")).outcome == "complete"


BOTH_WAYS = ["contiguous-14x23-1000-k2", "scattered-14x23-1000-k2"]


@pytest.mark.parametrize("name", [*BOTH_WAYS, pytest.param("scattered-14x23-1000-k8", marks=pytest.mark.slow)])
@pytest.mark.parametrize("limits", LIMITED[:3], ids=str)
def test_decisions_by_value_are_others_and_the_same_both_ways(limits: dict[str, Any], name: str) -> None:
    fixture = load_fixture(name)
    world = fixture.world.with_values(values_of(fixture.world, 3))
    plan = make_plan(world, fixture.starts, Settings(**limits), fixture.allocation)
    play_both_ways(plan, world, 5, 1)
    plain = make_plan(fixture.world, fixture.starts, Settings(**limits), fixture.allocation)
    assert any(one.path.tolist() != other.path.tolist() for one, other in zip(plan.robots, plain.robots, strict=True))


def test_mrac_ignores_values() -> None:
    fixture = load_fixture("contiguous-14x23-1000-k2")
    world = fixture.world.with_values(values_of(fixture.world, 1))
    plans = [make_plan(one, fixture.starts) for one in (world, fixture.world)]
    assert plans[0].to_json() == plans[1].to_json()
    loops = [compile_closed_loop(plan, one) for plan, one in zip(plans, (world, fixture.world), strict=True)]
    assert loops[0].identity == loops[1].identity
    by = Settings(policy="per_cell")
    by_value = [compile_closed_loop(make_plan(one, fixture.starts, by), one) for one in (world, fixture.world)]
    assert by_value[0].identity != by_value[1].identity


# `docs/examples/search.py`: drones with a budget search a map of probabilities, and some are lost.

SEARCH = runpy.run_path(str(ROOT / "docs" / "examples" / "search.py"))


def test_searching_drones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Seen pixels by their distance to the paths, losses by their law; survivors see more where budget is left."""
    rows, cols = np.mgrid[:660, :660] * 30.0 - 9885
    whole = np.exp(-np.hypot(rows, cols / 2) / 500) * (np.abs(cols - 700) > 150)
    for name in ("3", "4"):
        (tmp_path / name).mkdir()
    np.save(tmp_path / "3" / "heatmap.npy", whole / whole.sum())
    (tmp_path / "4" / "heatmap.npy").write_text("version https://git-lfs.github.com/spec/v1")
    SEARCH["main"](str(tmp_path), "0", str(tmp_path / "paths.png"))
    assert capsys.readouterr().out.count("\n| ") == 5 and (tmp_path / "paths.png").exists()
    heat = SEARCH["medium"](tmp_path / "3" / "heatmap.npy")
    search, spare = SEARCH["best"](heat, 5, 60), SEARCH["best"](heat, 2, 250)
    lines = shapely.MultiLineString([search.metres(path) for path in search.paths])
    away = shapely.distance(shapely.points(np.mgrid[:120, :120].transpose(1, 2, 0) * 30 + 15), lines)
    near = SEARCH["seen"](map(search.metres, search.paths), heat.shape)
    # The points of a path lie up to 15 m apart.
    assert away[near].max() < SEARCH["SIGHT"] + 1e-9 and near[away < SEARCH["SIGHT"] - 7.5].all()
    assert all((np.abs(np.diff(path, axis=0)).sum(axis=1) == 1).all() for path in search.paths)
    assert max(len(path) for path in search.paths) <= 12_000 / search.side + 1
    assert 0.85 < search.likelihood(search.paths) / SEARCH["swept"](heat, 60) < 1
    last = search.last_moves(0.3, 4000)
    assert abs((last > search.moves).mean() - 0.7) < 5 * np.sqrt(0.21 / last.size)
    assert (search.flown(0.3, 4, "open") == search.fixed(0.3, 4)).all()
    fixed, closed, again = spare.fixed(0.5, 4), spare.reallocated(0.5, 4), spare.replanned(0.5, 4)
    assert min(closed.mean(), again.mean()) > fixed.mean() + 0.01 and max(closed.max(), again.max()) <= heat.sum()
