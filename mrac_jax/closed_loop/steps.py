"""The closed loop's cheap part: in a micro-step a lane's robot acts, or looks at the next few cells for where to go.

Far searches, components and sharing, which are dear, wait for `mrac_jax.closed_loop.rules` and
`mrac_jax.closed_loop.areas`; no lane waits for another one. Axis letters as in `mrac_jax.closed_loop.state`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp

from mrac_jax.arrays import WORDS, exposure_in_doubt, is_reached, less
from mrac_jax.closed_loop.returning import Homing, after_move, before_move, end_at_home, follow_up, tell
from mrac_jax.closed_loop.rules import FAR, asking, notice
from mrac_jax.closed_loop.state import (
    ACT,
    CELL_KINDS,
    END,
    FIND_AREA,
    FIND_CELL,
    FIND_FAR,
    FIND_OR_SHARE,
    JUDGE,
    LOST,
    NEW_SURVIVED,
    NEW_VISITED,
    NEXT,
    OFF,
    RETARGET,
    SHARE,
    STEP_KINDS,
    STOPPED,
    Lanes,
    Sums,
    any_bit,
    bits_above,
    bits_of,
    choose_lanes,
    first_bit,
    get,
    high_half,
    lane_rows,
    low_half,
    put,
    read,
    spread,
    state_pack,
    switch,
    word_and_bit,
    write,
    write_down,
)
from mrac_jax.closed_loop.tables import LABEL, NEAREST, PENDING, SIDES, SPENT, SURVIVED, VISITED, LaneTables
from planner.simulator.codes import NO_AREA, NONE, Doing, EventKind, Outcome
from planner.simulator.state import MOST_PASSES

ACTS = 2
"""Actions of a lane between two looks."""


@dataclass(frozen=True)
class _Move:
    """One action of each lane's robot, `[B]`.

    Attributes:
        acts: there is one; moves: it is a move. slot: int32, the robot's place in flat tables; bit: uint32 `[W, B]`.
        traveling, covering: what the robot was doing. place, duty: its words before. area: int32, its area.
        cell: int32, the cell that it enters ("no cell" if it does not move); word: that cell's before.
        fresh: nobody had visited it. bears: int32 `[B, 2]`, where it stands what the robot still bears; left: uint32
            `[B, 2]`, what that is after the move. hit: the robot is stopped there; passed: it is not; stays: it has
            come to the end of its range there, False where nobody has one. arrives: at its target, and may go on.
        follows: it is on a path of another planner, whether it moves or waits; ends: at its end, and not stopped.
            False where there are none.
        home: what it does about its way home; None where robots do not come home.
        noticed: a mode, int32, what it does before it moves (`attentive.notice`); None by
            the paper's rule.
    """

    acts: jax.Array
    moves: jax.Array
    slot: jax.Array
    bit: jax.Array
    traveling: jax.Array
    covering: jax.Array
    place: jax.Array
    duty: jax.Array
    area: jax.Array
    cell: jax.Array
    word: jax.Array
    fresh: jax.Array
    bears: jax.Array
    left: jax.Array
    hit: jax.Array
    passed: jax.Array
    stays: jax.Array
    arrives: jax.Array
    follows: jax.Array
    ends: jax.Array
    home: Homing | None
    noticed: jax.Array | None


def act(tables: LaneTables, lanes: Lanes, sums: Sums) -> tuple[Lanes, Sums]:
    """One action of each lane's robot: a move, or the wish for an area. SPEC section 5, `Each time step`."""
    move = _move(tables, lanes)
    new_survived = move.passed & ((move.word & SURVIVED) == 0)
    sums = _count(lanes, sums, move, new_survived)
    acting, never = lanes.mode == ACT, jnp.zeros_like(move.hit)
    stays = move.stays if move.home is None else move.stays | move.home.turns
    ends = move.hit | stays
    lanes = replace(
        lanes,
        progress=lanes.progress | move.moves | move.follows,
        unvisited=lanes.unvisited - move.fresh.astype(jnp.int32),
        survived=lanes.survived + new_survived.astype(jnp.int32),
    )
    lanes = _mark(tables, lanes, move)
    lanes, sums = _count_passes(lanes, sums, move)
    mode, target, pending, left = _what_next(tables, lanes, move)
    place = jnp.where(move.moves, state_pack(move.cell, target), move.place)
    if move.noticed is not None:
        assert lanes.looked is not None
        lanes = replace(lanes, looked=jnp.where(acting, move.noticed != ACT, lanes.looked))
    if lanes.moves_left is not None:
        made = (move.moves & (lanes.step > 0)).astype(jnp.int32)
        lanes = replace(lanes, moves_left=write(lanes.moves_left, move.slot, read(lanes.moves_left, move.slot) - made))
    area = jnp.where(ends & (left == 0), tables.none, move.area)
    lanes = replace(
        lanes,
        place=write(lanes.place, move.slot, place),
        left=write(lanes.left, move.bears, move.left),
        duty=write(lanes.duty, move.slot, state_pack(area, jnp.where(move.arrives, pending, high_half(move.duty)))),
        traveling=switch(lanes.traveling, move.bit, never, ends | move.arrives),
        covering=switch(lanes.covering, move.bit, move.arrives, ends),
        alive=switch(lanes.alive, move.bit, never, ends),
        hopeful=switch(lanes.hopeful, move.bit, never, ends),
        done=switch(lanes.done, move.bit, stays, move.hit),
        mode=jnp.where(acting, mode, lanes.mode),
    )
    if move.home is not None:
        robot = jnp.minimum(lanes.robot, len(tables.starts) - 1)
        lanes = follow_up(tables, lanes, move.home, move.slot, robot, move.bit, move.hit | move.stays)
    return lanes, sums


