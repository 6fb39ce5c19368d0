"""Robots of several types and speeds, and radio of a limited distance."""

from collections.abc import Callable
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_worlds import assert_as_enumerated, drawn, moving_world
from helpers import load_plan, play_both_ways
from oracle_enumeration import everything
from test_return_home import check_rules, ways

from analysis.theory.exact import open_loop_exact
from planner.errors import InputError, PlanError
from planner.make_plan import make_plan, read_plan
from planner.mrac.problem import prepare
from planner.open_loop import plan_team
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.rollouts.engine import Rolling, make_engine
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import Doing, Outcome
from planner.simulator.jit import interpreted
from planner.world.robot_types import checked_types
from planner.world.scenario import load_input
from planner.world.start_rule import place_starts
from planner.world.world import World, world_of

# Robots of several types: both ways, one type against none, the tree of all that can happen.

KINDS: list[dict[str, Any]] = [
    {},
    {"policy": "per_cell"},
    {"policy": "per_cell", "risk_cap": 0.4, "robot_value": 30.0},
    {"policy": "watchful", "risk_cap": 0.4},
    {"policy": "per_cell", "range": 60, "hazard_multiplier": (1.0, 0.5, 2.0)},
    {"risk": "log", "levels": 3, "in_area": "boustrophedon"},
    {"policy": "watchful", "robot_value": 20.0, "levels": 3},
]
HOMES: list[dict[str, Any]] = [
    {"return_to": "home", "deadline": 40},
    {"return_to": "nearest", "range": 30, "recharge": 3},
    {"return_to": "home", "range": 40, "policy": "per_cell", "risk_cap": 0.4, "robot_value": 30.0},
    {"return_to": "nearest", "range": 45, "policy": "watchful", "risk_cap": 0.4},
]


def check_homes(part: int, seed: int, rollouts: int) -> None:
    """Each robot goes home by the safest way of its own type, found by the plainest search."""
    world, starts, types = drawn(seed)
    plan = make_plan(world, starts, Settings(**HOMES[part], types=types))
    problem = prepare(world, starts, Settings(**HOMES[part], types=types))
    within = np.flatnonzero(problem.levels.accessible).tolist()
    costs = [problem.costs if problem.own is None else problem.own.costs[problem.own.of[k]] for k in range(len(types))]
    entry = [{cell: int(own[cell]) for cell in within} for own in costs]
    mine = [[int(row * world.shape[1] + col)] for row, col in starts]
    bases = mine if HOMES[part]["return_to"] == "home" else [[base for (base,) in mine]] * len(types)
    found = [ways(world, *known) for known in zip(bases, entry, strict=True)]
    for run in play_both_ways(plan, world, seed, rollouts):
        check_rules(run.trace, world, plan, found)


@pytest.mark.parametrize("part", range(len(HOMES)))
@pytest.mark.parametrize("seeds", [range(8), pytest.param(range(1000, 1600), marks=pytest.mark.slow)], ids=str)
def test_robots_of_several_types_come_home_each_by_its_own_way(part: int, seeds: range) -> None:
    for seed in seeds[part :: len(HOMES)]:
        check_homes(part, seed, 2)


@pytest.mark.parametrize("what", ["types", "speeds", "radio", "wrecks"])
def test_everything_that_can_happen_on_rows(what: str) -> None:
    """The tree of the closed loop against an enumeration that shares no code with it."""
    for seed in range(12):
        rng, robots = np.random.default_rng(seed), 2 + seed % 2
        size = int(rng.integers(*((5, 9) if what == "radio" else (4, 8))))
        p = np.float32(rng.choice([0, 0, 0.1, 0.2, 0.37], (2, size) if what == "types" else (1, size)))
        starts, own = rng.integers(0, size, robots).tolist(), [p[0].tolist()] * robots
        world, paces, radio = World.create([p.max(axis=0)]), None, inf
        more: dict[str, Any] = {"wrecks": "block"} if what == "wrecks" else {}
        if what == "types":
            types = ("a", "b", *"ba"[: seed % 2])
            known = checked_types(("a", "b"), p[:, None], np.full((1, size), True), "")
            world, more = replace(world, types=known), {"types": types}
            own = [p["ab".index(of)].tolist() for of in types]
        elif what == "speeds":
            paces = (1, *rng.integers(2, 4, robots - 1).tolist())
            more = {"steps_per_move": paces}
        elif what == "radio":
            radio = float(rng.integers(1, 4))
            more = {"radio": radio}
        plan = make_plan(world, [[0, start] for start in starts], Settings(density=1e6, **more))
        assert_as_enumerated(plan, world, everything(own, starts, paces and list(paces), radio, what == "wrecks"))


