"""Areas (Def. 2): connected components, METIS and wavefront splits, Algorithm 1's allocation, orders of sides."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pymetis
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from planner.plan.plan import Area
from planner.policies.rules import BOUSTROPHEDON, COLUMNS, ROWS
from planner.simulator.codes import NO_ROBOT
from planner.simulator.searches import BY_COLUMN, BY_INDEX, BY_ROW, NOT_WANTED, SafestPaths
from planner.world.levels import NO_LEVEL, ThreatLevels
from planner.world.world import FOUR_NEIGHBOURS


def connected_parts(shape: tuple[int, int], cells: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """The 4-connected components of cells.

    Args:
        shape: (H, W).
        cells: int64 `[cells]`, indices.

    Returns:
        The components ordered by lowest cell, each int64, increasing.
    """
    if len(cells) == 0:
        return []
    rows, cols = np.divmod(cells, shape[1])
    top, left = rows.min(), cols.min()
    # Labelled in the bounding box: areas are small compared with the map.
    window = np.zeros((rows.max() - top + 1, cols.max() - left + 1), dtype=np.bool_)
    window[rows - top, cols - left] = True
    labels, count = ndimage.label(window, structure=FOUR_NEIGHBOURS)
    if count == 1:
        return [np.sort(cells)]
    ordered = np.sort(cells)
    # In the order of the indices, so that each part's cells increase without sorting them again.
    label = labels[ordered // shape[1] - top, ordered % shape[1] - left]
    return split_by_label(ordered, label)


def split_by_label(ordered: NDArray[np.int64], label: NDArray) -> list[NDArray[np.int64]]:
    """Split increasing cell indices by their labels; the parts ordered by lowest cell.

    Args:
        ordered: int64 `[cells]`, increasing.
        label: int `[cells]`, from 0.
    """
    grouped = ordered[np.argsort(label, kind="stable")]
    ends = np.cumsum(np.bincount(label)).tolist()
    parts = (grouped[begin:end] for begin, end in itertools.pairwise([0, *ends]) if end > begin)
    return sorted(parts, key=lambda part: int(part[0]))


@lru_cache(maxsize=1)
def find_areas(shape: tuple[int, int], levels: ThreatLevels) -> list[tuple[int, NDArray[np.int64]]]:
    """Every area as (level, cells), level by level and by lowest cell within a level: the order of area ids.

    The last result is kept for other teams with the same levels.

    Args:
        shape: (H, W).
        levels: of the cells.

    Source: paper, Def. 2.
    """
    cells = np.flatnonzero(levels.of_cell != NO_LEVEL)
    parts = split_by_label(cells, connected_alike(shape, levels.of_cell)[0][cells])
    return sorted(((int(levels.of_cell[part[0]]), part) for part in parts), key=lambda area: area[0])


def connected_alike(shape: tuple[int, int], kind: NDArray[np.integer]) -> tuple[NDArray[np.int32], int]:
    """The 4-connected components of cells of equal kind, all kinds at once.

    Labelled on a grid with an extra position between neighbours, which is free if both are of one kind.

    Args:
        shape: (H, W).
        kind: int `[N]`; negative: no kind.

    Returns:
        (component of each cell int32 `[N]` from 1, 0 for no kind; number of components).
    """
    of = kind.reshape(shape)
    free = np.zeros((2 * shape[0] - 1, 2 * shape[1] - 1), dtype=np.bool_)
    free[::2, ::2] = of >= 0
    # The positions between cells connect only neighbours of one kind, so that one call labels all kinds.
    free[1::2, ::2] = (of[1:] == of[:-1]) & (of[1:] >= 0)
    free[::2, 1::2] = (of[:, 1:] == of[:, :-1]) & (of[:, 1:] >= 0)
    labels, count = ndimage.label(free, structure=FOUR_NEIGHBOURS)
    return labels[::2, ::2].ravel(), count


# Splits of an area into connected, balanced parts: METIS before the start, wavefront bisection at run time.
#
# Only this file imports METIS. Parts are always ordered by lowest cell.

Partition = Callable[[tuple[int, int], NDArray[np.int64], int], list[NDArray[np.int64]]]
"""`(shape, cells of a connected area, number of parts) -> parts`, as `metis_parts` and `wavefront_parts`."""


def metis_parts(shape: tuple[int, int], cells: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Split a connected area into `count` connected parts by multilevel k-way partitioning.

    METIS leaves parts empty on tiny areas and may disconnect one; then the wavefront split is used.

    Args:
        shape: (H, W).
        cells: int64, indices.
        count: `1 <= count <= len(cells)`.

    Source: paper, section 4.1; SPEC section 4.
    """
    ordered = np.sort(cells)
    if count == 1:
        return [ordered]
    starts, targets = _adjacency(shape, ordered)
    options = pymetis.Options(contig=1, seed=0)
    adjacency = pymetis.CSRAdjacency(starts, targets)
    _, label = pymetis.part_graph(count, adjacency=adjacency, recursive=False, options=options)
    parts, part_of = split_by_label(ordered, np.asarray(label)), np.full(shape[0] * shape[1], -1)
    part_of[ordered] = label
    # As many components as parts: no part is empty or disconnected.
    if len(parts) == count == connected_alike(shape, part_of)[1]:
        return parts
    return wavefront_parts(shape, ordered, count)


