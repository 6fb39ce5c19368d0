"""The lanes as rollouts begin: at t = 0, or with a mission under way (`planner.plan.state`). NumPy alone.

Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import WORDS, HostArrays, padded
from mrac_jax.closed_loop.state import ACT, CELL_KINDS, NEW_SURVIVED, NEW_VISITED, OFF, STEP_KINDS, Lanes, Log
from mrac_jax.closed_loop.tables import (
    OPEN,
    OWNER_SHIFT,
    PENDING,
    SURVIVED,
    VISITED,
    LaneTables,
    areas_at,
    bits_of_robots,
)
from planner.arguments import argument
from planner.errors import WorldError
from planner.ids import MAX_STEP
from planner.plan.state import ON_ITS_WAY, RobotState
from planner.rollouts.closed_loop import nominal_loop, trace_rollouts
from planner.rollouts.loop import ClosedLoop, known_cells
from planner.simulator import state as classical
from planner.simulator.state import MOST_PASSES, State, first_room
from planner.simulator.thresholds import CERTAIN

BOARDS = ("traveling", "covering", "alive", "hopeful", "done", "held", "returning")
OWN = ("mode", "number", "rollout", "left")
COPIED = tuple(one.name for one in fields(Lanes) if one.name not in (*OWN, "log"))
"""What a lane takes over from the snapshot that it begins as."""


def begun_values(tables: LaneTables, loop: ClosedLoop) -> HostArrays:
    """What a lane (NumPy) holds as rollouts begin, of what is copied from lane to lane.

    It is the first state of the compiled simulator, in other words: at t = 0, or where the mission stands. Raises
    WorldError for robots that are not on the safest way to where they go, which lanes do not follow.
    """
    _check_ways(tables, loop)
    state = State._make(row[0] for row in loop.first_state(first_room(loop.tables)))
    marks, given = state.marks, len(loop.tables.level)
    area, home = areas_at(loop), padded(state.home[:-1], tables.size, classical.VISITED)
    lowest, label = np.full(given, tables.none), np.full(tables.size, tables.none)
    # The label of an area is its lowest cell.
    np.minimum.at(lowest, area, np.arange(len(area)))
    label[: len(area)] = lowest[area]
    is_open = np.unpackbits(state.open.view(np.uint8), bitorder="little")[:given] > 0
    visited, survived = home & classical.VISITED != 0, home & classical.SURVIVED != 0
    bits = (
        (~visited | (home & classical.TO_DO != 0), PENDING),
        (visited, VISITED),
        (survived, SURVIVED),
        (padded(is_open[area], tables.size, dtype=np.bool_), OPEN),
    )
    records, ids = np.zeros(tables.size, dtype=np.uint32), np.zeros(tables.size, dtype=np.int32)
    records[lowest] = state.areas["left"][:given] + ((loop.tables.owner.astype(np.int64) + 1) << OWNER_SHIFT)
    ids[lowest] = np.arange(given)
    safe = (tables.level == 0) & ~visited
    values = {
        "cells": (label | sum(np.where(where, bit, 0) for where, bit in bits)).astype(np.uint32),
        "areas": records,
        "ids": ids,
        **_of_robots(tables, loop, state, lowest),
        "looked": np.bool_(False),
        "safe_left": np.int32(safe[: len(area)].sum()),
        "passes": survived.astype(np.uint8),
        "waiting": np.int32(marks["open"]),
        "step": np.int32(marks["step"]),
        "quiet": np.int32(marks["quiet"]),
        "progress": np.bool_(False),
        "unvisited": np.int32(len(area) - marks["covered"]),
        "survived": np.int32(marks["covered"] - marks["unsurvived"]),
        "made": np.int32(marks["areas"]),
        **dict.fromkeys(("bisected", "divided"), np.int32(0)),
        "outcome": np.int32(0 if tables.homes is None else marks["over"] - 1),
    }
    acting = values["traveling"] | values["covering"] | values["held"] | values["returning"]
    acting |= values["hopeful"] if is_open.any() else 0
    first = np.flatnonzero(np.unpackbits(acting.view(np.uint8), bitorder="little"))
    # At t = 0 everybody acts; later the first who can.
    values["robot"] = np.int32(0 if loop.state is None else first[0] if len(first) else len(tables.starts))
    without = {"moves_left": tables.range is None, "passes": tables.weights is None, "returning": tables.homes is None}
    without |= {"ready": tables.homes is None or tables.homes.recharge is None}
    without |= dict.fromkeys(("looked", "held", "safe_left"), tables.policy is None)
    return {name: None if without.get(name) else value for name, value in values.items()}


def _of_robots(tables: LaneTables, loop: ClosedLoop, state: State, lowest: NDArray[np.int64]) -> HostArrays:
    """Where robots are and what they have and do; lowest: the lowest cell of each area."""
    words = ("doing", "cell", "target", "area", "left", "held")
    doing, cell, target, area, to_do, held = (state.robots[word].astype(np.int64) for word in words)
    has_area = np.isin(doing, (classical.STARTING, classical.TRAVELING, classical.COVERING))
    for robot in np.flatnonzero(doing == classical.STARTING):  # others know where they go
        members = np.flatnonzero(areas_at(loop) == area[robot])
        target[robot] = members[tables.cost[cell[robot], members].argmin()]
    duty = np.where(has_area, lowest[np.where(has_area, area, 0)] | to_do << OWNER_SHIFT, tables.none)
    returns = doing == classical.RETURNING
    on_its_way = (has_area | returns) & (loop.state is not None)
    left = np.minimum(state.robots["until"] - np.where(on_its_way, state.marks["step"] - 1, 0), MAX_STEP + 1)
    acts = np.unpackbits((state.movers | state.waiting).view(np.uint8), bitorder="little")[: len(doing)] > 0
    lives = acts & ~returns & (left > 0)
    of = {
        "traveling": np.isin(doing, (classical.STARTING, classical.TRAVELING, classical.FOLLOWING)),
        "covering": doing == classical.COVERING,
        "done": (doing == classical.DONE) | returns,
        "returning": returns,
        "alive": lives,
        "hopeful": np.isin(doing, (classical.LANDING, classical.IDLE, classical.DONE)) & lives,
        "held": held != 0,
    }
    team = len(tables.starts)
    return {
        "place": padded(cell | target << OWNER_SHIFT, team, tables.none, np.uint32),
        "duty": padded(duty, team, tables.none, np.uint32),
        "moves_left": padded(left, team),
        "ready": np.zeros(team, dtype=np.int32),
        **{name: bits_of_robots(np.flatnonzero(which), team) for name, which in of.items()},
    }


def _check_ways(tables: LaneTables, loop: ClosedLoop) -> None:
    for number, robot in enumerate(() if loop.state is None else loop.state.robots):
        if robot.status not in ON_ITS_WAY:
            continue
        leg = _leg(loop, robot)
        if (tables.hop.reshape(tables.size, -1)[leg[:-1], leg[-1]] != leg[1:]).any():
            raise WorldError(
                f"robot {number} is not on the safest way to cell {robot.ahead[-1]}",
                expected="the ways that plans have for the closed loop in JAX",
                fix=f"use {argument('engine', 'numba')}",
            )


def _leg(loop: ClosedLoop, robot: RobotState) -> NDArray[np.int64]:
    """Where a robot is, and the cells up to the end of its leg: on a coverage path the first one that is to do."""
    ahead = np.searchsorted(loop.cells, robot.ahead)
    ends = np.flatnonzero(np.isin(robot.ahead, robot.to_do)) if robot.status == "covering" else ahead[:0]
    here = np.searchsorted(loop.cells, [robot.cell])
    return np.concatenate([here, ahead[: int(ends[0]) + 1] if len(ends) else ahead])


def lanes_of(tables: LaneTables, loop: ClosedLoop, rollouts: NDArray[np.uint32], log: Log | None = None) -> Lanes:
    """Lanes (NumPy) at the beginning of the rollouts, uint32 `[B]`: t = 0, or the mission's state.

    Their robots bear as much as two words say.
    """
    batch = len(rollouts)
    new: HostArrays = begun_values(tables, loop)
    for name, value in new.items():
        if value is not None:
            new[name] = np.repeat(value[:, None], batch, axis=1) if name in BOARDS else np.tile(value, batch)
    new["mode"] = np.full(batch, ACT, dtype=np.int32)
    new["number"] = np.arange(batch, dtype=np.int32)
    new["halt"] = np.zeros(batch, dtype=np.int32)
    new["rollout"] = rollouts
    new["left"] = np.full(batch * len(tables.starts) * WORDS, 2**32 - 1, dtype=np.uint32)
    new["log"] = log
    return Lanes(**new)


def lanes_off(tables: LaneTables, loop: ClosedLoop, batch: int) -> Lanes:
    """Lanes (NumPy) at the beginning of a rollout, but off."""
    return halted(tables, loop, np.zeros(batch, dtype=np.int32))


def halted(tables: LaneTables, loop: ClosedLoop, halt: NDArray[np.int32]) -> Lanes:
    """Lanes (NumPy) at the beginning of a rollout that go off before these steps, `[B]`; at once before the first one
    or step 0, not at all before a negative one."""
    lanes = lanes_of(tables, loop, np.zeros(len(halt), dtype=np.uint32))
    goes = (halt != 0) & (halt != lanes.step)
    own: HostArrays = {"mode": np.where(goes, ACT, OFF).astype(np.int32), "halt": halt}
    return replace(lanes, **own)


def first_lanes(lanes: Lanes, count: int) -> Lanes:
    """The first `count` lanes of one device's (NumPy)."""
    batch = len(lanes.mode)
    kept: HostArrays = {}
    for name in (*COPIED, *OWN):
        flat = getattr(lanes, name)
        if flat is not None:
            kept[name] = flat[:, :count] if name in BOARDS else flat.reshape(batch, -1)[:count].reshape(-1)
    return replace(lanes, **kept)