@pytest.mark.parametrize("policy", ["per_cell", "watchful"])
@pytest.mark.parametrize("turned", range(4))
def test_ties_of_the_price_go_to_the_nearest_target(policy: str, turned: int) -> None:
    """By hand, n = 8: robot 0 has covered its safe cells and stands at 4 in `X X s s s Y # b`.

    X, p = .1, w = 8, is safe for robot 1, which waits elsewhere: w' = 1. It has two cells, of which the nearer costs
    d = 2 + 8, so C / u = (10 + 8 + 2 (8 - 1)) / 2 = 16. Y, p = .2, w = w' = 16, has one, beside it: d = C = 16. Both
    are dearest alike, and 10 < 16: X comes first, whichever has the lower index or id.
    """
    p = np.array([[[0.1, 0.1, 0, 0, 0, 0.2, 0, 0]], [[0, 0, 0, 0, 0, 0.2, 0, 0]]], dtype=np.float32)
    free, at = np.array([[True] * 6 + [False, True]]), np.array([[0, 2], [0, 7]])
    if turned % 2:
        p, free, at = p[:, :, ::-1], free[:, ::-1], at * [1, -1] + [0, 7]
    if turned // 2:
        p, free, at = p.transpose(0, 2, 1), free.T, at[:, ::-1]
    own = World.create(np.where(free, p.max(axis=0), np.nan))
    world = replace(own, types=checked_types(("a", "b"), p, free, ""))
    plan = make_plan(world, at, Settings(policy=policy, types=("a", "b")))
    places = [2, 3, 4, 3, 2, 1, 0, 1, 2, 3, 4, 5]
    assert plan.robots[0].path.tolist() == [7 - place if turned % 2 else place for place in places]
    play_both_ways(plan, world, turned, 3)


def test_robots_of_one_type_are_robots_of_none_on_its_map() -> None:
    """Bit for bit, in both loops and engines."""
    for seed in (0, 1):
        world, starts, _ = drawn(seed)
        plain = replace(world, types=None, threat=world.types.threat[1])  # type: ignore[union-attr]
        for kind in KINDS[:4]:
            one, none = (
                make_plan(world, starts, Settings(**kind, types="b")),
                make_plan(plain, starts, Settings(**kind)),
            )
            assert [r.path.tolist() for r in one.robots] == [r.path.tolist() for r in none.robots]
            for loop in ("closed", "open"):
                tallies = [
                    make_engine(plan, on, Rolling(loop, seed=3), "numba").tally(0, 2000)
                    for plan, on in ((one, world), (none, plain))
                ]
                assert replace(tallies[0], key="") == replace(tallies[1], key="")


def test_the_open_loop_is_everything_that_can_happen_to_each_robot_alone() -> None:
    world, starts, _ = drawn(3, 2)
    plan = make_plan(world, starts, Settings(types=("a", "c")))
    missed, alive = np.ones(world.threat.size), 1.0
    for robot, of in zip(plan.robots, (0, 2), strict=True):
        threat, reach, seen = world.types.threat[of].ravel(), 1.0, set()  # type: ignore[union-attr]
        for before, cell in zip([-1, *robot.path], robot.path, strict=False):
            if cell == before:
                continue
            if cell not in seen:
                missed[cell] *= 1 - reach
            seen.add(cell)
            reach *= 1 - float(threat[cell])
        alive *= reach
    exact = open_loop_exact(plan, world)
    assert exact.visited == pytest.approx((1 - missed).sum(), rel=1e-9)
    assert exact.survival.prod() == pytest.approx(alive, rel=1e-9)
    tally = make_engine(plan, world, Rolling("open", seed=5), "numba").tally(0, 40_000)
    shares = tally.visited / tally.visited.sum()
    cells = np.arange(len(shares))
    middle = float(shares @ cells)
    se = float(np.sqrt(shares @ (cells - middle) ** 2 / 40_000))
    assert abs(middle - exact.visited) <= 5 * se


SITE = """
map: site.csv
threats:
  - {generate: {kind: contiguous, ratio: 0.3, areas: 3, levels: [0.04, 0.08], seed: 1}, type: radiation}
  - {generate: {kind: scattered, ratio: 0.1, levels: [0.1], seed: 2}, type: mine}
  - {generate: {kind: scattered, ratio: 0.05, levels: [0.2], seed: 3}}
robots: {count: 2, types: [drone, rover], matrix: {drone: {mine: 0}, rover: {radiation: 0.5}}}
"""


