"""Compile a plan and a world into the path arrays of the open-loop engines. NumPy only.

In the open loop a robot follows its own path until it is lost, and only a dangerous entry can destroy it. So a rollout
is one *outcome* per robot: o in 0 .. D, the index of the dangerous entry at which it is lost, or D if it survives. A
cell is visited by robot i iff `o >= q`, q = dangerous entries before i's first entry of it (`o > q` for survived, if
the cell is dangerous). "Covered by the first m visitors" is then an *event*, an OR of such conditions:

- events of one group of robots (one or two robots, see `Groups`) need only the histogram of that group's outcomes;
- the others (`joint` events) are bits: one row of words per group outcome, OR-ed over the groups, then counted.

Axis letters: `K` robots, `D` dangerous entries, `G` groups, `A` robots in a group (1 or 2), `S` slots = G * A,
`R` rows (outcomes of a group, all groups one after the other), `E` joint events, `W` words of 32 events, `T` last step,
`N = H * W` cells. A *slot* is a robot's index in the engines' arrays.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_STEP, argument
from planner.errors import PlanError, names_of_0_3
from planner.failure_model import FailureModel, least_word
from planner.plan.plan import Plan, entries, last_move
from planner.rollouts.open_loop_events import (
    WORD_BITS,
    Entries,
    Events,
    Groups,
    Guide,
    JointDraws,
    collect_events,
    joint_draws,
    make_groups,
    make_guide,
    source_counts,
)
from planner.simulator.codes import Outcome
from planner.tally import Tally, tally_key
from planner.world.uncertain_maps import UNIT
from planner.world.world import World


@dataclass(frozen=True, eq=False)
class CompiledPlan:
    """A plan compiled for the open loop; the tables that engines read are made on first use.

    Attributes:
        plan, world: the source.
        identity: hash of the world's threats and the paths: equal for plans with the same open-loop rollouts.
        shape: (H, W). accessible: number of accessible cells. last_step: T, the last step at which any robot moves.
        entries: every entry of the nominal paths.
        danger_step: per robot int64 `[D]`, the steps of its dangerous entries.
        danger_cell: per robot int64 `[D]`, the cells entered there.
        last_move: int64 `[K]`, the step of each robot's last move.
    """

    plan: Plan
    world: World
    identity: str
    shape: tuple[int, int]
    accessible: int
    last_step: int
    entries: Entries
    danger_step: tuple[NDArray[np.int64], ...]
    danger_cell: tuple[NDArray[np.int64], ...]
    last_move: NDArray[np.int64]

    @property
    def robots(self) -> int:
        """K."""
        return len(self.last_move)

    @cached_property
    def tables(self) -> OpenLoopTables:
        """Tables of the engines, made once."""
        return _make_tables(self)

    def thresholds(self) -> list[NDArray[np.uint64]]:
        """Per robot uint64 `[D]`: it survives a dangerous entry iff its word is below. For a certain map."""
        failure_model, own = self.plan.failure_model, self.world.of_robots(self.plan.failure_model.types, self.robots)
        visits = map(self.world.visits, self.danger_cell, self.danger_step)
        hazards = [failure_model.fresh(np.cumsum(own[k].exposures[0][each]), k) for k, each in enumerate(visits)]
        return [least_word(one).astype(np.uint64) for one in hazards]

    def truncated_at(self, step: int) -> CompiledPlan:
        """The plan truncated at the end of `step`."""
        return compile_plan(self.plan.truncated_at(step), self.world)

    def with_threat(self, truth: World) -> CompiledPlan:
        """The same paths under the threats of `truth`, a map of the same cells."""
        return compile_plan(replace(self.plan, sha256=truth.sha256), truth)


@dataclass(frozen=True, eq=False)
class OpenLoopTables:
    """All arrays that an engine reads to score rollouts. Tables of draws are by slot.

    Attributes:
        groups: the robots of each slot, and the rows.
        events: the joint events, and the map from event counts to the tally's arrays.
        time: uint32 `[R]`, last step at which a robot of the group moves.
        alive: uint32 `[R]`, robots of the group that are not lost.
        guide: outcomes by inverse survival, for a certain map; else None.
        joint: draws entry by entry, for an uncertain map; else None.
    """

    groups: Groups
    events: Events
    time: NDArray[np.uint32]
    alive: NDArray[np.uint32]
    guide: Guide | None
    joint: JointDraws | None = None


def compile_plan(plan: Plan, world: World) -> CompiledPlan:
    """Compile a plan's open loop.

    Args:
        plan: for this world.
        world: the map.

    Raises:
        PlanError: the plan is for another map, leaves the free cells, or has no open loop.

    Cost: O(entries of all paths); the events (on first use) O(first entries).
    """
    plan.require(world)
    if plan.state is not None:
        raise PlanError("a mission under way has no open loop", fix=f"use {argument('loop', 'closed')}")
    if world.moving_threats is not None:
        problem = "the open loop cannot include moving threats, which destroy robots anywhere"
        raise PlanError(problem, source=world.source, fix=f"use {argument('loop', 'closed')}")
    if plan.settings is not None and len(plan.robots) > 1:
        plan.settings.require_no_wrecks("the open loop")
    threat = world.met.reshape(-1)
    paths = [np.asarray(robot.path, dtype=np.int64) for robot in plan.robots]
    for robot, path in enumerate(paths):
        _check_path(robot, path, threat)
    own = [of.by_phase.ravel() for of in world.of_robots(plan.failure_model.types, len(paths))]
    # For an uncertain map an entry is dangerous if it is so in any of the drawn maps.
    if world.draws is not None:
        own = [world.draws.bound.astype(np.float32) / np.float32(UNIT)] * len(paths)
    found = _find_entries(paths, world, own)
    per_robot = [found.dangerous & (found.robot == robot) for robot in range(len(paths))]
    moves = np.array([last_move(path) for path in paths], dtype=np.int64)
    return CompiledPlan(
        plan=plan,
        world=world,
        identity=_identity(world, paths, plan.failure_model),
        shape=world.shape,
        accessible=int(world.accessible(plan.starts).sum()),
        last_step=int(moves.max(initial=0)),
        entries=found,
        danger_step=tuple(found.step[mine] for mine in per_robot),
        danger_cell=tuple(found.cell[mine] for mine in per_robot),
        last_move=moves,
    )


def words_of(groups: Groups) -> NDArray[np.uint32]:
    """Second counter word of each slot's random number, uint32 `[S]`."""
    return np.maximum(groups.slot_robot, 0).astype(np.uint32)


