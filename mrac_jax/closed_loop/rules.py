"""Robots that look at what others have visited (SPEC section 11): what the lanes do beside the paper's rule.

The same rules in the simulator: `planner.simulator.replanning`. A cell to do is one
that
nobody has visited: its PENDING bit. A robot that notices something does not move until a search has told where to.
Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mrac_jax.arrays import Array
from mrac_jax.closed_loop.state import (
    ACT,
    END,
    FIND_AREA,
    FIND_CELL,
    FIND_FAR,
    FIND_OR_SHARE,
    JUDGE,
    LOOK_AGAIN,
    NEXT,
    RETARGET,
    SHARE,
    Lanes,
    affords,
    bits_of,
    choose_lanes,
    further,
    get,
    high_half,
    in_reach,
    lane_rows,
    low_half,
    moves_left,
    put,
    put_rows,
    read,
    spread,
    state_pack,
    switch,
    targets,
    word_and_bit,
    write_down,
)
from mrac_jax.closed_loop.tables import LABEL, OPEN, PENDING, UNREACHABLE, VISITED, LaneTables
from planner.simulator.codes import NO_ROBOT, EventKind, Outcome
from planner.simulator.offers import Offer, is_dangerous, is_refused

# Where to go: the search among all cells, of a few lanes of the batch at a time.
#
# The next area, and the next cell of a coverage path that is far away. Axis letters as in `mrac_jax.closed_loop.state`.

FAR = 2**31 - 1


@dataclass(frozen=True)
class Chosen:
    """Lanes that wait, and what is looked at there.

    Attributes:
        lane: int32 `[S]`, which; B where fewer than S wait. slot: int32 `[B]`, each lane's place among them, or S.
        shares: bool `[S]`, its robot wants to share.
        robot: int32 `[S]`, whose turn it is; here: int32 `[S]`, its cell.
        words: uint32 `[S, A]`, the lane's cells. duty: uint32 `[S, K]`.
    """

    lane: jax.Array
    slot: jax.Array
    shares: jax.Array
    robot: jax.Array
    here: jax.Array
    words: jax.Array
    duty: jax.Array


def choose(lanes: Lanes, wants: jax.Array, width: int) -> Chosen:
    """Up to `width` of the lanes in which it is true, bool `[B]`."""
    batch = lanes.mode.shape[0]
    lane, slot = choose_lanes(wants, width)
    at = jnp.minimum(lane, batch - 1)
    robot = jnp.minimum(lanes.robot[at], lanes.duty.shape[0] // batch - 1)
    return Chosen(
        lane=lane,
        slot=slot,
        shares=(lanes.mode[at] == SHARE) & (lane < batch),
        robot=robot,
        here=low_half(get(lanes, lanes.place, lane, robot)),
        words=lanes.cells.reshape(batch, -1)[at],
        duty=lanes.duty.reshape(batch, -1)[at],
    )


def entry(rows: jax.Array, column: jax.Array) -> jax.Array:
    """One entry of each row, `[S]`."""
    return jnp.take_along_axis(rows, column[:, None], axis=1)[:, 0]


def first_cell(where: jax.Array) -> jax.Array:
    """The lowest cell at which it is true, int32 `[S]` of bool `[S, A]`; the last cell if there is none."""
    return jnp.where(where, jnp.arange(where.shape[1], dtype=jnp.int32), where.shape[1] - 1).min(axis=1)


def search_find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """The next area, or the next cell of a coverage path that is far away, in up to `width` lanes that search one."""
    return jax.lax.cond(
        _search_seeks(lanes).any(), lambda now: _search_find(tables, now, width), lambda now: now, lanes
    )


def _search_seeks(lanes: Lanes) -> jax.Array:
    return (lanes.mode == FIND_FAR) | (lanes.mode == FIND_AREA) | (lanes.mode == FIND_OR_SHARE)


def _search_find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    chosen = choose(lanes, _search_seeks(lanes), width)
    lane, robot, words = chosen.lane, chosen.robot, chosen.words
    mode = lanes.mode[jnp.minimum(lane, lanes.mode.shape[0] - 1)]
    wants_cell = mode == FIND_FAR
    wanted = jnp.uint32(PENDING) | (entry(chosen.duty, robot) & LABEL)
    pending = (words & (PENDING | LABEL)) == wanted[:, None]
    fits = jnp.where(wants_cell[:, None], pending, (words & OPEN) != 0)
    if tables.homes is not None:
        left = moves_left(tables, lanes, lane, robot)
        fits = jnp.where(wants_cell[:, None], fits, in_reach(tables, chosen.here, robot, words, fits, left))
    fits, found = _best(tables, chosen.here, fits)
    cell = _of_least_area(lanes, chosen, fits, ~wants_cell)
    label = low_half(entry(words, cell))
    # An area whose last cell somebody passed through is completed, but its cells still say OPEN: look again without it.
    stale = low_half(get(lanes, lanes.areas, lane, label)) == 0  # somebody has passed through the last of its cells
    takes, again = found & ~wants_cell & ~stale, found & ~wants_cell & stale
    # From here on no other lane state tells that the area is taken: its cells must say so.
    shut = (found & ~wants_cell)[:, None] & (low_half(words) == label[:, None])
    after = jnp.where(found, NEXT, jnp.where(mode == FIND_OR_SHARE, SHARE, lanes.rests))
    lanes = replace(
        lanes,
        cells=put_rows(lanes, lanes.cells, lane, jnp.where(shut, words & ~jnp.uint32(OPEN), words)),
        place=put(lanes, lanes.place, lane, robot, state_pack(chosen.here, cell), found & ~again),
        mode=spread(lanes.mode, chosen.slot, jnp.where(again, mode, after)),
    )
    return take_area(lanes, chosen, cell, label, takes, ~found & ~wants_cell)


def _best(tables: LaneTables, here: jax.Array, fits: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rule that picks where to go: of the cells that fit, bool `[S, A]`, the best, and whether there is one, `[S]`.

    The least (level, cost), as seen from the cells `here`: SPEC section 5, `Allocate Next Area`; of equal areas the one
    with the least id is then taken. The pending cells of one area are of one level.
    """
    cost = tables.cost[here]
    fits = fits & (cost < UNREACHABLE)
    for key in (jnp.broadcast_to(tables.level, cost.shape), cost):
        fits = fits & (key == jnp.where(fits, key, FAR).min(axis=1, keepdims=True))
    return fits, fits.any(axis=1)


