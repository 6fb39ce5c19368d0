"""The pictures of `mrac-jax clear`: what each threat is worth after replanning, and where risk is paid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from analysis.kit.words import counted
from analysis.pictures.maps import draw_borders, map_figure, paint, terrain_handles, with_key
from analysis.pictures.robots import group_labels
from analysis.pictures.style import COVERED, HALO, INK, LOSSES, Key, cell_points, whole_ticks
from analysis.removal.answer import Clearing, Threat
from analysis.removal.table import KINDS_OF_GAIN, headline

PICK = "#b3263a"
LABELLED, LONGEST = 12, 14
"""Threats, the best first, that are named where there is room, and letters that a name may have."""
PAID = "What one percent of threat more in a cell would cost"


def clearing_figure(clearing: Clearing) -> Figure:
    """The threats that were simulated, by what robots gain that know they are gone; the picks have a red border."""
    world, first = clearing.world, clearing.turns[0]
    accessible = world.accessible(clearing.starts)
    gain = clearing.by_cell(lambda one: one.known)
    figure, layout = map_figure(world, 4)
    axes = figure.axes[0]
    scale = ScalarMappable(Normalize(0.0, float(gain.max()) or 1.0), COVERED)
    paint(axes, world, accessible, gain, scale)
    points = cell_points(axes, world.shape)
    thin, thick = min(0.8, 0.06 * points), float(np.clip(0.16 * points, 1.2, 2.4))
    for one in clearing.options:
        _border(axes, world.shape, one.threat, "#6b5b52", thin, 0.75)
    for threat in clearing.picks:
        _border(axes, world.shape, threat, PICK, thick, 1.0)
    best = [one.threat for one in first.simulated[:LABELLED]]
    middles = np.array([_middle(threat.cells, world.shape) for threat in best])
    for label in group_labels(middles, world.shape, points, lambda group: _short(best, group)):
        row, col = label.place
        bold = best[label.members[0]] in clearing.picks
        axes.text(col, row, label.name, ha="center", va="center", fontsize=7.5, color=PICK if bold else INK,
                  fontweight="bold" if bold else "normal", path_effects=HALO, zorder=4)  # fmt: skip
    _mark_starts(axes, clearing, points)
    handles = (Line2D([], [], color=PICK, linewidth=2.0, label="picked"), *_handles(clearing, accessible))
    key = Key(
        title=headline(clearing).removesuffix("."),
        subtitle=f"{counted(len(clearing.starts), 'robot')}, {clearing.cells:,} accessible cells; colour: gained "
        f"after replanning; named: the best {len(best)}",
        scale=scale,
        label=f"{KINDS_OF_GAIN[clearing.unit].lower()} gained on average",
        handles=handles,
    )
    return with_key(figure, layout, key)


def paid_figure(clearing: Clearing) -> Figure:
    """The open loop's gradient: where the team's paths pay for risk. No advice on what to clear."""
    world = clearing.world
    accessible = world.accessible(clearing.starts)
    figure, layout = map_figure(world, 3)
    axes = figure.axes[0]
    paid = np.maximum(clearing.risk_paid, 0.0)
    scale = ScalarMappable(PowerNorm(0.5, 0.0, float(paid.max()) or 1.0), LOSSES)
    paint(axes, world, accessible, paid, scale)
    _mark_starts(axes, clearing, cell_points(axes, world.shape))
    top = [tick for tick in whole_ticks(5, integer=False).tick_values(0.0, float(paid.max()) or 1.0) if tick >= 0]
    key = Key(
        title="Where risk is paid",
        subtitle=f"{PAID}, open loop, same paths: the price of risk as it is, no advice on what to clear",
        scale=scale,
        label="cells lost per percent of threat",
        ticks=np.array([tick for tick in top if tick <= (float(paid.max()) or 1.0)]),
        tick_labels=tuple(f"{tick:g}" for tick in top if tick <= (float(paid.max()) or 1.0)),
        handles=_handles(clearing, accessible),
    )
    return with_key(figure, layout, key)


def _border(axes: Axes, shape: tuple[int, int], threat: Threat, colour: str, width: float, alpha: float) -> None:
    """Each by itself: those of a scenario may overlap."""
    inside = np.zeros(shape, dtype=np.int64)
    inside.reshape(-1)[threat.cells] = 1
    draw_borders(axes, inside, colour, width, alpha=alpha)


def _short(threats: Sequence[Threat], group: list[int]) -> str:
    """The name of the first of some, and that there are more."""
    name = threats[group[0]].name.removeprefix("area ")
    return (name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…") + ("+" if len(group) > 1 else "")


def _middle(cells: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """The cell of a threat that is nearest to its middle, (row, col)."""
    places = np.stack(np.divmod(cells, shape[1]), axis=1)
    middle: NDArray[np.int64] = places[np.sum((places - places.mean(axis=0)) ** 2, axis=1).argmin()]
    return middle


def _mark_starts(axes: Axes, clearing: Clearing, points: float) -> None:
    rows, cols = clearing.starts.T
    size = float(np.clip(0.5 * points, 4.0, 8.0))
    axes.plot(cols, rows, "o", color=INK, markersize=size, markeredgecolor="white", mew=0.8, linestyle="", zorder=5)


def _handles(clearing: Clearing, accessible: NDArray[np.bool_]) -> tuple[Artist, ...]:
    start = Line2D([], [], color=INK, marker="o", linestyle="", markersize=7, markeredgecolor="white", label="start")
    return (start, *terrain_handles(clearing.world, accessible))
