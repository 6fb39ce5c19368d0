"""The compiled closed loop against the plain oracle, and against an independent simulator's means; the survey."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest
from closed_loop_worlds import SurveyWorld, first_worlds, survey_worlds
from conftest import NAMES, Fixture, load_fixture
from helpers import assert_same_trace, paths_of, play_both_ways
from numpy.typing import NDArray
from oracle_simulator import Paper
from oracle_tree import plain_run

from analysis.statistics.estimates import mean_estimate
from planner.make_plan import allocated_plan, make_plan
from planner.plan.plan import Plan
from planner.rollout_sampling import LossDraws
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.single_run import PythonLoop
from planner.settings import Settings
from planner.simulator.codes import NO_AREA, Doing, EventKind, Outcome
from planner.tally import RolloutResults, Tally, Trace
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# --- The compiled simulator against fixtures, on large worlds and on the survey; Theorem 2 holds on it.

# The compiled classical simulator against the fixtures' exact means and an independent simulator's samples, at
# length.
#
# All five means that the fixtures give: cells visited and survived, time, robots alive, and the share of rollouts
# that cover everything; where they are exact, also the shares of the other two endings.

EXACT = [name for name in NAMES if "closed_loop_exact" in load_fixture(name).answers]
SAMPLED = [name for name in NAMES if "closed_loop_sampled" in load_fixture(name).answers]
TEAMS = [name for name in SAMPLED if name.endswith("k8")]
SIGMAS = 5


def histograms(tally: Tally) -> dict[str, NDArray[np.int64]]:
    """Rollouts by value, of everything whose mean a fixture may give."""
    counts = {name: getattr(tally, name) for name in ("visited", "survived", "time", "alive")}
    for outcome in (Outcome.COMPLETE, Outcome.ALL_ROBOTS_LOST, Outcome.NO_PROGRESS):
        count = int(tally.outcomes[outcome])
        counts[outcome.word] = np.array([tally.rollouts - count, count])
    return counts


def z_scores(fixture: Fixture, rollouts: int) -> dict[str, float]:
    """How far our means are from the fixture's, in (combined) standard errors.

    Ours is at least what one rollout may make: otherwise a value that never varied would forbid the rarest event.
    """
    plan = fixture.plan
    tally, _ = run_range(compile_closed_loop(plan, fixture.world), 14, 0, rollouts)
    known = fixture.answers.get("closed_loop_exact") or fixture.answers["closed_loop_sampled"]
    scores = {}
    for name, counts in histograms(tally).items():
        if name in known:
            mean, se = known[name] if isinstance(known[name], list) else (known[name], 0.0)
            mine, one_rollout = mean_estimate(counts, 1.0), max(len(counts) - 1, 1) / rollouts
            scores[name] = (mine.mean - mean) / float(np.hypot(max(mine.se, one_rollout), se))
    return scores


def largest(names: list[str], rollouts: int) -> tuple[float, str]:
    """The largest z-score of all means of these fixtures, without its sign, and whose it is. Each gives at least five.

    Raises AssertionError if a fixture gives fewer.
    """
    scores = {}
    for name in names:
        found = z_scores(load_fixture(name), rollouts)
        assert {"visited", "survived", "time", "alive", "complete"} <= set(found), name
        scores |= {f"{name}, {meaning}": abs(score) for meaning, score in found.items()}
    worst = max(scores, key=scores.__getitem__)
    return scores[worst], worst


def test_two_teams_are_as_sampled() -> None:
    for kind in ("contiguous", "scattered"):
        score, whose = largest([next(name for name in TEAMS if name.startswith(kind))], 16_384)
        assert score <= SIGMAS, whose


def test_hand_sized_worlds_are_exact() -> None:
    score, whose = largest([name for name in EXACT if name.startswith("tiny")], 65_536)
    assert score <= SIGMAS, whose


AT_LENGTH = {
    "teams of eight": (TEAMS, 200_000),
    "one robot": ([name for name in EXACT if name.endswith("k1") and not name.startswith("tiny")], 1_000_000),
    "two robots": ([name for name in EXACT if name.endswith("k2") and not name.startswith("tiny")], 1_000_000),
    "hand-sized worlds": ([name for name in EXACT if name.startswith("tiny")], 1_000_000),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", AT_LENGTH)
def test_means_at_length(what: str, capsys: pytest.CaptureFixture[str]) -> None:
    names, rollouts = AT_LENGTH[what]
    assert len(names) >= 12
    score, whose = largest(names, rollouts)
    with capsys.disabled():
        print(f"\n{what}, {len(names)} x {rollouts:,} rollouts: the largest |z| is {score:.2f} ({whose})")  # noqa: T201
    assert score <= SIGMAS, whose


# What 16 bits of areas and 64 bits of robots do not hold: the simulator is the same both ways there too.

SEED = 3


def events_of(plan: Plan, world: World) -> NDArray[np.int32]:
    """What happens in four rollouts, which are the same both ways."""
    return np.concatenate([run.trace.events for run in play_both_ways(plan, world, SEED, 4, tabled=(None,))])


@pytest.mark.parametrize(("side", "robots"), [(20, 100), pytest.param(34, 1024, marks=pytest.mark.slow)])
def test_a_team_of_several_words(side: int, robots: int) -> None:
    world = random_world(side, side, ThreatPattern("scattered", side, seed=2))
    plan = make_plan(world, place_starts(world, robots)[0])
    happened = events_of(plan, world)
    for kind in (EventKind.HIT, EventKind.SHARED):
        acted = happened[happened[:, 2] == kind, 1]
        assert acted.min() < 64 <= acted.max()


@pytest.mark.slow
def test_areas_of_more_than_16_bits() -> None:
    """A chessboard: every cell is an area, and robots in the last corner begin beyond the 65,536th."""
    threat = np.indices((362, 364)).sum(axis=0) % 2 * 0.2
    world = World.create(threat)
    plan = allocated_plan(world, [[361, 363], [361, 362], [360, 363]], Settings())
    assert len(plan.areas) == threat.size
    happened = events_of(plan, world)
    for kind in (EventKind.HIT, EventKind.ALLOCATED):
        assert happened[happened[:, 2] == kind, 3].max() > 65_535


# The survey of closed-loop worlds: Theorem 2 holds on it.

SAMPLED_SURVEY = 3
"""Stuck rollouts of a world that are looked at."""


def roll(one: SurveyWorld, plan: Plan, rollouts: int) -> RolloutResults:
    _, singles = run_range(one.loop(plan), one.seed, 0, rollouts, singles=True)
    return singles


# --- Theorem 2: complete, unless every robot that can reach the rest was stopped ---


def check_theorem_2(one: SurveyWorld, results: RolloutResults) -> None:
    """On every rollout, as far as its results tell; `check_stuck` has the rest."""
    everything = results.visited == one.accessible
    expected = {
        Outcome.COMPLETE: everything,
        Outcome.ALL_ROBOTS_LOST: ~everything & (results.alive == 0),
        Outcome.NO_PROGRESS: ~everything & (results.alive > 0) & (one.parts > 1),
        Outcome.STEP_LIMIT: ~everything & (results.alive > 0) & (results.time == (one.settings.max_steps or -1)),
    }
    for outcome, holds in expected.items():
        wrong = np.flatnonzero((results.outcome == outcome) & ~holds)
        assert len(wrong) == 0, f"{one.name} rollout {wrong[0]} ends {outcome.name}\n{one.world.threat.tolist()}"


def check_stuck(one: SurveyWorld, plan: Plan, results: RolloutResults) -> int:
    """In a sample of the stuck rollouts no robot left can reach an unvisited cell; how many were looked at."""
    sample = np.flatnonzero(results.outcome == Outcome.NO_PROGRESS)[:SAMPLED_SURVEY]
    part = one.world.components.ravel()
    accessible, loop = one.world.accessible(one.starts).ravel(), PythonLoop(plan, one.world, first_only=one.first_only)
    for rollout in sample.tolist():
        run = loop.run(one.seed, rollout)
        assert run.outcome is Outcome.NO_PROGRESS
        assert run.visited.sum() == results.visited[rollout]
        alive = {int(part[path[-1]]) for path, lives in zip(paths_of(run), run.alive, strict=True) if lives}
        left = set(part[accessible & ~run.visited].tolist())
        assert alive, (one.name, rollout)
        assert left, (one.name, rollout)
        assert not alive & left, f"{one.name} rollout {rollout}\n{one.world.threat.tolist()}"
    return len(sample)


@pytest.mark.parametrize(("most", "rollouts"), [(40, 200), pytest.param(None, 1000, marks=pytest.mark.slow)])
def test_theorem_2_on_the_survey(most: int | None, rollouts: int) -> None:
    looked = 0
    for one in survey_worlds() if most is None else first_worlds(most):
        plan = one.plan()
        results = roll(one, plan, rollouts)
        check_theorem_2(one, results)
        looked += check_stuck(one, plan, results)
    assert looked >= SAMPLED_SURVEY * (1 if most else 10)


# --- The compiled closed loop against the plain oracle.

WORLDS, MANY = 100, 3000
"""Drawn, in quick tests and in slow ones."""


def luck_of(world: World, seed: int, rollout: int, *, first_only: bool = False) -> Callable[..., bool]:
    """Who is stopped in a rollout of the product."""
    luck, entered = LossDraws(world, seed, rollout), set()

    def stopped(robot: int, step: int, cell: tuple[int, int]) -> bool:
        again = cell in entered
        entered.add(cell)
        return not (first_only and again) and luck.hits(robot, step, cell[0] * world.shape[1] + cell[1])

    return stopped


def trace_of(run: Paper, width: int, rollout: int, stopped: Callable[..., bool]) -> Trace:
    """The oracle's run as the product writes one down."""
    frames, area_of = [], np.full(run.cells, NO_AREA, dtype=np.int32)

    def number(area: int | None) -> int:
        return NO_AREA if area is None else area

    while not run.outcome:
        run.play(stopped)
        alive = [walker.patch if walker.doing != "dead" else None for walker in run.team]
        frames.append(
            [
                (walker.at[0] * width + walker.at[1], Doing[walker.doing.upper()], number(patch))
                for walker, patch in zip(run.team, alive, strict=True)
            ]
        )
    for area, patch in enumerate(run.patches):
        area_of[[row * width + col for row, col in patch.cells]] = area
    events = [
        (step, robot, EventKind[what.upper()], number(area), of[0] * width + of[1] if isinstance(of, tuple) else of)
        for step, robot, what, area, of in run.events
    ]
    cells, doing, areas = np.array(frames, dtype=np.int32).transpose(2, 0, 1)
    happened = np.array(events, dtype=np.int32).reshape(-1, 5)
    return Trace(rollout, cells, doing.astype(np.int8), areas, happened, area_of, Outcome[run.outcome.upper()])


