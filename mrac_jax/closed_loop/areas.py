"""The closed loop's dear part: areas that fall apart, are bisected and shared. For a few lanes of the batch at a time.

Axis letters: `S` lanes chosen; the others as in `mrac_jax.closed_loop.state`. Boards: see
`mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from mrac_jax.closed_loop import state as boards
from mrac_jax.closed_loop.rules import (
    FAR,
    Chosen,
    bits_at,
    choose,
    entry,
    first_area,
    first_cell,
    hold,
    is_full,
    open_cells,
)
from mrac_jax.closed_loop.state import (
    ACT,
    LOST,
    NEXT,
    SHARE,
    Lanes,
    affords,
    bits_of,
    further,
    get,
    high_half,
    low_half,
    moves_left,
    put,
    put_rows,
    read,
    spread,
    state_pack,
    write_down,
)
from mrac_jax.closed_loop.tables import LABEL, OPEN, UNREACHABLE, VISITED, LaneTables
from planner.simulator.codes import EventKind
from planner.simulator.offers import Offer, is_dangerous, is_refused


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class _Part:
    """Who gets a part of a shared area, int32 `[S]`: robot, part (its label), and cell that it travels to."""

    robot: jax.Array
    label: jax.Array
    cell: jax.Array


@dataclass(frozen=True)
class _Deal:
    """What becomes of the chosen lanes' areas.

    Attributes:
        words: uint32 `[S, A]`, their cells. inside: bool `[S, A]`, the cells in new areas.
        shared, bisected: bool `[S]`. made: int32 `[S]`, new areas. parts: the owner's and the helper's where shared.
        more: bool `[S]`, another area is left to be dealt with; None: never.
    """

    words: jax.Array
    inside: jax.Array
    shared: jax.Array
    bisected: jax.Array
    made: jax.Array
    parts: tuple[_Part, _Part]
    more: jax.Array | None


def settle(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """`Reallocate Area` and `Find Area To Share` (SPEC section 5) in up to `width` of the lanes that wait for it."""
    wants = (lanes.mode == LOST) | (lanes.mode == SHARE)
    return jax.lax.cond(wants.any(), lambda now: _settle(tables, now, width), lambda now: now, lanes)


def _settle(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    chosen = choose(lanes, (lanes.mode == LOST) | (lanes.mode == SHARE), width)
    none, some_share = jnp.int32(tables.none), chosen.shares.any()
    mine, more = low_half(entry(chosen.duty, chosen.robot)), None
    if tables.paths is not None:
        mine, more = _first_left(lanes, chosen)
    # Where nobody among the chosen shares, which is usual early in a run, its three searches are skipped.
    area, waits = jax.lax.cond(
        some_share,
        lambda: _area_to_share(tables, lanes, chosen),
        lambda: (mine, None if tables.policy is None else mine < 0),
    )
    area = jnp.where(chosen.shares, area, mine)
    shared = chosen.shares & (area != none)
    if waits is not None:
        lanes = replace(lanes, held=hold(lanes, chosen, chosen.shares & waits, shared))
    number, record = get(lanes, lanes.ids, chosen.lane, area), get(lanes, lanes.areas, chosen.lane, area)
    belongs = (chosen.words & LABEL) == jnp.where(area == none, LABEL, area).astype(jnp.uint32)[:, None]
    inside = belongs & ((chosen.words & VISITED) == 0)
    unvisited = boards.boards_pack(inside, tables.cell_at)
    halves = jax.lax.cond(
        some_share, lambda: _bisected(tables, unvisited, shared), lambda: (jnp.zeros_like(unvisited),) * 2
    )
    bisected = boards.some(halves[0])
    # The old area keeps its visited cells under no label, so that nothing finds it any more.
    lanes = replace(lanes, areas=put(lanes, lanes.areas, chosen.lane, area, jnp.zeros_like(record), area != none))
    words = jnp.where(belongs, _labelled(chosen.words, none), chosen.words)
    first = jnp.where(bisected, halves[0], unvisited)
    lanes, words, made = _new_areas(tables, lanes, chosen.lane, words, first, halves[1])
    owner = high_half(record) - 1
    parts = jax.lax.cond(
        some_share, lambda: _two_parts(tables, lanes, chosen, words, inside, owner), lambda: _no_parts(chosen.robot)
    )
    deal = _Deal(words, inside, shared, bisected, made, parts, more)
    lanes = _note(lanes, chosen, ~chosen.shares & (made > 0), chosen.robot, EventKind.REALLOCATED, number, made)
    lanes = _note(lanes, chosen, shared, chosen.robot, EventKind.SHARED, number, made)
    for part in parts:
        lanes = _hand_out(lanes, chosen, part, shared)
    lanes = _log_cells(_put_back(tables, lanes, chosen, deal), chosen, deal)
    return _refused(tables, lanes, chosen, chosen.shares & ~shared)


def _first_left(lanes: Lanes, chosen: Chosen) -> tuple[jax.Array, jax.Array]:
    """Of the areas that lost robots leave unfinished the one with the least id, int32 `[S]`, "none" if there is none;
    and whether there are more, bool `[S]`: who follows the path of another planner has one a level.
    """
    batch = lanes.mode.shape[0]
    at = jnp.minimum(chosen.lane, batch - 1)
    records, ids = (flat.reshape(batch, -1)[at] for flat in (lanes.areas, lanes.ids))
    left = (high_half(records) == chosen.robot[:, None] + 1) & (low_half(records) > 0)
    number = jnp.where(left, ids, FAR)
    first = first_cell(left & (number == number.min(axis=1, keepdims=True)))
    return first, ~chosen.shares & (left.sum(axis=1, dtype=jnp.int32) > 1)


def _labelled(words: jax.Array, label: jax.Array) -> jax.Array:
    """Cells' words with another area's label."""
    return (words & ~jnp.uint32(LABEL)) | label.astype(jnp.uint32)


def _bisected(tables: LaneTables, unvisited: jax.Array, shared: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The halves of the unvisited cells where they are shared and in one piece; nothing elsewhere. Boards."""
    first = boards.first_component(unvisited, tables.stride)
    whole = jnp.where(shared & ((unvisited & ~first) == 0).all(axis=0), unvisited, jnp.uint32(0))
    return boards.bisect(whole, tables.stride)


