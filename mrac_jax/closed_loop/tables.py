"""A closed loop compiled for lanes: `planner.kernels.closed_loop.ClosedLoop` -> padded tables of few shapes.

Lane: the place of one rollout in a batch. Cells are numbered row by row over the smallest rectangle that holds the
accessible ones, a wall after each row and a row of walls after the last, then padding; the last number always is a wall
and stands for "no cell" and "no area". So a cell's neighbours are one, or one `stride`, away, in the order of the map's
indices. Axis letters: `A` cells in this numbering, `K` robots, `W` words of robot bits, `L` levels, `T` steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from planner.errors import WorldError
from planner.kernels.closed_loop import ClosedLoop

Array: TypeAlias = Any
"""A NumPy array on the host, a JAX array on a device."""
WORD_BITS = 32
LABEL_BITS = 15
LABEL = 2**LABEL_BITS - 1
PENDING, VISITED, SURVIVED, OPEN = 1 << 15, 1 << 16, 1 << 17, 1 << 18
"""A cell's word: the label of its area (the area's lowest cell when it was made), and these bits.

PENDING: to be visited by whoever covers the area: nobody has visited it, or somebody passed through it while its owner,
whose path is fixed, was already covering. OPEN: its area was unassigned when it was last looked at.
"""
OWNER_SHIFT = 16
"""An area's word stands at its label: unvisited cells, and above them its robot + 1 (0: unassigned)."""
UNREACHABLE = 2**30
"""Larger than every cost and than the sum of any two."""
CELL_BUCKETS = (64, 160, 448, 1120, 2432, 4256, 6592, 9600)
"""Multiples of 32 that worlds of 6, 11, 20, 32, 48, 64, 80 and 97 cells a side just fit."""
ROBOT_BUCKETS = (8, 32, 64, 128, 256, 512, 1024)
LEAST_LEVELS = 16
NEAREST = 16
"""Cells of an area's level among which the next one of a coverage path is looked for first."""
OUT_OF_REACH = 2**16 - 1


@dataclass(frozen=True, eq=False)
class LaneTables:
    """What every lane reads.

    Attributes:
        hop: uint16 `[A * A]`, first cell of the safest path from row to column; the cell itself where they are equal.
        nearest: uint16 `[A * A + NEAREST]`, for each cell the cells by (level, cost, index); "no cell" for those that
            it cannot reach, at the end of their level.
        rank: uint16 `[A, A]`, how good each cell is to a robot in search of an area; OUT_OF_REACH.
        cost: int32 `[A, A]`, UNREACHABLE where it is.
        bound: uint32 `[A]`, a visit stops the robot iff the 24 leading bits of its word are below this.
        level: int32 `[A]`, level of each cell's area. level_start: int32 `[L + 1]`, where each begins in `nearest`.
        starts, first_target: int32 `[K]`; first_area: int32 `[K]`, label of the area that each has at t = 0.
        robots: uint32 `[W]`, bits of the robots; assigned: uint32 `[W]`, of those with an area at t = 0.
        cells, areas: uint32 `[A]`, words of a fresh rollout; ids: int32 `[A]`, id of each area at its label.
        cell_ids: int32 `[A]`, id of each cell's area at t = 0.
        waiting: int32 scalar, unassigned areas at t = 0.
        stride: int32 scalar, from a cell to the one below it.
        accessible, given, max_steps: int32 scalars: accessible cells, areas at t = 0, T_max.
        first_only: bool scalar, `threat_checks="first_visit"`.
    """

    hop: Array
    nearest: Array
    rank: Array
    cost: Array
    bound: Array
    level: Array
    level_start: Array
    starts: Array
    first_target: Array
    first_area: Array
    robots: Array
    assigned: Array
    cells: Array
    areas: Array
    ids: Array
    cell_ids: Array
    waiting: Array
    stride: Array
    accessible: Array
    given: Array
    max_steps: Array
    first_only: Array

    @property
    def size(self) -> int:
        """A."""
        return self.cells.shape[0]

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
    """Raise WorldError for a world that the lanes have no room for: a large map, or costs beyond 30 bits."""
    fix = "use --engine numba"
    if not loop.tabled or numbering(loop)[2] > CELL_BUCKETS[-1]:
        size = f"a map of {loop.shape[0]} x {loop.shape[1]} cells, {len(loop.cells)} of them accessible"
        raise WorldError(size, expected=f"at most {CELL_BUCKETS[-1]} cells for the closed loop in JAX", fix=fix)
    if int(loop.tables.cost_to.max()) * 2 >= UNREACHABLE:
        expected = "threats whose ratios keep the costs of eq. (3) below that for the closed loop in JAX"
        raise WorldError("costs of 2**29 and more", expected=expected, fix=f"{fix}, or fewer --levels")


def numbering(loop: ClosedLoop) -> tuple[NDArray[np.int64], int, int]:
    """(number of each accessible cell, stride, numbers used)."""
    row, col = np.divmod(loop.cells, loop.shape[1])
    row, col = row - row.min(), col - col.min()
    stride = int(col.max()) + 2
    return row * stride + col, stride, (int(row.max()) + 2) * stride


