"""Hazards that are there or not, and maps one of which is true."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from drawn_worlds import WORLDS, closed_loop, expected, one_of, open_loop, persistent
from helpers import ROOT, assert_same_results, play_both_ways
from numba import typeof
from open_loop_reference import plan_of as external_plan
from scipy import stats

from analysis.theory.exact import open_loop_exact
from planner.errors import InputError
from planner.failure_model import own_key
from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollout_sampling import LossDraws
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.engine import Rolling, make_engine, open_loop_engine
from planner.rollouts.loop import typed
from planner.rollouts.open_loop import compile_plan
from planner.settings import Settings
from planner.simulator.thresholds import threefry2x32
from planner.world.generate import ThreatPattern, random_world
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World, load_world_file

# Hazards that are there or not, and maps one of which is true: both ways, and against enumeration.

BASE = random_world(8, 8, ThreatPattern("contiguous", 4, (0.04, 0.12, 0.2), 3), obstacles=0.2, threats=0.4)
DANGER = np.where(BASE.threat > 0, 1.0, 0.0)
OTHERS = [BASE.threat, np.minimum(3 * BASE.threat, np.float32(0.9)), 0 * BASE.threat]
DOUBTS: dict[str, Callable[[], World]] = {
    "persistent": lambda: BASE.with_latent_hazard("persistent", 0.3 * DANGER, 0.6),
    "consumed": lambda: BASE.with_latent_hazard("consumed", 0.5 * DANGER, 0.8),
    "maps": lambda: BASE.with_maps(OTHERS),
    "maps, a low quantile": lambda: BASE.with_maps(OTHERS, plan_on=0.2),
    "common": lambda: BASE.with_spread("lognormal", 1.0),
    "level": lambda: BASE.with_spread("beta", 5.0, "level", plan_on=0.9),
}
COLUMNS = ("visited", "survived", "time", "alive", "outcome")


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
@pytest.mark.parametrize("doubt", DOUBTS)
def test_runs_are_the_same_both_ways_and_in_parts(doubt: str, policy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("planner.rollouts.runners.LEAST_SHARED", 1)
    world = DOUBTS[doubt]()
    plan = make_plan(world, place_starts(world, 3)[0], Settings(policy=policy))
    play_both_ways(plan, world, 5, 15)
    loop = compile_closed_loop(plan, world)
    tally, _ = run_range(loop, 5, 0, 60)
    assert np.count_nonzero(tally.visited) > 4
    apart = [run_range(loop, 5, start, 20, threads=threads)[0] for start, threads in ((0, 1), (20, 2), (40, 1))]
    assert apart[0] + apart[1] + apart[2] == tally


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_one_program_serves_every_team_and_map(policy: str) -> None:
    teams = [(BASE, 1, Settings(policy=policy)), (BASE, 8, Settings(policy=policy))]
    teams += [(BASE, robots, Settings(policy=policy, range=60)) for robots in (1, 2)]
    teams += [(make(), 3, Settings(policy=policy)) for make in DOUBTS.values()]
    loops = [
        compile_closed_loop(make_plan(world, place_starts(world, robots)[0], settings), world)
        for world, robots, settings in teams
    ]
    for field in ("tables", "policy"):
        given = [getattr(loop, field) for loop in loops]
        assert len({typeof(None if one is None else typed(one)) for one in given}) == 1, field


def tiny(threat: list[list[float]]) -> World:
    return World.create(np.array(threat, dtype=np.float32), [[0, 0], [1, 0]])


TINY = tiny([[0.0, 0.3, 0.0], [0.0, 0.2, 0.0]])
BLOCKED = float("nan")
SMALL = tiny([[0.0, BLOCKED, 0.0, 0.2, 0.0], [0.0, 0.3, 0.0, BLOCKED, 0.2]])
Q, H = np.where(SMALL.threat > 0, SMALL.threat + 0.3, 0.0), np.full((2, 5), 0.75)


@pytest.mark.parametrize("kind", ["persistent", "consumed", "maps"])
def test_means_are_those_of_everything_that_can_happen(kind: str) -> None:
    if kind == "maps":
        maps = [SMALL.threat, np.where(SMALL.threat > 0.25, np.float32(0.7), SMALL.threat), 0 * SMALL.threat]
        world, judge = SMALL.with_maps(maps), one_of([one.ravel() for one in maps])
    else:
        world, judge = SMALL.with_latent_hazard(kind, Q, H), persistent(Q.ravel(), H.ravel(), kind == "consumed")
    plan = make_plan(world, world.starts, Settings())
    exact = expected(closed_loop(plan, world), judge)
    rollouts = 40_000
    singles = run_range(compile_closed_loop(plan, world), 11, 0, rollouts, singles=True)[1]
    for name, value in zip(("visited", "survived", "alive", "delivered"), exact, strict=True):
        column = getattr(singles, name).astype(float)
        assert abs(column.mean() - value) <= 5 * column.std() / np.sqrt(rollouts), name
    unaware = expected(closed_loop(plan, world), one_of([world.threat.ravel()]))
    assert np.abs(exact - unaware).max() > 0.01


def test_hazards_and_maps_are_drawn_as_specified() -> None:
    for purpose in (0, 1):
        word = threefry2x32((7, 0), 0x48415A44, purpose)
        assert own_key(7, purpose) == (int(word[0]), int(word[1]))
    world = TINY.with_latent_hazard("persistent", np.full((2, 3), 0.25), 1.0)
    there = threefry2x32(own_key(3, 0), np.arange(4000), 4)[0] >> 8 < 0.25 * 2**24
    assert [LossDraws(world, 3, rollout).hits(0, 1, 4) for rollout in range(4000)] == there.tolist()
    assert abs(there.mean() - 0.25) < 5 * np.sqrt(0.25 * 0.75 / 4000)


@pytest.mark.parametrize(("kind", "amount"), [("lognormal", 0.3), ("beta", 6.0)])
def test_a_spread_has_the_mean_and_the_quantiles_that_it_says(kind: str, amount: float) -> None:
    world = TINY.with_spread(kind, amount)
    chances = np.stack([world.uncertainty.threat_at(row) for row in range(world.uncertainty.count)])[:, 0, 1].astype(
        float
    )
    p = float(TINY.threat[0, 1])
    np.testing.assert_allclose(np.minimum(chances, 1).mean(), p, rtol=2e-3)
    law = stats.lognorm(amount, scale=p * np.exp(-(amount**2) / 2)) if kind == "lognormal" else None
    law = law or stats.beta(p * amount, (1 - p) * amount)
    edges = law.ppf(np.arange(200) / 256)
    assert ((edges[:-1] <= chances[:199] + 1e-7) & (chances[:199] <= edges[1:] + 1e-7)).all()
    assert (world.threat == TINY.threat).all()
    high = TINY.with_spread(kind, amount, plan_on=0.9).threat[0, 1]
    assert abs(high - law.ppf(0.9)) < 0.02


def test_levels_are_drawn_apart_and_a_common_spread_is_one_for_all() -> None:
    for by, same in (("common", True), ("level", False)):
        draws = TINY.with_spread("beta", 4.0, by).draws
        assert (draws.counter[1] == draws.counter[4]) == same
    assert draws.counter.reshape(2, 3)[:, 1].tolist() == [3, 2]


def test_a_world_file_holds_what_is_in_doubt(tmp_path: Path) -> None:
    for name, make in DOUBTS.items():
        world = make()
        world.save(tmp_path / "world.npz", force=True)
        for again in (load_world_file(tmp_path / "world.npz"), load_input(tmp_path / "world.npz")):
            assert again.randomness_sha256 == world.randomness_sha256, name
            assert again.sha256 == world.sha256
    assert BASE.randomness_sha256 == BASE.sha256


def scenario(folder: Path, more: str, threats: str = "[{raster: p.csv}]") -> World:
    np.savetxt(folder / "map.csv", np.zeros((2, 3)), delimiter=",")
    np.savetxt(folder / "p.csv", TINY.threat, delimiter=",")
    np.savetxt(folder / "other.csv", 2 * TINY.threat, delimiter=",")
    np.savetxt(folder / "wide.csv", np.zeros((2, 4)), delimiter=",")
    np.savetxt(folder / "nan.csv", np.full((2, 3), np.nan), delimiter=",")
    np.savetxt(folder / "two.csv", np.full((2, 3), 2.0), delimiter=",")
    (folder / "s.yaml").write_text(f"map: map.csv\nthreats: {threats}\n{more}\n")
    return load_input(folder / "s.yaml")


def test_a_scenario_names_hazards_and_maps(tmp_path: Path) -> None:
    mines = scenario(tmp_path, "latent_hazard: {kind: consumed, h: 0.5}")
    assert mines.randomness_sha256 == TINY.with_latent_hazard("consumed", TINY.threat, 0.5).randomness_sha256
    weak = scenario(tmp_path, "latent_hazard: {kind: persistent, q: 0.25, h: threats}")
    assert weak.randomness_sha256 == TINY.with_latent_hazard("persistent", 0.25, TINY.threat).randomness_sha256
    raster = scenario(tmp_path, "latent_hazard: {kind: persistent, q: p.csv, h: other.csv}", "[]")
    persistent = TINY.with_latent_hazard("persistent", TINY.threat, 2 * TINY.threat)
    assert raster.randomness_sha256 == persistent.randomness_sha256
    assert scenario(tmp_path, "latent_hazard: {kind: independent}").randomness_sha256 == TINY.sha256
    maps = scenario(tmp_path, "map_uncertainty: {maps: [p.csv, other.csv], plan_on: 0.9}", "[]")
    assert maps.randomness_sha256 == TINY.with_maps([TINY.threat, 2 * TINY.threat], 0.9).randomness_sha256
    np.testing.assert_array_equal(maps.threat, 2 * TINY.threat)
    doses = scenario(tmp_path, "map_uncertainty: {maps: [p.csv, other.csv], rule: {kind: linear, scale: 0.5}}", "[]")
    np.testing.assert_allclose(doses.threat, 0.75 * TINY.threat, rtol=1e-6)
    spread = scenario(tmp_path, "map_uncertainty: {spread: {kind: beta, sample_size: 9, by: level}, plan_on: mean}")
    assert spread.randomness_sha256 == TINY.with_spread("beta", 9.0, "level").randomness_sha256


BAD = {
    "latent_hazard: {kind: odd}": "`latent_hazard.kind` is 'odd'",
    "latent_hazard: {q: 0.1}": "`latent_hazard.kind` is missing",
    "latent_hazard: {kind: persistent, h: 1.5}": "`latent_hazard.h` is 1.5",
    "latent_hazard: {kind: persistent, h: -0.5}": "`latent_hazard.h` is -0.5",
    "latent_hazard: {kind: persistent, h: .nan}": "`latent_hazard.h` is nan",
    "latent_hazard: {kind: persistent, q: 0.5, h: 0.5}": "`latent_hazard.q` is 0.5",
    "latent_hazard: {kind: persistent, h: threats}": "`latent_hazard.h` is 'threats'",
    "latent_hazard: {kind: persistent, q: wide.csv, h: threats}": "`latent_hazard.q` is 'wide.csv'",
    "latent_hazard: {kind: persistent, h: nan.csv}": "`latent_hazard.h` names nan.csv, which is nan (no data)",
    "latent_hazard: {kind: persistent, h: two.csv}": "`latent_hazard`: hazard h is 2 at [0, 0]",
    "latent_hazard: {kind: persistent, h: none.csv}": "`latent_hazard.h`: ",
    "latent_hazard: {kind: independent, h: 0.5}": "`latent_hazard.h` is 0.5",
    "latent_hazard: 3": "`latent_hazard` is 3",
    "latent_hazard: {kind: consumed}\nmap_uncertainty: {maps: [p.csv]}": "`map_uncertainty` is",
    "map_uncertainty: {}": "`map_uncertainty` is {}",
    "map_uncertainty: {maps: []}": "`map_uncertainty.maps` is []",
    "map_uncertainty: {maps: [p.csv], spread: {kind: beta, sample_size: 3}}": "`map_uncertainty` is",
    "map_uncertainty: {maps: [wide.csv]}": "`map_uncertainty.maps[0]` is 'wide.csv'",
    "map_uncertainty: {maps: [p.csv, nan.csv]}": "`map_uncertainty.maps[1]` names nan.csv, which is nan",
    "map_uncertainty: {maps: [two.csv]}": "`map_uncertainty.maps[0]` gives p = 2",
    "map_uncertainty: {maps: [p.csv], plan_on: worst}": "`map_uncertainty.plan_on` is 'worst'",
    "map_uncertainty: {maps: [p.csv], plan_on: 1}": "`map_uncertainty.plan_on` is 1",
    "map_uncertainty: {spread: {kind: normal, sigma: 1}}": "`map_uncertainty.spread.kind` is 'normal'",
    "map_uncertainty: {spread: {kind: lognormal}}": "`map_uncertainty.spread.sigma` is missing",
    "map_uncertainty: {spread: {kind: lognormal, sigma: 0}}": "`map_uncertainty.spread.sigma` is 0",
    "map_uncertainty: {spread: {kind: beta, sigma: 1}}": "unknown key `map_uncertainty.spread.sigma`",
    "map_uncertainty: {spread: {kind: beta, sample_size: 2, by: cell}}": "`map_uncertainty.spread.by` is 'cell'",
}


@pytest.mark.parametrize("more", BAD)
def test_what_a_scenario_says_wrongly_is_one_line(tmp_path: Path, more: str) -> None:
    with pytest.raises(InputError) as caught:
        scenario(tmp_path, more)
    assert BAD[more] in str(caught.value).replace(f"{tmp_path}/", "")
    assert "\n" not in str(caught.value)


def test_arrays_that_are_no_hazard_and_no_maps() -> None:
    for q in (1.5, -0.1, np.nan, np.zeros((3, 3)), "much"):
        with pytest.raises(InputError, match=r"hazard q (is|has|holds)"):
            TINY.with_latent_hazard("persistent", q)
    with pytest.raises(InputError, match="hazard kind is 'odd'"):
        TINY.with_latent_hazard("odd", 0.5)
    with pytest.raises(InputError, match=r"hazard q \* h is 1 at \[0, 0\]"):
        TINY.with_latent_hazard("consumed", 1.0)
    with pytest.raises(InputError, match="maps is empty"):
        TINY.with_maps([])
    with pytest.raises(InputError, match=r"maps\[1\] has other obstacles"):
        TINY.with_maps([TINY.threat, np.where(np.eye(2, 3) > 0, np.nan, 0.1)])
    with pytest.raises(InputError, match="amount=nan; expected a standard deviation"):
        TINY.with_spread("lognormal", float("nan"))


KINDS: dict[str, Callable[[World], World]] = {
    "persistent": lambda world: world.with_latent_hazard("persistent", world.threat, 0.5),
    "independent": lambda world: world.with_latent_hazard("independent", world.threat, 0.5),
    "maps": lambda world: world.with_maps([world.threat, world.threat / 2]),
    "spread": lambda world: world.with_spread("beta", 20),
    "movers": lambda world: world.with_moving_threats([{"walk": 0.5, "h": 0.3}]),
    "phases": lambda world: world.with_phases([(10, world.threat / 2)]),
    "truth": lambda world: world.with_true_map(world.threat / 2),
    "prior": lambda world: world.with_prior_map(0.04, "known", 1),
}
TOGETHER = {
    *(("independent", other) for other in KINDS),
    *(("persistent", "persistent"), ("persistent", "independent"), ("maps", "maps"), ("spread", "maps")),
    *(("maps", "prior"), ("spread", "prior"), ("truth", "prior"), ("prior", "prior")),
}
"""What may be said after what: all after a plain map, anew what is replaced whole, and a prior last."""


@pytest.mark.parametrize("first", KINDS)
def test_one_thing_that_is_not_known_beside_another_is_refused_in_either_order(first: str) -> None:
    world = KINDS[first](TINY)
    for second, add in KINDS.items():
        if (first, second) in TOGETHER:
            add(world)
            continue
        with pytest.raises(InputError, match=r"together with another |do not support"):
            add(world)
    if first == "prior":
        with pytest.raises(InputError, match="leave one of the two out; a prior is given after the maps"):
            world.with_spread("beta", 20)


# The open loop where hazards are there or not, or the map is one of several: engines, traces, exact values.

TINY_OPEN_LOOP = World.create([[0.0, 0.2, 0.0, 0.25, 0.0]])
PATHS = [[2, 3, 4, 3, 2, 1, 0], [2, 1, 0, 1, 2, 3, 4], [1, 0, 1, 2, 3]]


def plan_of(world: World) -> Plan:
    return make_plan(world, place_starts(world, 5)[0], Settings())


@pytest.mark.parametrize("name", WORLDS)
def test_engines_count_what_luck_says(name: str) -> None:
    world = WORLDS[name]
    plan = plan_of(world)
    engine = make_engine(plan, world, Rolling("open", seed=4), "numba")
    tally, found = engine.run(0, 200)
    play = open_loop(plan, world)
    for rollout in range(60):
        visited, survived, alive, _ = play(LossDraws(world, 4, rollout).hits)
        assert [found.visited[rollout], found.survived[rollout], found.alive[rollout]] == [visited, survived, alive]
    assert np.count_nonzero(tally.visited) > 4
    parts = open_loop_engine(compile_plan(plan, world), 4, "numba", threads=2)
    assert parts.tally(0, 77) + parts.tally(77, 123) == tally
    trace = next(iter(engine.traces([9])))
    assert len(np.unique(trace.cells)) == found.visited[9]


@pytest.mark.parametrize(
    "name", ["consumed", *(pytest.param(name, marks=pytest.mark.slow) for name in WORLDS if name != "consumed")]
)
def test_jax_counts_the_same(name: str) -> None:
    compiled = compile_plan(plan_of(WORLDS[name]), WORLDS[name])
    engines = [open_loop_engine(compiled, 4, engine) for engine in ("numba", "jax")]
    assert engines[1].tally(0, 777) + engines[1].tally(777, 9223) == engines[0].tally(0, 10_000)
    if name != "consumed":  # a program of its own
        assert_same_results(*(engine.results(70, 3000) for engine in engines))


def check_sampled(plan: Plan, world: World, seed: int, **exact: float) -> None:
    """Sampled means lie within five standard errors of the exact ones."""
    tally = make_engine(plan, world, Rolling("open", seed=seed), "numba").tally(0, 40_000)
    for name, value in exact.items():
        counts = getattr(tally, name)
        mean = counts @ np.arange(len(counts)) / 40_000
        assert abs(mean - value) <= 5 * np.sqrt(counts @ (np.arange(len(counts)) - mean) ** 2) / 40_000, name


@pytest.mark.parametrize("paths", [PATHS[:1], [[0, 1, 0, 1, 2]], PATHS], ids=["one", "to and fro", "three"])
@pytest.mark.parametrize("kind", ["persistent", "consumed", "maps"])
def test_exact_values_are_those_of_everything_that_can_happen(kind: str, paths: list[list[int]]) -> None:
    robots = len(paths)
    threat = TINY_OPEN_LOOP.threat
    maps = [threat, np.where(threat > 0.2, np.float32(0.6), threat), 0 * threat]
    q, h = (np.full(threat.shape, chance, np.float32) for chance in (0.6, 0.5))
    world = TINY_OPEN_LOOP.with_maps(maps) if kind == "maps" else TINY_OPEN_LOOP.with_latent_hazard(kind, q, h)
    by_hazard = persistent(q.ravel(), h.ravel(), kind == "consumed")
    draw = one_of([one.ravel() for one in maps]) if kind == "maps" else by_hazard
    plan = external_plan(world, paths)
    visited, survived, alive, _ = expected(open_loop(plan, world), draw)
    exact = open_loop_exact(plan, world)
    if kind == "consumed" and robots > 1:  # what one robot hits is gone for the others
        assert not exact.is_known
    else:
        assert exact.is_known
        np.testing.assert_allclose([exact.visited, exact.survived], [visited, survived], rtol=1e-9)
        np.testing.assert_allclose(exact.alive_chance @ np.arange(robots + 1), alive, rtol=1e-9)
        np.testing.assert_allclose(exact.stops_by_cell.sum(), robots - alive, rtol=1e-9)
    check_sampled(plan, world, 2, visited=visited, survived=survived, alive=alive)


def test_one_robot_is_exact_by_level_and_teams_are_known_robot_by_robot() -> None:
    world = TINY_OPEN_LOOP.with_spread("lognormal", 0.5, "level")
    chances, column = world.uncertainty.chances.astype(float), world.uncertainty.column.ravel()
    low, high = ((1 - chances[:, column[cell]]) ** 2 for cell in (1, 3))  # PATHS[0] enters cell 1 once, cell 3 twice
    survival = np.sqrt(low).mean() * high.mean()
    exact = open_loop_exact(external_plan(world, PATHS[:1]), world)
    np.testing.assert_allclose(exact.survival, [survival], rtol=1e-9)
    np.testing.assert_allclose(exact.visited_by_cell[4], np.sqrt(high).mean(), rtol=1e-9)
    team = open_loop_exact(external_plan(world, PATHS), world)
    assert not team.is_known
    np.testing.assert_allclose(team.survival[0], survival, rtol=1e-9)


@pytest.mark.parametrize(
    ("robots", "h", "percent"), [(2, 1.0, 64.675), (4, 1.0, 70.187), (8, 1.0, 76.173), (12, 0.6, 83.461)]
)
def test_teams_among_hazards_in_many_shared_cells(robots: int, h: float, percent: float) -> None:
    """Against values of another program; sampled values lie within five standard errors."""
    plain = load_input(ROOT / "analysis" / "examples" / "paper.npz")
    world = plain.with_latent_hazard("persistent", np.where(plain.free, plain.threat, 0), h)
    plan = make_plan(world, place_starts(world, robots)[0], Settings())
    exact = open_loop_exact(plan, world)
    cells = int(world.accessible(plan.starts).sum())
    assert abs(100 * exact.visited / cells - percent) < 0.0006
    np.testing.assert_allclose(exact.visited_curve[-1], exact.visited, rtol=1e-12)
    assert robots - exact.alive_chance @ np.arange(robots + 1) == pytest.approx(exact.expected_losses, rel=1e-12)
    check_sampled(plan, world, 5, visited=exact.visited, survived=exact.survived, time=exact.mean_time)


@pytest.mark.parametrize("seed", range(3))
def test_hazards_of_every_cell_are_those_of_all_their_patterns(seed: int) -> None:
    """Twelve cells, three robots, all 4,096 patterns: by cell, by step, and the numbers and times of survivors."""
    draw = np.random.default_rng(seed)
    q, h = draw.uniform(0, 0.9, (3, 4)).astype(np.float32), draw.uniform(0.1, 1, (3, 4)).astype(np.float32)
    world = World.create(np.zeros((3, 4))).with_latent_hazard("persistent", q, h)
    paths = []
    for _ in range(3):
        path = [int(draw.integers(12))]
        while len(path) < 9:
            row, col = divmod(path[-1], 4)
            near = [(row + a, col + b) for a, b in ((0, 1), (1, 0), (0, -1), (-1, 0))]
            near = [4 * a + b for a, b in near if 0 <= a < 3 and 0 <= b < 4]
            path.append(int(draw.choice(near)))
        paths.append(path)
    there = (np.arange(2**12)[:, None] >> np.arange(12)) & 1
    weight = np.where(there, q.ravel().astype(float), 1 - q.ravel().astype(float)).prod(axis=1)
    missed, alive = np.ones((2, 9, 2**12, 12)), np.ones((2**12, 3, 10))
    for robot, path in enumerate(paths):
        for step, cell in enumerate(path):
            before = alive[:, robot, step]
            alive[:, robot, step + 1] = before * (1 - there[:, cell] * h.ravel()[cell].astype(float))
            if cell not in path[:step]:
                missed[0, step:, :, cell] *= 1 - before
                missed[1, step:, :, cell] *= 1 - alive[:, robot, step + 1]
    exact = open_loop_exact(external_plan(world, paths), world)
    covered = 1 - missed.transpose(0, 1, 3, 2) @ weight
    np.testing.assert_allclose(exact.visited_by_cell, covered[0, -1], atol=1e-12)
    np.testing.assert_allclose(exact.survived_by_cell, covered[1, -1], atol=1e-12)
    np.testing.assert_allclose(exact.visited_curve, covered[0].sum(axis=1), atol=1e-12)
    np.testing.assert_allclose(exact.survived_curve, covered[1].sum(axis=1), atol=1e-12)
    at_end = alive[:, :, -1]
    by_number = [((1 - at_end).prod(axis=1) @ weight), at_end.prod(axis=1) @ weight]
    np.testing.assert_allclose(exact.alive_chance[[0, 3]], by_number, atol=1e-12)
    ended = (1 - alive[:, :, 1:9]).prod(axis=1).T @ weight
    np.testing.assert_allclose(np.cumsum(exact.time_chance)[:-1], ended, atol=1e-12)
