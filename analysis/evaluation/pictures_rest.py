"""What a range cuts off, and what a mission's state leaves, on the map."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.rest import BEFORE, BEYOND, NAMES, TO_DO, Rest
from analysis.evaluation.words import how_known
from analysis.pictures.maps import SMALLEST, draw_borders, paint, terrain_handles
from analysis.pictures.plans import mark_starts, start_handle
from analysis.pictures.style import COVERED, Key, Look, cell_points
from planner.shown import counted

DONE, FAR, LOST = "#c9cdd4", "#b98fb5", "#b3263a"


def draw_rest(axes: Axes, evaluation: Evaluation, rest: Rest) -> Key:
    """The chance to cover what can still be; what was visited before, and what is too far, in a colour each."""
    world, plan = evaluation.world, evaluation.plan
    accessible = world.accessible(plan.starts)
    scale = ScalarMappable(Normalize(0.0, 1.0), COVERED)
    paint(axes, world, accessible, evaluation.expected.visited_by_cell.reshape(world.shape), scale)
    over, points = np.zeros((*world.shape, 4)), cell_points(axes, world.shape)
    handles: list[Artist] = []
    for kind, colour in ((BEFORE, DONE), (BEYOND, FAR)):
        held = accessible & (rest.kinds == kind)
        over[held] = to_rgba(colour)
        if held.any():
            handles.append(Patch(facecolor=colour, label=NAMES[kind]))
    axes.imshow(over, interpolation="nearest", zorder=0.5)
    if points >= SMALLEST:
        draw_borders(axes, np.where(accessible, rest.kinds, -1), "#6b5b52", min(0.8, 0.06 * points), alpha=0.75)
    mark_starts(axes, plan.starts, plan.shape, points)
    lost = [] if plan.state is None else [place for place, robot in enumerate(plan.state.robots) if not robot.alive]
    if lost:
        rows, cols = plan.starts[lost].T
        look: Look = {"color": LOST, "marker": "x", "linestyle": "", "markeredgewidth": 2.0}
        axes.plot(cols, rows, markersize=11, zorder=5, **look)
        handles.append(Line2D([], [], markersize=8, label="lost before", **look))
    to_do = accessible & (rest.kinds == TO_DO)
    expected = float(evaluation.expected.visited_by_cell.reshape(world.shape)[to_do].sum())
    ticks = np.linspace(0, 1, 6)
    return Key(
        title=rest.title,
        subtitle=f"of {counted(int(to_do.sum()), 'cell')} to do {expected:,.1f} are visited on average "
        f"({how_known(evaluation)})",
        scale=scale,
        label="chance that a cell to do is covered",
        ticks=ticks,
        tick_labels=tuple(f"{100 * x:.0f} %" for x in ticks),
        handles=(*handles, start_handle(plan.starts), *terrain_handles(world, accessible)),
    )