def _move(tables: LaneTables, lanes: Lanes) -> _Move:
    """Where each lane's robot goes, and whether it is stopped there (SPEC section 14, `Tolerance`)."""
    batch, words = lanes.mode.shape[0], lanes.alive.shape[0]
    team = lanes.place.shape[0] // batch
    acts, first = (lanes.mode == ACT) & (lanes.robot < team), lanes.step == 0
    slot, bit = lane_rows(lanes.place, batch) + jnp.minimum(lanes.robot, team - 1), bits_of(lanes.robot, words)
    traveling, covering = any_bit(lanes.traveling & bit), any_bit(lanes.covering & bit)
    place, duty = read(lanes.place, slot), read(lanes.duty, slot)
    here, target = low_half(place), high_half(place)
    # At t = 0 everybody enters its start, also who has no area: that visit counts, and can stop it.
    moves = acts & (traveling | covering | first)
    ahead = read(tables.hop, here * jnp.int32(tables.size) + target).astype(jnp.int32)
    noticed, follows, ends = None, jnp.zeros_like(acts), jnp.zeros_like(acts)
    if tables.paths is not None:
        path, begin, last = tables.paths
        robot = jnp.minimum(lanes.robot, team - 1)
        follows, ends = acts & (lanes.step <= read(last, robot)), acts & (lanes.step == read(last, robot))
        given = read(path, jnp.where(follows, read(begin, robot) + lanes.step, 0)).astype(jnp.int32)
        ahead = jnp.where(follows, given, ahead)
        moves = moves & (~follows | first | (ahead != here))
    if tables.policy is not None:
        going = acts & (traveling | covering)
        noticed = notice(tables, lanes, going, traveling, low_half(duty), target, ahead)
        moves = moves & (noticed == ACT)
    home, robot = None, jnp.minimum(lanes.robot, team - 1)
    if lanes.returning is not None:
        returns = acts & any_bit(lanes.returning & bit)
        home, onward, goes = before_move(tables, lanes, slot, robot, returns, moves)
        ahead, moves = jnp.where(returns, onward, ahead), (moves & ~home.turns) | goes
    # Lanes without a move enter the wall, which is visited and adds nothing: no branch, and nothing to mask afterwards.
    cell = jnp.where(moves, jnp.where(first, here, ahead), tables.none)
    word = read(lanes.cells, lane_rows(lanes.cells, batch) + cell)
    fresh = (word & VISITED) == 0
    # What is not checked adds nothing, so what a robot bears can be written back in every lane.
    exposure, checked = read(tables.exposure, cell), moves & (fresh | ~tables.first_only)
    if tables.doubt is not None:
        exposure = exposure_in_doubt(tables.doubt, lanes.rollout, cell, exposure)
        checked = checked & ((word & SPENT) == 0)
    bears = slot[:, None] * WORDS + jnp.arange(WORDS, dtype=jnp.int32)
    left, exposure = read(lanes.left, bears), jnp.where(checked[:, None], exposure, jnp.uint32(0))
    hit = checked & is_reached(left, exposure)
    # The last move of a range is made, and checked, before the robot stays for good.
    stays = jnp.zeros_like(hit)
    if lanes.moves_left is not None:
        stays = moves & ~first & ~hit & (read(lanes.moves_left, slot) == 1)
    # Who is on a given path has no target: its end is a step, not a cell.
    arrives = moves & ~hit & ~stays & ~follows & (cell == target) & (traveling | covering)
    if home is not None:
        home, stays = after_move(tables, home, robot, jnp.where(moves, cell, here), hit, stays)
    return _Move(
        acts=acts, moves=moves, slot=slot, bit=bit, traveling=traveling, covering=covering, place=place, duty=duty,
        area=low_half(duty), cell=cell, word=word, fresh=fresh, bears=bears,
        left=less(left, exposure), hit=hit, passed=moves & ~hit, stays=stays,
        arrives=arrives, follows=follows, ends=ends & ~hit, home=home, noticed=noticed,
    )  # fmt: skip