# The nominal run of a closed loop, on which every rollout is until somebody is hit: lanes begin at the first hit.
#
# Which dangerous entry is a rollout's first hit follows from what its robots bear; what the rollouts have in common
# with
# the nominal run is counted from how many are still on it at each step, and those that are never hit need no lane.
# Axis letters: `E` dangerous entries of the nominal run in the order in which they are made, `V` all its entries, `M`
# steps at which lanes begin, `T` steps, `B` rollouts; the others as in `mrac_jax.closed_loop.state`. NumPy alone.

NO_HIT = 2**30
"""Larger than the number of any entry."""


@dataclass(frozen=True, eq=False)
class Nominal:
    """The run with no hits, as the lanes' counts need it.

    Attributes:
        step, cell, kind: int64 `[V]`, of its entries in order; the kind of a visit as in `mrac_jax.closed_loop.state`.
        turn: int64 `[V]`, entries of the same cell before.
        own, borne: for each robot, the numbers of its dangerous entries, and the exposure after each; int64.
        begins: int32 `[M]`, rising steps: lanes begin at the start of one. begin_of: int32 `[E]`, the last of them that
            is not after the entry. before: int64 `[M, K]`, the exposure of each robot by then.
    """

    step: NDArray[np.int64]
    cell: NDArray[np.int64]
    kind: NDArray[np.int64]
    turn: NDArray[np.int64]
    own: list[NDArray[np.int64]]
    borne: list[NDArray[np.int64]]
    begins: NDArray[np.int32]
    begin_of: NDArray[np.int32]
    before: NDArray[np.int64]

    def first_hits(self, tolerance: NDArray[np.int64]) -> NDArray[np.int64]:
        """The number of each rollout's first hit, `[B]` of int64 `[B, K]`; NO_HIT if there is none."""
        first = np.full(len(tolerance), NO_HIT)
        for robot, (own, borne) in enumerate(zip(self.own, self.borne, strict=True)):
            # Exposure only grows along a path, so a robot's first hit is found by bisection.
            first = np.minimum(first, np.append(own, NO_HIT)[np.searchsorted(borne, tolerance[:, robot])])
        return first

    def count(
        self,
        begun: NDArray[np.int64],
        whole: int,
        by_cell: NDArray[np.int64],
        by_step: NDArray[np.int64],
        passes: NDArray[np.int64] | None = None,
    ) -> None:
        """Add what rollouts did on the nominal run: `begun` `[M]` of them left it for a lane, `whole` never did."""
        on_it = np.full(int(self.step.max(initial=-1)) + 1, whole, dtype=np.int64)  # [T], rollouts that are on it then
        # A lane counts from its snapshot's step on; all before that is the nominal run's.
        for step, leaving in zip(self.begins.tolist(), begun.tolist(), strict=True):
            on_it[:step] += leaving
        np.add.at(by_cell, self.cell * CELL_KINDS + self.kind, on_it[self.step])
        np.add.at(by_step, self.step * STEP_KINDS + self.kind, on_it[self.step])
        if passes is not None:
            told = self.turn < MOST_PASSES
            np.add.at(passes, (self.cell * MOST_PASSES + self.turn)[told], on_it[self.step[told]])


