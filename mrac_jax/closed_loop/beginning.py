"""The lanes as rollouts begin: at t = 0, or with a mission under way (`planner.plans.state`). NumPy alone.

Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import HostArrays, padded
from mrac_jax.closed_loop.state import ACT, OFF, Lanes, Log
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
from mrac_jax.two_words import WORDS
from planner.arguments import argument
from planner.errors import WorldError
from planner.kernels import state as classical
from planner.kernels.loop import ClosedLoop
from planner.kernels.state import State, first_room
from planner.limits import MAX_STEP
from planner.plans.state import ON_ITS_WAY, RobotState

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
    records[lowest] = state.areas[:given, classical.LEFT_IN] + ((loop.tables.owner.astype(np.int64) + 1) << OWNER_SHIFT)
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
        "waiting": np.int32(marks[classical.OPEN]),
        "step": np.int32(marks[classical.STEP]),
        "quiet": np.int32(marks[classical.QUIET]),
        "progress": np.bool_(False),
        "unvisited": np.int32(len(area) - marks[classical.COVERED]),
        "survived": np.int32(marks[classical.COVERED] - marks[classical.UNSURVIVED]),
        "made": np.int32(marks[classical.AREAS]),
        **dict.fromkeys(("bisected", "divided"), np.int32(0)),
        "outcome": np.int32(0 if tables.homes is None else marks[classical.OVER] - 1),
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
    words = (classical.DOING, classical.CELL, classical.TARGET, classical.AREA, classical.LEFT, classical.HELD)
    doing, cell, target, area, to_do, held = state.robots.astype(np.int64).T[list(words)]
    has_area = np.isin(doing, (classical.STARTING, classical.TRAVELING, classical.COVERING))
    for robot in np.flatnonzero(doing == classical.STARTING):  # others know where they go
        members = np.flatnonzero(areas_at(loop) == area[robot])
        target[robot] = members[tables.cost[cell[robot], members].argmin()]
    duty = np.where(has_area, lowest[np.where(has_area, area, 0)] | to_do << OWNER_SHIFT, tables.none)
    returns = doing == classical.RETURNING
    on_its_way = (has_area | returns) & (loop.state is not None)
    left = np.minimum(
        state.team[:, classical.UNTIL] - np.where(on_its_way, state.marks[classical.STEP] - 1, 0), MAX_STEP + 1
    )
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
