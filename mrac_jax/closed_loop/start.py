"""Lanes at their first step: t = 0 of a plan, or a mission's state. Only NumPy is used."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import on_host, uint64_pairs
from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import BASE, END, LENGTH, NEVER, NOWHERE, HostBook, padded_team
from mrac_jax.closed_loop.lanes import Lanes
from planner.arguments import argument
from planner.errors import UsageError, WorldError
from planner.rollouts.closed_loop import MOST_TABLED
from planner.rollouts.loop import ClosedLoop, known_cells
from planner.simulator.state import first_room

ENDLESS = 2**62
"""A threshold that no hazard reaches."""
AREAS = 64
"""The capacity for areas is a multiple of this."""


def check_supported(loop: ClosedLoop) -> None:
    """Raise WorldError or UsageError for a mission that the book does not support."""
    t, fix = loop.tables, f"use {argument('engine', 'numba')}"
    size = f"a map of {loop.shape[0]} x {loop.shape[1]} cells, {len(loop.cells)} of them accessible"
    if not loop.tabled and not loop.learns:
        raise WorldError(size, expected=f"at most {MOST_TABLED} accessible ones for the closed loop in JAX", fix=fix)
    if (loop.max_steps + 2) * stride_of(loop) >= NEVER:
        problem = f"{loop.robots} robots that may run for {loop.max_steps:,} steps"
        raise WorldError(problem, expected="a product below 2**30 for the closed loop in JAX", fix=fix)
    of_the_map = {
        "threats that change with time": len(t.phases) > 0,
        argument("wrecks", "block"): len(t.odds) > 0 and not loop.is_uncertain,
        "robots that learn the map": loop.learns,
        "an uncertain map": loop.is_uncertain,
        "moving threats": loop.moving_threats is not None,
    }
    options = {
        argument("transit", "area"): loop.stay_inside,
        argument("policy", loop.rule.name): loop.policy is not None,
        argument("threat_checks", "first_visit"): loop.first_only,
        argument("types"): len(t.type_of) > 0,
        argument("steps_per_move"): len(t.pace) > 0,
        argument("deliver_every"): t.deliver_every > 0,
        argument("deliver_value"): t.deliver_value > 0,
        argument("radio"): len(t.reach) > 0,
    }
    for kind, asked in ((WorldError, of_the_map), (UsageError, options)):
        for named in (name for name, is_asked in asked.items() if is_asked):
            raise kind(f"{argument('engine', 'jax')} with {named}, in the closed loop", fix=fix)


def stride_of(loop: ClosedLoop) -> int:
    """Keys of a step: the robots' turns, and with return to base, the events at the end of the step."""
    return padded_team(loop.robots) * (2 if loop.comes_home else 1)


def members(bits: NDArray[np.uint64]) -> NDArray[np.int64]:
    """The members of a set of the simulator."""
    return np.flatnonzero(np.unpackbits(bits.view(np.uint8), bitorder="little"))


