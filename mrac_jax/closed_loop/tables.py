"""A closed loop compiled for lanes: `planner.rollouts.loop.ClosedLoop` -> padded tables of few shapes.

Lane: the place of one rollout in a batch. Cells are the accessible ones in rising index, then padding; the last number
is a wall, visited from the start, and stands for "no cell" and "no area". Boards (`mrac_jax.closed_loop.state`) number
the smallest rectangle that holds them, row by row, a wall after each row and a row of walls after the last: there a
cell's neighbours are one, or one `stride`, away. Both orders are the map's. Axis letters: `A` cells, `P` places of a
board, `K` robots, `W` words of robot bits, `L` levels, `T` steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from mrac_jax.arrays import STATIC, Array, Doubt, make_doubt, on_host, padded, two_words
from planner.arguments import argument
from planner.errors import UsageError, WorldError
from planner.failure_model import own_key
from planner.ids import MAX_STEP
from planner.mrac.problem import NO_LIMIT
from planner.rollouts.closed_loop import MOST_TABLED
from planner.rollouts.loop import ClosedLoop
from planner.simulator.codes import NONE
from planner.simulator.offers import NO_REFUSAL, Offer, price
from planner.simulator.state import MOST_PASSES

# Ways home as tables that every lane reads (SPEC section 19): `planner.mrac.home_paths` for lanes. NumPy alone.
#
# A leg is the safest path from cell to cell, as `hop` has it. Axis letters: `B` sets of bases; the others as in
# `mrac_jax.closed_loop.tables`.

GOALS_AT_A_TIME = 64
NO_LEG = -(2**20)
"""Far less than any leg needs."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Homes:
    """Where home is, and how far.

    Attributes:
        of: int32 `[K]`, the bases of each robot.
        steps: int32 `[B * A]`, moves of the way home from each cell, NONE where it is cut off; cost: int32, its cost;
            onward, base: uint16, what is entered next on it, and where it ends.
        moves: uint16 `[A * A]`, those of the leg from row to column. need: uint16 `[B * A * A]`, the moves that a robot
            must have left before the leg, so that it is within its way home of a base all along.
        last: int32 scalar, D. furthest: int32 scalar, moves of the longest way home.
        recharge: int32 scalar, steps; None: robots are not charged.
    """

    of: Array
    steps: Array
    cost: Array
    onward: Array
    base: Array
    moves: Array
    need: Array
    last: Array
    furthest: Array
    recharge: Array | None

    @property
    def size(self) -> int:
        """A."""
        return self.steps.shape[0] // (self.need.shape[0] // self.moves.shape[0])


def lane_homes(loop: ClosedLoop, size: int, robots: int, sets: tuple[int, ...]) -> Homes | None:
    """The ways home of a closed loop, None where robots stay where they end; A; K; B is the first of `sets` that fits.

    Raises WorldError for more than there is room for.
    """
    if not loop.comes_home:
        return None
    tables, (given, count) = loop.tables, loop.tables.home_steps.shape
    if given * count**2 > MOST_TABLED**2:
        raise WorldError(
            f"{given} bases for themselves on {count:,} cells",
            expected=f"bases x cells x cells up to {MOST_TABLED**2:,} for the closed loop in JAX",
            fix=f"use {argument('engine', 'numba')}, or {argument('return_to', 'nearest')}",
        )
    more = next(one for one in sets if one >= given) - given
    base = onward = np.where(tables.home_steps > 0, tables.onward, np.arange(count)).astype(np.int64)
    while (tables.home_steps[np.arange(given)[:, None], base] > 0).any():
        base = np.take_along_axis(base, base, axis=1)
    moves, need = _legs(loop, size)

    def flat(rows: NDArray, fill: int, kind: type) -> NDArray:
        return np.pad(rows.astype(kind), ((0, more), (0, size - count)), constant_values=fill).reshape(-1)

    return on_host(
        Homes,
        of=padded(tables.home_of, robots),
        steps=flat(tables.home_steps, NONE, np.int32),
        cost=flat(tables.home_cost, NONE, np.int32),
        onward=flat(onward, size - 1, np.uint16),
        base=flat(base, size - 1, np.uint16),
        moves=moves.reshape(-1),
        need=np.pad(need, ((0, more), (0, 0), (0, 0))).reshape(-1),
        last=np.int32(tables.last_step),
        furthest=np.int32(tables.home_steps.max()),
        recharge=np.int32(tables.recharge) if tables.recharge else None,
    )