def _of_least_area(lanes: Lanes, chosen: Chosen, fits: jax.Array, any_area: jax.Array) -> jax.Array:
    """Of the cells that fit, bool `[S, A]`, the lowest; where they may be of any area, of the one with the least id."""
    label = low_half(chosen.words)
    # Labels are cells, not ids: between areas of equal level and cost the ids decide, which is rare.
    lowest = jnp.where(fits, label, LABEL).min(axis=1)
    tie = any_area & (lowest < jnp.where(fits, label, -1).max(axis=1))

    def least() -> jax.Array:
        rows = lanes.ids.reshape(lanes.mode.shape[0], -1)[jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)]
        number = jnp.where(fits, jnp.take_along_axis(rows, label, axis=1), FAR)
        return jnp.where(tie[:, None], fits & (number == number.min(axis=1, keepdims=True)), fits)

    return first_cell(jax.lax.cond(tie.any(), least, lambda: fits))


def take_area(
    lanes: Lanes, chosen: Chosen, cell: jax.Array, label: jax.Array, takes: jax.Array, missed: jax.Array
) -> Lanes:
    """The area that was found is the robot's, who may stand in it; it has no hope for one if none was. `[S]` each."""
    batch, words = lanes.mode.shape[0], lanes.alive.shape[0]
    lane, robot = chosen.lane, chosen.robot
    at = jnp.minimum(lane, batch - 1)
    left = low_half(get(lanes, lanes.areas, lane, label))
    stands, bit, never = takes & (cell == chosen.here), bits_of(robot, words), jnp.zeros_like(takes)

    def switched(name: str, on: jax.Array, off: jax.Array) -> jax.Array:
        board = getattr(lanes, name)
        return spread(board, chosen.slot, switch(board[:, at], bit, on, off))

    number = get(lanes, lanes.ids, lane, label)
    lanes = replace(
        lanes,
        areas=put(lanes, lanes.areas, lane, label, state_pack(left, robot + 1), takes),
        waiting=spread(lanes.waiting, chosen.slot, lanes.waiting[at] - takes.astype(jnp.int32)),
        duty=put(lanes, lanes.duty, lane, robot, state_pack(label, left), takes),
        traveling=switched("traveling", takes & ~stands, stands),
        covering=switched("covering", stands, takes & ~stands),
        hopeful=switched("hopeful", never, takes | missed),
        done=switched("done", never, takes),
        mode=spread(lanes.mode, chosen.slot, jnp.where(stands, FIND_CELL, lanes.mode[at])),
        progress=spread(lanes.progress, chosen.slot, lanes.progress[at] | takes),
    )
    if lanes.log is None:
        return lanes

    def wide(values: jax.Array) -> jax.Array:
        return spread(jnp.zeros(batch, dtype=values.dtype), chosen.slot, values)

    return write_down(lanes, wide(takes), wide(robot), EventKind.ALLOCATED, wide(number), wide(cell))