def site(folder: Path, text: str = SITE) -> World:
    np.savetxt(folder / "site.csv", np.zeros((8, 9)), delimiter=",")
    (folder / "site.yaml").write_text(text)
    return load_input(folder / "site.yaml")


def test_a_scenario_says_what_a_threat_is_to_a_type(tmp_path: Path) -> None:
    world = site(tmp_path)
    assert world.types is not None and world.types.names == ("drone", "rover")
    assert world.team.settings == {"types": ("drone", "rover")}
    radiation, mine, other = (
        site(tmp_path, f"map: site.csv\nthreats:\n{line}\n").threat.astype(np.float64)
        for line in SITE.splitlines()[3:6]
        for line in [line.partition(", type")[0] + "}" * (", type" in line)]
    )
    drone = 1 - (1 - radiation) * (1 - other)
    rover = 1 - (1 - 0.5 * radiation) * (1 - mine) * (1 - other)
    np.testing.assert_allclose(world.types.threat, [drone, rover], atol=1e-7)
    np.testing.assert_allclose(world.threat, 1 - (1 - radiation) * (1 - mine) * (1 - other), atol=1e-7)
    world.save(tmp_path / "site.npz")
    again = load_input(tmp_path / "site.npz")
    assert again.randomness_sha256 == world.randomness_sha256 != replace(world, types=None).randomness_sha256
    plan = make_plan(world, place_starts(world, 2)[0], Settings(types=("drone", "rover")))
    plan.save(tmp_path / "plan.json")
    assert read_plan(tmp_path / "plan.json", again).settings == plan.settings


WRONG_TYPES = [
    ("type: mine", "type: mines", "`threats\\[1\\].type` is 'mines'; expected mine or radiation; did you"),
    ("types: [drone, rover]", "types: [drone, 3]", "`robots.types` is"),
    ("matrix: {drone: {mine: 0}", "matrix: {drone: {mine: -1}", "`robots.matrix.drone.mine` is -1"),
    ("matrix: {drone: {mine: 0}", "matrix: {drone: 2", "`robots.matrix.drone`"),
    ("radiation: 0.5", "radiation: 20", "p = 1.6 for a robot of type rover"),
]


