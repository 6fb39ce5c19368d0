"""Threats that change with time (docs/spec.md, section 16)."""

from __future__ import annotations

from dataclasses import replace
from math import gamma
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace, followed
from oracle_phases import closed_loop, mean_of, open_loop

from analysis.theory.exact import open_loop_exact
from planner.errors import InputError
from planner.failure_model import Bearing
from planner.ids import MAX_STEP, NO_ROBOT
from planner.mrac.make_plan import allocated_plan, make_plan
from planner.mrac.simulate import ReferenceLoop
from planner.plan.plan import Plan, RobotPlan
from planner.rollouts.engine import Rolling, make_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, run_range, trace_rollouts, with_nominal_run
from planner.simulator.exact_tree import grow_tree
from planner.tally import EventKind
from planner.world.changing_maps import with_phases
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.moving_threats import PLAN_ON, Foresight
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

N = np.nan
POLICIES = (
    {}, {"policy": "per_cell"}, {"policy": "per_cell", "reserve": 0.5}, {"policy": "frontier"},
    {"policy": "per_cell", "worth": 3.0}, {"policy": "watchful"}, {"wear": 3.0}, {"range": 12},
)  # fmt: skip


def changing(number: int, stream: Stream) -> tuple[World, np.ndarray]:
    """A small map, up to three others that follow, starts."""
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    free = np.array([stream.below(5) > 0 for _ in range(height * width)]).reshape(height, width)
    free.flat[stream.below(height * width)] = True
    levels, maps, begins = np.array([0.0, 0.0, 0.0, 0.1, 0.3]), [], [0]
    for _ in range(2 + stream.below(3)):
        drawn = levels[[stream.below(5) for _ in range(height * width)]].reshape(height, width)
        maps.append(np.where(free, np.where(stream.below(3) > 0, drawn, maps[-1] if maps else 0), np.nan))
        begins.append(begins[-1] + 1 + stream.below(6))
    world = with_phases(World.create(maps[0]), list(zip(begins[1:], maps[1:], strict=False)), PLAN_ON[number % 3])
    places = np.argwhere(free)
    return world, places[[stream.below(len(places)) for _ in range(1 + stream.below(5))]]


def agree(number: int) -> int:
    """Both engines, in a drawn world, and both plans; how often robots were surprised."""
    stream = Stream(number, 1616)
    world, starts = changing(number, stream)
    settings = Settings(**POLICIES[number % len(POLICIES)])
    if number % 5 == 0:
        settings = replace(settings, in_area="boustrophedon")
    plan, first_only = make_plan(world, starts, settings), number % 4 == 1
    loop = compile_closed_loop(plan, world, first_only=first_only)
    readable, traces = (
        ReferenceLoop(plan, world, first_only=first_only),
        trace_rollouts(loop, number, (0, 1)),
    )
    runs, known = zip(*(followed(readable, number, rollout) for rollout in range(4)), strict=True)
    for trace in traces:
        assert_same_trace(trace, known[trace.rollout])
    quick = with_nominal_run(allocated_plan(world, starts, settings), loop)
    assert [robot.path.tolist() for robot in quick.robots] == [robot.path.tolist() for robot in plan.robots], number
    tally = run_range(loop, number, 0, 4, threads=1)[0]
    assert tally.covered_survived.tolist() == sum(run.survived.astype(int) for run in runs).tolist(), number
    return sum(int((trace.events[:, 2] == EventKind.SURPRISED).sum()) for trace in traces)


def test_events_are_those_of_the_readable_simulator() -> None:
    assert sum(agree(number) for number in range(48)) > 20


# --- how a run ends ---


@pytest.mark.parametrize("policy", ["per_cell", "watchful", "frontier"])
def test_a_team_waits_for_a_danger_that_is_announced_to_end(policy: str) -> None:
    """`0 .5 0 0`, one robot that is worth 4 cells, all safe from step f on: it goes on at f, and covers all.

    Where f is after the last step, T_max = 8 * 2 * 4 + 64 = 128, it waits until then.
    """
    world = World.create([[0, 0.5, 0, 0]])
    for f in (1, 2, 3, 4, 5, 9, 125, 128, 500):
        timed = with_phases(world, [(f, np.zeros((1, 4)))])
        plan = make_plan(timed, [[0, 0]], Settings(policy=policy, worth=4.0))
        done = f + 3 <= 128  # it is allocated the area in step f, and moves in the three steps after it
        assert (plan.outcome, plan.time) == (("complete", f + 3) if done else ("step_limit", 128)), f
        loop = compile_closed_loop(plan, timed)
        tally = run_range(loop, f, 0, 64, threads=1)[0]
        assert tally.alive.tolist() == [0, 64]
        assert tally.visited.tolist() == [64 * (n == (4 if done else 1)) for n in range(5)]
        assert_same_trace(trace_rollouts(loop, f, (3,))[0], followed(ReferenceLoop(plan, timed), f, 3)[1])
        tree = grow_tree(loop, 0.0, 10**6)
        assert tree is not None and tree.mean_alive == 1.0