# Areas as a rule sees them, and the first of them: fractions compared exactly, in numbers of 32 bits.
#
# Axis letters as in `mrac_jax.closed_loop.state`.

BITS, ONES = 16, 2**16 - 1
"""Trailing bits of a product that are a word of their own, and their largest value."""


class Candidate(NamedTuple):
    """Areas, by the fractions that the rule orders them by; arrays of one shape.

    Attributes:
        number: id, FAR for none. label: as in `mrac_jax.closed_loop.tables`. first, second: fractions.
    """

    number: Array
    label: Array
    first: tuple[Array, Array]
    second: tuple[Array, Array]


class First(NamedTuple):
    """The first area of each lane, `[S]`.

    Attributes:
        candidate: it, number FAR for none. found: there is one. cell: its target. dangerous: it is, or the way there.
    """

    candidate: Candidate
    found: jax.Array
    cell: jax.Array
    dangerous: jax.Array


def open_cells(words: jax.Array) -> jax.Array:
    """The unvisited cells of unassigned areas, bool `[S, A]` of cells' words."""
    return (words & (OPEN | PENDING)) == (OPEN | PENDING)


def first_area(
    tables: LaneTables,
    lanes: Lanes,
    chosen: Chosen,
    here: jax.Array,
    offered: jax.Array,
    refusing: jax.Array | bool = True,
    robot: jax.Array | None = None,
    limited: jax.Array | bool = True,
) -> First:
    """Of the areas of the unvisited cells offered, bool `[S, A]`, the first that a robot in `here` `[S]` can reach.

    refusing: bool `[S]`, areas that cost more than a robot is worth are not among them. robot: int32 `[S]`; None: those
    whose turn it is. limited: bool `[S]`, nor are areas that they cannot afford.
    """
    policy, batch = tables.policy, lanes.mode.shape[0]
    assert policy is not None
    label, at = low_half(chosen.words), jnp.minimum(chosen.lane, batch - 1)
    cost = jnp.where(offered, tables.cost[here], UNREACHABLE)
    # Everything about an area is gathered at its label, so areas need no table of their own.
    rows = jnp.broadcast_to(jnp.arange(len(label), dtype=jnp.int32)[:, None], label.shape)
    least = jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")  # at each label
    left = jnp.maximum(low_half(lanes.areas.reshape(batch, -1)[at]), 1)
    value = left
    if policy.value is not None:
        worth = jnp.where(offered, policy.value, 0)
        value = jnp.zeros_like(cost).at[rows, label].add(worth, mode="promise_in_bounds")
    offer = Offer(
        level=jnp.broadcast_to(tables.level, cost.shape),
        cost=least,
        unvisited=left,
        entry=jnp.broadcast_to(policy.entry, cost.shape),
        value=value,
        beyond=policy.beyond,
    )
    asked, can = offer, least < UNREACHABLE
    if tables.homes is not None:
        who, target = (chosen.robot if robot is None else robot)[:, None], targets(cost, label)
        left = moves_left(tables, lanes, chosen.lane, who[:, 0])[:, None]
        can = can & (affords(tables, here[:, None], who, target, left) | ~jnp.asarray(limited)[..., None])
        asked = offer._replace(cost=least + further(tables, here[:, None], who, target))
    refused = jax.lax.cond(
        policy.refuses,
        lambda: is_refused(asked, policy.cells, policy.theta, policy.scale),
        lambda: jnp.zeros_like(offered),
    )
    number = jnp.where(can & ~(refused & jnp.asarray(refusing)[..., None]), lanes.ids.reshape(batch, -1)[at], FAR)
    best = _first_of(tables, offer, number)
    cell = first_cell((label == best.label[:, None]) & (cost == entry(least, best.label)[:, None]))
    return First(best, best.number != FAR, cell, entry(is_dangerous(offer, policy.cells), best.label))