def _legs(loop: ClosedLoop, size: int) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """`moves` `[A, A]` and `need` `[B', A, A]` of Homes: legs twice as long at a time, of some goals at a time."""
    tables, steps, count = loop.tables, loop.tables.home_steps, len(loop.cells)
    moves, need = np.zeros((size, size), np.uint16), np.zeros((len(steps), size, size), np.uint16)
    for begin in range(0, count, GOALS_AT_A_TIME):
        goals = np.arange(begin, min(begin + GOALS_AT_A_TIME, count))
        row, end = np.arange(len(goals))[:, None], goals[:, None]
        made = ((tables.cost_to[goals] >= 0) & (end != np.arange(count))).astype(np.int64)
        at = np.where(made, tables.hop_to[goals], end)
        most = np.where(made, 1 + steps[:, at], NO_LEG)
        while (at != end).any():
            most = np.maximum(most, made + most[:, row, at])
            made, at = made + made[row, at], at[row, at]
        moves[:count, goals] = made.T
        need[:, :count, goals] = np.maximum(most, 0).transpose(0, 2, 1)
    return moves, need


# A policy as the lanes follow it: the rule's own `order`, traced by JAX as it stands, in 32-bit numbers.
#
# Axis letters as in `mrac_jax.closed_loop.tables`.