def test_a_team_ends_once_nothing_that_is_announced_changes_the_map() -> None:
    """The last phase that changes a level counts, on cells that robots can reach, and while a robot can move."""
    base = np.array([[0, 0.5, 0, np.nan, 0]])

    def ends(phases: list[tuple[int, list[float]]], **more: Any) -> tuple[str, int]:
        maps = [(at, np.array([p])) for at, p in phases]
        plan = make_plan(
            with_phases(World.create(base), maps), [[0, 0]], Settings(policy="per_cell", worth=4.0, **more)
        )
        return plan.outcome, plan.time

    assert ends([(9, [0, 0.5, 0, N, 0.3])]) == ("not_worth_the_risk", 2)  # out of reach
    assert ends([(4, [0, 0.4, 0, N, 0]), (9, [0, 0.4, 0, N, 0.3])]) == (
        "not_worth_the_risk",
        5,
    )  # the last that counts: 4
    assert ends([(4, [0, 0.4, 0, N, 0]), (9, [0, 0, 0, N, 0])]) == ("complete", 11)
    assert ends([(3, [0, 0, 0, N, 0]), (9, [0, 0.5, 0, N, 0])]) == ("complete", 5)
    timed = with_phases(World.create([[0, 0, 0.5]]), [(9, np.zeros((1, 3)))])
    spent = make_plan(timed, [[0, 0]], Settings(policy="per_cell", range=1))
    assert (spent.outcome, spent.time) == ("no_progress", 3)  # nobody can move any more


def test_robots_that_come_home_wait_for_it_too() -> None:
    """As above, and then home: B, C, D at f + 1 to f + 3, back at f + 6; by a deadline that is before f nothing."""
    world = World.create([[0, 0.5, 0, 0]])
    for f, deadline, end in (
        (5, None, ("complete", 11)), (4, 10, ("complete", 10)), (4, 9, ("deadline", 9)), (20, 10, ("deadline", 10)),
    ):  # fmt: skip
        timed = with_phases(world, [(f, np.zeros((1, 4)))])
        settings = Settings(policy="per_cell", worth=4.0, return_to="home", deadline=deadline)
        plan = make_plan(timed, [[0, 0]], settings)
        assert (plan.outcome, plan.time) == end
        loop = compile_closed_loop(plan, timed)
        assert_same_trace(trace_rollouts(loop, f, (0,))[0], followed(ReferenceLoop(plan, timed), f, 0)[1])
        assert run_range(loop, f, 0, 8, threads=1)[0].home.tolist() == [0, 8]


@pytest.mark.slow
def test_so_they_are_in_a_thousand_more() -> None:
    assert sum(agree(number) for number in range(48, 1048)) > 500


# --- what is expected ---

TINY = [
    [(0, [[0, 0.3, 0], [0, 0.2, 0]]), (3, [[0.3, 0, 0], [0, 0, 0.2]])],
    [(0, [[0, 0, 0.4], [N, 0, 0], [0, 0.4, 0]]),
     (2, [[0.4, 0, 0], [N, 0, 0.1], [0, 0, 0.1]]), (5, [[0, 0, 0], [N, 0, 0], [0, 0, 0]])],
    [(0, [[0, 0, 0, 0, 0]]), (4, [[0.5, 0.5, 0.5, 0.5, 0]])],
    [(0, [[0.2, 0.2, 0.2], [0.2, N, 0.2], [0, 0.2, 0]]), (1, [[0, 0.2, 0], [0.3, N, 0.3], [0, 0.2, 0.3]])],
]  # fmt: skip


def tiny(number: int, plan_on: Foresight) -> tuple[World, list[tuple[int, np.ndarray]]]:
    maps = [(begin, np.array(p, dtype=np.float32)) for begin, p in TINY[number]]
    return with_phases(World.create(maps[0][1]), maps[1:], plan_on), maps


@pytest.mark.parametrize("plan_on", PLAN_ON)
@pytest.mark.parametrize("number", range(len(TINY)))
@pytest.mark.parametrize("wide", [False, True])
def test_teams_come_to_what_enumeration_has(number: int, plan_on: Foresight, wide: bool) -> None:
    world, maps = tiny(number, plan_on)
    free = [tuple(cell) for cell in np.argwhere(world.free).tolist()]
    starts, width = [free[0], free[-1] if wide else free[0]], world.shape[1]
    plan = make_plan(world, starts)
    areas = [
        (area.level, None if area.robot == NO_ROBOT else area.robot, [divmod(c, width) for c in area.cells.tolist()])
        for area in plan.areas
    ]
    planned = maps if plan_on == "now" else [(0, world.threat)]
    expected = mean_of(lambda judge: closed_loop(planned, starts, areas, judge), maps)
    loop = compile_closed_loop(plan, world)
    tree, singles = grow_tree(loop, 0.0, 10**6), run_range(loop, 3, 0, 40_000, singles=True)[1]
    assert tree is not None and singles is not None
    found = (tree.covered("visited")[0], tree.mean_alive, tree.covered("survived")[0])
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    for name, mean in zip(("visited", "alive", "survived"), expected, strict=True):
        values = getattr(singles, name)
        assert abs(values.mean() - mean) < 5 * max(values.std() / 200, 1e-4), name