def _first_of(tables: LaneTables, offer: Offer, number: jax.Array) -> Candidate:
    """The first offer of each row by the rule, then by number, `[S]` of `[S, A]`; number: FAR where nothing is."""

    def wide(value: jax.Array | int) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(value, dtype=jnp.int32), number.shape)

    assert tables.policy is not None
    (first, second), label = tables.policy.order(offer), jnp.arange(number.shape[1], dtype=jnp.int32)
    # One reduction over all labels: an order of fractions is associative, and ids make it total.
    each = Candidate(number, wide(label), (wide(first[0]), wide(first[1])), (wide(second[0]), wide(second[1])))
    nought, one = jnp.int32(0), jnp.int32(1)
    nothing = Candidate(jnp.int32(FAR), nought, (nought, one), (nought, one))

    def earlier(mine: Candidate, theirs: Candidate) -> Candidate:
        ahead = is_before(tables, mine, theirs, mine.number < theirs.number)
        ahead = (theirs.number == FAR) | ((mine.number != FAR) & ahead)
        return jax.tree.map(lambda left, right: jnp.where(ahead, left, right), mine, theirs)

    best: Candidate = jax.lax.reduce(each, nothing, earlier, (1,))
    return best


def is_before(tables: LaneTables, one: Candidate, other: Candidate, tied: jax.Array | bool = False) -> jax.Array:
    """Whether the rule puts one area before the other; `tied`: where it sees no difference."""
    before, product = jnp.asarray(tied), _product
    if tables.policy is not None and tables.policy.value is not None:
        product = _wide_product
    for mine, theirs in ((one.second, other.second), (one.first, other.first)):
        left, right = product(mine[0], theirs[1]), product(theirs[0], mine[1])
        less = (left[0] < right[0]) | ((left[0] == right[0]) & (left[1] < right[1]))
        before = less | ((left[0] == right[0]) & (left[1] == right[1]) & before)
    return before


def _product(numerator: jax.Array, denominator: jax.Array) -> tuple[jax.Array, jax.Array]:
    """An int32 times a positive number below 2**16, exactly: the leading word, and the 16 trailing bits."""
    low = (numerator & ONES).astype(jnp.uint32) * denominator.astype(jnp.uint32)
    return (numerator >> BITS) * denominator + (low >> BITS).astype(jnp.int32), low & ONES


def _wide_product(numerator: jax.Array, denominator: jax.Array) -> tuple[jax.Array, jax.Array]:
    """An int32 times a positive number below 2**31, exactly: the leading word, and the trailing one, uint32."""
    low, high = (numerator & ONES).astype(jnp.uint32), numerator >> BITS
    under, over = denominator & ONES, denominator >> BITS
    least = low * under.astype(jnp.uint32)
    mixed = low * over.astype(jnp.uint32), high * under  # the second one signed, |high| at most 2**15
    middle = (mixed[0] & ONES) + (mixed[1] & ONES).astype(jnp.uint32) + (least >> BITS)
    leading = high * over + (mixed[0] >> BITS).astype(jnp.int32) + (mixed[1] >> BITS)
    return leading + (middle >> BITS).astype(jnp.int32), (middle << BITS) | (least & ONES)


# The limits on a team (`planner.policies.limits`) in the lanes: who has to wait, and what is not worth the risk.
#
# Axis letters as in `mrac_jax.closed_loop.state`.


def bits_at(words: jax.Array, robot: jax.Array) -> jax.Array:
    """Whether each robot's bit is set, bool `[S]`, of uint32 `[W, S]` and int32 `[S]`."""
    word, bit = word_and_bit(robot)
    return (jnp.take_along_axis(words, word[None], axis=0)[0] & bit) != 0