def wavefront_parts(shape: tuple[int, int], cells: NDArray[np.int64], count: int) -> list[NDArray[np.int64]]:
    """Split a connected area into `count` connected parts by repeated wavefront bisection, sizes nearly equal.

    Args and returns as in `metis_parts`.
    """
    if count == 1:
        return [np.sort(cells)]
    first = (count + 1) // 2
    # Half of the parts are cut off at a time: their share of the cells, rounded up.
    grown, rest = bisect(shape, cells, -(-len(cells) * first // count))
    share = round(count * len(rest) / len(cells))
    # The cut may miss its target, since the largest rest stays whole: parts are divided again by size.
    of_rest = min(max(share, 1, count - len(grown)), len(rest), count - 1)
    parts = wavefront_parts(shape, grown, count - of_rest) + wavefront_parts(shape, rest, of_rest)
    return sorted(parts, key=lambda part: int(part[0]))


def bisect(
    shape: tuple[int, int], cells: NDArray[np.int64], target: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Split a connected area of at least 2 cells in two connected parts.

    A breadth-first wavefront grows from a far end until it has `target` cells: whole layers, the last one in index
    order. Of the rest the largest component stays, the others join the grown part.

    Args:
        shape: (H, W).
        cells: int64, indices.
        target: None: half of the cells, rounded up.

    Returns:
        (grown, rest), int64, increasing.

    Source: SPEC section 5.
    """
    ordered = np.sort(cells)
    goal = min(target if target is not None else (len(cells) + 1) // 2, len(cells) - 1)
    starts, targets = _adjacency(shape, ordered)
    graph = csr_array((np.ones(len(targets)), targets, starts), shape=(len(cells), len(cells)))
    far_end = dijkstra(graph, unweighted=True, indices=0).argmax()
    # Stable: whole layers by their distance from the far end, the last one in index order.
    nearest_first = np.argsort(dijkstra(graph, unweighted=True, indices=far_end), kind="stable")
    rest = connected_parts(shape, ordered[np.sort(nearest_first[goal:])])
    # Smaller components of the rest join the grown part: they are connected to it only.
    stays = max(rest, key=lambda part: (len(part), -int(part[0])))
    return np.setdiff1d(ordered, stays, assume_unique=True), stays


def _adjacency(shape: tuple[int, int], ordered: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Compressed rows (starts, targets) of the 4-neighbour graph of the cells, nodes in increasing cell order."""
    height, width = shape
    node = np.full((height + 2) * (width + 2), -1, dtype=np.int64)
    padded = (ordered // width + 1) * (width + 2) + ordered % width + 1
    node[padded] = np.arange(len(ordered))
    sides = node[padded[:, None] + np.array([-(width + 2), -1, 1, width + 2])]
    present = sides >= 0
    return np.concatenate([[0], np.cumsum(present.sum(axis=1))]), sides[present]


# The allocation of areas before the start (Algorithm 1).


@dataclass(frozen=True)
class _SafeArea:
    number: int
    cells: NDArray[np.int64]
    robots: list[int]


def allocate_areas_to_robots(
    areas: list[tuple[int, NDArray[np.int64]]],
    starts: NDArray[np.int64],
    shape: tuple[int, int],
    paths: Sequence[SafestPaths],
    density: float,
    partition: Partition,
) -> tuple[Area, ...]:
    """Algorithm 1's initial allocation: the areas in id order with their owners.

    Args:
        areas: (level, cells) in id order.
        starts: int64 `[K]`, cell index of each robot.
        shape: (H, W).
        paths: of each robot.
        density: d; a safe area takes another robot while `robots in it * d <= cells`.
        partition: splits an area of several robots.

    Source: paper, Algorithm 1; SPEC section 4.
    """
    safe = [_SafeArea(number, cells, []) for number, (level, cells) in enumerate(areas) if level == 0]
    with_room = np.full(len(paths[0].neighbours), NOT_WANTED, dtype=np.int32)
    for place, area in enumerate(safe):
        with_room[area.cells] = place
    for robot, start in enumerate(starts.tolist()):
        target = paths[robot].nearest(start, with_room)
        if target is not None:
            area = safe[with_room[target.cell]]
            area.robots.append(robot)
            # Counted after this robot was added: the next one would make the area too dense.
            if len(area.robots) * density > len(area.cells):
                with_room[area.cells] = NOT_WANTED
    split = {area.number for area in safe if len(area.robots) > 1}
    owner = {area.number: area.robots[0] for area in safe if len(area.robots) == 1}
    whole = ((number, *area) for number, area in enumerate(areas) if number not in split)
    kept = [Area(level, owner.get(number, NO_ROBOT), cells) for number, level, cells in whole]
    for area in safe:
        if area.number in split:
            kept += _split_between(area, starts, shape, paths, partition)
    return tuple(kept)


def _split_between(
    area: _SafeArea,
    starts: NDArray[np.int64],
    shape: tuple[int, int],
    paths: Sequence[SafestPaths],
    partition: Partition,
) -> list[Area]:
    """One part of the area for each of its robots, by the Hungarian method on safest-path costs."""
    parts = partition(shape, area.cells, len(area.robots))
    from_each = (paths[robot].to_all(int(starts[robot])) for robot in area.robots)
    cells, begins = np.concatenate(parts), np.cumsum([0, *map(len, parts[:-1])])
    costs = np.array([np.minimum.reduceat(cost[cells], begins) for cost in from_each])
    # Robots as rows, parts as columns in order of lowest cell: SciPy's ties then follow from the plan alone.
    of_row, of_column = linear_sum_assignment(costs)
    robot_of_part = {int(part): area.robots[int(row)] for row, part in zip(of_row, of_column, strict=True)}
    return [Area(0, robot_of_part[number], part) for number, part in enumerate(parts)]


def sides_first(order: object, safe: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Priority of the sides of each cell on coverage paths.

    The order in a connected set of safe cells depends only on its shape, so a resumed mission keeps its order.

    Args:
        order: one of ORDERS, or a user's order.
        safe: bool `[H, W]`, cells of level 0; all others have their sides by index.

    Returns:
        int64 `[H * W, 4]`.

    Source: SPEC section 20.
    """
    # Only safe areas get another order: in dangerous ones few cells are adjacent and to do.
    sides = np.tile(BY_INDEX, (safe.size, 1))
    along_row = np.zeros(safe.shape, dtype=np.bool_)
    if order == ROWS:
        along_row = safe
    elif order == BOUSTROPHEDON:
        along_row = _fewer_in_rows(safe)
    if order in (ROWS, COLUMNS, BOUSTROPHEDON):
        sides[safe.ravel()] = BY_COLUMN
        sides[along_row.ravel()] = BY_ROW
    return sides


def _fewer_in_rows(safe: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The cells of connected sets that have at most as many straight runs in rows as in columns."""
    part, count = ndimage.label(safe, FOUR_NEIGHBOURS)
    begins_row, begins_column = safe.copy(), safe.copy()
    begins_row[:, 1:] &= ~safe[:, :-1]
    begins_column[1:] &= ~safe[:-1]
    runs = (np.bincount(part[begins], minlength=count + 1) for begins in (begins_row, begins_column))
    return safe & np.less_equal(*runs)[part]