@pytest.mark.parametrize("number", range(len(TINY)))
def test_given_paths_are_known_exactly(number: int) -> None:
    world, maps = tiny(number, "first")
    width = world.shape[1]
    paths = [robot.path for robot in make_plan(world, np.argwhere(world.free)[[0, -1]]).robots]
    paths[0] = np.insert(paths[0], 1, [paths[0][0]] * 2)  # it waits
    plan = Plan(world.shape, world.sha256, None, tuple(map(RobotPlan, paths)))
    expected = mean_of(lambda judge: open_loop([[divmod(c, width) for c in p.tolist()] for p in paths], judge), maps)
    exact = open_loop_exact(plan, world)
    np.testing.assert_allclose((exact.visited, exact.survival.sum(), exact.survived), expected, rtol=1e-6)
    values = make_engine(plan, world, Rolling("open"), "numba").results(0, 40_000)
    for name, mean in zip(("visited", "alive", "survived"), expected, strict=True):
        of = getattr(values, name)
        assert abs(of.mean() - mean) < 5 * max(of.std() / 200, 1e-4), name


def test_who_wears_bears_what_each_phase_brings() -> None:
    """One robot of wear 3 on a path: S = exp(-(E / s)**3) of the exposure E of its visits, each in its phase."""
    world, _ = tiny(2, "now")
    exact = open_loop_exact(make_plan(world, [[0, 0]], Settings(wear=3.0)), world)
    borne = -np.log1p(-np.float64(np.float32(0.5)))  # it enters [0, 4] at step 4, safe in both; nothing before
    assert exact.survival[0] == 1.0 and borne > 0
    back = Plan(world.shape, world.sha256, None, (RobotPlan(np.array([0, 1, 2, 3, 2, 1])),), bears=Bearing(3.0))
    scale = round(2**20 / gamma(1 + 1 / 3)) / 2**20
    assert open_loop_exact(back, world).survival[0] == pytest.approx(np.exp(-((2 * borne / scale) ** 3)), rel=1e-4)


# --- what changes nothing ---


def test_phases_that_change_nothing_change_no_run() -> None:
    for seed in range(4):
        world = random_world(9, 9, ThreatPattern(seed=seed))
        assert with_phases(world, [(0, world)]).doubt is None
        starts, _ = place_starts(world, 3)
        settings = Settings(policy=("mrac", "per_cell")[seed % 2])
        other = np.where(world.free, 0.3, np.nan)
        for phases in ([(5, world), (9, world)], [(MAX_STEP, other)]):
            timed = with_phases(world, phases, "first")
            plans = [make_plan(one, starts, settings) for one in (world, timed)]
            assert plans[0].to_json() == plans[1].to_json()
            loops = [compile_closed_loop(plan, one) for plan, one in zip(plans, (world, timed), strict=True)]
            counts = [run_range(loop, 1, 0, 2000)[0].counts() for loop in loops]
            assert all(np.array_equal(counts[0][name], counts[1][name]) for name in counts[0])
            assert loops[0].identity != loops[1].identity
        alike = with_phases(world, [(5, world)])
        runs = [trace_rollouts(compile_closed_loop(plans[0], one), 1, range(8)) for one in (world, alike)]
        assert runs[0] == runs[1]


def test_no_count_depends_on_threads_or_chunks() -> None:
    world = random_world(9, 9, ThreatPattern(seed=3))
    timed = with_phases(world, [(20, np.roll(np.nan_to_num(world.threat), 3, axis=1) + 0 * world.threat)])
    loop = compile_closed_loop(make_plan(timed, place_starts(timed, 4)[0]), timed)
    whole = run_range(loop, 9, 0, 6000, threads=2)[0]
    assert run_range(loop, 9, 0, 1700, threads=1)[0] + run_range(loop, 9, 1700, 4300, threads=1)[0] == whole


# --- files, and what is refused ---

SCENARIO = "map: m.npy\nthreats: [{raster: a.npy}]\nphases:\n- {from: 4, threats: [{raster: b.npy}]}\n"