def _mark(tables: LaneTables, lanes: Lanes, move: _Move) -> Lanes:
    """The cells that were entered are visited, and their areas completed; then what happened goes into the log."""
    batch, words = lanes.mode.shape[0], lanes.alive.shape[0]
    row, holder = lane_rows(lanes.cells, batch), low_half(move.word)
    record = read(lanes.areas, row + holder)
    owner = high_half(record) - 1
    after = (move.word & ~jnp.uint32(PENDING)) | jnp.uint32(VISITED)
    if lanes.safe_left is None:
        late = (owner != lanes.robot) & any_bit(lanes.covering & bits_of(owner, words))
        pends = jnp.where(move.fresh, late, (move.word & PENDING) != 0) & ~(move.arrives & move.covering)
        after = after | jnp.where(pends, jnp.uint32(PENDING), jnp.uint32(0))
    else:
        safe = move.fresh & (read(tables.level, move.cell) == 0)
        lanes = replace(lanes, safe_left=lanes.safe_left - safe.astype(jnp.int32))
    after = after | jnp.where(move.passed, jnp.uint32(SURVIVED), jnp.uint32(0))
    if tables.doubt is not None:
        after = after | jnp.where(move.hit & tables.doubt.spends, jnp.uint32(SPENT), jnp.uint32(0))
    # The record counts what is unvisited: this visit was the last one.
    completes = move.fresh & (low_half(record) == 1)
    closes = (completes & (owner < 0)).astype(jnp.int32)
    # The order of these lines is the order of events: completion before the hit, as Algorithm 2 has it.
    if lanes.log is not None:
        lanes = write_down(lanes, completes, lanes.robot, EventKind.COMPLETED, read(lanes.ids, row + holder), move.cell)
        mine = jnp.where(move.area == tables.none, NO_AREA, read(lanes.ids, row + move.area))
        lanes = write_down(lanes, move.hit, lanes.robot, EventKind.HIT, mine, move.cell)
        if lanes.moves_left is not None:
            lanes = write_down(lanes, move.stays, lanes.robot, EventKind.RANGE_ENDED, mine, move.cell)
        if move.home is not None:
            lanes = tell(tables, lanes, move.home, mine)
    return replace(
        lanes,
        cells=write(lanes.cells, row + move.cell, jnp.where(move.moves, after, move.word)),
        areas=write(lanes.areas, row + holder, record - move.fresh.astype(jnp.uint32)),
        waiting=lanes.waiting - closes,
    )