def _new_areas(
    tables: LaneTables, lanes: Lanes, lane: jax.Array, words: jax.Array, first: jax.Array, then: jax.Array
) -> tuple[Lanes, jax.Array, jax.Array]:
    """The components of the first board, then those of the second, become unassigned areas with the next ids.

    Returns the lanes with the areas' words and ids, the cells' words `[S, A]`, and the number of areas made `[S]`.
    """
    State = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]

    def make(state: State) -> State:
        rest, then, words, areas, ids, parts = state
        # Components of the first half get lower ids than those of the second.
        through = ~boards.some(rest)
        rest, then = jnp.where(through, then, rest), jnp.where(through, jnp.uint32(0), then)
        part = boards.first_component(rest, tables.stride)
        made, label = boards.some(part), boards.lowest_cell(part, tables.cell_at)
        number = get(lanes, lanes.made, lane, jnp.int32(0)) + parts
        return (
            rest & ~part,
            then,
            jnp.where(boards.unpack(part, tables.spot), _labelled(words, label[:, None]) | jnp.uint32(OPEN), words),
            put(lanes, areas, lane, label, boards.size(part).astype(jnp.uint32), made),
            put(lanes, ids, lane, label, number, made),
            parts + made.astype(jnp.int32),
        )

    start = (first, then, words, lanes.areas, lanes.ids, jnp.zeros_like(lane))
    end = jax.lax.while_loop(lambda state: ((state[0] | state[1]) != 0).any(), make, start)
    return replace(lanes, areas=end[3], ids=end[4]), end[2], end[5]