LARGEST_DENOMINATOR = 2**16 - 1
"""Products of an int32 and a number up to this are compared in two words."""
LARGEST = 2**31 - 1
"""A theta that refuses nothing, since every price is less."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LanePolicy:
    """What attentive robots decide by. One program for all limits on a team: they are numbers in it.

    Attributes:
        entry: int32 `[A]`, cost of entering a cell of each cell's level.
        cells: int32 scalar, n of the whole map. theta: int32 scalar, the price per new cell from which an area is
            refused. refuses: bool scalar, there is a `worth`.
        most: int32 `[K + 1]`, robots that may be at risk of so many alive. holds: bool scalar, there is a `reserve`.
        value: int32 `[A]`, what cells count; None: 1 each. scale, beyond: int32 scalars as in
            `planner.mrac.problem.Problem`.
        order: of the rule, offer -> two fractions. looks_again, breaks_off: as in `planner.policies.rule.Rule`. Static.
    """

    entry: Array
    cells: Array
    theta: Array
    refuses: Array
    most: Array
    holds: Array
    value: Array | None
    scale: Array
    beyond: Array
    order: Callable[[Offer], Any] = field(metadata=STATIC)
    looks_again: bool = field(metadata=STATIC)
    breaks_off: bool = field(metadata=STATIC)


def lane_policy(loop: ClosedLoop, level: NDArray[np.int32], robots: int) -> LanePolicy | None:
    """The policy of a closed loop, None for the paper's rule; int32 `[A]`, the level of each cell's area; K."""
    policy = loop.policy
    if policy is None:
        return None
    most = np.full(robots + 1, robots, dtype=np.int32)
    most[: len(policy.most)] = policy.most
    return on_host(
        LanePolicy,
        entry=policy.entry[level].astype(np.int32),
        cells=np.int32(policy.cells),
        theta=np.int32(min(policy.theta, LARGEST)),
        refuses=np.bool_(policy.worth and policy.theta < NO_REFUSAL),
        most=most,
        holds=np.bool_(len(policy.most) > 0),
        value=padded(policy.value, len(level)) if len(policy.value) else None,
        scale=np.int32(policy.scale),
        beyond=np.int32(policy.beyond),
        order=loop.rule.order,
        looks_again=policy.looks_again,
        breaks_off=policy.breaks_off,
    )


def check_policy(loop: ClosedLoop) -> None:
    """Raise WorldError for a policy that JAX cannot trace, or whose numbers do not fit into 32 bits.

    What the rule makes of the dearest offer of each level is computed with overflow being an error.
    """
    policy, fix = loop.policy, f"use {argument('engine', 'numba')}"
    if policy is None:
        return
    try:
        jax.eval_shape(loop.rule.order, Offer(*[jax.ShapeDtypeStruct((1,), np.int32)] * 6))
    except (TypeError, OverflowError) as error:
        raise WorldError(
            f"the order of rule {loop.rule.name} cannot be traced by JAX", expected="arithmetic alone", fix=fix
        ) from error
    longest = int(loop.tables.cost_to.max()) * (1 + loop.comes_home)  # a way home may get dearer by as much
    sizes = np.bincount(loop.tables.level, weights=np.diff(loop.tables.begin), minlength=len(policy.entry))
    try:
        for level, (cells, entry) in enumerate(zip(sizes, policy.entry, strict=True)):
            with np.errstate(over="raise"):
                left = max(int(cells), 1)
                most = left if len(policy.value) == 0 else left * int(policy.value.max())
                for value in (most, 0)[: 1 + (len(policy.value) > 0)]:
                    said = (level, longest, left, int(entry), value, policy.beyond)
                    offer = Offer(*map(np.int32, said))
                    np.int32(policy.scale if policy.worth else 1) * price(offer)
                    denominators = [int(denominator) for _, denominator in loop.rule.order(offer)]
                    if max(denominators) > (LARGEST if len(policy.value) else LARGEST_DENOMINATOR):
                        raise OverflowError
    except (FloatingPointError, OverflowError) as error:
        raise WorldError(
            f"prices of areas too large for policy {loop.rule.name} to be compared in 32 bits",
            expected=f"numerators below 2**31, denominators up to {LARGEST_DENOMINATOR} for the closed loop in JAX",
            fix=f"{fix}, or raise the smallest threats",
        ) from error


PIECES, PIECE_BITS = 3, 16
"""Of a whole number below 2**48: sums of a piece over 2**15 cells fit into 32 bits."""
WORD_BITS = 32
LABEL_BITS = 15
LABEL = 2**LABEL_BITS - 1
PENDING, VISITED, SURVIVED, OPEN, SPENT = 1 << 15, 1 << 16, 1 << 17, 1 << 18, 1 << 19
"""A cell's word: the label of its area (the area's lowest cell when it was made), and these bits.