def hold(lanes: Lanes, chosen: Chosen, on: jax.Array, off: jax.Array) -> jax.Array:
    """`lanes.held` with the robots held from now on, or no longer, bool `[S]`."""
    assert lanes.held is not None
    held = lanes.held[:, jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)]
    return spread(lanes.held, chosen.slot, switch(held, bits_of(chosen.robot, len(held)), on, off))


def is_full(tables: LaneTables, lanes: Lanes, at: jax.Array, robot: jax.Array) -> jax.Array:
    """Whether as many robots besides this one as may be are at risk in the lanes `at`; int32 and bool `[S]`."""
    policy, risky = tables.policy, at_risk(tables, lanes, at)
    assert policy is not None
    others = risky & (jnp.arange(risky.shape[1], dtype=jnp.int32) != robot[:, None])
    alive = jax.lax.population_count(lanes.unharmed[:, at]).sum(axis=0, dtype=jnp.uint32).astype(jnp.int32)
    return policy.holds & (others.sum(axis=1, dtype=jnp.int32) >= policy.most[alive])


def at_risk(tables: LaneTables, lanes: Lanes, at: jax.Array) -> jax.Array:
    """Which robots are at risk in the lanes `at`, bool `[S, K]`.

    One dangerous cell on the way to a target costs more than every safe one.
    """
    policy, batch = tables.policy, lanes.mode.shape[0]
    assert policy is not None
    place, area = lanes.place.reshape(batch, -1)[at], low_half(lanes.duty.reshape(batch, -1)[at])
    robots = jnp.arange(place.shape[1], dtype=jnp.int32)
    word, bit = word_and_bit(robots)
    moves = (((lanes.traveling | lanes.covering)[:, at][word] & bit[:, None]) != 0).T  # [S, K]
    dangerous = (tables.cost[low_half(place), high_half(place)] >= policy.cells) | (tables.level[area] > 0)
    risky, homes = moves & dangerous, tables.homes
    if homes is None or lanes.returning is None:
        return risky
    returns = ((lanes.returning[:, at][word] & bit[:, None]) != 0).T
    return risky | (returns & (read(homes.cost, homes.of * homes.size + low_half(place)) >= policy.cells))


def asking(tables: LaneTables, lanes: Lanes) -> jax.Array:
    """Those held who ask again, uint32 `[W, B]`: nobody where the team is full and nothing safe is left to do."""
    assert tables.policy is not None and lanes.held is not None and lanes.safe_left is not None
    held, nothing = lanes.held, lanes.safe_left == 0
    if lanes.ready is not None:  # who is held may be charged
        return held

    def some() -> jax.Array:
        every = jnp.arange(len(nothing), dtype=jnp.int32)
        vain = nothing & is_full(tables, lanes, every, jnp.full_like(every, NO_ROBOT))
        return jnp.where(vain, jnp.uint32(0), held)

    return jax.lax.cond((nothing & (held != 0)).any(), some, lambda: held)


def has_to_wait(tables: LaneTables, lanes: Lanes, chosen: Chosen, mine: First, asks: jax.Array) -> jax.Array:
    """Whether the robots that ask, bool `[S]`, are held from the area that they would be allocated (`reserve`)."""
    policy = tables.policy
    assert policy is not None
    asks = asks & policy.holds & mine.found & mine.dangerous

    def wait() -> jax.Array:
        full = is_full(tables, lanes, jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1), chosen.robot)
        return asks & (full | _is_another_s(tables, lanes, chosen, mine, asks & ~full))

    return jax.lax.cond(asks.any(), wait, lambda: asks)


