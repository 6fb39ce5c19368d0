"""The pictures of an evaluation, as PNG files: the world and the plan, coverage, losses, distribution, and time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.pictures_curves import draw_distribution, draw_over_time, summary_marks
from analysis.evaluation.pictures_maps import LISTED_ROBOTS, draw_covered, draw_losses, draw_world
from analysis.kit.folder import write_all
from analysis.pictures.style import (
    DPI,
    FAINT,
    FINE_DPI,
    FINE_FROM,
    INK,
    WIDTH,
    Key,
    MapLayout,
    heading,
    in_metres,
    inches,
    map_layout,
    new_figure,
    png_of,
)


def save_pictures(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write the five pictures into `folder` (made if it is not there); the paths in the order of `PICTURES`.

    Every picture is drawn before the first is written, and each is written whole or not at all. The same evaluation
    gives the same bytes.
    """
    return write_all(folder, draw_pictures(evaluation))


def draw_pictures(evaluation: Evaluation) -> dict[str, bytes]:
    """The five pictures as PNG files, by name."""
    return {name: png_of(make, evaluation) for name, make in PICTURES.items()}


def world_figure(evaluation: Evaluation) -> Figure:
    """The world by threat level, areas and every robot's nominal path."""
    figure, layout = _map_figure(evaluation, min(len(evaluation.plan.robots), LISTED_ROBOTS) + 4)
    return _with_key(figure, layout, draw_world(figure.axes[0], evaluation))


def covered_figure(evaluation: Evaluation) -> Figure:
    """The chance that each cell is covered in the evaluated loop."""
    figure, layout = _map_figure(evaluation)
    return _with_key(figure, layout, draw_covered(figure.axes[0], evaluation))


def losses_figure(evaluation: Evaluation) -> Figure:
    """Where robots are lost in the evaluated loop: the expected number in each cell."""
    figure, layout = _map_figure(evaluation)
    return _with_key(figure, layout, draw_losses(figure.axes[0], evaluation))


def distribution_figure(evaluation: Evaluation) -> Figure:
    """The distribution of coverage over rollouts, with means, quantiles and ideals above it."""
    rows = 0.24 * (len(summary_marks(evaluation)) + 1)
    figure = new_figure((WIDTH, 0.8 + rows + 3.6))
    summary = figure.add_axes(inches(figure, (2.15, 3.6, WIDTH - 3.75, rows)))
    axes = figure.add_axes(inches(figure, (2.15, 0.72, WIDTH - 3.75, 2.8)))
    draw_distribution(summary, axes, evaluation)
    return figure


def over_time_figure(evaluation: Evaluation) -> Figure:
    """Expected coverage over time."""
    figure = new_figure((WIDTH, 5.4))
    draw_over_time(figure.add_axes(inches(figure, (0.8, 1.4, WIDTH - 1.65, 3.25))), evaluation)
    return figure


PICTURES: dict[str, Callable[[Evaluation], Figure]] = {
    "world.png": world_figure,
    "covered.png": covered_figure,
    "losses.png": losses_figure,
    "distribution.png": distribution_figure,
    "over_time.png": over_time_figure,
}
"""File names, and what draws each."""


def _map_figure(evaluation: Evaluation, entries: int = 4) -> tuple[Figure, MapLayout]:
    """An empty figure for the map and a legend of `entries`: its first Axes is the map's."""
    world = evaluation.world
    layout = map_layout(world.shape, entries, in_metres(world.cell_size, world.origin))
    figure = new_figure(layout.size, FINE_DPI if max(evaluation.world.shape) > FINE_FROM else DPI)
    figure.add_axes(inches(figure, layout.map_box))
    return figure, layout


def _with_key(figure: Figure, layout: MapLayout, key: Key) -> Figure:
    """Heading, colour bar, legend and listed lines round the map."""
    heading(figure.axes[0], key.title, key.subtitle)
    below = layout.columns > 1
    bar_axes = figure.add_axes(inches(figure, layout.bar_box))
    bar = figure.colorbar(key.scale, cax=bar_axes, orientation="horizontal" if below else "vertical")
    if key.ticks is not None:
        bar.set_ticks(key.ticks.tolist(), labels=key.tick_labels)
    bar.ax.minorticks_off()
    bar.ax.tick_params(length=0, labelsize=8, labelcolor=INK)
    bar.outline.set_linewidth(0.5)
    bar.set_label(key.label, color=FAINT, fontsize=8.5)
    width, height = layout.size
    legend = figure.legend(
        handles=[handle for column in range(layout.columns) for handle in key.handles[column :: layout.columns]],
        loc="upper left",
        bbox_to_anchor=(layout.legend[0] / width, layout.legend[1] / height),
        ncols=layout.columns,
        borderaxespad=0,
        borderpad=0,
        handlelength=1.6,
    )
    if key.lines:
        under = layout.legend[1] - legend.get_window_extent().height / figure.dpi - 0.2
        across, up = layout.lines or (layout.legend[0], under)
        figure.text(across / width, up / height, "\n".join(key.lines), va="top", fontsize=8.5, linespacing=1.5)
    return figure