PENDING: to be visited by whoever covers the area: nobody has visited it, or somebody passed through it while its owner,
whose path is fixed, was already covering. OPEN: its area was unassigned when it was last looked at. SPENT: a hit has
made it harmless.
"""
OWNER_SHIFT = 16
"""An area's word stands at its label: unvisited cells, and above them its robot + 1 (0: unassigned)."""
UNREACHABLE = 2**30
"""Larger than every cost and than the sum of any two."""
CELL_BUCKETS = (160, 320, 448, 896, 1120, 1792, 2432, 3136, 4256, 5504, 6592, 8192, MOST_TABLED + 1)
"""Worlds of 20, 32, 48 and 64 cells a side just fit, with and without a quarter of obstacles; one cell stays free."""
BOARD_BUCKETS = (448, 1120, 2432, 4256, 6592, 9600, *(2**power for power in range(14, 31)))
"""Multiples of 32 that squares of 20, 32, 48, 64, 80 and 97 cells a side just fit."""
ROBOT_BUCKETS = (8, 32, 64, 128, 256, 512, 1024)
LEAST_LEVELS = 16
NEAREST = 16
"""Cells of an area's level among which the next one of a coverage path is looked for first."""
LEAST_PATHS = 2**10
SIDES = 4
"""Neighbours of a cell."""
CELLS_AT_A_TIME = 256
"""Rows of the square tables that are made at a time."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class LaneTables:
    """What every lane reads.

    Attributes:
        hop: uint16 `[A * A]`, first cell of the safest path from row to column; the cell itself where they are equal.
        nearest: uint16 `[A * L * NEAREST]`, for each cell and level the cheapest cells by (cost, index); "no cell"
            after the last that it can reach.
        cost: int32 `[A, A]`, UNREACHABLE where it is.
        sweep: uint16 `[A * SIDES]`, the neighbours, the one that goes first on coverage paths first; "no cell" if none.
        exposure: uint32 `[A, 2]`, what a visit adds to a robot's exposure (`mrac_jax.arrays`). doubt: how much it is
            in a rollout where the map is in doubt, else None.
        level: int32 `[A]`, level of each cell's area.
        starts: int32 `[K]`.
        range: int32 `[K]`, moves that each can make; None: any number. homes: of robots that come home; None: they do
            not, else there is a range.
        paths: of another planner, followed first: their cells, uint16, robot after robot; where each robot's begins,
            and its last step, int32 `[K]` each; None: there are none.
        robots: uint32 `[W]`, bits of the robots.
        spot: int32 `[A]`, each cell's place on a board; cell_at: int32 `[P]`, the cell there, "no cell" for walls.
        stride: int32 scalar, from a place on a board to the one below it.
        accessible, max_steps: int32 scalars: accessible cells, T_max.
        first_only: bool scalar, `threat_checks="first_visit"`.
        policy: what attentive robots decide by; None: the paper's rule.
        weights: int32 `[PIECES, A]`, and `[PIECES, A, MOST_PASSES + 1]`: `ClosedLoop.weights` in pieces of PIECE_BITS
            bits, the trailing ones first; None: survived visits are not counted.
    """

    hop: Array
    nearest: Array
    cost: Array
    sweep: Array
    exposure: Array
    doubt: Doubt | None
    level: Array
    starts: Array
    range: Array | None
    homes: Homes | None
    paths: tuple[Array, Array, Array] | None
    robots: Array
    spot: Array
    cell_at: Array
    stride: Array
    accessible: Array
    max_steps: Array
    first_only: Array
    policy: LanePolicy | None
    weights: tuple[Array, Array] | None

    @property
    def size(self) -> int:
        """A."""
        return self.level.shape[0]

    @property
    def levels(self) -> int:
        """L."""
        return self.nearest.shape[0] // (self.size * NEAREST)

    @property
    def none(self) -> int:
        """The padding cell that stands for "no cell" and "no area"."""
        return self.size - 1


def bucket(size: int, buckets: tuple[int, ...]) -> int:
    """The least of the buckets that is at least `size`."""
    return next(one for one in buckets if one >= size)


def step_bucket(max_steps: int, cells: int) -> int:
    """Steps that the counts by step have room for: one number for all but worlds of unusually many levels."""
    usual = 8 * LEAST_LEVELS * cells + 64
    return 1 << max(usual.bit_length(), max_steps.bit_length())


def check_supported(loop: ClosedLoop) -> None:
    """Raise WorldError for a world that the lanes have no room for: a large map, or costs beyond 30 bits; and for a
    policy that they do not follow (`check_policy`). Raise UsageError for legs that are to stay
    in their area, and for robots that differ.
    """
    fix = f"use {argument('engine', 'numba')}"
    if loop.stay_inside:
        what = f"{argument('engine', 'jax')} with {argument('transit', 'area')}"
        raise UsageError(what, expected=argument("transit", "grid"), fix=fix)
    if len(loop.tables.phases):
        raise WorldError("threats that change with time, in the closed loop in JAX", fix=fix)
    if loop.is_mixed:
        named = argument(
            "types" if len(loop.tables.type_of) else "steps_per_move" if len(loop.tables.pace) else "radio"
        )
        raise UsageError(f"{argument('engine', 'jax')} with {named}, in the closed loop", fix=fix)
    if loop.learns:
        raise WorldError("robots that learn the map, in the closed loop in JAX", fix=fix)
    if not loop.tabled:
        size = f"a map of {loop.shape[0]} x {loop.shape[1]} cells, {len(loop.cells)} of them accessible"
        raise WorldError(size, expected=f"at most {MOST_TABLED} accessible ones for the closed loop in JAX", fix=fix)
    if int(loop.tables.cost_to.max()) * 2 >= UNREACHABLE:
        expected = "threats whose ratios keep the costs of eq. (3) below that for the closed loop in JAX"
        raise WorldError("costs of 2**29 and more", expected=expected, fix=f"{fix}, or fewer {argument('levels')}")
    if loop.movers is not None:
        raise WorldError(loop.movers.said, expected="threats that stand still in JAX", fix=fix)
    check_policy(loop)


def board_places(loop: ClosedLoop) -> tuple[NDArray[np.int64], int, int]:
    """(each accessible cell's place on a board, stride, places used)."""
    row, col = np.divmod(loop.cells, loop.shape[1])
    row, col = row - row.min(), col - col.min()
    stride = int(col.max()) + 2
    return row * stride + col, stride, (int(row.max()) + 2) * stride


def lane_tables(loop: ClosedLoop, seed: int, least: tuple[int, int] = (1, 1)) -> LaneTables:
    """The padded tables, with room for at least so many (cells, robots).

    Raises WorldError or UsageError (`check_supported`).
    """
    check_supported(loop)
    tables, count, team = loop.tables, len(loop.cells), len(loop.tables.starts)
    places, stride, used = board_places(loop)
    # One cell more than there are: the wall.
    size, robots = bucket(max(count + 1, least[0]), CELL_BUCKETS), bucket(max(team, least[1]), ROBOT_BUCKETS)
    board, none = bucket(max(used, least[0]), BOARD_BUCKETS), size - 1
    cell_at = np.full(board, none, dtype=np.int32)
    cell_at[places] = np.arange(count)
    sweep = np.full((size, SIDES), none, dtype=np.uint16)
    sweep[:count] = np.where(tables.sweep == count, none, tables.sweep)
    level = tables.level[areas_at(loop)]
    cost, hop = _squares(loop, size)
    limited = loop.comes_home or bool((tables.range < NO_LIMIT).any())
    return on_host(
        LaneTables,
        hop=hop.reshape(-1),
        nearest=_nearest(cost, level, none),
        cost=cost,
        sweep=sweep.reshape(-1),
        exposure=two_words(np.pad(tables.exposure, (0, size - count))),
        doubt=make_doubt(tables, own_key(seed, loop.purpose), len(tables.spent) > 0, size) if loop.in_doubt else None,
        level=padded(level, size, 0),
        starts=padded(tables.starts, robots, none),
        range=padded(np.minimum(tables.range, MAX_STEP + 1), robots, 0) if limited else None,
        homes=lane_homes(loop, size, robots, (1, *ROBOT_BUCKETS)),
        paths=_paths(loop, robots) if len(tables.given) else None,
        robots=bits_of_robots(np.arange(team), robots),
        spot=padded(places, size, board - 1),
        cell_at=cell_at,
        stride=np.int32(stride),
        accessible=np.int32(count),
        max_steps=np.int32(loop.max_steps),
        first_only=np.bool_(loop.first_only),
        policy=lane_policy(loop, padded(level, size, 0), robots),
        weights=_weights(loop, size),
    )


def areas_at(loop: ClosedLoop) -> NDArray[np.int64]:
    """The area of each cell as rollouts begin, int64 `[A']`."""
    tables, area_of = loop.tables, np.empty(len(loop.cells), dtype=np.int64)
    area_of[tables.order] = np.repeat(np.arange(len(tables.level)), np.diff(tables.begin))
    return area_of


def _paths(loop: ClosedLoop, robots: int) -> tuple[NDArray[np.uint16], NDArray[np.int32], NDArray[np.int32]]:
    """`paths` of LaneTables."""
    tables = loop.tables
    cells = np.concatenate([path[: last + 1] for path, last in zip(tables.given, tables.length, strict=True)])
    begin = np.cumsum(tables.length + 1) - tables.length - 1
    room = max(LEAST_PATHS, 1 << (len(cells) - 1).bit_length())
    return (
        np.pad(cells, (0, room - len(cells))).astype(np.uint16),
        padded(begin, robots, 0),
        padded(tables.length, robots, 0),
    )


def _weights(loop: ClosedLoop, size: int) -> tuple[NDArray[np.int32], NDArray[np.int32]] | None:
    """The weights in pieces, padded with nothing."""
    if loop.weights is None:
        return None
    shifts, piece = PIECE_BITS * np.arange(PIECES), 2**PIECE_BITS - 1
    covered, found = np.zeros((PIECES, size), np.int32), np.zeros((PIECES, size, MOST_PASSES + 1), np.int32)
    covered[:, : len(loop.cells)] = loop.weights.covered >> shifts[:, None] & piece
    found[:, : len(loop.cells)] = loop.weights.found >> shifts[:, None, None] & piece
    return covered, found


def _squares(loop: ClosedLoop, size: int) -> tuple[NDArray[np.int32], NDArray[np.uint16]]:
    """`cost` and `hop` `[A, A]` of LaneTables, a few rows at a time: on large maps they are most of the memory."""
    count, tables = len(loop.cells), loop.tables
    cost = np.full((size, size), UNREACHABLE, dtype=np.int32)
    hop = np.full((size, size), size - 1, dtype=np.uint16)
    for begin in range(0, count, CELLS_AT_A_TIME):
        some = slice(begin, min(begin + CELLS_AT_A_TIME, count))
        cost[some, :count] = np.where(tables.cost_to[some] < 0, UNREACHABLE, tables.cost_to[some])
        hop[some, :count] = tables.hop_to[:, some].T
    # Who is there stays there: a hop from a cell to itself is no move.
    np.fill_diagonal(hop[:count, :count], np.arange(count))
    return cost, hop


def _nearest(cost: NDArray[np.int32], level: NDArray[np.int32], none: int) -> NDArray[np.uint16]:
    """`nearest` of LaneTables: int32 `[A, A]` costs and the levels `[A']` of the cells that are not padding."""
    levels = max(LEAST_LEVELS, 1 << int(level.max()).bit_length())
    nearest = np.full((len(cost), levels, NEAREST), none, dtype=np.uint16)
    for one in np.unique(level):
        members = np.flatnonzero(level == one)
        kept = min(len(members), NEAREST)
        for begin in range(0, len(level), CELLS_AT_A_TIME):
            some = slice(begin, min(begin + CELLS_AT_A_TIME, len(level)))
            # Cost and index in one number, so that one sort breaks ties by index.
            key = (cost[some][:, members].astype(np.int64) << LABEL_BITS) | members
            key = np.sort(np.partition(key, kept - 1, axis=1)[:, :kept], axis=1)
            nearest[some, one, :kept] = np.where(key >> LABEL_BITS < UNREACHABLE, key & LABEL, none)
    return nearest.reshape(-1)


def bits_of_robots(robots: NDArray, size: int) -> NDArray[np.uint32]:
    """uint32 `[W]` of the numbers of some of `size` robots."""
    flags = np.zeros(-(-size // WORD_BITS) * WORD_BITS, dtype=np.bool_)
    flags[robots] = True
    return np.packbits(flags, bitorder="little").view("<u4").astype(np.uint32)