def _is_another_s(tables: LaneTables, lanes: Lanes, chosen: Chosen, mine: First, asks: jax.Array) -> jax.Array:
    """Whether another robot without an area, or where robots break off one not at risk, would get its own first one
    before, `[S]`.
    """
    batch, policy = lanes.mode.shape[0], tables.policy
    assert policy is not None
    at = jnp.minimum(chosen.lane, batch - 1)
    busy = jnp.zeros_like(lanes.alive) if policy.breaks_off else lanes.traveling | lanes.covering
    at_rest, risky = (lanes.alive & ~busy)[:, at], at_risk(tables, lanes, at) if policy.breaks_off else None
    place, offered = low_half(lanes.place.reshape(batch, -1)[at]), open_cells(chosen.words)

    def also(robot: jax.Array, before: jax.Array) -> jax.Array:
        # Robot by robot, since nearly always none other is at rest and the branch is not taken.
        could = asks & (robot != chosen.robot) & bits_at(at_rest, jnp.full_like(chosen.robot, robot))
        could = could if risky is None else could & ~risky[:, robot]

        def compare() -> jax.Array:
            theirs = first_area(
                tables, lanes, chosen, place[:, robot], offered, robot=jnp.full_like(chosen.robot, robot)
            )
            return could & theirs.found & is_before(tables, theirs.candidate, mine.candidate)

        return before | jax.lax.cond(could.any(), compare, lambda: jnp.zeros_like(could))

    return jax.lax.fori_loop(0, place.shape[1], also, jnp.zeros_like(asks))


def judge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """A run without progress is not worth the risk if a live robot can reach an unassigned area."""
    waits = lanes.mode == JUDGE
    return jax.lax.cond(waits.any(), lambda now: _judge(tables, now, width), lambda now: now, lanes)


