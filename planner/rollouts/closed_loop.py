"""The classical simulator at scale: closed-loop rollouts of `planner.simulator.rollouts`, on all cores, as tallies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import PlanError
from planner.mrac.problem import Problem, check_every_visit, ready_loop
from planner.plan.plan import Area, Plan, RobotPlan, last_move
from planner.plan.state import MissionState
from planner.renamed import names_of_0_3
from planner.rollout_sampling import check_counters
from planner.rollouts.loop import NO_COUNTS, ClosedLoop, known_cells, purpose_of
from planner.rollouts.runners import Runner, on_threads, run_sets, singles_of
from planner.rollouts.tables import ASKED_BEFORE, AllPairs, first_frames, make_policy, make_tables
from planner.simulator.areas import FRAME_AREA, FRAME_CELL, FRAME_DOING, make_log
from planner.simulator.codes import NO_AREA, EventKind, Outcome
from planner.simulator.jit import LARGE
from planner.simulator.offers import CellOffer
from planner.simulator.state import Counts
from planner.tally import RolloutResults, Tally, Trace, tally_key
from planner.world.features import BEFORE, rules_of
from planner.world.uncertain_maps import Uncertain
from planner.world.world import World

MOST_TABLED = 10_000
"""Most accessible cells for which all-pairs tables are made (0.6 GB); beyond, distances are searched for on demand."""
SINGLE_FILE = 64
"""Rollouts that a thread takes at a time, one by one."""
TIME, OUTCOME = 2, 4
"""Columns of the single results."""


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
    """The closed loop from the plan's allocation. Raises PlanError for a plan of another map.

    Robots with paths of another planner follow them first (`planner.mrac.problem`).

    `tabled`: distances from all-pairs tables, or searched for on demand; None: tables up to MOST_TABLED cells. No
    rollout depends on it. `kept`: where all-pairs tables are kept for other teams on the same map. `problem`: the
    plan's own, if it is available. `interpreted`: for the simulator as Python, without tables, and with
    rules and orders of cells that compiled programs do not follow.
    """
    problem, areas = ready_loop(plan, world) if problem is None else (problem, plan.areas)
    settings, rule = problem.settings, problem.rule
    follows = isinstance(settings.in_area, str) and (rule.nearest or (rule.attentive and rule.exact))
    if not follows and not (interpreted and (rule.nearest or rule.attentive)):
        raise PlanError(
            f"the compiled engines do not follow {settings.own_words}",
            expected="an exact Rule of attentive robots, cells in the planner's own order",
            fix="roll it out open loop, or with the simulator as Python: planner.rollouts.single_run.PythonLoop",
        )
    check_counters(world, len(problem.starts), problem.max_steps)
    check_every_visit(world, first_only)
    learns, unknown = problem.learns, problem.unknown
    cells = np.flatnonzero(problem.levels.accessible if unknown is None or not learns else unknown.within)
    tabled = not (learns or interpreted) and (len(cells) <= MOST_TABLED if tabled is None else tabled)
    if problem.own is not None:
        tabled = True
        if len(problem.own.costs) * len(cells) ** 2 > MOST_TABLED**2:
            raise PlanError(
                f"{len(problem.own.costs)} types of robots on {len(cells):,} cells",
                expected=f"types x cells x cells up to {MOST_TABLED**2:,}",
                fix="coarsen the map",
            )
    tables = make_tables(problem, cells, areas, tabled, kept, plan.bearing)
    if interpreted and len(cells) >= LARGE:  # one run seldom asks for the costs from a cell again
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
        policy=make_policy(problem, cells, tables, interpreted=interpreted) if rule.attentive else None,
        state=plan.state,
        purpose=purpose_of(world),
        bearing=plan.bearing,
        movers=world.movers,
        doubt=world.doubt if learns and isinstance(world.doubt, Uncertain) else None,
        in_area=None if isinstance(settings.in_area, str) else _by_order(settings.in_area, cells),
    )


def _by_order(order: Callable[[CellOffer], Any], cells: NDArray[np.int64]) -> Callable[[int, int, int], Any]:
    """`ClosedLoop.in_area`."""
    return lambda here, cell, cost: order(CellOffer(int(cells[here]), int(cells[cell]), cost))


def _identity(problem: Problem, areas: tuple[Area, ...], first_only: bool, state: MissionState | None) -> str:
    width = problem.world.shape[1]
    said = {
        "world": problem.world.luck_sha256,
        "settings": names_of_0_3(problem.settings.to_json()),
        "areas": [[area.level, area.robot, area.cells.tolist()] for area in areas],
        "starts": [divmod(cell, width) for cell in problem.starts.tolist()],
        "max_steps": problem.max_steps,
        "first_only": first_only,
    }
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
    """Rollouts `start .. start + count - 1` on `threads` threads (None: all cores); the single results if asked."""
    kept = singles_of(loop, start, count if singles else 0)
    tally = tally_from(loop, seed, start, count, run_sets(loop, seed, start, count, threads, kept))
    if not singles:
        return tally, None
    return tally, results_from(start, kept.numbers, kept.worth)


def results_from(start: int, numbers: NDArray[np.int32], worth: NDArray[np.int64]) -> RolloutResults:
    """Single results of the rollouts from `start` on; rows as in `planner.simulator.state.Singles`, or without home."""
    visited, survived, times, alive, outcome, bisected, divided, *home = numbers.T
    rest = bisected, divided, *(home or [NO_COUNTS.astype(np.int32)]), *worth.T
    return RolloutResults(start, visited, survived, times, alive, outcome.astype(np.int8), *rest)


def new_cells(
    loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None
) -> list[NDArray[np.int64]]:
    """Of each rollout `start .. start + count - 1`, int64 `[time + 1]`: cells visited for the first time, by step.

    They are the rollouts that `run_range` counts, run one at a time by the same compiled program.
    """
    curves: dict[int, NDArray[np.int64]] = {}

    def work(runner: Runner, first: int, stop: int) -> None:
        for rollout in range(first, stop):
            single = runner.run_one(rollout)
            curves[rollout] = runner.counts.new[: int(single[TIME]) + 1].copy()
            curves[rollout][0] += len(known_cells(loop)[0])
            runner.counts.new[: int(single[TIME]) + 1] = 0

    on_threads(loop, seed, start, count, SINGLE_FILE, threads, work)
    return [curves[rollout] for rollout in range(start, start + count)]


def final_odds(loop: ClosedLoop, seed: int, start: int, count: int, *, threads: int | None = None) -> NDArray[np.int64]:
    """Log odds of a hazard at the end of each rollout `start .. start + count - 1`, int64 `[count, A]`.

    They are those of robots that learn, of the rollouts that `run_range` counts.
    """
    odds = np.empty((count, len(loop.tables.odds)), dtype=np.int64)

    def work(runner: Runner, first: int, stop: int) -> None:
        for rollout in range(first, stop):
            runner.run_one(rollout)
            odds[rollout - start] = runner.odds

    on_threads(loop, seed, start, count, SINGLE_FILE, threads, work)
    return odds


def trace_rollouts(loop: ClosedLoop, seed: int, ids: Iterable[int]) -> list[Trace]:
    """Chosen rollouts in full, in the order of `ids` (each below 2**32), on one thread.

    They are the rollouts that `run_range` counts. Memory: 12 bytes a step and robot, and the state of one rollout.
    """
    return [trace for trace, _, _ in logged_rollouts(loop, seed, ids)]


def logged_rollouts(
    loop: ClosedLoop, seed: int, ids: Iterable[int], legs: bool = False
) -> Iterator[tuple[Trace, NDArray[np.int32], Runner]]:
    """The same one after the other, with `Log.legs` `[T, K]` if asked, and the thread's runner as it stands then."""
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
            # What did not fit was counted, not kept: run it again with enough room.
            if last < steps and happened <= events:
                break
            steps, events = max(steps, last + 1), max(events, happened)
        kept = log.frames[: last + 1], log.events[1 : happened + 1]
        trace = trace_from(loop, rollout, *kept, runner.area_of, Outcome(int(single[OUTCOME])))
        yield trace, log.legs[: last + 1], runner


