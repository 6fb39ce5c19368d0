"""Robots that learn about hazards from what happens to them (docs/spec.md, section 15), readable and compiled."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from closed_loop_compare import assert_same_trace
from doubt import expected, persistent
from oracle_experience import Pupil
from test_planner_unknown import POLICIES, cells_of, moves

from planner.errors import InputError, WorldError
from planner.failure_model import own_key, threefry2x32
from planner.ids import NO_ROBOT
from planner.mrac.make_plan import make_plan
from planner.mrac.problem import prepare
from planner.mrac.simulate import ReferenceLoop, make_team, play_step, simulate
from planner.rollouts.engine import closed_loop_engine
from planner.settings import Settings
from planner.simulator.closed_loop import compile_closed_loop, final_odds, run_range, trace_rollouts
from planner.world.changing_maps import with_hazard
from planner.world.features import with_prior, with_sense
from planner.world.generate import Stream, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.map_knowledge import ALWAYS, NAT, NEVER, chance_of
from planner.world.scenario import load_input
from planner.world.uncertain_maps import bounds_of
from planner.world.world import World

N = np.nan
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
    world = with_hazard(World.create(np.where(np.isnan(q), N, 0)), kind, q, h, learn=True)
    if detector is None:
        return world
    return with_sense(world, dict(zip(("range", "detect", "false_alarm"), detector, strict=True)))


def wants(robot, step, cell):
    """A scripted reading: one in four is an alarm."""
    return (7 * robot + 5 * step + 3 * cell) % 4 == 0


def nothing(robot, step, cell):
    """No alarm: where a reading may be certain, one that contradicts what happened would be none."""
    return False


class Script:
    """Robot i is stopped at its `stops[i]`-th visit of a cell that it may be stopped in; sure: all or none."""

    def __init__(self, world, stops):
        self.may, self.stops = (world.threat > 0).ravel(), stops
        self.sure = (world.doubt.h == 1).ravel() & (world.doubt.kind == "persistent")
        self.visits, self.known = [0, 0], {}

    def hit(self, robot, step, cell):
        self.visits[robot] += self.may[cell]
        stopped = bool(self.may[cell] and self.visits[robot] == self.stops[robot])
        return self.known.setdefault(cell, stopped) if self.sure[cell] else stopped


class Both:
    """A run by the simulator and one by the twin, by the same judges of visits and readings."""

    def __init__(self, q, h, kind, starts, detector=None):
        self.world = taught(q, h, kind, detector)
        self.plan = make_plan(self.world, starts, Settings(levels=64))  # the twin knows no bins
        self.problem = prepare(self.world, starts, self.plan.settings)
        self.kind, self.detector = kind, detector

    def ours(self, hit, alarm=wants):
        team = make_team(
            self.problem, self.plan.areas, truth=0,
            readings=lambda robot, step, cells: np.array([alarm(robot, step, int(cell)) for cell in cells]),
        )  # fmt: skip
        while (outcome := team.outcome(self.problem.max_steps)) is None:
            play_step(team, hit)
        paths = [moves(cells_of(self.world, robot.path)) for robot in team.robots]
        return paths, set(cells_of(self.world, np.flatnonzero(team.visited))), outcome.word, team

    def theirs(self, hit, alarm=wants):
        width, areas = self.world.shape[1], self.plan.areas
        given = [(a.level, None if a.robot == NO_ROBOT else a.robot, cells_of(self.world, a.cells)) for a in areas]
        q, h = (one.astype(np.float64) for one in (self.world.doubt.q, self.world.doubt.h))
        starts = [divmod(int(cell), width) for cell in self.problem.starts]
        twin = Pupil(
            q, h, self.kind == "consumed", starts, given, lambda i, t, c: hit(i, t, c[0] * width + c[1]),
            self.detector, lambda i, t, c: alarm(i, t, c[0] * width + c[1]),
        )  # fmt: skip
        ended = twin.run()
        return [moves(walker.path) for walker in twin.team], twin.visited, ended, twin


@pytest.mark.parametrize("detector", DETECTORS)
@pytest.mark.parametrize("kind", ["persistent", "consumed"])
@pytest.mark.parametrize("number", range(len(TINY)))
def test_every_scripted_run_is_that_of_a_twin_written_from_the_rules(number, kind, detector):
    q, h = TINY[number]
    free = np.argwhere(~np.isnan(np.array(q, dtype=float)))
    for starts in (free[[0, -1]], free[[0, 0]]):
        both = Both(q, h, kind, starts, detector)
        readings = wants if detector and detector[2] > 0 and detector[1] < 1 else nothing
        for stops in itertools.product(range(4), repeat=2):
            *ours, team = both.ours(Script(both.world, stops).hit, readings)
            *theirs, twin = both.theirs(Script(both.world, stops).hit, readings)
            assert ours == theirs, (stops, starts.tolist())
            cells = sorted(twin.goal)
            mine = chance_of(team.odds)[[r * both.world.shape[1] + c for r, c in cells]]
            np.testing.assert_allclose(mine, [twin.chance[cell] for cell in cells], atol=2e-5)


@pytest.mark.parametrize(("detect", "false_alarm", "worth", "time"), [(0.7, 0.3, 8, 6), (0.6, 0.3, 32, 9)])
def test_a_detector_that_changes_the_map_keeps_a_waiting_team_up(detect, false_alarm, worth, time):
    """`0 q 0 0`, q = .5, h = .9: nobody goes at first. Each silent step takes ln((1 - a) / (1 - b)) nats off, and in
    the steps in which that is another class the map changes; at the least class, or before, the robot goes.
    """
    world = taught([[0, 0.5, 0, 0]], np.full((1, 4), 0.9), "persistent", (1, detect, false_alarm))
    plan = make_plan(world, [[0, 0]], Settings(policy="per_cell", worth=worth))
    assert (plan.outcome, plan.time) == ("not_worth_the_risk", 2)  # in the nominal run nobody learns
    problem = prepare(world, [[0, 0]], plan.settings)
    team = make_team(problem, plan.areas, truth=0, readings=lambda robot, step, cells: np.zeros(len(cells), bool))
    while (outcome := team.outcome(problem.max_steps)) is None:
        play_step(team, lambda *_: False)
    assert (outcome.name, team.step, int(team.visited.sum())) == ("COMPLETE", time, 4)
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    for trace in trace_rollouts(loop, worth, range(12)):
        assert_same_trace(trace, readable.trace(worth, trace.rollout))


def test_all_that_can_happen_on_a_hidden_map_is_what_rollouts_come_to():
    """Every hidden map and every hit, by the twin, against rollouts: visited cells, and the mean posterior."""
    count = 5_000
    for number, kind in ((0, "persistent"), (0, "consumed"), (2, "persistent")):
        q, h = TINY[number]
        both = Both(q, h, kind, [[0, 0], [0, 0]])
        there, hits = (
            np.nan_to_num(one.ravel().astype(np.float64)) for one in (both.world.doubt.q, both.world.doubt.h)
        )

        def play(hit, both=both):
            _, visited, _, twin = both.theirs(hit)
            width = both.world.shape[1]
            posterior = np.zeros(both.world.threat.size)
            posterior[[r * width + c for r, c in twin.chance]] = list(twin.chance.values())
            return np.append(posterior, len(visited))

        exact = expected(play, persistent(there, hits, kind == "consumed"))
        loop = compile_closed_loop(both.plan, both.world)
        _, singles = run_range(loop, 3, 0, count, singles=True)
        posterior = np.zeros((count, there.size))
        posterior[:, loop.cells] = chance_of(final_odds(loop, 3, 0, count))
        for found, wanted in ((singles.visited, exact[-1:]), (posterior, exact[:-1])):
            error = found.std(axis=0) / np.sqrt(count) + 1e-6
            assert (np.abs(found.mean(axis=0) - wanted) < 5 * error).all(), (number, kind)
        if kind == "persistent":  # what is learned is right on average: the law of total probability
            np.testing.assert_allclose(exact[:-1], there, atol=1e-6)


# --- calibration ---

FIELD = random_world(9, 9, ThreatPattern("scattered", 4, (0.1, 0.3, 0.5), 5), obstacles=0.1, threats=0.4)
Q = np.where(FIELD.threat > 0, np.nan_to_num(FIELD.threat), 0.1)


def hidden(world, seed, count):
    """Where a hazard is at first in each rollout, bool `[count, N]`, drawn as docs/spec.md, section 13, says."""
    cells = np.arange(world.threat.size)
    words, _ = threefry2x32(own_key(seed, 0), np.arange(count)[:, None], cells)
    return (words >> np.uint32(8)) < bounds_of(world.doubt.q).ravel()


@pytest.mark.parametrize("detector", [None, (2, 0.7, 0.2)])
def test_posteriors_are_calibrated_and_their_mean_is_the_prior_in_every_cell(detector):
    count = 2500
    world = taught(np.where(np.isnan(FIELD.threat), N, Q), 0.4, "persistent", detector)
    plan = make_plan(world, place_starts(world, 3)[0])
    loop = compile_closed_loop(plan, world)
    posterior, visits = chance_of(final_odds(loop, 17, 0, count)), run_range(loop, 17, 0, count)[0].visits[loop.cells]
    there, prior = hidden(world, 17, count)[:, loop.cells], world.doubt.q.ravel()[loop.cells].astype(float)
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
        plain = with_hazard(FIELD, kind, q, 0.4)
        for world in (
            with_hazard(FIELD, kind, q, 0.4, learn=True),
            with_sense(with_hazard(FIELD, kind, q, 0.4, learn=True), {"range": 3, "detect": 0.9, "false_alarm": 0.1}),
        ):
            starts = place_starts(plain, 3)[0]
            for policy in ("mrac", "per_cell"):
                plan = make_plan(plain, starts, Settings(policy=policy))
                assert make_plan(world, starts, plan.settings).to_json() == plan.to_json()
                loops = [compile_closed_loop(plan, one) for one in (plain, world)]
                assert trace_rollouts(loops[0], 4, range(9)) == trace_rollouts(loops[1], 4, range(9))
                readable = ReferenceLoop(plan, world)
                assert readable.trace(4, 1) == ReferenceLoop(plan, plain).trace(4, 1)


# --- engines ---


def drawn(number):
    """A world of robots that learn, drawn, their starts and settings."""
    stream = Stream(number, 3301)
    height, width = 2 + stream.below(7), 2 + stream.below(7)
    chances, stops = np.array([0, 0, 0.05, 0.3, 0.6, 1, N, N]), (0.2, 0.5, 0.9, 1.0)
    q = chances[[stream.below(8) for _ in range(height * width)]].reshape(height, width)
    q.flat[stream.below(height * width)] = 0.0
    h = np.where(q == 1, 0.5, np.array([stops[stream.below(4)] for _ in range(q.size)]).reshape(q.shape))
    world = with_hazard(World.create(np.where(np.isnan(q), N, 0)), ("persistent", "consumed")[number % 2], q, h, True)
    if number % 3:
        rates = ((0.9, 0.1), (0.5, 0.3), (1, 0.1), (0.7, 0))[stream.below(4)]
        sense = {"range": (1, 1.5, 2, 3)[stream.below(4)], "sight": stream.below(2) == 1}
        world = with_sense(world, sense | {"detect": rates[0], "false_alarm": rates[1]})
    free = np.argwhere(~np.isnan(q))
    starts = free[[stream.below(len(free)) for _ in range(1 + stream.below(5))]]
    settings = Settings(**POLICIES[number % len(POLICIES)])
    if number % 5 == 0:
        settings = replace(settings, range=4 + stream.below(12))
    return world, starts, settings


def agree(number, rollouts=2):
    """Both engines, in a drawn world; how often robots were surprised."""
    world, starts, settings = drawn(number)
    plan = make_plan(world, starts, settings)
    loop, readable = compile_closed_loop(plan, world), ReferenceLoop(plan, world)
    traces = trace_rollouts(loop, number, range(rollouts))
    assert traces == [readable.trace(number, rollout) for rollout in range(rollouts)], number
    return sum(int((trace.events[:, 2] == 8).sum()) for trace in traces)


def test_events_are_those_of_the_readable_simulator():
    assert sum(agree(number) for number in range(60)) > 200


@pytest.mark.slow
def test_so_they_are_in_a_thousand_more():
    assert sum(agree(number) for number in range(60, 1060)) > 3000


@pytest.mark.parametrize("detector", [None, (2, 0.7, 0.2)])
def test_no_count_depends_on_threads_or_chunks(detector, monkeypatch):
    monkeypatch.setattr("planner.simulator.runners.LEAST_SHARED", 1)
    world = taught(np.where(np.isnan(FIELD.threat), N, Q), 0.4, "consumed", detector)
    plan = make_plan(world, place_starts(world, 3)[0], Settings(policy="per_cell"))
    loop = compile_closed_loop(plan, world)
    tally, singles = run_range(loop, 5, 0, 60, singles=True, threads=2)
    apart = [run_range(loop, 5, start, 20, threads=threads)[0] for start, threads in ((0, 1), (20, 2), (40, 1))]
    assert apart[0] + apart[1] + apart[2] == tally
    readable = ReferenceLoop(plan, world)
    for rollout in range(3):
        assert singles.visited[rollout] == readable.run(5, rollout).visited.sum()


# --- what is said, and refused ---


def test_bayes_rule_in_whole_numbers():
    evidence = taught([[0.2, 1, 0]], [[0.5, 0.5, 1]], "persistent", (1, 0.8, 0.1)).doubt.evidence
    assert evidence.prior.tolist() == [round(np.log(0.25) * NAT), ALWAYS, NEVER]
    after = evidence.read(evidence.prior, np.array([0, 0, 1, 2]), np.array([True, False, False, True]))
    q = float(np.float32(0.2))
    wanted = [q * 0.8 / (q * 0.8 + (1 - q) * 0.1), q * 0.2 / (q * 0.2 + (1 - q) * 0.9), 1, 0]
    np.testing.assert_allclose(chance_of(after), wanted, atol=1e-6)
    classes = [evidence.class_of(evidence.prior + lost * NAT // 2, np.array([0]))[0] - 6 for lost in range(-11, 12)]
    assert classes == [4, 4, 4, 4, 3, 3, 2, 2, 1, 1, 0, 0, 0, -1, -1, -2, -2, -3, -3, -4, -4, -4, -4]


def test_worlds_say_what_is_wrong_with_them(tmp_path):
    world = taught([[0.2, 0.1], [0, 0]], 0.5, "persistent")
    with pytest.raises(WorldError, match="hazards are not seen"):
        with_sense(world, 2)
    with pytest.raises(WorldError, match="tells nothing"):
        with_sense(world, {"range": 2, "detect": 0.1, "false_alarm": 0.1})
    with pytest.raises(WorldError, match="drawn anew"):
        with_hazard(world, "independent", 0.1, learn=True)
    with pytest.raises(WorldError, match="robots would have to learn"):
        with_prior(world, 0.1, sense=1)
    with pytest.raises(WorldError, match="learn: true"):
        with_sense(replace(world, doubt=replace(world.doubt, learn=False)), 1)
    plan = make_plan(world, [[0, 0]])
    with pytest.raises(WorldError, match=r"first_visit.*leave `learn` out"):
        compile_closed_loop(plan, world, first_only=True)
    with pytest.raises(InputError, match="robots that learn the map"):
        closed_loop_engine(compile_closed_loop(plan, world), 1, "jax")


def test_scenarios_and_world_files_keep_it(tmp_path):
    world = with_sense(
        taught([[0.2, 0.1], [0, 0]], 0.5, "consumed"), {"range": 2, "detect": 0.8, "false_alarm": 0.1, "sight": True}
    )
    world.save(tmp_path / "w.npz")
    again = load_input(tmp_path / "w.npz")
    assert again.luck_sha256 == world.luck_sha256
    assert again.doubt.detector == world.doubt.detector
    World.create(world.doubt.q).save(tmp_path / "q.npz")
    text = "map: q.npz\nhazard: {kind: consumed, h: 0.5, learn: true}\nsense: {range: 2, %s}\n"
    (tmp_path / "s.yaml").write_text(text % "sight: true, detect: 0.8, false_alarm: 0.1")
    assert load_input(tmp_path / "s.yaml").luck_sha256 == world.luck_sha256
    for wrong in ("detect: 0.8", "detect: 2, false_alarm: 0"):
        (tmp_path / "s.yaml").write_text(text % wrong)
        with pytest.raises(InputError, match="sense"):
            load_input(tmp_path / "s.yaml")


def test_nobody_who_learns_nothing_runs_otherwise():
    """The nominal run, and one without a truth, learn nothing."""
    both = Both(*TINY[0], "persistent", [[0, 0], [0, 0]])
    run = simulate(both.problem, both.plan.areas)
    assert [robot.path.tolist() for robot in both.plan.robots] == [path.tolist() for path in run.paths]
