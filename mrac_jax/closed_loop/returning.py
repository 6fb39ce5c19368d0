"""When robots turn for home (SPEC section 19) in the lanes, when they are there or charged, and when all turn.

The same rules in the simulator: `planner.simulator.return_home`. A robot that has
turned is
among those that are `done`, not among those alive. While it has still to move, to say that it is home, or to be charged
it is `returning`. Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop.rules import FAR, choose, first_area, open_cells
from mrac_jax.closed_loop.state import (
    ACT,
    CHARGE,
    JUDGE,
    NEXT,
    Lanes,
    any_bit,
    bits_of,
    flags_of,
    get,
    high_half,
    lane_rows,
    low_half,
    read,
    spread,
    switch,
    write,
    write_down,
)
from mrac_jax.closed_loop.tables import UNREACHABLE, WORD_BITS, LaneTables
from planner.simulator.codes import NO_AREA, NONE, EventKind, Outcome


@dataclass(frozen=True)
class Homing:
    """What each lane's robot does about its way home in one action, `[B]`.

    Attributes:
        returns: it is on its way, or at its base. turns: it turns, before it moves or at the end of its range; bound:
            and a base can be reached; charges: and it is charged there. comes: it is home. charging: it stands at its
            base; full: and has its range again. place: int32, where it is in the tables of `Homes`.
    """

    returns: jax.Array
    turns: jax.Array
    bound: jax.Array
    charges: jax.Array
    comes: jax.Array
    charging: jax.Array
    full: jax.Array
    place: jax.Array


def before_move(
    tables: LaneTables, lanes: Lanes, slot: jax.Array, robot: jax.Array, returns: jax.Array, moves: jax.Array
) -> tuple[Homing, jax.Array, jax.Array]:
    """Before the robots move: who turns instead; where those on their way home go, int32, and whether they do."""
    homes = tables.homes
    assert homes is not None and lanes.moves_left is not None and tables.range is not None
    word, own = read(lanes.place, slot), read(lanes.moves_left, slot)
    place = homes.of[robot] * homes.size + low_half(word)
    need = read(homes.need, place * homes.size + high_half(word)).astype(jnp.int32)
    turns = moves & (lanes.step > 0) & (need > jnp.minimum(own, homes.last - lanes.step + 1))
    ready = jnp.zeros_like(own) if lanes.ready is None else read(lanes.ready, slot)
    charging = returns & (ready > 0) & (ready < FAR)
    home = Homing(
        returns=returns,
        turns=turns,
        bound=turns & (read(homes.steps, place) >= 0),
        charges=turns & (need > own) & (own < read(tables.range, robot)),
        comes=returns & ~charging,
        charging=charging,
        full=charging & (lanes.step >= ready),
        place=place,
    )
    return home, read(homes.onward, place).astype(jnp.int32), returns & (read(homes.steps, place) > 0)


def after_move(
    tables: LaneTables, home: Homing, robot: jax.Array, cell: jax.Array, hit: jax.Array, stays: jax.Array
) -> tuple[Homing, jax.Array]:
    """After they have moved, to these cells: who is home; and who stays, since its range ends elsewhere."""
    homes = tables.homes
    assert homes is not None
    place = homes.of[robot] * homes.size + cell
    there = read(homes.steps, place) == 0
    ended = stays & there & ~home.returns
    turns, bound, charges = (one | ended for one in (home.turns, home.bound, home.charges))
    comes = home.comes & ~hit & there
    return replace(home, turns=turns, bound=bound, charges=charges, comes=comes, place=place), stays & ~there


def follow_up(
    tables: LaneTables, lanes: Lanes, home: Homing, slot: jax.Array, robot: jax.Array, bit: jax.Array, off: jax.Array
) -> Lanes:
    """What the robots are after that; `off`: they were stopped, or are at the end of their range."""
    assert lanes.returning is not None and lanes.moves_left is not None and tables.homes is not None
    if lanes.ready is None or tables.homes.recharge is None or tables.range is None:
        return replace(lanes, returning=switch(lanes.returning, bit, home.bound, off | home.comes))
    before = read(lanes.ready, slot)
    charges = home.comes & (before == FAR) & (lanes.outcome == NONE)
    ready = jnp.where(home.turns, jnp.where(home.charges, FAR, 0), jnp.where(home.full, 0, before))
    left = jnp.where(home.full, read(tables.range, robot), read(lanes.moves_left, slot))
    never = jnp.zeros_like(off)
    return replace(
        lanes,
        returning=switch(lanes.returning, bit, home.bound, off | (home.comes & ~charges) | home.full),
        ready=write(lanes.ready, slot, jnp.where(charges, lanes.step + tables.homes.recharge, ready)),
        moves_left=write(lanes.moves_left, slot, left),
        alive=switch(lanes.alive, bit, home.full, never),
        done=switch(lanes.done, bit, never, home.full),
        progress=lanes.progress | home.charging,
    )


def tell(tables: LaneTables, lanes: Lanes, home: Homing, area: jax.Array) -> Lanes:
    """In the log: who turns, leaving its area, who is home, and who has its range again."""
    assert tables.homes is not None
    base, nothing = read(tables.homes.base, home.place).astype(jnp.int32), jnp.full_like(area, NO_AREA)
    lanes = write_down(lanes, home.turns, lanes.robot, EventKind.TURNED_HOME, area, base)
    lanes = write_down(lanes, home.comes, lanes.robot, EventKind.HOME, nothing, base)
    return write_down(lanes, home.full, lanes.robot, EventKind.CHARGED, nothing, base)


def charge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """Up to `width` of the robots without an area that ask turn to be charged, if there is an area for them then."""
    if lanes.ready is None:
        return lanes
    asks = lanes.mode == CHARGE
    return jax.lax.cond(asks.any(), lambda now: _charge(tables, now, width), lambda now: now, lanes)


def _charge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None and lanes.moves_left is not None and tables.range is not None
    chosen = choose(lanes, lanes.mode == CHARGE, width)
    offered = open_cells(chosen.words)
    if tables.policy is None:
        turns = (offered & (tables.cost[chosen.here] < UNREACHABLE)).any(axis=1)
    else:
        turns = first_area(tables, lanes, chosen, chosen.here, offered, limited=False).found
    turns = turns & (get(lanes, lanes.moves_left, chosen.lane, chosen.robot) < read(tables.range, chosen.robot))
    place = homes.of[chosen.robot] * homes.size + chosen.here
    acts = read(homes.steps, place) == 0
    if lanes.looked is not None:  # who looked up has yet to move
        acts = acts | lanes.looked[jnp.minimum(chosen.lane, batch - 1)]

    def wide(values: jax.Array) -> jax.Array:
        return spread(jnp.zeros(batch, dtype=values.dtype), chosen.slot, values)

    way, robot, who = wide(read(homes.steps, place)), wide(chosen.robot), wide(turns)
    base = wide(read(homes.base, place).astype(jnp.int32))
    lanes = write_down(lanes, who, robot, EventKind.TURNED_HOME, jnp.full_like(robot, NO_AREA), base)
    ready, bit = lanes.ready, bits_of(robot, len(lanes.alive))
    assert ready is not None
    slot = lane_rows(ready, batch) + robot
    lanes = _turned(lanes, jnp.where(who, bit, jnp.uint32(0)), jnp.where(who & (way >= 0), bit, jnp.uint32(0)))
    return replace(
        lanes,
        ready=write(ready, slot, jnp.where(who, FAR, read(ready, slot))),
        mode=spread(lanes.mode, chosen.slot, jnp.where(turns & acts, ACT, NEXT)),
    )


def _turned(lanes: Lanes, who: jax.Array, bound: jax.Array) -> Lanes:
    """Robots, bits `[W, B]`, have turned for home, and those that are bound for a base are on their way."""
    assert lanes.returning is not None
    return replace(
        lanes,
        traveling=lanes.traveling & ~who,
        covering=lanes.covering & ~who,
        alive=lanes.alive & ~who,
        hopeful=lanes.hopeful & ~who,
        held=None if lanes.held is None else lanes.held & ~who,
        done=lanes.done | who,
        returning=lanes.returning | bound,
    )


def end_at_home(
    tables: LaneTables, lanes: Lanes, ends: jax.Array, outcome: jax.Array
) -> tuple[Lanes, jax.Array, jax.Array]:
    """At the end of a step: lanes in which all have turned if there is nothing more to be done.

    And where the step does end, since it is known how; and how the run ends, NONE if it goes on. `[B]` each.
    """
    homes, team = tables.homes, lanes.place.shape[0] // lanes.mode.shape[0]
    assert homes is not None
    over = ends & (lanes.outcome == NONE) & (outcome != NONE) & (outcome != Outcome.STEP_LIMIT)
    lanes = replace(lanes, outcome=jnp.where(over, outcome, lanes.outcome))
    if tables.policy is not None:  # is the rest not worth the risk? The step's end comes again, once that is known
        asks = over & (outcome == Outcome.NO_PROGRESS)
        lanes = replace(lanes, mode=jnp.where(asks, JUDGE, lanes.mode), robot=jnp.where(asks, team, lanes.robot))
        ends = ends & ~asks
    near = (lanes.outcome != NONE) | (homes.last - lanes.step <= homes.furthest)
    assert lanes.returning is not None
    calls = ends & near & any_bit(lanes.alive | lanes.returning)
    lanes = jax.lax.cond(calls.any(), lambda now: _call_home(tables, now, calls), lambda now: now, lanes)
    late = jnp.where(lanes.step >= tables.max_steps, jnp.int32(Outcome.STEP_LIMIT), NONE)
    assert lanes.returning is not None
    away = any_bit(lanes.returning)
    outcome = jnp.where((lanes.outcome == NONE) | away, late, lanes.outcome)
    # All robots may be lost on the way home too, whatever ended the mission.
    outcome = jnp.where(any_bit(lanes.unharmed), outcome, jnp.int32(Outcome.ALL_ROBOTS_LOST))
    return lanes, ends, jnp.where((outcome != NONE) & (lanes.unvisited == 0), jnp.int32(Outcome.COMPLETE), outcome)


def _call_home(tables: LaneTables, lanes: Lanes, calls: jax.Array) -> Lanes:
    """In the lanes that call, all turn where the mission is over, and who waits and would come too late."""
    homes, batch = tables.homes, lanes.mode.shape[0]
    assert homes is not None and lanes.returning is not None
    place = low_half(lanes.place).reshape(batch, -1)
    team = place.shape[1]
    row = homes.of * homes.size
    way = read(homes.steps, row + place)
    late = ((way > 0) & (homes.last - lanes.step[:, None] <= way)).T
    rests = ~flags_of(lanes.traveling | lanes.covering, team)
    over = lanes.outcome != NONE
    turns = flags_of(lanes.alive, team) & calls & (over | (late & rests))
    if lanes.log is not None:
        lanes = _tell(tables, lanes, turns.T, way, read(homes.base, row + place).astype(jnp.int32))
    bound = _words(turns & (way.T > 0), lanes.alive)
    if lanes.ready is not None:  # nobody is charged any more
        ready = lanes.ready.reshape(batch, -1).T
        stops = _words(calls & over & (ready > 0) & (ready < FAR), lanes.alive)
        assert lanes.returning is not None
        lanes = replace(lanes, returning=lanes.returning & ~stops, ready=jnp.where(turns, 0, ready).T.reshape(-1))
    lanes = replace(lanes, duty=jnp.where(turns.T.reshape(-1), jnp.uint32(tables.none), lanes.duty))
    return _turned(lanes, _words(turns, lanes.alive), bound)


def _tell(tables: LaneTables, lanes: Lanes, turns: jax.Array, way: jax.Array, base: jax.Array) -> Lanes:
    """In the log: who turns, bool `[B, K]`, for which base, and who is there."""
    batch, team = turns.shape
    label, number = low_half(lanes.duty.reshape(batch, team)), lanes.ids.reshape(batch, -1)
    area = jnp.where(label == tables.none, NO_AREA, jnp.take_along_axis(number, label, axis=1))

    def tell(robot: jax.Array, lanes: Lanes) -> Lanes:
        who, none = jnp.full(batch, robot, dtype=jnp.int32), jnp.full(batch, NO_AREA, dtype=jnp.int32)
        lanes = write_down(lanes, turns[:, robot], who, EventKind.TURNED_HOME, area[:, robot], base[:, robot])
        there = turns[:, robot] & (way[:, robot] == 0)
        return write_down(lanes, there, who, EventKind.HOME, none, base[:, robot])

    return jax.lax.fori_loop(0, team, tell, lanes)


def _words(flags: jax.Array, like: jax.Array) -> jax.Array:
    """uint32 `[W, B]`, as many as `like`, of bool `[K, B]`."""
    padded = jnp.pad(flags, ((0, like.shape[0] * WORD_BITS - flags.shape[0]), (0, 0)))
    bits = jnp.uint32(1) << jnp.arange(WORD_BITS, dtype=jnp.uint32)
    by_word = padded.reshape(like.shape[0], WORD_BITS, -1)
    return jnp.where(by_word, bits[:, None], jnp.uint32(0)).sum(axis=1, dtype=jnp.uint32)
