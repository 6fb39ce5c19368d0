"""Closed-loop rollouts of `planner.simulator.rollouts` on all cores, as tallies, results and traces."""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from planner.arguments import argument
from planner.errors import PlanError, names_of_0_3
from planner.mrac.problem import Problem, ready_loop
from planner.plan.plan import Area, Leg, Plan, RobotPlan, last_move
from planner.plan.state import MissionState
from planner.rollout_sampling import check_counters
from planner.rollouts.loop import NO_COUNTS, ClosedLoop, known_cells, purpose_of
from planner.rollouts.runners import Runner, on_threads, run_rollouts, singles_of
from planner.rollouts.tables import ASKED_BEFORE, AllPairs, first_frames, make_policy, make_tables
from planner.simulator.areas import FRAME_AREA, FRAME_CELL, FRAME_DOING, make_log
from planner.simulator.codes import EventKind, Outcome
from planner.simulator.jit import LARGE
from planner.simulator.offers import CellOffer
from planner.simulator.state import SINGLES, Counts
from planner.tally import RolloutResults, Tally, Trace, tally_key
from planner.world.start_rule import BEFORE, rules_of
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import World

MOST_TABLED = 10_000
"""Most accessible cells with all-pairs tables (0.6 GB); on larger maps distances are searched for on demand."""
SINGLE_FILE = 64
"""Rollouts that a thread takes at a time if it runs them one by one."""
OF_SINGLES = ("visited", "survived", "time", "alive", "outcome", "bisected", "divided", "home", "delivered")
"""Columns of `Singles.numbers`, as fields of `RolloutResults`."""
OF_VALUES = "value_covered", "value_found"
TIME, OUTCOME = map(OF_SINGLES.index, ("time", "outcome"))


def compile_closed_loop(
    plan: Plan,
    world: World,
    *,
    first_only: bool = False,
    tabled: bool | None = None,
    kept: AllPairs | None = None,
    problem: Problem | None = None,
    interpreted: bool = False,
) -> ClosedLoop:
    """Compile the closed loop of a plan from its allocation.

    Robots with an external path follow it first (`planner.mrac.problem`).

    Args:
        plan: for this world.
        world: the map.
        first_only: only the first visit of a cell by any robot is checked.
        tabled: distances from all-pairs tables (True) or by searches; None: tables up to MOST_TABLED cells. No rollout
            depends on it.
        kept: where all-pairs tables are kept for other teams on the same map.
        problem: the plan's problem, if available.
        interpreted: for the simulator as Python: no tables, and any rule and order of cells.

    Raises:
        PlanError: a plan of another map, or a rule or order that compiled programs do not support.
    """
    problem, areas = ready_loop(plan, world) if problem is None else (problem, plan.areas)
    settings, rule, order = problem.settings, problem.rule, problem.settings.in_area
    follows = isinstance(order, str) and (rule.nearest or (rule.replanning and rule.exact))
    if not follows and not (interpreted and (rule.nearest or rule.replanning)):
        raise PlanError(
            f"the compiled engines do not support {settings.own_words}",
            expected="an exact Rule that re-evaluates, and the planner's own order of cells",
            fix="use the open loop, or the simulator as Python: planner.rollouts.single_run.PythonLoop",
        )
    check_counters(world, len(problem.starts), problem.max_steps)
    if first_only and isinstance(world.uncertainty, Hazard):
        world.require_known_map(argument("threat_checks", "first_visit"))
    learns, unknown = problem.learns, problem.unknown
    cells = np.flatnonzero(problem.levels.accessible if unknown is None or not learns else unknown.within)
    tabled = not (learns or interpreted) and (len(cells) <= MOST_TABLED if tabled is None else tabled)
    # Robot types have tables of their own, which searches on demand do not support.
    if problem.own is not None:
        tabled = True
        if len(problem.own.costs) * len(cells) ** 2 > MOST_TABLED**2:
            large = f"{len(problem.own.costs)} types of robots on {len(cells):,} cells"
            raise PlanError(large, expected=f"types x cells x cells up to {MOST_TABLED**2:,}", fix="coarsen the map")
    tables = make_tables(problem, cells, areas, tabled, kept, plan.failure_model)
    if interpreted and len(cells) >= LARGE:  # a single run rarely asks for the costs from a cell again
        tables = tables._replace(patience=ASKED_BEFORE)
    return ClosedLoop(
        identity=_identity(problem, areas, first_only, plan.state),
        shape=world.shape,
        cells=cells,
        tables=tables,
        max_steps=problem.max_steps,
        first_only=first_only,
        stay_inside=settings.transit == "area",
        rule=rule,
        policy=make_policy(problem, cells, tables, interpreted=interpreted) if rule.replanning else None,
        state=plan.state,
        purpose=purpose_of(world),
        failure_model=plan.failure_model,
        moving_threats=world.moving_threats,
        uncertainty=world.uncertainty if learns and isinstance(world.uncertainty, Uncertain) else None,
        in_area=None
        if isinstance(order, str)
        else lambda here, cell, cost: order(CellOffer(int(cells[here]), int(cells[cell]), cost)),
    )


