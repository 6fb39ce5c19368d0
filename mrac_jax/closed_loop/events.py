"""The closed loop event by event: a lane jumps from one decision of a robot to the next.

The next event is the least (step, robot) at which a walk ends. There are no moves and no searches: the next walk of a
robot is looked up. A lane waits if a set is not in the book. Letters as in `mrac_jax.closed_loop.lanes`.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp

from mrac_jax.arrays import is_reached, less
from mrac_jax.closed_loop import lanes as ln
from mrac_jax.closed_loop.book import BISECTED, HOMEWARD, LENGTH, NEVER, PARTS, PIECE, SPLIT
from mrac_jax.closed_loop.decisions import (
    all_return,
    depart,
    end_walks,
    find_to_share,
    is_within_range,
    moves_home,
    of_bases,
    owner_sets_out,
)
from mrac_jax.closed_loop.lanes import Book, Ended, Lanes, Log, at, entered, hold, look_up, one_cell, pick
from planner.simulator.codes import Outcome


def next_event(book: Book, lanes: Lanes, log: Log | None) -> tuple[Lanes, Log | None]:
    """The next event of every lane that runs."""
    (K, G), flat = (lanes.key.shape[1], lanes.slots.shape[1]), book.cost.shape[1]
    robots = jnp.arange(K, dtype=jnp.int32)
    homes, stride = book.homes, ln.stride_of(book, lanes)
    runs, key = (lanes.mode == ln.RUN) & (lanes.fuel > 0), lanes.key.min(axis=1)
    if homes is not None:
        lanes = all_return(book, lanes, runs, key)
        key = lanes.key.min(axis=1)
    none, step, who = key == NEVER, key // stride, key % stride % K
    due = key % stride >= K  # at the end of the step
    late = step > book.max_steps
    step = jnp.where(late, book.max_steps, step)
    mine = robots == who[:, None]
    # Robots that act later in this step have not moved in it.
    behind = (robots > who[:, None]) & ~(late | due)[:, None]
    offset, row = ln.moves_by(lanes, step[:, None] - behind), lanes.robots[:, :, ln.ROW]
    now = hold(lanes.visited | entered(book, row + offset))
    me, left = hold((pick(lanes.robots, who), pick(lanes.left, who)))
    doing, fate, piece = me[:, ln.DOING], me[:, ln.FATE], jnp.maximum(me[:, ln.AREA], 0)
    row_end = pick(row, who) + me[:, ln.LAST]
    here = me[:, ln.HERE]
    if homes is not None:  # a robot that turns back is not at the end of its walk
        here = hold(jnp.where(me[:, ln.WALK] > 0, at(book.cell_at, row_end), here))
    ends = late | none
    if homes is None:
        ends = ends | (now == book.every).all(axis=1)
    dies, leaves = fate == ln.DIES, fate != ln.ARRIVES
    alive = (lanes.robots[:, :, ln.DOING] != ln.DEAD).sum(axis=1, dtype=jnp.int32) - dies
    todo = hold(at(book.bits, piece) & ~now)
    owns = (me[:, ln.AREA] >= 0) & ((doing != ln.FOLLOW) | dies)
    rest = (todo != 0).any(axis=1) & owns
    splits = leaves & rest & (alive > 0)
    again = (doing == ln.FOLLOW) & dies & (at(book.next_of, piece) >= 0) & (me[:, ln.AREA] >= 0) & (alive > 0)
    covers, starts = ~leaves & (doing == ln.TRAVEL) & rest, ~leaves & (doing == ln.START)
    returns = (doing == ln.RETURN) | (doing == ln.RECALL)
    wants = ~leaves & ~covers & ~starts & ~returns & ~due & (doing != ln.LAND)
    # Waiting and recharging robots store moves left; others store the step at which these end.
    until = me[:, ln.UNTIL] + jnp.where(doing == ln.IDLE, step, 0)
    if homes is not None:
        until = jnp.where(doing == ln.CHARGE, step + at(homes.range, who), until)

    # The unassigned area of least (level, cost, id): slots are in order of id.
    place = jnp.maximum(lanes.slots, 0) * flat + here[:, None]
    costs = jnp.where(lanes.slots >= 0, at(book.cost.reshape(-1), place), NEVER)
    afford, too_far = until - step, jnp.zeros_like(due)
    if homes is not None:
        afford = jnp.minimum(until, homes.last) - step
        every, costs = costs, jnp.where(is_within_range(book, place, who, afford), costs, NEVER)
        too_far = (costs.min(axis=1) == NEVER) & (every.min(axis=1) < NEVER)
        costs = jnp.where(too_far[:, None], every, costs)
    best = jnp.argmin(costs, axis=1).astype(jnp.int32)
    least, area = hold((costs.min(axis=1), jnp.maximum(pick(lanes.slots, best), 0)))
    is_open = least < NEVER
    # A passing robot may have completed it: then it is closed, and the robot selects again.
    closed = wants & is_open & ((at(book.bits, area) & ~now) == 0).all(axis=1)
    takes = wants & is_open & ~closed & ~too_far
    finds_none = wants & (~is_open | too_far) & ~closed
    asks = finds_none & (doing != ln.IDLE)

    area = jnp.where(starts, piece, area)
    goal = at(book.target.reshape(-1), area * flat + here)
    salt = jnp.where(splits, jnp.uint32(SPLIT), here.astype(jnp.uint32))
    lanes = replace(lanes, now=jnp.where(runs[:, None], now, lanes.now))
    share = ln.if_any(runs & asks & ~ends, lambda: find_to_share(book, lanes, who, here, offset, afford))
    shares = asks & share.found
    arrives = turned = homeward = recalls = jnp.zeros_like(due)
    if homes is not None:
        way = moves_home(book, who, here)
        # A robot recharges only if all work is out of range, and only if it has made a move.
        recalls = wants & too_far & ~closed & ~shares & (homes.recharge > 0) & (until - step < at(homes.range, who))
        turned = (fate == ln.TURNS) | ((fate == ln.ENDS) & (way == 0) & ~returns) | recalls | due
        next_row = row_end + (me[:, ln.LAST] < at(book.entries, me[:, ln.WALK])[:, LENGTH])
        need = of_bases(book.need, book, next_row, who)
        own = (homes.recharge > 0) & (until - step + 1 < at(homes.range, who)) & (need > until - me[:, ln.SINCE])
        recalls = recalls | ((fate == ln.TURNS) & own) | ((fate == ln.ENDS) & (way == 0) & (homes.recharge > 0))
        recalls = jnp.where(returns, doing == ln.RECALL, recalls)
        again = again | (turned & splits)
        arrives = (turned & (way == 0)) | (returns & (fate == ln.ARRIVES))
        homeward = turned & (way > 0) & ~splits
        goal = jnp.where(homeward, here, goal)
        salt = jnp.where(homeward, jnp.uint32(HOMEWARD) - at(homes.of, who).astype(jnp.uint32), salt)
    goal = one_cell(book, goal)
    wanted = jnp.where((splits | covers)[:, None], todo, goal)
    entry = hold(look_up(book, wanted, salt))
    needs = splits | covers | starts | takes | homeward
    asked = jnp.concatenate([wanted, salt[:, None]], axis=1)

    entry = jnp.where(shares, share.split, entry)
    split = at(book.entries, jnp.maximum(entry, 0))
    first, count = split[:, PIECE], split[:, PARTS]
    missing = (needs & (entry < 0)) | (shares & ((share.split < 0) | (share.walks < 0).any(axis=1)))
    makes = splits | shares
    full = makes & ~missing & ((lanes.made + count > G) | (shares & (count > book.parts)))
    acts = runs & ~ends & ~missing & ~full
    wanted_share = shares
    splits, takes, closed, shares, makes = (acts & of for of in (splits, takes, closed, shares, makes))
    goes = acts & (covers | starts | takes | shares | (homeward & ~again))
    again, rests = acts & again, acts & ((finds_none & ~shares) | (~leaves & (doing == ln.LAND))) & ~turned
    gone = acts & (leaves | turned | returns) & ~again & ~goes
    charges = gone & arrives & recalls & (lanes.over == 0)

    # A robot that turns back keeps the rest of its threshold; at the end of its range it needs none.
    done, spent = None if homes is None else me[:, ln.LAST], acts & ~again & ~dies
    left = jnp.where(spent[:, None], ln.left_after(book, me[:, ln.WALK], left, done), left)
    leg = jnp.maximum(jnp.where(shares, share.walks[:, 1], entry), 0)
    # A robot that turns back before its move makes it on its way to the base.
    since = step - ((fate == ln.TURNS) & ~due)
    kind = jnp.where(homeward, jnp.where(recalls, ln.RECALL, ln.RETURN), jnp.where(covers, ln.COVER, ln.TRAVEL))
    base, moves, how, end = depart(book, who, kind, leg, left, since, until)
    given, number = first + share.parts[:, 1], lanes.made + share.parts[:, 1]
    own = jnp.where(shares, given, jnp.where(covers, piece, jnp.where(homeward, -1, area)))
    ident = jnp.where(shares, number, jnp.where(covers | starts, me[:, ln.IDENT], best))
    fresh = ln.robot_fields(
        step, doing=kind, here=end, area=own, ident=ident, since=since, until=until, fate=how, walk=leg, row=base,
        last=moves,
    )  # fmt: skip
    rest_as = jnp.where(gone, jnp.where(dies, ln.DEAD, jnp.where(charges, ln.CHARGE, ln.OUT)), ln.IDLE)
    stays = ln.robot_fields(
        step, doing=jnp.where(closed, doing, rest_as), here=here, area=jnp.where(closed, me[:, ln.AREA], -1),
        ident=me[:, ln.IDENT], since=step, until=jnp.where(closed, me[:, ln.UNTIL], until - step),
    )  # fmt: skip
    after = jnp.where(goes[:, None], fresh, stays)
    left_over = jnp.where(turned, -1, at(book.next_of, piece))
    after = jnp.where(again[:, None], me.at[:, ln.AREA].set(left_over), after)
    key = jnp.where(goes, (since + moves + (how == ln.TURNS)) * stride + who, jnp.where(closed | again, key, NEVER))
    if homes is not None:
        key = jnp.where(charges, (step + homes.recharge) * stride + who, key)
        # A waiting robot returns at the end of the last step from which it is in time.
        rest_until = jnp.maximum(homes.last - moves_home(book, who, here), step) * stride + K + who
        is_due = rests & (moves_home(book, who, here) > 0) & (homes.last <= book.max_steps)
        key = jnp.where(is_due, rest_until, key)
    # A robot without an area at its start looks for one from the next step on.
    key = jnp.where(rests & (doing == ln.LAND), (step + 1) * stride + who, key)
    mine = mine & acts[:, None]
    opened = splits | (shares & (count > 2))
    waits = (lanes.robots[:, :, ln.DOING] == ln.IDLE) & opened[:, None]
    woken = (step[:, None] + (robots < who[:, None])) * stride + robots
    keys = jnp.where(waits, jnp.minimum(woken, lanes.key), lanes.key)

    place = jnp.arange(G, dtype=jnp.int32)
    slots = jnp.where((takes | closed)[:, None] & (place == best[:, None]), -1, lanes.slots)
    part = place - lanes.made[:, None]
    new = makes[:, None] & (part >= 0) & (part < count[:, None])
    taken = shares[:, None] & (part[:, :, None] == share.parts[:, None]).any(axis=2)
    slots = jnp.where(new, jnp.where(taken, -1, first[:, None] + part), slots)

    come = acts & ~again
    bisected = split[:, BISECTED] > 0
    kinds = shares[:, None] & jnp.stack([bisected, ~bisected], axis=1)
    ended = runs & (ends | (acts & dies & (alive == 0)))
    ahead = lanes.last + book.quiet
    final = jnp.where(none, jnp.minimum(ahead, book.max_steps), step)
    outcome = jnp.where(late, int(Outcome.STEP_LIMIT), int(Outcome.ALL_ROBOTS_LOST))
    outcome = jnp.where(none & (ahead <= book.max_steps), int(Outcome.NO_PROGRESS), outcome)
    if homes is not None:
        outcome = jnp.where(none & (lanes.over > 0), lanes.over - 1, outcome)
        final = jnp.where(none & (lanes.over > 0), lanes.last, final)
    moved = come & ~due & (goes | ((doing != ln.IDLE) & (step > me[:, ln.SINCE]) & (fate != ln.TURNS)))
    mode = jnp.where(ended, ln.DONE, jnp.where(missing, ln.MISSING, jnp.where(full, ln.FULL, ln.RUN)))
    walked = jnp.where(come, me[:, ln.LAST], -1)
    changed = replace(
        end_walks(book, lanes, who, me, walked, walked - dies),
        mode=jnp.where(runs, mode, lanes.mode),
        fuel=lanes.fuel - (acts | (runs & ends)).astype(jnp.int32),
        slots=slots,
        made=lanes.made + jnp.where(makes, count, 0),
        key=jnp.where(mine, key[:, None], keys),
        robots=jnp.where(mine[:, :, None], after[:, None], lanes.robots),
        left=jnp.where(mine[:, :, None], left[:, None], lanes.left),
        shared=lanes.shared + kinds,
        last=jnp.where(ended, final, jnp.where(moved, step, lanes.last)),
        outcome=jnp.where(ended, outcome, lanes.outcome),
        asked=jnp.where((runs & missing)[:, None], jnp.where(wanted_share[:, None], share.asked, asked), lanes.asked),
    )
    if log is not None:
        flags = jnp.where(dies, jnp.uint32(ln.STOPPED), jnp.uint32(0))
        log = ln.write(log, walked > 0, ln.log_row(lanes.number, who, me, me[:, ln.LAST], flags))
    share = replace(share, found=shares)
    return ln.if_any(
        shares, lambda: owner_sets_out(book, changed, log, share, lanes.made, first, step, who, offset), (changed, log)
    )


def begin(book: Book, left: jax.Array, number: jax.Array) -> tuple[Lanes, jax.Array]:
    """Lanes of rollouts with these thresholds, `[S, K, 2]`, at the last snapshot before a loss, and its number."""
    S, (M, K, _) = left.shape[0], book.met.shape
    who = jnp.tile(jnp.arange(K, dtype=jnp.int32), S)

    def is_lost(snapshot: jax.Array) -> jax.Array:
        return is_reached(left.reshape(-1, 2), at(book.met.reshape(-1, 2), snapshot * K + who))

    lost = ln.first_that(is_lost, jnp.ones_like(who), jnp.full_like(who, M), M.bit_length())
    which = lost.reshape(S, K).min(axis=1) - 1
    lanes = jax.tree.map(lambda of: at(of, which), book.first)
    left, robots = less(left, lanes.left), lanes.robots
    me = robots.reshape(S * K, ln.FIELDS)
    walks = me[:, ln.WALK], left.reshape(-1, 2), me[:, ln.SINCE], me[:, ln.UNTIL]
    _, moves, fate, _ = (of.reshape(S, K) for of in depart(book, who, me[:, ln.DOING], *walks))
    stride = ln.stride_of(book, lanes)
    stands = (robots[:, :, ln.LAST] == 0) & (robots[:, :, ln.FATE] != ln.TURNS)
    # Robots that are due at the end of a step end their walks there.
    stands = stands | (at(book.entries, robots[:, :, ln.WALK])[:, :, LENGTH] == 0) | (lanes.key % stride >= K)
    key = (robots[:, :, ln.SINCE] + moves + (fate == ln.TURNS)) * stride + jnp.arange(K, dtype=jnp.int32)
    moves, fate, key = (
        jnp.where(stands, old, new)
        for old, new in ((robots[:, :, ln.LAST], moves), (robots[:, :, ln.FATE], fate), (lanes.key, key))
    )
    kept = robots.at[:, :, ln.LAST].set(moves).at[:, :, ln.FATE].set(fate)
    return replace(lanes, number=number, left=left, key=key, robots=kept), which


def ended(book: Book, lanes: Lanes) -> tuple[Ended, jax.Array, jax.Array]:
    """Results of lanes at their end; and rows of the log, uint32 `[S, K, 4]`, and which of them there are."""
    robots, row = lanes.robots, lanes.robots[:, :, ln.ROW]
    complete = (lanes.now == book.every).all(axis=1)
    time = lanes.last
    if book.homes is None:  # else a robot had to return after that

        def rewind() -> jax.Array:
            return ln.first_that(partial(ln.is_covered, book, lanes), jnp.zeros_like(time), time, ln.HALVINGS)

        time = jnp.where(complete, jax.lax.cond(complete.any(), rewind, lambda: time), time)
    moves = ln.moves_by(lanes, time[:, None])
    stopped = (robots[:, :, ln.FATE] == ln.DIES) & (robots[:, :, ln.SINCE] + robots[:, :, ln.LAST] <= time[:, None])
    lost = (robots[:, :, ln.DOING] == ln.DEAD) | stopped
    visited = lanes.visited | entered(book, row + moves)
    survived = lanes.survived | entered(book, row + moves - stopped)

    def size(cells: jax.Array) -> jax.Array:
        return jax.lax.population_count(cells).sum(axis=1, dtype=jnp.uint32).astype(jnp.int32)

    numbers = [size(visited), size(survived), time, (~lost).sum(axis=1, dtype=jnp.int32)]
    numbers += [jnp.where(complete, int(Outcome.COMPLETE), lanes.outcome), lanes.shared[:, 0], lanes.shared[:, 1]]
    flags = jnp.where(stopped, jnp.uint32(ln.STOPPED), jnp.uint32(0)) | jnp.uint32(ln.FINAL)
    who = jnp.arange(robots.shape[1], dtype=jnp.int32)
    home = delivered = jnp.zeros_like(time)
    if book.homes is not None:
        cell = jnp.where(robots[:, :, ln.WALK] > 0, at(book.cell_at, row + moves), robots[:, :, ln.HERE])
        is_home = moves_home(book, jnp.broadcast_to(who, cell.shape), cell) == 0
        home = (is_home & ~lost).sum(axis=1, dtype=jnp.int32)
    if lanes.undelivered is not None:
        last = of_bases(book.brought, book, row + moves - stopped, jnp.broadcast_to(who, row.shape))
        cells = jnp.where(
            (last > 0)[:, :, None], lanes.undelivered[:, :-1] | at(book.prefix, row + last), jnp.uint32(0)
        )
        delivered = size(lanes.undelivered[:, -1] | jnp.bitwise_or.reduce(cells, axis=1))
    numbers += [home, delivered]
    rows = ln.log_row(lanes.number[:, None], who, robots, moves, flags)
    return Ended(jnp.stack(numbers, axis=1), visited, survived), rows, moves > 0