def nominal_of(loop: ClosedLoop, most_begins: int) -> Nominal:
    """The nominal run of a closed loop; lanes begin at `most_begins` of its steps at most."""
    (trace,) = trace_rollouts(nominal_loop(loop), 0, (0,))
    moved = np.diff(trace.cells, axis=0, prepend=-1) != 0  # all robots enter their starts at t = 0
    visited, survived = (np.isin(loop.cells, known) for known in known_cells(loop))
    moved[: 0 if loop.state is None else loop.state.step + 1] = False
    step, robot = np.nonzero(moved)
    cell = np.searchsorted(loop.cells, trace.cells[moved])
    first = np.zeros(len(cell), dtype=np.bool_)
    first[np.unique(cell, return_index=True)[1]] = True
    fresh, safely = first & ~visited[cell], first & ~survived[cell]
    danger = np.flatnonzero((loop.tables.bound[cell] > 0) & (fresh | (not loop.first_only)))
    exposure = loop.tables.exposure[cell[danger]]
    if loop.in_doubt:  # it is not known here what adds how much: whoever may be hit needs a lane from the first on
        exposure = CERTAIN * (np.arange(len(danger)) == 0)
    begins = np.unique(step[danger])
    # More steps than snapshots: some lanes begin earlier than they need to, and nothing else changes.
    if len(begins) > most_begins:
        begins = begins[np.linspace(0, len(begins) - 1, most_begins).astype(np.int64)]
    own = [np.flatnonzero(robot[danger] == number) for number in range(loop.robots)]
    borne = [np.cumsum(exposure[mine]) for mine in own]
    made = [np.searchsorted(step[danger][mine], begins) for mine in own]
    return Nominal(
        step=step,
        cell=cell,
        kind=fresh * NEW_VISITED + safely * NEW_SURVIVED,
        turn=_turns(cell) + survived[cell],
        own=own,
        borne=borne,
        begins=begins.astype(np.int32),
        begin_of=(np.searchsorted(begins, step[danger], side="right") - 1).astype(np.int32),
        before=np.stack([np.append(0, one)[many] for one, many in zip(borne, made, strict=True)], axis=1),
    )


def _turns(cell: NDArray[np.int64]) -> NDArray[np.int64]:
    """How often each entry's cell was entered before, int64 `[V]`."""
    order = np.argsort(cell, kind="stable")
    begins = np.flatnonzero(np.diff(cell[order], prepend=-1))
    turn = np.empty(len(cell), dtype=np.int64)
    turn[order] = np.arange(len(cell)) - np.repeat(begins, np.diff(begins, append=len(cell)))
    return turn