def _check_path(robot: int, path: NDArray[np.int64], threat: NDArray[np.float32]) -> None:
    if len(path) == 0 or len(path) - 1 > MAX_STEP:
        raise PlanError(f"robot {robot} has a path of {len(path)} entries", expected=f"1 .. {MAX_STEP + 1}")
    outside = np.flatnonzero((path < 0) | (path >= len(threat)))
    if len(outside):
        raise PlanError(f"robot {robot} is off the map at step {outside[0]}", expected=f"cells 0 .. {len(threat) - 1}")
    blocked = np.flatnonzero(np.isnan(threat[path]))
    if len(blocked):
        raise PlanError(f"robot {robot} is in an obstacle at step {blocked[0]}", expected="free cells")


def _find_entries(paths: list[NDArray[np.int64]], world: World, threats: list[NDArray[np.float32]]) -> Entries:
    parts: list[tuple[NDArray, ...]] = []
    for robot, (path, threat) in enumerate(zip(paths, threats, strict=True)):
        step = entries(path)
        cell = path[step]
        danger = threat[world.visits(cell, step)] > 0
        first = np.zeros(len(cell), dtype=bool)
        # `np.unique` gives the first index of each cell, which is the earliest entry.
        first[np.unique(cell, return_index=True)[1]] = True
        robots = np.full(len(step), robot, dtype=np.int64)
        parts.append((robots, step, cell, np.cumsum(danger) - danger, danger, first))
    robots, steps, cells, passed, dangerous, firsts = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return Entries(robots, steps, cells, passed.astype(np.int64), dangerous, firsts)


def _identity(world: World, paths: list[NDArray[np.int64]], failure_model: FailureModel) -> str:
    # A plain failure model adds nothing, so that identities of earlier releases stay valid.
    digest = hashlib.sha256(world.randomness_sha256.encode())
    if not failure_model.is_plain:
        digest.update(json.dumps(names_of_0_3(failure_model.to_json())).encode())
    for path in paths:
        digest.update(len(path).to_bytes(8, "little"))
        digest.update(np.ascontiguousarray(path, dtype="<i8").tobytes())
    return digest.hexdigest()


def _make_tables(compiled: CompiledPlan) -> OpenLoopTables:
    """The tables of a plan. On a certain map, outcomes that no 32-bit word reaches get no rows."""
    draws = compiled.world.draws
    dangers = np.array([len(steps) for steps in compiled.danger_step], dtype=np.int64)
    drawn_once = draws is None
    thresholds = compiled.thresholds() if drawn_once else []
    # A threshold of 0 is above no word: the entries beyond need no rows.
    depth = np.array([np.count_nonzero(t) for t in thresholds], dtype=np.int64) if drawn_once else dangers
    groups = make_groups(depth)
    events = collect_events(compiled.entries, groups, compiled.shape[0] * compiled.shape[1], compiled.last_step)
    times = [
        np.append(steps, move)[: deep + 1]
        for steps, move, deep in zip(compiled.danger_step, compiled.last_move, depth, strict=True)
    ]
    alive = [(np.arange(deep + 1) == many).astype(np.int64) for deep, many in zip(depth, dangers, strict=True)]
    # Draws are by cell, or by cell and phase.
    visits = compiled.world.visits(compiled.entries.cell, compiled.entries.step)
    drawn = replace(compiled.entries, cell=visits)
    return OpenLoopTables(
        groups=groups,
        events=events,
        time=groups.rows(times, np.maximum),
        alive=groups.rows(alive, np.add),
        guide=make_guide([thresholds[r] if r >= 0 else thresholds[0][:0] for r in groups.slot_robot])
        if drawn_once
        else None,
        joint=None
        if draws is None
        else joint_draws(draws, compiled.world.exposures, drawn, groups, compiled.plan.failure_model),
    )