def _judge(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    batch = lanes.mode.shape[0]
    chosen = choose(lanes, lanes.mode == JUDGE, width)
    at = jnp.minimum(chosen.lane, batch - 1)
    place, offered = low_half(lanes.place.reshape(batch, -1)[at]), open_cells(chosen.words)

    def also(robot: jax.Array, could: jax.Array) -> jax.Array:
        who = jnp.full_like(chosen.robot, robot)
        if tables.homes is None:
            reached = (offered & (tables.cost[place[:, robot]] < UNREACHABLE)).any(axis=1)
        else:
            left = moves_left(tables, lanes, chosen.lane, who)
            reached = in_reach(tables, place[:, robot], who, chosen.words, offered, left).any(axis=1)
        return could | (reached & bits_at(lanes.alive[:, at], who))

    could = jax.lax.fori_loop(0, place.shape[1], also, jnp.zeros(len(at), dtype=jnp.bool_))
    outcome = jnp.where(could, jnp.int32(Outcome.NOT_WORTH_THE_RISK), lanes.outcome[at])
    return replace(
        lanes,
        outcome=spread(lanes.outcome, chosen.slot, outcome),
        mode=jnp.where(chosen.slot < width, END if tables.homes is None else NEXT, lanes.mode),
    )


def notice(
    tables: LaneTables,
    lanes: Lanes,
    moves: jax.Array,
    traveling: jax.Array,
    area: jax.Array,
    target: jax.Array,
    ahead: jax.Array,
) -> jax.Array:
    """What each lane's robot does before it moves, a mode, int32 `[B]`: ACT where there is nothing to notice.

    moves: bool, there is a robot about to move; area, target, ahead: its area, the cells it is going to and enters.
    """
    assert tables.policy is not None and lanes.looked is not None
    row = lane_rows(lanes.cells, lanes.mode.shape[0])
    gone = (read(lanes.cells, row + target) & VISITED) != 0
    # From the least to the most important of what may be noticed: a later line overrides.
    mode = jnp.where(gone, jnp.where(traveling, RETARGET, FIND_CELL), ACT)
    if tables.policy.looks_again:
        others = (lanes.waiting > 0) | tables.policy.refuses
        if tables.policy.breaks_off:
            traveling, others = jnp.ones_like(traveling), others | tables.policy.holds
        if lanes.returning is not None:  # its own may be more than it can afford by now
            others = jnp.ones_like(others)
        wary = traveling & others & (read(tables.level, ahead) > 0)
        mode = jnp.where(wary, LOOK_AGAIN, mode)
    done = low_half(read(lanes.areas, row + area)) == 0
    mode = jnp.where(done, jnp.where(lanes.waiting > 0, FIND_OR_SHARE, SHARE), mode)
    return jnp.where(moves & (lanes.step > 0) & ~lanes.looked, mode, ACT)


def attentive_find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """The next area, target, or far cell of a coverage path, in up to `width` lanes that search one."""
    return jax.lax.cond(
        _attentive_seeks(lanes).any(), lambda now: _attentive_find(tables, now, width), lambda now: now, lanes
    )


def _attentive_seeks(lanes: Lanes) -> jax.Array:
    wanted = lanes.mode == FIND_FAR
    for mode in (FIND_AREA, FIND_OR_SHARE, RETARGET, LOOK_AGAIN):
        wanted = wanted | (lanes.mode == mode)
    return wanted


def _attentive_find(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    assert lanes.held is not None
    chosen = choose(lanes, _attentive_seeks(lanes), width)
    lane, robot, words = chosen.lane, chosen.robot, chosen.words
    at = jnp.minimum(lane, lanes.mode.shape[0] - 1)
    mode, own = lanes.mode[at], low_half(entry(chosen.duty, robot))
    goal = high_half(get(lanes, lanes.place, lane, robot))
    looks, stays = mode == LOOK_AGAIN, (mode == FIND_FAR) | (mode == RETARGET)
    mine = low_half(words) == own[:, None]
    unvisited = mine & ((words & PENDING) != 0)
    offered = (unvisited & (looks | stays)[:, None]) | (open_cells(words) & ~stays[:, None])
    first = first_area(tables, lanes, chosen, chosen.here, offered, ~stays, limited=~stays)
    label, held = first.candidate.label, bits_at(lanes.held[:, at], robot)
    breaks_off = tables.policy is not None and tables.policy.breaks_off
    waits = has_to_wait(tables, lanes, chosen, first, ~stays if breaks_off else ~(stays | looks))
    found = first.found & ~waits
    keeps = found & (looks | stays) & (label == own)
    takes, frees = found & ~keeps, looks & ~keeps
    # Who keeps its area keeps its target until somebody visits it, also if another cell is cheaper by now.
    fresh = (entry(words, goal) & VISITED) == 0
    covers = bits_at(lanes.covering[:, at], robot) & looks & keeps
    keeps_goal = keeps & looks & (fresh | covers)
    after = jnp.where(covers & ~fresh, FIND_CELL, lanes.found_next(at))
    lanes = _release(tables, lanes, chosen, own, frees)
    words = jnp.where(mine & frees[:, None], words | OPEN, words)
    shut = takes[:, None] & (low_half(words) == label[:, None])
    rests = (mode == FIND_AREA) & ~(waits | held)
    lanes = replace(
        lanes,
        cells=put_rows(lanes, lanes.cells, lane, jnp.where(shut, words & ~jnp.uint32(OPEN), words)),
        place=put(lanes, lanes.place, lane, robot, state_pack(chosen.here, first.cell), found & ~keeps_goal),
        held=hold(lanes, chosen, waits, takes),
        mode=spread(lanes.mode, chosen.slot, jnp.where(found, after, jnp.where(rests, lanes.rests, SHARE))),
    )
    return take_area(lanes, chosen, first.cell, label, takes, ~first.found)


def _release(tables: LaneTables, lanes: Lanes, chosen: Chosen, own: jax.Array, frees: jax.Array) -> Lanes:
    """The robots' areas are nobody's again, `[S]`; who is without one has hope."""
    batch, lane = lanes.mode.shape[0], chosen.lane
    at = jnp.minimum(lane, batch - 1)
    if lanes.log is not None:
        ahead = read(tables.hop, chosen.here * tables.size + high_half(get(lanes, lanes.place, lane, chosen.robot)))
        number = get(lanes, lanes.ids, lane, own)
        told = [spread(jnp.zeros_like(lanes.robot), chosen.slot, one) for one in (number, ahead.astype(jnp.int32))]
        happened = spread(jnp.zeros(batch, dtype=jnp.bool_), chosen.slot, frees)
        lanes = write_down(lanes, happened, lanes.robot, EventKind.LOOKED_AGAIN, *told)
    at_rest = lanes.alive[:, at] & ~(lanes.traveling | lanes.covering)[:, at]
    left = low_half(get(lanes, lanes.areas, lane, own)).astype(jnp.uint32)
    return replace(
        lanes,
        areas=put(lanes, lanes.areas, lane, own, left, frees),
        waiting=spread(lanes.waiting, chosen.slot, lanes.waiting[at] + frees.astype(jnp.int32)),
        hopeful=spread(lanes.hopeful, chosen.slot, jnp.where(frees, at_rest, lanes.hopeful[:, at])),
    )