def _what_next(tables: LaneTables, lanes: Lanes, move: _Move) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """(mode, target, pending cells of the coverage path, unvisited cells of the robot's area), int32 `[B]` each.

    At the end of a travel or a leg, the next leg; without an adjacent cell to do it must be searched for.
    """
    row = lane_rows(lanes.cells, lanes.mode.shape[0])
    left = low_half(read(lanes.areas, row + move.area))
    # By the paper's rule what is to do is frozen when coverage begins: others' visits do not shorten the path.
    pending = left if tables.policy is not None else jnp.where(move.covering, high_half(move.duty) - 1, left)
    adjacent = _adjacent(tables, lanes.cells, row, move.cell, move.area)
    goes_on, ends = move.arrives & (pending > 0), move.ends | (move.arrives & (pending == 0))
    # An adjacent cell costs one entry of the level, and nothing costs less: no search.
    leg = goes_on & (adjacent != tables.none)
    mode = jnp.where(move.acts & ~move.moves & ~move.follows, FIND_AREA, NEXT)
    leaves = move.hit | move.stays
    on = jnp.where(lanes.waiting > 0, FIND_OR_SHARE, SHARE)
    if (home := move.home) is not None:
        # Who turns makes its first move home, or says that it is there, when what it leaves is somebody else's.
        mode = jnp.where(home.bound, ACT, jnp.where(home.turns | home.returns, NEXT, mode))
        mode, leaves = jnp.where(home.full, on, mode), leaves | home.turns
    mode = jnp.where((move.hit & move.follows) | (leaves & (left > 0)), LOST, mode)
    mode = jnp.where(ends, on, mode)
    mode = jnp.where(goes_on & ~leg, FIND_CELL, mode)
    if move.noticed is not None:
        mode = jnp.where(move.noticed != ACT, move.noticed, mode)
        starts = move.passed & move.traveling & ~move.arrives & (lanes.step == 0)
        gone = (read(lanes.cells, row + high_half(move.place)) & VISITED) != 0
        mode = jnp.where(starts & gone, jnp.where(left > 0, RETARGET, on), mode)
    return mode, jnp.where(leg, adjacent, high_half(move.place)), pending, left


def _count(lanes: Lanes, sums: Sums, move: _Move, new_survived: jax.Array) -> Sums:
    kind = move.fresh * NEW_VISITED + new_survived * NEW_SURVIVED
    visit = move.cell * CELL_KINDS + kind + move.hit * STOPPED
    return replace(
        sums,
        by_cell=sums.by_cell.at[visit].add(1, mode="promise_in_bounds"),
        by_step=sums.by_step.at[lanes.step * STEP_KINDS + kind].add(1, mode="promise_in_bounds"),
        moves=sums.moves + move.moves.sum(dtype=jnp.int32),
    )


def _count_passes(lanes: Lanes, sums: Sums, move: _Move) -> tuple[Lanes, Sums]:
    """One survived visit more of the cells that robots entered and were not stopped in, where somebody asks."""
    if lanes.passes is None or sums.passes is None:
        return lanes, sums
    place = lane_rows(lanes.passes, lanes.mode.shape[0]) + move.cell
    before = read(lanes.passes, place).astype(jnp.int32)
    counts = move.passed & (before < MOST_PASSES)
    at = move.cell * MOST_PASSES + jnp.minimum(before, MOST_PASSES - 1)
    total = sums.passes.at[at].add(counts.astype(jnp.int32), mode="promise_in_bounds")
    after = (before + counts).astype(jnp.uint8)
    return replace(lanes, passes=write(lanes.passes, place, after)), replace(sums, passes=total)


def _adjacent(tables: LaneTables, cells: jax.Array, row: jax.Array, cell: jax.Array, area: jax.Array) -> jax.Array:
    """The adjacent pending cell of the area that goes first, int32 `[B]`: always the cheapest. Or "no cell"."""
    wanted = jnp.uint32(PENDING) | area.astype(jnp.uint32)
    best = jnp.full_like(cell, tables.none)
    for side in reversed(range(SIDES)):
        near = read(tables.sweep, cell * SIDES + side).astype(jnp.int32)
        best = jnp.where((read(cells, row + near) & (PENDING | LABEL)) == wanted, near, best)
    return best


