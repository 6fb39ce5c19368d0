"""The lanes as rollouts begin: at t = 0, or with a mission under way (`planner.plans.state`). NumPy alone.

Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import HostArrays
from mrac_jax.closed_loop.state import ACT, OFF, Lanes, Log
from mrac_jax.closed_loop.tables import LABEL, OPEN, OWNER_SHIFT, PENDING, SURVIVED, VISITED, LaneTables, bits_of_robots
from mrac_jax.two_words import WORDS
from planner.arguments import argument
from planner.errors import WorldError
from planner.kernels.loop import ClosedLoop
from planner.plans.state import ON_ITS_WAY, MissionState, RobotState

BOARDS = ("traveling", "covering", "alive", "hopeful", "done", "held")
OWN = ("mode", "number", "rollout", "left")
COPIED = tuple(one.name for one in fields(Lanes) if one.name not in (*OWN, "log"))
"""What a lane takes over from the snapshot that it begins as."""


def fresh_values(tables: LaneTables, loop: ClosedLoop) -> HostArrays:
    """What a lane (NumPy) holds at t = 0, of what is copied from lane to lane; but for halt."""
    nobody = np.zeros_like(tables.robots)
    zero = np.int32(0)
    target = tables.first_target.astype(np.uint32) << OWNER_SHIFT
    return {
        "cells": tables.cells,
        "areas": tables.areas,
        "ids": tables.ids,
        "place": tables.starts.astype(np.uint32) | target,
        "duty": tables.first_area.astype(np.uint32),
        "traveling": tables.assigned,
        "covering": nobody,
        "alive": tables.robots,
        "hopeful": tables.robots & ~tables.assigned,
        "done": nobody,
        "waiting": tables.waiting,
        "step": zero,
        "robot": zero,
        "quiet": zero,
        "progress": np.bool_(False),
        "unvisited": tables.accessible,
        "survived": zero,
        "made": tables.given,
        "bisected": zero,
        "divided": zero,
        "outcome": zero,
        **({"legs": np.zeros(tables.size, dtype=np.uint16)} if loop.stay_inside else {}),
        **({} if tables.policy is None else _attentive_values(tables)),
        **({} if tables.range is None else {"moves_left": tables.range}),
        **({} if tables.weights is None else {"passes": np.zeros(tables.size, dtype=np.uint8)}),
    }


def _attentive_values(tables: LaneTables) -> HostArrays:
    """The same of lanes with attentive robots alone."""
    safe = (tables.level == 0) & ((tables.cells & VISITED) == 0)
    return {"looked": np.bool_(False), "held": np.zeros_like(tables.robots), "safe_left": np.int32(safe.sum())}


def resumed(fresh: HostArrays, tables: LaneTables, loop: ClosedLoop, mission: MissionState) -> HostArrays:
    """What a lane holds otherwise than a `fresh` one where the mission goes on.

    Raises WorldError for robots that are not on the safest way to where they go, which lanes do not follow.
    """
    unassigned = [area.cells for area in mission.areas if area.state == "unassigned"]
    visited, survived = _marked(tables, loop, mission.visited), _marked(tables, loop, mission.survived)
    visited[len(loop.cells) :] = True
    to_do = ~visited | _marked(tables, loop, *(robot.to_do for robot in mission.robots))
    bits = ((to_do, PENDING), (visited, VISITED), (survived, SURVIVED), (_marked(tables, loop, *unassigned), OPEN))
    word = (tables.cells & LABEL) | sum(np.where(where, bit, 0) for where, bit in bits)
    areas, labels = (
        np.zeros_like(tables.areas),
        [int(np.searchsorted(loop.cells, a.cells.min())) for a in mission.areas],
    )
    for label, area in zip(labels, mission.areas, strict=True):
        left = np.count_nonzero(~visited[np.searchsorted(loop.cells, area.cells)])
        areas[label] = left if area.state == "completed" else left | (area.robot + 1) << OWNER_SHIFT
    values = {"cells": word.astype(np.uint32), "areas": areas, **_boards(fresh, mission)}
    acting = values["traveling"] | values["covering"] | (values["hopeful"] if unassigned else 0) | values.get("held", 0)
    first = np.flatnonzero(np.unpackbits(acting.view(np.uint8), bitorder="little"))
    optional = {"safe_left": np.int32(((tables.level == 0) & ~visited).sum()), "passes": survived.astype(np.uint8)}
    return {
        **values,
        **_ways(fresh, tables, loop, mission, labels),
        **{name: value for name, value in optional.items() if name in fresh},
        "waiting": np.int32(len(unassigned)),
        "step": np.int32(mission.step + 1),
        "quiet": np.int32(mission.quiet),
        "robot": np.int32(first[0] if len(first) else len(fresh["place"])),
        "unvisited": np.int32((~visited).sum()),
        "survived": np.int32(survived.sum()),
    }


def _marked(tables: LaneTables, loop: ClosedLoop, *cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """bool `[A]` of cells of the map."""
    marked = np.zeros(tables.size, dtype=np.bool_)
    for some in cells:
        marked[np.searchsorted(loop.cells, some)] = True
    return marked


def _ways(
    fresh: HostArrays, tables: LaneTables, loop: ClosedLoop, mission: MissionState, labels: list[int]
) -> HostArrays:
    """Where robots are, what they have and the ways that they are on; labels: of the areas. Raises WorldError."""
    place, duty = fresh["place"].copy(), np.full_like(fresh["duty"], tables.none)
    place[: len(mission.robots)] = np.searchsorted(loop.cells, [robot.cell for robot in mission.robots])
    ways = {"place": place, "duty": duty} | ({"legs": fresh["legs"].copy()} if "legs" in fresh else {})
    for number, robot in enumerate(mission.robots):
        if robot.status not in ON_ITS_WAY:
            continue
        leg = _leg(loop, robot)
        place[number] |= leg[-1] << OWNER_SHIFT
        duty[number] = labels[robot.area] | len(robot.to_do) << OWNER_SHIFT
        if "legs" in ways and robot.status == "covering":
            ways["legs"][leg[:-1]] = leg[1:]
        elif (tables.hop.reshape(tables.size, -1)[leg[:-1], leg[-1]] != leg[1:]).any():
            raise WorldError(
                f"robot {number} is not on the safest way to cell {robot.ahead[-1]}",
                expected="the ways that plans have for the closed loop in JAX",
                fix=f"use {argument('engine', 'numba')}",
            )
    return ways


def _leg(loop: ClosedLoop, robot: RobotState) -> NDArray[np.int64]:
    """Where a robot is, and the cells up to the end of its leg: on a coverage path the first one that is to do."""
    ahead = np.searchsorted(loop.cells, robot.ahead)
    ends = np.flatnonzero(np.isin(robot.ahead, robot.to_do)) if robot.status == "covering" else ahead[:0]
    here = np.searchsorted(loop.cells, [robot.cell])
    return np.concatenate([here, ahead[: int(ends[0]) + 1] if len(ends) else ahead])


def _boards(fresh: HostArrays, mission: MissionState) -> HostArrays:
    """The bits of the robots, and the moves that they have left where that counts."""
    robots, size = mission.robots, len(fresh["place"])
    made = np.zeros(size, dtype=np.int32)
    made[: len(robots)] = [robot.moves for robot in robots]
    left = fresh["moves_left"] - made if "moves_left" in fresh else np.ones(size, dtype=np.int32)
    of = {
        "traveling": [robot.status == "traveling" for robot in robots],
        "covering": [robot.status == "covering" for robot in robots],
        "done": [robot.status == "done" for robot in robots],
        "alive": [robot.alive and moves > 0 for robot, moves in zip(robots, left, strict=False)],
        "hopeful": [robot.status in ("idle", "done") and moves > 0 for robot, moves in zip(robots, left, strict=False)],
        "held": [robot.held for robot in robots],
    }
    boards = {name: bits_of_robots(np.flatnonzero(which), size) for name, which in of.items() if name in fresh}
    return boards | ({"moves_left": left} if "moves_left" in fresh else {})


def lanes_of(tables: LaneTables, loop: ClosedLoop, rollouts: NDArray[np.uint32], log: Log | None = None) -> Lanes:
    """Lanes (NumPy) at the beginning of the rollouts, uint32 `[B]`: t = 0, or the mission's state.

    Their robots bear as much as two words say.
    """
    batch = len(rollouts)
    new: HostArrays = dict.fromkeys(("legs", "looked", "held", "safe_left", "moves_left", "passes"))
    values = fresh_values(tables, loop)
    if loop.state is not None:
        values |= resumed(values, tables, loop, loop.state)
    for name, value in values.items():
        if name in BOARDS:
            new[name] = np.repeat(value[:, None], batch, axis=1)
        else:
            new[name] = np.tile(value, batch)
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