# Counts of one range of rollout ids, and the tally made of them. NumPy only.


@dataclass(frozen=True, eq=False)
class RangeCounts:
    """Counts over some rollouts, int64. Axis letters as above.

    Attributes:
        rollouts: number of rollouts.
        rows: `[R]`, rollouts by outcome of each group.
        events: `[E]`, rollouts in which each joint event happened.
        visited, survived: `[accessible + 1]`; time: `[T + 1]`; alive: `[K + 1]`: histograms.
        complete_dead: rollouts that covered all cells and lost all robots.
    """

    rollouts: int
    rows: NDArray[np.int64]
    events: NDArray[np.int64]
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    time: NDArray[np.int64]
    alive: NDArray[np.int64]
    complete_dead: int


def tally_of(compiled: CompiledPlan, seed: int, start: int, counts: RangeCounts) -> Tally:
    """The tally of consecutive rollouts.

    Args:
        compiled: the plan.
        seed: of the random numbers.
        start: first id.
        counts: of the rollouts.
    """
    tables = compiled.tables
    sources = source_counts(tables.groups, counts.rows, counts.events, counts.rollouts)
    complete = int(counts.visited[-1])
    # A rollout that covers all cells is complete even if all robots are lost.
    stopped = int(counts.alive[0]) - counts.complete_dead
    outcomes = np.zeros(len(Outcome), dtype=np.int64)
    outcomes[Outcome.COMPLETE] = complete
    outcomes[Outcome.ALL_ROBOTS_LOST] = stopped
    outcomes[Outcome.END_OF_PATHS] = counts.rollouts - complete - stopped
    return Tally(
        key=tally_key(compiled.identity, "open", seed),
        shape=compiled.shape,
        ids=((start, start + counts.rollouts),) if counts.rollouts else (),
        visited=counts.visited,
        survived=counts.survived,
        time=counts.time,
        alive=counts.alive,
        outcomes=outcomes,
        **tables.events.tally_arrays(sources),
    )


def outcomes_of(visited: NDArray[np.int32], alive: NDArray[np.int32], accessible: int) -> NDArray[np.int8]:
    """Open-loop outcome of each rollout.

    Args:
        visited: int32 `[B]`, cells visited.
        alive: int32 `[B]`, robots alive.
        accessible: number of accessible cells.

    Returns:
        int8 `[B]`, codes of `Outcome`.
    """
    unfinished = np.where(alive == 0, np.int8(Outcome.ALL_ROBOTS_LOST), np.int8(Outcome.END_OF_PATHS))
    return np.where(visited == accessible, np.int8(Outcome.COMPLETE), unfinished)


def available_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def share_out(start: int, count: int, workers: int, unit: int) -> list[tuple[int, int]]:
    """Split the ids `start .. start + count - 1` among workers, at multiples of `unit`.

    Returns:
        (first id, number of ids) for each worker; fewer than `workers` if there are few ids.
    """
    stop = start + count
    # Multiples of `unit` are counted from id 0, so that parts of different calls meet at the same ids.
    share = -(-(stop - start // unit * unit) // (workers * unit)) * unit
    cuts = [start // unit * unit + share * worker for worker in range(1, workers)]
    edges = [start, *(cut for cut in cuts if start < cut < stop), stop]
    return [(first, last - first) for first, last in pairwise(edges)]


# Weights of events as bit planes: both engines add up as many at a time as a word has bits.


def weight_planes(weight: NDArray[np.int64], words: int, planes: int) -> NDArray[np.uint32]:
    """Bit planes of weights.

    Args:
        weight: int64 `[E]`.
        words: W.
        planes: number of planes (`plane_count`).

    Returns:
        uint32 `[planes, W]`: bit e % 32 of word e // 32 of plane p is bit p of the weight of event e.
    """
    padded = np.zeros(words * WORD_BITS, dtype=np.int64)
    padded[: len(weight)] = weight
    bits = (padded[None, :] >> np.arange(planes)[:, None]) & 1
    return (bits.reshape(planes, words, WORD_BITS) << np.arange(WORD_BITS)).sum(axis=2).astype(np.uint32)


def plane_count(weight: NDArray[np.int64]) -> int:
    """Number of bit planes that hold every weight, at least 1."""
    return max(1, int(weight.max(initial=0)).bit_length())


MakeKernel = Callable[[CompiledPlan, int], Any]
"""Makes the kernel of a plan and a seed: its `counts(start, count)` are the `RangeCounts` of these rollouts, its
`results(start, count)` their `RolloutResults`."""