@pytest.mark.parametrize(("was", "now", "said"), WRONG_TYPES)
def test_wrong_types_are_refused_by_their_key(was: str, now: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        site(tmp_path, SITE.replace(was, now))


def test_teams_of_unknown_types_and_what_does_not_know_types(tmp_path: Path) -> None:
    world = site(tmp_path)
    starts = place_starts(world, 2)[0]
    for types, said in (("dron", "did you mean 'drone'"), (("drone",) * 3, "types of 3 robots for a team of 2")):
        with pytest.raises(InputError, match=f"site.yaml: .*{said}"):
            make_plan(world, starts, Settings(types=types))
    with pytest.raises(InputError, match="for a world without robot types"):
        make_plan(replace(world, types=None), starts, Settings(types="drone"))
    for more in ({"transit": "area"}, {"plan_for": "open_loop"}):
        with pytest.raises(InputError, match="types"):
            plan_team(world, starts, Settings(types=("drone", "rover"), **more))
    hazard = replace(world, types=None).with_latent_hazard("persistent", 0.1)
    with pytest.raises(InputError, match="require one known map"):
        make_plan(replace(hazard, types=world.types), starts, Settings(types="drone"))


def test_threats_in_the_place_of_those_of_types_are_refused(tmp_path: Path) -> None:
    world = site(tmp_path)
    changes: tuple[Callable[[], World], ...] = (
        lambda: world.with_latent_hazard("independent", 0.5, 0.5),
        lambda: world.with_latent_hazard("persistent", 0.5, 0.5),
        lambda: world.with_maps([world.threat]),
        lambda: world.with_spread("beta", 20),
        lambda: world.with_phases([(0, np.full(world.shape, 0.5))]),
        lambda: world.with_moving_threats([{"walk": 0.5, "h": 0.3}]),
    )
    for change in changes:
        with pytest.raises(InputError, match="together with robots of the types drone, rover; expected one known map"):
            change()


def test_paths_alone_keep_their_types(tmp_path: Path) -> None:
    world, file = site(tmp_path), tmp_path / "paths.json"
    plan = make_plan(world, place_starts(world, 2)[0], Settings(types=("drone", "rover"))).truncated_at(500)
    plan.save(file)
    other = replace(world, team=replace(world.team, settings={"types": ("rover", "rover")}))
    assert load_plan(file, other).failure_model == plan.failure_model
    paths = {"paths": [[[0, 0]], [[0, 1]]], "types": "drone"}
    assert parse_plan(paths, other, "paths").failure_model.types == "drone"
    with pytest.raises(InputError, match="for a world without robot types"):
        load_plan(file, replace(world, types=None))


@pytest.mark.parametrize("types", ["[drone, rover]", "rover"])
def test_a_world_file_says_of_which_types_its_robots_are(types: str, tmp_path: Path) -> None:
    world, file = site(tmp_path, SITE.replace("types: [drone, rover]", f"types: {types}")), tmp_path / "site.npz"
    world.save(file)
    again = load_input(file)
    assert again.team.settings == world.team.settings
    assert again.randomness_sha256 == world.randomness_sha256
    assert again.to_bytes() == world.to_bytes()
    with pytest.raises(InputError, match=r"types=.tank.; expected one of drone, rover"):
        world_of(world.arrays() | {"types_team": np.array("tank")}, "site.npz")


def test_robots_leave_to_a_type_what_it_covers_for_less() -> None:
    """A tank would take the mines beside it first; but a drone, busy far away, will cover them for a tenth of that."""
    mines, other = np.array([0.2] * 2 + [0.0] * 13), np.array([0.0] * 5 + [0.2] * 2 + [0.0] * 8)
    world = World.create([mines + other])
    of_types = np.array([[mines + other], [mines / 10 + other]])
    world = replace(world, types=checked_types(("tank", "drone"), of_types, world.free, ""))

    def first_danger(types: tuple[str, ...], policy: str) -> int:
        path = make_plan(world, [[0, 4], [0, 14]], Settings(types=types, policy=policy)).robots[0].path
        return int(path[np.flatnonzero(world.threat.ravel()[path] > 0)[0]])

    for policy in ("per_cell", "watchful"):
        assert first_danger(("tank", "tank"), policy) == 1
        assert first_danger(("tank", "drone"), policy) == 5


# Robots of several speeds: both ways, equal speeds against one, the tree of all that can happen.

KINDS_SPEEDS: list[dict[str, Any]] = [
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "risk_cap": 0.4, "robot_value": 30.0, "range": (40, 20, 60)},
    {"policy": "watchful", "risk_cap": 0.4}, {"policy": "watchful", "types": ("a", "c", "b")},
    {"range": 30, "deadline": 45}, {"return_to": "home", "range": 40, "deadline": 70},
    {"return_to": "nearest", "range": (25, 40, 60), "recharge": 7, "deadline": 140, "policy": "per_cell"},
    {"return_to": "home", "policy": "per_cell", "deadline": 60},
    {"transit": "area", "return_to": "nearest", "range": 30, "recharge": 4},
]  # fmt: skip
PACES = [(1, 2, 3), (4, 6, 2)]