def lane_tables(loop: ClosedLoop, least: tuple[int, int] = (1, 1)) -> LaneTables:
    """The padded tables, with room for at least so many (cells, robots). Raises WorldError (`check_supported`)."""
    check_supported(loop)
    tables, count, team = loop.tables, len(loop.cells), len(loop.tables.starts)
    number, stride, used = numbering(loop)
    size, robots = bucket(max(used, least[0]), CELL_BUCKETS), bucket(max(team, least[1]), ROBOT_BUCKETS)
    none = size - 1
    sizes = np.diff(tables.begin)
    lowest = number[np.minimum.reduceat(tables.order, tables.begin[:-1])]
    area_of = np.empty(count, dtype=np.int64)
    area_of[tables.order] = np.repeat(np.arange(len(sizes)), sizes)
    level = tables.level[area_of]
    levels = max(LEAST_LEVELS, 1 << int(level.max()).bit_length())
    cost = np.where(tables.cost_to < 0, UNREACHABLE, tables.cost_to).astype(np.int32)
    owned = tables.owner >= 0
    areas = _spread(sizes + ((tables.owner + 1) << OWNER_SHIFT), lowest, size, 0).astype(np.uint32)
    first_area, first_target = np.full(robots, none, dtype=np.int32), np.full(robots, none, dtype=np.int32)
    first_area[tables.owner[owned]] = lowest[owned]
    first_target[:team] = number[tables.starts]
    for area in np.flatnonzero(owned):
        members, robot = np.flatnonzero(area_of == area), tables.owner[area]
        first_target[robot] = number[members[cost[tables.starts[robot], members].argmin()]]
    starts = np.full(robots, none, dtype=np.int32)
    starts[:team] = number[tables.starts]
    nearest, rank = _preferences(cost, level, number, size)
    return LaneTables(
        hop=_square(number[_hops(tables.hop_to.T)], number, size, none).reshape(-1).astype(np.uint16),
        nearest=nearest,
        rank=rank,
        cost=_square(cost, number, size, UNREACHABLE),
        bound=_spread(tables.bound, number, size, 0).astype(np.uint32),
        level=_spread(level, number, size, 0),
        level_start=np.searchsorted(np.sort(level), np.arange(levels + 1)).astype(np.int32),
        starts=starts,
        first_target=first_target,
        first_area=first_area,
        robots=_bits(np.arange(team), robots),
        assigned=_bits(tables.owner[owned], robots),
        cells=_spread(
            lowest[area_of] | PENDING | np.where(owned[area_of], 0, OPEN), number, size, none | VISITED
        ).astype(np.uint32),
        areas=areas,
        ids=_spread(np.arange(len(sizes)), lowest, size, 0),
        cell_ids=_spread(area_of, number, size, -1),
        waiting=np.int32((~owned).sum()),
        stride=np.int32(stride),
        accessible=np.int32(count),
        given=np.int32(len(sizes)),
        max_steps=np.int32(loop.max_steps),
        first_only=np.bool_(loop.first_only),
    )


def next_area_rank(level: NDArray[np.int32], cost: NDArray[np.int32]) -> NDArray[np.int64]:
    """The rule that picks the next area: the rank of every cell, `[A]`; the least wins, of equals the least area id.

    From the cells' levels and their costs from where the robot is, int32 `[A]`: by (level, cost) (SPEC section 5,
    `Allocate Next Area`).
    """
    order = np.lexsort((cost, level))
    by_cost, by_level = cost[order], level[order]
    changes = np.concatenate([[False], (by_cost[1:] != by_cost[:-1]) | (by_level[1:] != by_level[:-1])])
    rank = np.empty(len(cost), dtype=np.int64)
    rank[order] = np.cumsum(changes)
    return rank


def _preferences(
    cost: NDArray[np.int32], level: NDArray[np.int32], number: NDArray[np.int64], size: int
) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
    """`nearest` and `rank` of LaneTables."""
    count, none = len(cost), size - 1
    nearest = np.full((size, size), none, dtype=np.uint16)
    rank = np.full((size, size), OUT_OF_REACH, dtype=np.uint16)
    for cell in range(count):
        order, reached = np.lexsort((cost[cell], level)), cost[cell] < UNREACHABLE
        nearest[number[cell], :count] = np.where(reached[order], number[order], none)
        rank[number[cell], number] = np.where(reached, next_area_rank(level, cost[cell]), OUT_OF_REACH)
    return np.concatenate([nearest.reshape(-1), np.full(NEAREST, none, dtype=np.uint16)]), rank


def _hops(hop_to: NDArray) -> NDArray[np.int64]:
    hops = hop_to.astype(np.int64)
    np.fill_diagonal(hops, np.arange(len(hops)))
    return hops


def _spread(values: NDArray, places: NDArray[np.int64], size: int, fill: int) -> NDArray[np.int32]:
    """int32 `[size]` with the values at their places."""
    out = np.full(size, fill, dtype=np.int32)
    out[places] = values
    return out


def _square(values: NDArray, number: NDArray[np.int64], size: int, fill: int) -> NDArray[np.int32]:
    out = np.full((size, size), fill, dtype=np.int32)
    out[np.ix_(number, number)] = values
    return out


def _bits(robots: NDArray, size: int) -> NDArray[np.uint32]:
    words = np.zeros(-(-size // WORD_BITS), dtype=np.uint32)
    for robot in robots:
        words[robot // WORD_BITS] |= np.uint32(1) << np.uint32(robot % WORD_BITS)
    return words