def scenario(folder: Path, text: str) -> World:
    grid = np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.save(folder / "m.npy", grid)
    for name, p in (("a", [[0.1, 0, 0], [0, 0, 0]]), ("b", [[0, 0, 0], [0, 0.2, 0.3]])):
        np.save(folder / f"{name}.npy", np.array(p))
    (folder / "s.yaml").write_text(text)
    return load_input(folder / "s.yaml")


def test_a_scenario_and_its_world_file(tmp_path: Path) -> None:
    for plan_on, planned in (("now", [0.1, 0, 0]), ("first", [0.1, 0, 0]), ("worst", [0.1, 0.2, 0.3])):
        world = scenario(tmp_path, SCENARIO + f"plan_on: {plan_on}\n")
        assert world.phases is not None and world.phases.begins.tolist() == [0, 4]
        shown = world.threat[[0, 1, 1], [0, 1, 2]]
        np.testing.assert_allclose(shown, planned, rtol=1e-6)
        world.save(tmp_path / "w.npz", force=True)
        again = load_world_file(tmp_path / "w.npz")
        assert again.luck_sha256 == world.luck_sha256 == load_input(tmp_path / "w.npz").luck_sha256
        assert "threats that change at step 4; " in repr(again)
    whole = scenario(tmp_path, SCENARIO.replace("threats: [{raster: a.npy}]\n", "").replace("from: 4", "from: 0"))
    assert whole.doubt is None and whole.threat[1, 2] == np.float32(0.3)
    arrays = dict(np.load(tmp_path / "w.npz"))
    for name, value in (("phases_from", np.array([1, 4])), ("phases_threat", arrays["phases_threat"][:1])):
        np.savez(tmp_path / "bad.npz", **(arrays | {name: value}))
        with pytest.raises(InputError, match="phases_"):
            load_world_file(tmp_path / "bad.npz")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("from: 4", "from: -1", r"`phases`: phases\[0\]\.from is -1; expected a step, 0 to"),
        ("from: 4", "from: 1.5", r"phases\[0\]\.from is 1\.5; expected a step"),
        ("from: 4", "from: 0", r"`phases` begin at step 0, where `threats` are to hold; leave `threats` out"),
        ("from: 4", "step: 4", r"phases\[0\]"),
        (
            "phases:\n",
            "phases:\n- {from: 9, threats: []}\n",
            r"phases\[1\]\.from is 4; expected a step, 10 to .* order",
        ),
        ("threats: [{raster: b.npy}]", "threats: 3", r"`phases\[0\]\.threats` is 3; expected a list of sources"),
        ("{raster: b.npy}", "{raster: c.npy}", r"`phases\[0\]\.threats\[0\]\.raster`"),
        ("phases:\n- {from: 4, threats: [{raster: b.npy}]}\n", "phases: []\n", r"`phases` is \[\]; expected a list of"),
        ("map: m.npy", "map: m.npy\nplan_on: last", r"`plan_on` is 'last'; expected now or first or worst"),
        ("map: m.npy", "map: m.npy\nmovers: [{walk: 1, h: 0.1}]", r"`phases` is .*none beside movers"),
        ("map: m.npy", "map: m.npy\nprior: {p: 0.1}", r"here: threats that change at step 4"),
    ],
)
def test_a_wrong_phase_is_one_line(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in SCENARIO
    with pytest.raises(InputError, match=said) as error:
        scenario(tmp_path, SCENARIO.replace(old, new))
    assert "\n" not in str(error.value)


def test_maps_and_loops_that_do_not_fit_are_refused() -> None:
    world, _ = tiny(1, "now")
    plain = replace(world, threat=world.met, doubt=None)
    with pytest.raises(InputError, match=r"phases\[0\] has none at \[1, 0\]; expected the obstacles of the map"):
        with_phases(plain, [(3, np.zeros((3, 3)))])
    with pytest.raises(InputError, match=r"phases\[0\] is dict; expected pairs \(step, threats\)"):
        with_phases(World.create(np.zeros((2, 2))), [{"from": 4, "threats": []}])  # type: ignore[list-item]
    with pytest.raises(InputError, match=r"phases\[0\] has shape \[2, 3\]"):
        with_phases(plain, [(3, np.zeros((2, 3)))])
    with pytest.raises(InputError, match="beside another thing that is not known"):
        with_phases(world, [(3, plain)])
    with pytest.raises(InputError, match=r"threats that robots know beforehand.*give `plan_on: first` or `worst`"):
        make_plan(world, [[0, 0]], Settings(radio=4.0))
    with pytest.raises(InputError, match=r"`transit=\"area\"`, legs that stay.*give `plan_on: first` or `worst`"):
        make_plan(world, [[0, 0]], Settings(transit="area"))
    with pytest.raises(InputError, match="threats that change with time, in the closed loop in JAX"):
        make_engine(make_plan(world, [[0, 0]]), world, Rolling(), "jax")