@pytest.mark.parametrize("part", range(len(KINDS_SPEEDS)))
def test_nobody_moves_out_of_turn(part: int) -> None:
    for seed in range(part, 2 * len(KINDS_SPEEDS), len(KINDS_SPEEDS)):
        (world, starts, _), given = drawn(seed), PACES[seed // len(KINDS_SPEEDS)]
        plan = make_plan(world, starts, settings := Settings(**KINDS_SPEEDS[part], steps_per_move=given))
        for run in play_both_ways(plan, world, seed, 2):
            steps, robots = np.nonzero(np.diff(run.trace.cells, axis=0))
            assert ((steps + 1) % np.array(settings.paces)[robots] == 0).all()


def test_threats_that_move_meet_robots_of_every_speed_at_every_step() -> None:
    for seed in range(6):
        world = moving_world(seed)
        starts = place_starts(world, 3)[0]
        asked = {"steps_per_move": (1, 3, 2), "radio": (None, 2.5)[seed % 2], "policy": ("mrac", "per_cell")[seed // 3]}
        play_both_ways(make_plan(world, starts, Settings(**asked)), world, seed, 3)


def test_one_speed_is_any_other() -> None:
    world, starts, _ = drawn(2)
    plain = make_plan(world, starts, Settings())
    for steps in (2, (3, 3, 3)):
        plan = make_plan(world, starts, Settings(steps_per_move=steps))
        assert [r.path.tolist() for r in plan.robots] == [r.path.tolist() for r in plain.robots]
        tallies = [run_range(compile_closed_loop(one, world), 1, 0, 500)[0] for one in (plan, plain)]
        assert replace(tallies[0], key="") == replace(tallies[1], key="")
    twice = make_plan(world, starts, Settings(steps_per_move=(2, 4, 2)))
    once = make_plan(world, starts, Settings(steps_per_move=(1, 2, 1)))
    assert [r.path.tolist() for r in twice.robots] == [r.path.tolist() for r in once.robots]


def test_a_corridor_by_hand() -> None:
    """Six cells each, one robot three times as fast: it has covered its own when four are left of the other's, gets two
    of these, and would be too late for more.
    """
    world = World.create(np.zeros((1, 12)))
    plan = make_plan(world, [[0, 0], [0, 11]], Settings(steps_per_move=(1, 3)))
    assert (plan.outcome, [len(np.unique(robot.path)) for robot in plan.robots]) == ("complete", [8, 4])
    moves = np.flatnonzero(np.diff(plan.robots[1].path)) + 1
    assert (moves.tolist(), plan.time) == ([3, 6, 9], 9)
    alone = make_plan(world, [[0, 0], [0, 11]], Settings(steps_per_move=(1, 3), deadline=4))
    assert alone.time == 4


def test_the_open_loop_of_slow_robots_covers_as_much_but_later() -> None:
    world, starts, _ = drawn(5)
    plan = make_plan(world, starts, Settings(steps_per_move=(1, 2, 4)))
    exact = open_loop_exact(plan, world)
    tally = make_engine(plan, world, Rolling("open", seed=5), "numba").tally(0, 40_000)
    cells = np.arange(len(tally.visited))
    middle = float(tally.visited @ cells / 40_000)
    se = float(np.sqrt(tally.visited @ (cells - middle) ** 2)) / 40_000
    assert abs(middle - exact.visited) <= 5 * se


def test_speeds_of_another_team_are_an_error() -> None:
    with pytest.raises(PlanError, match="steps_per_move of 2 robots for a team of 3"):
        make_plan(World.create(np.zeros((2, 3))), [[0, 0]] * 3, Settings(steps_per_move=(1, 2)))


# Robots that hear each other over a distance: everybody near against no limit, a tree.


def test_a_chain_is_as_long_as_its_links_are_short() -> None:
    world, every = World.create(np.zeros((5, 14))), [True] * 4
    for radio, heard in ((3.0, [True, True, False, False]), (4.0, [True, True, True, False]), (5.0, every)):
        run = PythonLoop(make_plan(world, [[0, 0]] * 4, Settings(radio=radio)), world).begin(0, 0)
        run.raw.robots["cell"] = 3, 6, 10, 69  # the last one in [4, 13]
        assert [interpreted("robot_types").hears(run.t, run.s, robot) for robot in range(4)] == heard
        run.raw.robots["doing"][0] = Doing.DEAD
        assert radio > 3 or not any(interpreted("robot_types").hears(run.t, run.s, robot) for robot in range(1, 4))


def test_who_hears_everybody_is_who_has_no_limit() -> None:
    world, starts, _ = drawn(4)
    plans = [make_plan(world, starts, Settings(policy="per_cell", radio=radio)) for radio in (100.0, None)]
    tallies = [run_range(compile_closed_loop(plan, world), 1, 0, 500)[0] for plan in plans]
    assert replace(tallies[0], key="") == replace(tallies[1], key="")


@pytest.mark.parametrize("policy", ["mrac", "per_cell"])
def test_who_is_out_of_touch_drives_back_to_hear_of_what_is_left(policy: str) -> None:
    """Two robots cover their sides of a dangerous cell. The first is done four cells from its start, and the other one,
    three from its own, three from it: over three cells it hears of what is left; else it drives back as far as it must,
    or as its range of six moves lets it.
    """
    world = World.create([[0.0] * 5 + [0.5] + [0.0] * 5])
    back = {1.0: [3, 2, 1, 1, 2, 3, 4, 5], 2.0: [3, 2, 2, 3, 4, 5], 2.9: [3, 2, 2, 3, 4, 5], 3.0: [5]}
    for radio, then in back.items():
        plan = make_plan(world, [[0, 0], [0, 10]], Settings(radio=radio, policy=policy))
        assert plan.robots[0].path.tolist() == [0, 1, 2, 3, 4, *then]
        assert _ends(plan, world) == {(Outcome.COMPLETE, 11)}
    short = make_plan(world, [[0, 0], [0, 10]], Settings(radio=1.0, policy=policy, range=6))
    assert short.robots[0].path.tolist() == [0, 1, 2, 3, 4, 3, 2]
    assert _ends(short, world) == {(Outcome.NO_PROGRESS, 10)}


def _ends(plan: Plan, world: World) -> set[tuple[int, int]]:
    """(outcome, cells visited) of rollouts."""
    _, singles = run_range(compile_closed_loop(plan, world), 0, 0, 50, singles=True)
    return set(zip(singles.outcome.tolist(), singles.visited.tolist(), strict=True))