def _identity(problem: Problem, areas: tuple[Area, ...], first_only: bool, state: MissionState | None) -> str:
    width = problem.world.shape[1]
    said = {
        "world": problem.world.randomness_sha256,
        "settings": names_of_0_3(problem.settings.to_json()),
        "areas": [[area.level, area.robot, area.cells.tolist()] for area in areas],
        "starts": [divmod(cell, width) for cell in problem.starts.tolist()],
        "max_steps": problem.max_steps,
        "first_only": first_only,
    }
    # Keys are added only where they differ from the default, so that identities of earlier releases stay valid.
    if (rules := rules_of(problem.world, problem.settings)) != BEFORE:
        said["rules"] = rules
    if problem.value is not None:
        said["value"] = problem.value.tolist()
    if state is not None:
        said["state"] = state.to_json()
    if problem.given:
        said["paths"] = [path.tolist() for path in problem.given]
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def run_range(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None, singles: bool = False
) -> tuple[Tally, RolloutResults | None]:
    """Run rollouts `start .. start + count - 1`.

    Args:
        loop: the closed loop.
        seed: of the random numbers.
        start: first id.
        count: rollouts.
        threads: None: all cores.
        singles: whether results of single rollouts are returned.

    Returns:
        (tally, results or None).
    """
    kept = singles_of(loop, start, count if singles else 0)
    tally = tally_from(loop, seed, start, count, run_rollouts(loop, seed, start, count, threads, kept))
    if not singles:
        return tally, None
    return tally, results_from(start, kept.numbers[:, : SINGLES - (not loop.delivers)], kept.value_sums)


def results_from(start: int, numbers: NDArray[np.int32], value_sums: NDArray[np.int64]) -> RolloutResults:
    """Results of the rollouts from id `start` on.

    Args:
        start: first id.
        numbers: int32 `[B, SINGLES]`, as in `planner.simulator.state.Singles`, or without its last columns.
        value_sums: int64 `[B, 2]` or without rows, sums of values.
    """
    columns = dict(zip(OF_SINGLES, numbers.T, strict=False)) | dict(zip(OF_VALUES, value_sums.T, strict=False))
    return RolloutResults(start, **columns | {"outcome": columns["outcome"].astype(np.int8)})


def new_cells(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None
) -> list[NDArray[np.int64]]:
    """Curves of new cells: for each rollout int64 `[time + 1]`, cells visited for the first time, by step.

    They are the rollouts of `run_range`, run one at a time by the same compiled program, with the same arguments.
    """
    known = len(known_cells(loop)[0])

    def curve(runner: Runner, numbers: NDArray[np.int32]) -> NDArray[np.int64]:
        new = runner.counts.new[: int(numbers[TIME]) + 1]
        found = new.copy()
        # Cells covered before a resumed mission's state count in step 0, as in `tally_from`.
        found[0] += known
        new[:] = 0  # a runner's counts add up: what this rollout has added is taken out again
        return found

    return _one_by_one(loop, seed, range(start, start + count), threads, curve)