def trace_from(
    loop: ClosedLoop,
    rollout: int,
    frames: NDArray[np.int32],
    events: NDArray[np.int32],
    area_of: NDArray[np.int32],
    outcome: Outcome,
) -> Trace:
    """What a rollout wrote down, in cells of the grid: frames `[T, 3, K]`, events `[E, 5]`, area_of `[A]`."""
    happened = events.copy()
    tells_cell = ~np.isin(happened[:, 2], (EventKind.REALLOCATED, EventKind.SHARED, EventKind.SURPRISED))
    happened[tells_cell, 4] = loop.cells[happened[tells_cell, 4]]
    return Trace(
        rollout=rollout,
        cells=loop.cells[frames[:, FRAME_CELL]].astype(np.int32),
        doing=frames[:, FRAME_DOING].astype(np.int8),
        areas=frames[:, FRAME_AREA].copy(),
        events=happened,
        area_of=loop.on_grid(area_of, NO_AREA),
        outcome=outcome,
    )


def tally_from(loop: ClosedLoop, seed: int, start: int, count: int, parts: list[Counts]) -> Tally:
    """The tally of rollouts `start .. start + count - 1`, which were counted in parts."""
    if count == 0:
        return loop.empty_tally(seed)
    counts = Counts(*(sum(values[1:], values[0]) for values in zip(*parts, strict=True)))
    visited, survived = known_cells(loop)
    # What was covered before a mission's state counts from step 0 on.
    counts.new[0] += count * len(visited)
    counts.late[0] += count * (len(survived) - len(visited))
    covered, unsurvived = loop.on_grid(counts.covered), loop.on_grid(counts.unsurvived)
    covered[visited] += count
    unsurvived[visited] += count
    unsurvived[survived] -= count
    passes = loop.weights is not None
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
    """The closed loop without losses, in which all is as robots believe it once they have looked about."""
    tables = loop.tables
    safe = tables._replace(bound=np.zeros_like(tables.bound), movers=tables.movers[:0])
    if loop.learns and not len(tables.phases):  # threats change whatever happens
        safe = safe._replace(truths=np.tile(tables.belief, (len(tables.truths), 1)), goal=len(tables.order))
    policy = None if loop.policy is None else loop.policy._replace(view_begin=loop.policy.view_begin[:0])
    begin = replace if loop.learns or loop.movers is not None else ClosedLoop.again
    return begin(loop, tables=safe, movers=None, doubt=None, policy=policy)


def with_nominal_run(plan: Plan, loop: ClosedLoop) -> Plan:
    """A plan of which areas and starts are known (`allocated_plan`), with its nominal run; `loop`: its closed loop.

    Equal to the plan of `make_plan` but for legs and the areas that sharing adds, which it does without.
    """
    (trace,) = trace_rollouts(nominal_loop(loop), 0, (0,))
    paths = [path[: last_move(path) + 1] for path in trace.cells.T.astype(np.int64)]
    return replace(
        plan,
        robots=tuple(map(RobotPlan, paths)),
        outcome=plan.ending(trace.outcome).word,
        time=len(trace.cells) - 1,
        shares=int(np.count_nonzero(trace.events[:, 2] == EventKind.SHARED)),
    )