def _area_to_share(tables: LaneTables, lanes: Lanes, chosen: Chosen) -> tuple[jax.Array, jax.Array | None]:
    """The area that each helper shares, `[S]`: of those near enough the least (level, cost, id); "none" if none is.

    And who is held from it by `reserve`, bool `[S]`; None by the paper's rule.
    """
    batch = lanes.mode.shape[0]
    movers = (lanes.traveling | lanes.covering)[:, jnp.minimum(chosen.lane, batch - 1)]
    cost_here, labels = tables.cost[chosen.here], low_half(chosen.words)
    goals = True if tables.policy is None else (chosen.words & VISITED) == 0

    def reach(robot: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array | None]:
        """For one robot's area: the helper's cost and cheapest cell, it, its unvisited cells, their value, `[S]`."""
        area = low_half(chosen.duty[:, robot])
        word, bit = boards.word_and_bit(robot)
        moves = movers[word] & bit
        record = get(lanes, lanes.areas, chosen.lane, area)
        can = (moves != 0) & (robot != chosen.robot) & (high_half(record) == robot + 1) & (low_half(record) >= 2)
        inside = goals & (labels == area[:, None])
        cost = jnp.where(inside, cost_here, UNREACHABLE)
        cheapest = cost.min(axis=1)
        value = None if valued is None else jnp.where(inside, valued, 0).sum(axis=1, dtype=jnp.int32)
        first = first_cell(cost == cheapest[:, None])
        return jnp.where(can, cheapest, UNREACHABLE), first, area, low_half(record), value

    valued = None if tables.policy is None else tables.policy.value
    cost, cell, area, left, value = jax.lax.map(reach, jnp.arange(chosen.duty.shape[1], dtype=jnp.int32))
    # `steps <= unvisited cells`: the way is walked hop by hop, in all lanes at once, until each is there or cannot be.
    cost = jnp.where(_within(tables, jnp.broadcast_to(chosen.here, cell.shape), cell, left), cost, UNREACHABLE)
    possible, policy, level = cost < UNREACHABLE, tables.policy, read(tables.level, area)
    asked = None
    if tables.homes is not None:
        left_to_go = moves_left(tables, lanes, chosen.lane, chosen.robot)
        possible = possible & affords(tables, chosen.here, chosen.robot, cell, left_to_go)
        asked = cost + further(tables, chosen.here, chosen.robot, cell)
    if policy is not None:
        left = jnp.maximum(left, 1)
        offer = Offer(level, cost, left, policy.entry[area], left if value is None else value, policy.beyond)
        dear = offer if asked is None else offer._replace(cost=asked)
        possible = possible & ~(policy.refuses & is_refused(dear, policy.cells, policy.theta, policy.scale))
    number = jax.vmap(partial(get, lanes, lanes.ids, chosen.lane))(area)
    # Least by (level, cost, id): one key after the other thins out what is left.
    for key in (level, cost, number):
        possible = possible & (key == jnp.where(possible, key, FAR).min(axis=0))
    best = jnp.where(possible, area, tables.none).min(axis=0)
    if policy is None or lanes.held is None:
        return best, None
    at = jnp.minimum(chosen.lane, batch - 1)
    held = bits_at(lanes.held[:, at], chosen.robot) | is_full(tables, lanes, at, chosen.robot)
    waits = (possible & is_dangerous(offer, policy.cells)).any(axis=0) & held
    return jnp.where(waits, tables.none, best), waits