def final_odds(loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None) -> NDArray[np.int64]:
    """Log odds of a hazard at the end of each rollout `start .. start + count - 1`, int64 `[count, A]`.

    They are the rollouts of `run_range`, of an online mission with estimated hazards.
    """
    ids = range(start, start + count)
    odds = _one_by_one(loop, seed, ids, threads, lambda runner, _: runner.state.odds.copy())
    return np.array(odds, dtype=np.int64).reshape(count, len(loop.tables.odds))


def _one_by_one(
    loop: ClosedLoop, seed: int, ids: range, threads: int | None, read: Callable[[Runner, NDArray[np.int32]], NDArray]
) -> list[NDArray]:
    """`read(runner, numbers)` after each of these rollouts, in order."""
    found: dict[int, NDArray] = {}

    def work(runner: Runner, first: int, stop: int) -> None:
        for rollout in range(first, stop):
            found[rollout] = read(runner, runner.run_one(rollout))

    on_threads(loop, seed, ids.start, len(ids), SINGLE_FILE, threads, work)
    return [found[rollout] for rollout in ids]


def trace_rollouts(loop: ClosedLoop, seed: int, ids: Iterable[int]) -> list[Trace]:
    """Traces of chosen rollouts, in the order of `ids` (each below 2**32), on one thread.

    They are the rollouts of `run_range`. Memory: 12 bytes per step and robot, and the state of one rollout.
    """
    return [trace for trace, _, _ in logged_rollouts(loop, seed, ids)]


def logged_rollouts(
    loop: ClosedLoop, seed: int, ids: Iterable[int], legs: bool = False
) -> Iterator[tuple[Trace, NDArray[np.int32], Runner]]:
    """The same one by one: (trace, `Log.legs` `[T, K]` if `legs`, the thread's runner after the rollout)."""
    events = 4 * len(loop.cells) + 64
    steps = events // loop.robots + 64
    runner = Runner(loop, seed, 1)
    for rollout in ids:
        while True:
            log = make_log(steps, events, loop.robots, legs)
            if loop.state is not None:
                log.frames[: loop.state.step + 1] = first_frames(loop.state, loop.cells)[:steps]
            single = runner.run_one(rollout, log)
            last, happened = int(single[TIME]), int(log.events[0, 0])
            # Events beyond the room were counted, not kept: the rollout is run again with enough room.
            if last < steps and happened <= events:
                break
            steps, events = max(steps, last + 1), max(events, happened)
        kept = log.frames[: last + 1], log.events[1 : happened + 1]
        trace = trace_from(loop, rollout, *kept, loop.area_of(runner.state), Outcome(int(single[OUTCOME])))
        yield trace, log.legs[: last + 1], runner


def trace_from(
    loop: ClosedLoop,
    rollout: int,
    frames: NDArray[np.int32],
    events: NDArray[np.int32],
    area_of: NDArray[np.int32],
    outcome: Outcome,
) -> Trace:
    """The trace of a rollout, with cells of the grid.

    Args:
        loop: the closed loop.
        rollout: id.
        frames: int32 `[T, 3, K]`, of `Log`.
        events: int32 `[E, 5]`, of `Log`.
        area_of: int32 `[N]`, last area of each cell.
        outcome: of the rollout.
    """
    happened = events.copy()
    # Events of other kinds hold a count in their last column, not a cell.
    tells_cell = ~np.isin(happened[:, 2], (EventKind.REALLOCATED, EventKind.SHARED, EventKind.SURPRISED))
    happened[tells_cell, 4] = loop.cells[happened[tells_cell, 4]]
    return Trace(
        rollout=rollout,
        cells=loop.cells[frames[:, FRAME_CELL]].astype(np.int32),
        doing=frames[:, FRAME_DOING].astype(np.int8),
        areas=frames[:, FRAME_AREA].copy(),
        events=happened,
        area_of=area_of,
        outcome=outcome,
    )


