"""The picture of `mrac-jax starts`: coverage by depot, or the best starts, on the map by threat."""

from __future__ import annotations

import numpy as np
from matplotlib.artist import Artist
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.depots.answer import Starts
from analysis.depots.table import headline
from analysis.kit.words import counted, percent
from analysis.pictures.maps import map_figure, paint, terrain_handles, with_key
from analysis.pictures.style import COVERED, FAINT, INK, SHADES, Key, Look, cell_points, threat_scale
from planner.worlds.levels import find_levels

PICK = "#b3263a"
PALE = 0.45
"""How far the threats under the marks fade into white."""


def starts_figure(starts: Starts) -> Figure:
    """A mark for every place that was simulated, coloured by coverage; dots for those that were screened out."""
    world = starts.world
    accessible = world.accessible(starts.starts)
    figure, layout = map_figure(world, 5)
    axes = figure.axes[0]
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    levels = find_levels(world, accessible, starts.settings.levels)
    known = threat_scale(levels.values, float(threat.max()))
    scale = ScalarMappable(known.norm, known.colours)
    pale = ListedColormap(1 - PALE * (1 - known.colours(np.linspace(0, 1, SHADES))[:, :3]))
    paint(axes, world, accessible, threat, ScalarMappable(known.norm, pale) if starts.depot else scale)
    points = cell_points(axes, world.shape)
    rows, cols = starts.candidates.T
    axes.plot(cols, rows, ".", color=FAINT, markersize=float(np.clip(0.25 * points, 1.2, 3.5)), linestyle="", zorder=2)
    size = float(np.clip(points, 5.0, 11.0)) ** 2
    look: Look = {"marker": "o", "linestyle": "", "markeredgecolor": INK, "markersize": 7}
    handles: list[Artist] = [Line2D([], [], color=FAINT, marker=".", linestyle="", label="candidate")]
    ticks = levels.values
    if starts.depot:
        shown = [place for place in starts.simulated if place.counted is not None][::-1]
        values = np.array([100 * place.counted.mean for place in shown if place.counted is not None])
        low, high = float(values.min()), float(values.max())
        high = high if high > low else low + 1
        scale, ticks = ScalarMappable(Normalize(low, high), COVERED), np.linspace(low, high, 5)
        at, colours = np.array([place.starts[0] for place in shown]), scale.to_rgba(values)
        axes.scatter(at[:, 1], at[:, 0], s=size, c=colours, edgecolors=INK, linewidths=0.6, zorder=3)
        handles.append(Line2D([], [], color="white", label="simulated", **look))
    rows, cols = np.unique(starts.starts, axis=0).T
    fill = "none" if starts.depot else "white"
    axes.scatter(cols, rows, s=2.2 * size, c=fill, edgecolors=PICK, linewidths=1.8, zorder=4, clip_on=False)
    best = {**look, "markeredgecolor": PICK, "markersize": 9}
    handles += [Line2D([], [], color="white", label="to start at", **best), *terrain_handles(world, accessible)]
    team = counted(len(starts.starts), "robot")
    key = Key(
        title=headline(starts).removesuffix(".") if starts.depot else _title(starts),
        subtitle=f"{team} from {'one depot' if starts.depot else 'a start each'}, {starts.cells:,} accessible cells; "
        f"{len(starts.candidates):,} candidates, {len(starts.simulated)} simulated"
        + ("; pale: threats" if starts.depot else ""),
        scale=scale,
        label=f"{starts.covered} on average" if starts.depot else "chance that one visit stops the robot",
        ticks=ticks,
        tick_labels=tuple(f"{tick:.1f} %" if starts.depot else f"{100 * tick:.3g} %" for tick in ticks),
        handles=tuple(handles),
    )
    return with_key(figure, layout, key)


def _title(starts: Starts) -> str:
    shown = starts.chosen if starts.confirmed is None else starts.confirmed
    covered = "" if shown.counted is None else f": {percent(shown.counted.mean)} {starts.covered} on average"
    return f"{'Stay' if starts.stay else 'Best starts found'}, {counted(len(starts.starts), 'robot')}{covered}"