def _within(tables: LaneTables, here: jax.Array, cell: jax.Array, moves: jax.Array) -> jax.Array:
    """Whether the safest path from here to the cell has at most so many moves; int32 and bool `[K, S]`."""

    def step(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        at, left = state
        goes = (at != cell) & (left > 0)
        return jnp.where(goes, read(tables.hop, at * tables.size + cell).astype(jnp.int32), at), left - goes

    at, _ = jax.lax.while_loop(lambda state: ((state[0] != cell) & (state[1] > 0)).any(), step, (here, moves))
    return at == cell


def _two_parts(
    tables: LaneTables, lanes: Lanes, chosen: Chosen, words: jax.Array, inside: jax.Array, owner: jax.Array
) -> tuple[_Part, _Part]:
    """Different parts for owner and helper at least total cost; ties: the owner's lower part, then the helper's."""
    label = low_half(words)
    own = jnp.arange(tables.size, dtype=jnp.int32)
    rows = jnp.broadcast_to(jnp.arange(label.shape[0], dtype=jnp.int32)[:, None], label.shape)

    def costs(cell: jax.Array) -> tuple[jax.Array, jax.Array]:
        """From the cell to every unvisited cell, and to every part at its label; `[S, A]`."""
        cost = jnp.where(inside, tables.cost[cell], UNREACHABLE)
        return cost, jnp.full_like(cost, UNREACHABLE).at[rows, label].min(cost, mode="promise_in_bounds")

    owner = jnp.maximum(owner, 0)
    owners, to_owners = costs(low_half(get(lanes, lanes.place, chosen.lane, owner)))
    helpers, to_helpers = costs(chosen.here)
    least = to_helpers.min(axis=1, keepdims=True)
    best = first_cell(to_helpers == least)
    # The helper's best part, and its best one besides: with these two every part of the owner's has its least total.
    others = jnp.where(own == best[:, None], UNREACHABLE, to_helpers)
    least_other = others.min(axis=1, keepdims=True)
    total = to_owners + jnp.where(own == best[:, None], least_other, least)
    total = jnp.where(inside & (label == own), total, FAR)
    owners_part = first_cell(total == total.min(axis=1, keepdims=True))
    helpers_part = jnp.where(owners_part == best, first_cell(others == least_other), best)

    def cell_of(part: jax.Array, cost: jax.Array, to_parts: jax.Array) -> jax.Array:
        return first_cell(inside & (label == part[:, None]) & (cost == entry(to_parts, part)[:, None]))

    return (
        _Part(owner, owners_part, cell_of(owners_part, owners, to_owners)),
        _Part(chosen.robot, helpers_part, cell_of(helpers_part, helpers, to_helpers)),
    )


def _no_parts(robot: jax.Array) -> tuple[_Part, _Part]:
    nobody = _Part(*(jnp.zeros_like(robot),) * 3)
    return nobody, nobody


def _hand_out(lanes: Lanes, chosen: Chosen, part: _Part, shared: jax.Array) -> Lanes:
    """A part is its robot's where the area is shared, bool `[S]`, and it is on its way there."""
    lane, robot, label = chosen.lane, part.robot, part.label
    here, left = low_half(get(lanes, lanes.place, lane, robot)), get(lanes, lanes.areas, lane, label)
    lanes = replace(
        lanes,
        place=put(lanes, lanes.place, lane, robot, state_pack(here, part.cell), shared),
        duty=put(lanes, lanes.duty, lane, robot, label.astype(jnp.uint32), shared),
        areas=put(lanes, lanes.areas, lane, label, state_pack(left, robot + 1), shared),
    )
    return _note(lanes, chosen, shared, robot, EventKind.ALLOCATED, get(lanes, lanes.ids, lane, label), part.cell)


def _put_back(tables: LaneTables, lanes: Lanes, chosen: Chosen, deal: _Deal) -> Lanes:
    """The chosen lanes' cells in their place; robots that share set out, others that wanted to are done."""
    batch, robot_words, lane = lanes.mode.shape[0], lanes.alive.shape[0], chosen.lane
    shared, made, label, (owner, helper) = deal.shared, deal.made, low_half(deal.words), deal.parts
    given = ((label == owner.label[:, None]) | (label == helper.label[:, None])) & shared[:, None]
    no_area = jnp.full_like(lane, tables.none).astype(jnp.uint32)
    at = jnp.minimum(lane, batch - 1)
    nobody = jnp.uint32(0)

    def back(field: jax.Array, values: jax.Array) -> jax.Array:
        return spread(field, chosen.slot, values)

    sharers = jnp.where(shared, bits_of(owner.robot, robot_words) | bits_of(helper.robot, robot_words), nobody)
    gives_up = jnp.where(chosen.shares & ~shared, bits_of(chosen.robot, robot_words), nobody)
    traveling = (lanes.traveling[:, at] | sharers) & ~gives_up
    covering = lanes.covering[:, at] & ~(sharers | gives_up)
    done = lanes.done[:, at] | gives_up
    if tables.policy is not None:  # who is held may be done, and share
        done = done & ~sharers
    at_rest = lanes.alive[:, at] & ~(traveling | covering)
    mode = jnp.where(shared, lanes.found_next(at), NEXT if deal.more is None else jnp.where(deal.more, LOST, NEXT))
    if lanes.ready is not None:
        mode = jnp.where(chosen.shares & ~shared, lanes.rests, mode)
    if lanes.returning is not None:  # who has turned makes its first move home
        mode = jnp.where(~shared & bits_at(lanes.returning[:, at], chosen.robot), ACT, mode)
    return replace(
        lanes,
        cells=put_rows(lanes, lanes.cells, lane, jnp.where(given, deal.words & ~jnp.uint32(OPEN), deal.words)),
        duty=put(lanes, lanes.duty, lane, chosen.robot, no_area, ~shared),
        traveling=back(lanes.traveling, traveling),
        covering=back(lanes.covering, covering),
        hopeful=back(lanes.hopeful, jnp.where(made > 0, at_rest, lanes.hopeful[:, at])),
        done=back(lanes.done, done),
        waiting=back(lanes.waiting, lanes.waiting[at] + made - 2 * shared),
        made=back(lanes.made, lanes.made[at] + made),
        bisected=back(lanes.bisected, lanes.bisected[at] + deal.bisected.astype(jnp.int32)),
        divided=back(lanes.divided, lanes.divided[at] + (shared & ~deal.bisected).astype(jnp.int32)),
        mode=back(lanes.mode, mode),
        progress=back(lanes.progress, lanes.progress[at] | shared),
    )


def _note(
    lanes: Lanes,
    chosen: Chosen,
    happened: jax.Array,
    robot: jax.Array,
    kind: EventKind,
    area: jax.Array,
    other: jax.Array,
) -> Lanes:
    """The event in the log of the chosen lanes where it happened, all `[S]`; nothing if none is kept."""
    if lanes.log is None:
        return lanes

    def wide(values: jax.Array) -> jax.Array:
        return spread(jnp.zeros(lanes.mode.shape, dtype=values.dtype), chosen.slot, values)

    return write_down(lanes, wide(happened), wide(robot), kind, wide(area), wide(other))


def _log_cells(lanes: Lanes, chosen: Chosen, deal: _Deal) -> Lanes:
    """The ids of the areas that the cells are in now, in the lanes' log; nothing if none is kept."""
    if lanes.log is None:
        return lanes
    batch, before = lanes.mode.shape[0], lanes.log.cell_ids.reshape(lanes.mode.shape[0], -1)
    at = jnp.minimum(chosen.lane, batch - 1)
    ids = jnp.take_along_axis(lanes.ids.reshape(batch, -1)[at], low_half(deal.words), axis=1)
    after = before.at[chosen.lane].set(jnp.where(deal.inside, ids, before[at]), mode="drop")
    return replace(lanes, log=replace(lanes.log, cell_ids=after.reshape(-1)))


def _refused(tables: LaneTables, lanes: Lanes, chosen: Chosen, rests: jax.Array) -> Lanes:
    """`worth`: what the robots that are done now, bool `[S]`, refused, in the lanes' log; nothing if none is kept."""
    if lanes.log is None or tables.policy is None or lanes.held is None:
        return lanes
    first = first_area(tables, lanes, chosen, chosen.here, open_cells(chosen.words), refusing=False)
    held = bits_at(lanes.held[:, jnp.minimum(chosen.lane, lanes.mode.shape[0] - 1)], chosen.robot)
    happened = rests & first.found & ~held & tables.policy.refuses
    return _note(lanes, chosen, happened, chosen.robot, EventKind.REFUSED, first.candidate.number, first.cell)