def tally_from(loop: ClosedLoop, seed: int, start: int, count: int, parts: list[Counts]) -> Tally:
    """The tally of rollouts `start .. start + count - 1`, whose counts are in `parts`, one of each thread."""
    if count == 0:
        return loop.empty_tally(seed)
    counts = Counts(*(sum(values[1:], values[0]) for values in zip(*parts, strict=True)))
    visited, survived = known_cells(loop)
    # Cells covered before a resumed mission's state count from step 0 on.
    counts.new[0] += count * len(visited)
    counts.late[0] += count * (len(survived) - len(visited))
    covered, unsurvived = loop.on_grid(counts.covered), loop.on_grid(counts.unsurvived)
    covered[visited] += count
    unsurvived[visited] += count
    unsurvived[survived] -= count
    passes = loop.weights is not None
    # Arrays by step end with the longest rollout, so that tallies do not depend on T_max.
    last = len(counts.time) - int((counts.time[::-1] > 0).argmax())
    return Tally(
        key=tally_key(loop.identity, "closed", seed),
        shape=loop.shape,
        ids=((start, start + count),),
        visited=counts.visited,
        survived=counts.survived,
        time=counts.time[:last],
        alive=counts.alive,
        home=counts.home,
        delivered=counts.delivered,
        outcomes=counts.outcomes,
        new_visited=counts.new[:last],
        new_survived=counts.new[:last] + counts.late[:last],
        visits=loop.on_grid(counts.visits),
        stops=loop.on_grid(counts.stops),
        covered_visited=covered,
        covered_survived=covered - unsurvived,
        passes=np.stack([loop.on_grid(column) for column in counts.passes.T], axis=1).ravel() if passes else NO_COUNTS,
    )


# The nominal run by the compiled simulator.


def nominal_loop(loop: ClosedLoop) -> ClosedLoop:
    """The closed loop without losses, on a true map that equals the prior map."""
    tables = loop.tables
    safe = tables._replace(bound=np.zeros_like(tables.bound), moving_threats=tables.moving_threats[:0])
    if loop.learns and not len(tables.phases):  # phases are announced: they change the nominal run's map too
        safe = safe._replace(truths=np.tile(tables.belief, (len(tables.truths), 1)), goal=len(tables.order))
    policy = None if loop.policy is None else loop.policy._replace(view_begin=loop.policy.view_begin[:0])
    # Without online updates and moving threats the first state is unchanged, so it is shared.
    begin = replace if loop.learns or loop.moving_threats is not None else ClosedLoop.again
    return begin(loop, tables=safe, moving_threats=None, uncertainty=None, policy=policy)


def with_nominal_run(plan: Plan, loop: ClosedLoop) -> Plan:
    """A plan with its nominal run, from the plan's areas and starts (`allocated_plan`).

    Equal to the plan of `make_plan` without legs and without the areas that sharing adds.

    Args:
        plan: without paths.
        loop: its closed loop.
    """
    (trace,) = trace_rollouts(nominal_loop(loop), 0, (0,))
    return with_run(plan, trace, itertools.repeat(()))


def with_run(plan: Plan, trace: Trace, legs: Iterable[tuple[Leg, ...]]) -> Plan:
    """A plan with this nominal run.

    Args:
        plan: without paths.
        trace: of the run.
        legs: of each robot.
    """
    paths = [path[: last_move(path) + 1] for path in trace.cells.T.astype(np.int64)]
    return replace(
        plan,
        robots=tuple(map(RobotPlan, paths, legs)),
        outcome=plan.ending(trace.outcome).word,
        time=trace.time,
        shares=int(np.count_nonzero(trace.events[:, 2] == EventKind.SHARED)),
    )