def drawn(number: int) -> tuple[World, np.ndarray, Settings, bool]:
    """A small world in one piece or several, a team on it, its policy, and whether first visits alone are checked."""
    luck = np.random.default_rng(number)
    threat = luck.choice([np.nan, 0.0, 0.1, 0.35], p=[0.15, 0.5, 0.2, 0.15], size=luck.integers(1, 9, size=2))
    threat.flat[0] = 0.0
    free = np.argwhere(~np.isnan(threat))
    starts = free[luck.integers(len(free), size=luck.integers(1, 6))]
    settings = Settings(
        policy=("mrac", "per_cell")[number % 2],
        transit=("grid", "area")[int(luck.random() < 0.2)],
        density=float(luck.choice([1.5, 4.0])),
        max_steps=int(luck.integers(1, 30)) if luck.random() < 0.1 else None,
    )
    return World.create(threat), starts, settings, bool(luck.random() < 0.2)


def compare(number: int) -> Counter[int | str]:
    """Rollouts of a drawn world, event for event; how often each event and outcome came about."""
    world, starts, settings, first_only = drawn(number)
    plan, found = make_plan(world, starts, settings), Counter[int | str]()
    begun = plain_run(plan, world)
    loop = compile_closed_loop(plan, world, first_only=first_only, tabled=number % 4 < 2)
    for trace in trace_rollouts(loop, number, range(4)):
        stopped = luck_of(world, number, trace.rollout, first_only=first_only)
        mine = trace_of(begun.fork(), world.shape[1], trace.rollout, stopped)
        assert_same_trace(trace, mine, f"world {number}")
        found.update([*trace.events[:, 2].tolist(), trace.outcome.word])
    return found


@pytest.mark.parametrize(("first", "count"), [(0, WORLDS), pytest.param(WORLDS, MANY, marks=pytest.mark.slow)])
def test_the_compiled_closed_loop_is_the_oracle_s_event_for_event(first: int, count: int) -> None:
    found = sum(map(compare, range(first, first + count)), Counter[int | str]())
    kinds = (
        EventKind.COMPLETED, EventKind.HIT, EventKind.REALLOCATED, EventKind.ALLOCATED, EventKind.SHARED,
        EventKind.LOOKED_AGAIN,
    )  # fmt: skip
    assert min(found[kind] for kind in kinds) >= count // 20
    assert all(found[word] for word in ("complete", "all_robots_lost", "no_progress", "step_limit"))
