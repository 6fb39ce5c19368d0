"""The maps: how likely each cell is covered, where robots are lost, and what value is left.

Each function draws on an Axes and returns the Key (title, colour scale, legend) that belongs around it.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.value import Value
from analysis.evaluation.words import how_known, lost_words
from analysis.kit.words import percent
from analysis.pictures.maps import SMALLEST, draw_borders, paint, terrain_handles
from analysis.pictures.plans import mark_starts, start_handle
from analysis.pictures.robots import (
    HALF,
    LABEL_HEIGHT,
    _near_groups,
    group_labels,
    label_width,
    ranges,
)
from analysis.pictures.style import (
    COVERED,
    INK,
    LOSSES,
    Key,
    Look,
    cell_points,
    whole_ticks,
)
from planner.plans.plan import Plan
from planner.shown import counted

WORST_CELLS = 5
RANK_HEIGHT = 10.0
"""Of the labels of the worst cells, in points."""


def draw_covered(axes: Axes, evaluation: Evaluation) -> Key:
    """The chance that each accessible cell is covered (visited); cells below one half are outlined."""
    world, plan, expected = evaluation.world, evaluation.plan, evaluation.expected
    accessible = world.accessible(plan.starts)
    chance = np.where(accessible, expected.visited_by_cell.reshape(world.shape), np.nan)
    scale = ScalarMappable(Normalize(0.0, 1.0), COVERED)
    paint(axes, world, accessible, chance, scale)
    points = cell_points(axes, world.shape)
    rare = accessible & (chance < HALF)
    outlined = bool(rare.any()) and points >= SMALLEST
    if outlined:
        draw_borders(axes, rare.astype(np.int64), "#b3263a", float(np.clip(0.12 * points, 0.7, 1.8)), alpha=1.0)
    mark_starts(axes, plan.starts, plan.shape, points)
    cells, below = int(accessible.sum()), int(rare.sum())
    outline = Line2D([], [], color="#b3263a", linewidth=1.6, label="below 50 %")
    ticks = np.linspace(0, 1, 6)
    return Key(
        title=f"Expected coverage: {percent(expected.visited / cells)} of the accessible cells",
        subtitle=f"{expected.visited:,.1f} of {counted(cells, 'cell')} (visited; {how_known(evaluation)}); "
        + (f"{counted(below, 'cell')} below 50 %" if below else "no cell below 50 %"),
        scale=scale,
        label="chance that the cell is covered",
        ticks=ticks,
        tick_labels=tuple(f"{100 * x:.0f} %" for x in ticks),
        handles=(*([outline] if outlined else []), start_handle(plan.starts), *terrain_handles(world, accessible)),
    )


def draw_losses(axes: Axes, evaluation: Evaluation) -> Key:
    """The expected number of robots lost in each cell; the worst cells are numbered and listed."""
    world, plan, expected = evaluation.world, evaluation.plan, evaluation.expected
    accessible, robots = world.accessible(plan.starts), len(plan.robots)
    lost = expected.stops_by_cell.reshape(world.shape)
    top = float(lost.max())
    scale = ScalarMappable(PowerNorm(0.5, 0.0, top or 1.0), LOSSES)
    ticks = _root_ticks(top)
    paint(axes, world, accessible, lost, scale)
    points = cell_points(axes, world.shape)
    worst = _worst_cells(lost)
    _mark_worst(axes, plan, worst, points)
    mark_starts(axes, plan.starts, plan.shape, points)
    listed = [
        f"{rank}  [{row}, {col}]  {_robots_lost(lost[row, col])}" for rank, (row, col) in enumerate(worst.tolist(), 1)
    ]
    return Key(
        title=f"Expected losses: {lost_words(expected.losses, robots)}",
        subtitle=f"{_none_or_all(evaluation)} ({how_known(evaluation)})",
        scale=scale,
        label="expected robots lost in the cell",
        ticks=ticks,
        tick_labels=tuple(f"{tick:g}" for tick in ticks),
        handles=(start_handle(plan.starts), *terrain_handles(world, accessible)),
        lines=("worst cells", *listed) if listed else ("no robot is lost",),
    )


def draw_left(axes: Axes, evaluation: Evaluation, value: Value) -> Key:
    """The expected value left in each cell, and the route that is to be safe."""
    world, plan = evaluation.world, evaluation.plan
    accessible, left = world.accessible(plan.starts), value.left_by_cell.reshape(world.shape)
    top = float(left[accessible].max(initial=0.0))
    scale = ScalarMappable(PowerNorm(0.5, 0.0, top or 1.0), LOSSES)
    ticks = _root_ticks(top)
    paint(axes, world, accessible, left, scale)
    handles = [start_handle(plan.starts), *terrain_handles(world, accessible)]
    if world.team.route is not None:
        rows, cols = world.team.route.T
        handles.insert(0, axes.plot(cols, rows, color=INK, linewidth=1.2, linestyle="--", label="the route")[0])
    mark_starts(axes, plan.starts, plan.shape, cell_points(axes, world.shape))
    share = value.found.mean / value.worth.total
    return Key(
        title=f"Expected value left: {value.left.mean:,.4g} of {value.worth.total:,.4g}",
        subtitle=f"{percent(share)} is found ({how_known(evaluation)})",
        scale=scale,
        label="expected value left in the cell",
        ticks=ticks,
        tick_labels=tuple(f"{tick:g}" for tick in ticks),
        handles=tuple(handles),
    )


def _root_ticks(top: float) -> NDArray[np.float64]:
    """Round numbers in `0 .. top` that lie well apart on a scale of square roots, from the largest down."""
    round_numbers = np.asarray(whole_ticks(8, integer=False).tick_values(0.0, top) if top else [0.0])
    shown: list[float] = []
    for value in sorted(x for x in round_numbers.tolist() if 0 <= x <= top)[::-1]:
        if not shown or np.sqrt(shown[-1] / top) - np.sqrt(value / top) > 0.1:
            shown.append(round(value, 12))
    return np.array(shown[::-1])


def _none_or_all(evaluation: Evaluation) -> str:
    """How often no robot is lost, and how often all are: chances where they are exact, else shares of the rollouts."""
    alive = evaluation.expected.alive_chance
    none, every = percent(alive[-1]), percent(alive[0])
    if evaluation.loop == "open":
        return f"chance that none is lost {none}, that all are {every}"
    return f"none is lost in {none} of the rollouts, all are in {every}"


def _robots_lost(number: float) -> str:
    return f"{number:.3f}" if number >= 0.01 else f"{number:.2g}"


def _worst_cells(lost: NDArray[np.float64]) -> NDArray[np.int64]:
    """(row, col) `[up to WORST_CELLS, 2]` of the cells that cost most robots, the worst first; ties by index."""
    order = np.argsort(-lost, axis=None, kind="stable")[:WORST_CELLS]
    order = order[lost.ravel()[order] > 0]
    return np.stack(np.divmod(order, lost.shape[1]), axis=1)


def _mark_worst(axes: Axes, plan: Plan, worst: NDArray[np.int64], points: float) -> None:
    """A frame round each of the worst cells, and its rank; cells too close together share a label."""
    inside = points >= 12
    for row, col in worst:
        width = 1.1 if inside else 0.5
        axes.add_patch(Rectangle((col - 0.5, row - 0.5), 1, 1, fill=False, edgecolor=INK, linewidth=width, zorder=3))
    box = {"boxstyle": "round,pad=0.12", "facecolor": "white", "edgecolor": "none"}
    font: Look = {"fontsize": 7, "fontweight": "bold", "color": INK, "bbox": box, "zorder": 3.5}
    groups = [([rank], str(rank + 1)) for rank in range(len(worst))]
    if not inside:
        near = _near_groups(worst, LABEL_HEIGHT / points)
        groups = [(group, ranges([rank + 1 for rank in group])) for group in near]
    starts = group_labels(plan.starts, plan.shape, points)
    taken = [(*label.place, LABEL_HEIGHT / points, label_width(label.name) / points) for label in starts]
    frames = [(float(row), float(col), 1.0, 1.0) for row, col in worst]
    for group, name in groups:
        row, col = worst[group[0]].tolist()
        size = (RANK_HEIGHT / points, (RANK_HEIGHT + 4.5 * (len(name) - 1)) / points)
        others = [frame for rank, frame in enumerate(frames) if not (inside and rank == group[0])]
        place = free_place((row, col), size, [*taken, *others], plan.shape, inside)
        taken.append((*place, *size))
        axes.text(place[1], place[0], name, ha="center", va="center", **font)


def free_place(
    cell: tuple[int, int],
    size: tuple[float, float],
    taken: list[tuple[float, float, float, float]],
    shape: tuple[int, int],
    inside: bool,
) -> tuple[float, float]:
    """Where a label (its middle, row and col) of `size` (height, width, in cells) best stands at a cell.

    In a corner of the cell if `inside`, else or where these are taken round it, farther out as need be: the first place
    on the map of `shape` that overlaps nothing of `taken` (row, col, height, width); if none is free, the least bad.
    """
    row, col = cell
    height, width = size
    corners = ((-1, -1), (-1, 1), (1, -1), (1, 1))
    places = [(row + down * (0.5 - height / 2), col + across * (0.5 - width / 2)) for down, across in corners]
    if not inside:
        places = []
    for far in (0.08, 0.6, 1.5, 3.0):
        down, across = 0.5 + height * (0.5 + far), 0.5 + width * (0.5 + far)
        ways = (*corners, (-1, 0), (1, 0), (0, -1), (0, 1))
        places += [(row + up * down, col + right * across) for up, right in ways]

    def overlap(place: tuple[float, float]) -> float:
        hidden = 0.0
        for at_row, at_col, high, wide in taken:
            down = (height + high) / 2 - abs(place[0] - at_row)
            across = (width + wide) / 2 - abs(place[1] - at_col)
            hidden += max(down, 0.0) * max(across, 0.0)
        return hidden

    margin = (height / 2 - 0.5, width / 2 - 0.5)
    held = [p for p in places if all(m <= x <= s - 1 - m for x, m, s in zip(p, margin, shape, strict=True))]
    return min(held or places, key=overlap)