def first_lane(book: HostBook, room: int) -> Lanes:
    """One lane (NumPy) before its first step, without losses; `room`: capacity for new areas."""
    loop, t = book.loop, book.loop.tables
    state = loop.first_state(first_room(t))
    raw = type(state)(*(row[0] for row in state))
    given, step = len(t.level), int(raw.marks["step"])
    team, K = loop.robots, padded_team(loop.robots)
    robots, key = np.zeros((K, ln.FIELDS), np.int32), np.full(K, NEVER, np.int32)
    robots[:, ln.DOING], robots[:, ln.AREA], robots[:, ln.SINCE] = ln.DEAD, -1, step - 1
    for number in range(team):
        robots[number], key[number] = _robot(book, raw, number, step)
    G = -(-(given + room) // AREAS) * AREAS
    slots = np.full(G, -1, np.int32)
    open_ = members(raw.open)
    slots[open_] = open_
    visited, survived = (book.row_of(np.searchsorted(loop.cells, known)) for known in known_cells(loop))
    undelivered = np.array([book.row_of(members(row)) for row in raw.undelivered])
    return on_host(
        Lanes,
        mode=np.int32(ln.RUN), number=np.int32(0), fuel=np.int32(NEVER), visited=visited, survived=survived,
        now=np.zeros_like(visited), slots=slots, made=np.int32(given), key=key, robots=robots,
        left=np.broadcast_to(uint64_pairs(np.array(ENDLESS)), (K, 2)).copy(), shared=np.zeros(2, np.int32),
        last=np.int32(step - 1 - int(raw.marks["quiet"])), outcome=np.int32(0), over=np.int32(raw.marks["over"]),
        asked=np.zeros(book.words + 1, np.uint32),
        undelivered=np.insert(undelivered, [team] * (K - team), 0, axis=0) if loop.delivers else None,
    )  # fmt: skip


def _robot(book: HostBook, raw, number: int, step: int) -> tuple[NDArray[np.int32], int]:  # type: ignore[no-untyped-def]
    """One robot's fields and its key."""
    loop, t = book.loop, book.loop.tables
    me, begins = raw.robots[number], loop.state is None
    cell, until = int(me["cell"]), int(min(me["until"], ln.LIMITLESS))
    area, entry = -1, NOWHERE
    if begins:
        owned = np.flatnonzero(t.owner == number)
        doing, path = ln.START if len(owned) else ln.LAND, np.array([cell])
        area = int(owned[0]) if len(owned) else -1
        if len(t.given):
            doing, path = ln.FOLLOW, t.given[number][: int(t.length[number]) + 1].astype(np.int64)
        entry = book.add_walk(cell, path, np.append(False, path[1:] == path[:-1]))
    else:
        robot = loop.state.robots[number]  # type: ignore[union-attr]
        if number in members(raw.moving):
            doing, area = {"covering": ln.COVER, "returning": ln.RETURN}.get(robot.status, ln.TRAVEL), int(robot.area)
            entry = _rest_of(book, raw, number, cell)
        elif number in members(raw.waiting):
            doing = ln.IDLE
        else:
            doing = ln.OUT if robot.alive else ln.DEAD
    base, length, end = book.entries.rows[entry, [BASE, LENGTH, END]].tolist()
    since = step - 1
    fate, last, stride = ln.ARRIVES, length, stride_of(loop)
    if until - since < length + (doing != ln.RETURN):
        fate, last = ln.ENDS, until - since
    if loop.comes_home and doing in (ln.TRAVEL, ln.COVER):
        need = book.need.rows[base + 1 : base + 1 + length, t.home_of[number]]
        beyond = need > min(until, t.last_step) - since
        if beyond.any() and int(beyond.argmax()) < last:
            fate, last = ln.TURNS, int(beyond.argmax())
    fields = {
        ln.DOING: doing, ln.FATE: fate, ln.HERE: end if entry else cell, ln.AREA: area, ln.IDENT: max(area, 0),
        ln.WALK: entry, ln.ROW: base, ln.SINCE: since, ln.LAST: last, ln.UNTIL: until,
    }  # fmt: skip
    key = (since + last + (fate == ln.TURNS)) * stride + number
    if doing == ln.IDLE:
        key = step * stride + number
    elif doing in (ln.OUT, ln.DEAD):
        key = NEVER
    return np.array([fields[name] for name in range(ln.FIELDS)], np.int32), key


def _rest_of(book: HostBook, raw, number: int, cell: int) -> int:  # type: ignore[no-untyped-def]
    """The walk of a robot of a mission's state: along its path, and through the remaining cells."""
    loop = book.loop
    robot = loop.state.robots[number]  # type: ignore[union-attr]
    if robot.status == "returning":
        return book.add_walk(cell, book.way_home(cell, int(loop.tables.home_of[number])))
    ahead, to_do = np.searchsorted(loop.cells, robot.ahead), np.searchsorted(loop.cells, robot.to_do)
    found = np.flatnonzero(np.isin(ahead, to_do)) if robot.status == "covering" else ahead[:0]
    leg = ahead[: int(found[0]) + 1] if len(found) else ahead
    if (loop.tables.hop_to[leg[-1], leg[:-1]] != leg[1:]).any():
        raise WorldError(
            f"robot {number} is not on the safest way to cell {loop.cells[leg[-1]]}",
            expected="the ways that plans have for the closed loop in JAX",
            fix=f"use {argument('engine', 'numba')}",
        )
    if robot.status != "covering":
        return book.add_walk(cell, ahead, np.append(cell, ahead[:-1]) == ahead)
    rest, _, ends = book.path(int(leg[-1]), np.setdiff1d(to_do, leg[-1:]))
    return book.add_walk(cell, np.append(leg, rest), None, np.append(np.arange(len(leg)) == len(leg) - 1, ends))