def look(tables: LaneTables, lanes: Lanes, width: int) -> Lanes:
    """The next cell of a coverage path among the nearest of its level, for up to `width` lanes that search one."""
    batch = lanes.mode.shape[0]
    lane, slot = choose_lanes(lanes.mode == FIND_CELL, width)
    at = jnp.minimum(lane, batch - 1)
    robot = lanes.robot[at]
    here, area = low_half(get(lanes, lanes.place, lane, robot)), low_half(get(lanes, lanes.duty, lane, robot))
    begin = (here * jnp.int32(tables.levels) + read(tables.level, area)) * NEAREST
    cell = read(tables.nearest, begin + jnp.arange(NEAREST, dtype=jnp.int32)[:, None]).astype(jnp.int32)
    word = get(lanes, lanes.cells, lane, cell)
    wanted = (word & (PENDING | LABEL)) == (jnp.uint32(PENDING) | area.astype(jnp.uint32))
    # `nearest` is in the order in which cells are chosen, so the first that fits is the one.
    first = jnp.where(wanted, jnp.arange(NEAREST, dtype=jnp.int32)[:, None], NEAREST).min(axis=0)
    found = first < NEAREST
    target = jnp.where(jnp.arange(NEAREST, dtype=jnp.int32)[:, None] == first, cell, 0).max(axis=0)
    return replace(
        lanes,
        place=put(lanes, lanes.place, lane, robot, state_pack(here, target), found),
        mode=spread(lanes.mode, slot, jnp.where(found, lanes.found_next(at), FIND_FAR)),
    )


def give_up(lanes: Lanes, gives_up: jax.Array, none: int) -> Lanes:
    """Lanes `[B]` whose robot has found nothing more to do: it is done, without an area."""
    batch, words = lanes.mode.shape[0], lanes.alive.shape[0]
    team = lanes.place.shape[0] // batch
    slot = lane_rows(lanes.duty, batch) + jnp.minimum(lanes.robot, team - 1)
    bit, never = bits_of(lanes.robot, words), jnp.zeros_like(gives_up)
    return replace(
        lanes,
        duty=write(lanes.duty, slot, jnp.where(gives_up, jnp.uint32(none), read(lanes.duty, slot))),
        traveling=switch(lanes.traveling, bit, never, gives_up),
        covering=switch(lanes.covering, bit, never, gives_up),
        done=switch(lanes.done, bit, gives_up, never),
        mode=jnp.where(gives_up, NEXT, lanes.mode),
    )


def advance(tables: LaneTables, lanes: Lanes) -> Lanes:
    """The next robot's turn, or the end of the step and, perhaps, of the rollout (SPEC section 5's order)."""
    words, team = lanes.alive.shape[0], lanes.place.shape[0] // lanes.mode.shape[0]
    movers = lanes.traveling | lanes.covering
    # With nobody else on the move there is nothing to share: most runs end so, and need no search for it.
    nobody_else = ~any_bit(movers & ~bits_of(lanes.robot, words))
    if lanes.ready is None and (tables.policy is None or lanes.log is None):  # else more is to be said or done
        lanes = give_up(lanes, (lanes.mode == SHARE) & nobody_else, tables.none)
    turns = lanes.mode == NEXT
    movers = lanes.traveling | lanes.covering
    actors = _actors(tables, lanes)
    now = jnp.where(lanes.step == 0, tables.robots[:, None], actors) & bits_above(lanes.robot, words)
    later = first_bit(now, team)
    # The step ends when no robot after this one acts in it.
    ends = turns & (later == team)
    quiet = jnp.where(lanes.progress, 0, lanes.quiet + 1)
    outcome = jnp.where(lanes.step >= tables.max_steps, jnp.int32(Outcome.STEP_LIMIT), NONE)
    outcome = jnp.where(quiet >= 2, jnp.int32(Outcome.NO_PROGRESS), outcome)
    outcome = jnp.where(any_bit(lanes.unharmed), outcome, jnp.int32(Outcome.ALL_ROBOTS_LOST))
    outcome = jnp.where(lanes.unvisited == 0, jnp.int32(Outcome.COMPLETE), outcome)
    if tables.homes is not None:
        lanes, ends, outcome = end_at_home(tables, lanes, ends, outcome)
        turns, actors = turns & (lanes.mode == NEXT), _actors(tables, lanes)
    over = ends & (outcome >= 0)
    lanes = keep_step(tables, lanes, ends)
    halts = ends & (lanes.step + 1 == lanes.halt)
    # Only `worth` can make a run without progress one that is not worth the risk; that takes a look at all cells.
    asks = tables.policy is not None and tables.homes is None
    done = jnp.where(outcome == Outcome.NO_PROGRESS, JUDGE, END) if asks else END
    return replace(
        lanes,
        mode=jnp.where(over, done, jnp.where(halts, OFF, jnp.where(turns, ACT, lanes.mode))),
        robot=jnp.where(ends, first_bit(actors, team), jnp.where(turns, later, lanes.robot)),
        step=lanes.step + (ends & ~over).astype(jnp.int32),
        quiet=jnp.where(ends, quiet, lanes.quiet),
        progress=lanes.progress & ~ends,
        outcome=jnp.where(over, outcome, lanes.outcome),
        looked=None if lanes.looked is None else lanes.looked & ~turns,
    )


def _actors(tables: LaneTables, lanes: Lanes) -> jax.Array:
    """The robots that act, uint32 `[W, B]`."""
    movers, hopeful = lanes.traveling | lanes.covering, lanes.hopeful
    if lanes.returning is not None and lanes.held is not None:  # what can be afforded changes with an area's target
        hopeful = lanes.alive & ~movers
    actors = movers | jnp.where(lanes.waiting > 0, hopeful, jnp.uint32(0))
    if lanes.held is not None:
        actors = actors | asking(tables, lanes)
    return actors if lanes.returning is None else actors | lanes.returning


def keep_step(tables: LaneTables, lanes: Lanes, ends: jax.Array) -> Lanes:
    """Where the robots are at the end of the step, in the log of the lanes where it ends; nothing if none is kept."""
    if lanes.log is None:
        return lanes
    log, batch = lanes.log, ends.shape[0]
    team, steps = lanes.place.shape[0] // batch, log.frames.shape[0] // batch
    robots = jnp.arange(team, dtype=jnp.int32)

    def has(words: jax.Array) -> jax.Array:
        """bool `[B, K]`."""
        word, bit = word_and_bit(robots)
        return (words[word] & bit[:, None]).T != 0

    doing = jnp.where(has(lanes.done), jnp.int32(Doing.DONE), jnp.int32(Doing.IDLE))
    doing = jnp.where(has(lanes.traveling), jnp.int32(Doing.TRAVELING), doing)
    if tables.paths is not None:
        doing = jnp.where(
            has(lanes.traveling) & (lanes.step[:, None] < tables.paths[2]), jnp.int32(Doing.FOLLOWING), doing
        )
    doing = jnp.where(has(lanes.covering), jnp.int32(Doing.COVERING), doing)
    if lanes.returning is not None:
        doing = jnp.where(has(lanes.returning), jnp.int32(Doing.RETURNING), doing)
    if lanes.ready is not None and lanes.returning is not None:
        ready = lanes.ready.reshape(batch, team)
        doing = jnp.where(has(lanes.returning) & (ready > 0) & (ready < FAR), jnp.int32(Doing.CHARGING), doing)
    doing = jnp.where(has(lanes.unharmed), doing, jnp.int32(Doing.DEAD))
    label = low_half(lanes.duty.reshape(batch, team))
    area = jnp.take_along_axis(lanes.ids.reshape(batch, -1), label, axis=1)
    row = jnp.where(ends & (lanes.step < steps), lane_rows(log.frames, batch) + lanes.step, log.frames.shape[0])
    place = low_half(lanes.place.reshape(batch, team))
    frame = jnp.stack([place, doing, jnp.where(label == tables.none, NO_AREA, area)], axis=1)
    return replace(lanes, log=replace(log, frames=log.frames.at[row].set(frame, mode="drop")))


def micro_step(tables: LaneTables, lanes: Lanes, sums: Sums, width: int) -> tuple[Lanes, Sums]:
    """Each lane a few actions further, and up to `width` of those that search one look further."""

    def one(_: jax.Array, state: tuple[Lanes, Sums]) -> tuple[Lanes, Sums]:
        lanes, sums = state
        return act(tables, advance(tables, lanes), sums)

    lanes, sums = jax.lax.fori_loop(0, ACTS, one, (lanes, sums))
    return look(tables, lanes, width), sums
