"""Rendering of a report: its page, and its charts and maps as pictures for slides and papers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from numpy.typing import NDArray

from analysis.page.charts import chart_html, charts_figure
from analysis.page.document import Html, PageSection, block, document, from_rich, pictures_section, reproduce_section
from analysis.page.elements import Chart
from analysis.page.maps import cell_maps_html, plan_map_html, scale_of
from analysis.pictures import (
    HALO,
    INK,
    PICK,
    Key,
    cell_points,
    draw_borders,
    group_labels,
    map_figure,
    mark_starts,
    paint,
    start_handle,
    terrain_handles,
    with_key,
)
from analysis.report.model import CellMaps, Report, Section

# The page of a report.

BROAD = 1.6
"""Ratio of width to height above which a map is placed below the answer instead of next to it."""


def page_of(report: Report, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML. Equal reports give equal bytes.

    Args:
        report: the report. command: the command line that made it.
        pictures: PNG files by name. files: names of the other files in the folder.
    """
    shown = None if report.picture is None else report.picture()
    height, width = shown.world.shape if isinstance(shown, CellMaps) else (1, 1)
    said, notes = report.findings, [f"Note: {note}" for note in report.notes]
    # With a picture the sentences are next to it; without one they are a section.
    findings = [] if shown is not None else [*said, *report.notes]
    words, notes = (said, notes) if shown is not None else ([], [])
    sections = (
        PageSection("Findings", block("findings", findings)),
        *map(_section, report.parts),
        PageSection("Settings", block("settings", report.heading, report.settings)),
        pictures_section(pictures),
        reproduce_section(command, files, report.again),
    )
    return document(
        sections, report=report, words=words, notes=notes, warnings=report.warnings,
        below=_charts(report.below(), "h2"), picture=None if shown is None else _html(shown, "h2"),
        broad=width > BROAD * height,
    )  # fmt: skip


def _section(part: Section) -> PageSection:
    shown, tables = part.figures(), [from_rich(table) for table in part.whole or part.tables]
    drawn = _charts([one for one in shown if isinstance(one, Chart)])
    drawn += Html("").join(_html(one) for one in shown if not isinstance(one, Chart))
    return PageSection(part.title, block("part", drawn, tables, part.notes), part.intro, part.collapsed)


def _charts(charts: Sequence[Chart], heading: str = "h3") -> Html:
    """The charts side by side; charts without data are omitted."""
    return block("charts", [html for chart in charts if (html := chart_html(chart, heading))])


def _html(drawn: Chart | CellMaps, heading: str = "h3") -> Html:
    """A chart or maps, under headings of this level; the maps of a plan have its paths and runs."""
    if isinstance(drawn, Chart):
        return chart_html(drawn, heading)
    maps, world, plan = drawn, drawn.world, drawn.plan
    if plan is not None:
        return plan_map_html(maps.layers, world, plan, *maps.runs, values_of=maps.values_of)
    return cell_maps_html(maps.layers, world, np.unique(maps.starts, axis=0), heading=heading, anchor=maps.anchor)


# Charts and maps as pictures for slides and papers.

BORDER = "#6b5b52"
NAMED, LONGEST = 12, 14
"""Most parts of a map that are labelled, and most characters of a label."""


def figure_of(report: Report, name: str) -> Figure:
    """The picture `name` of a report."""
    drawn = report.pictures[name]()
    if isinstance(drawn, Figure):
        return drawn
    return layer_figure(drawn) if isinstance(drawn, CellMaps) else charts_figure(drawn)


def layer_figure(maps: CellMaps) -> Figure:
    """The first layer on its map: discs or coloured cells, outlined and labelled parts, starts."""
    world, starts, layer = maps.world, maps.starts, maps.layers[0]
    accessible, scaled = world.accessible(starts), 100.0 if layer.unit else 1.0
    figure, layout = map_figure(world, 5)
    axes = figure.axes[0]
    top = layer.top or float(layer.values.max()) or 1.0
    scale = ScalarMappable(layer.norm or PowerNorm(0.5 if layer.root else 1.0, 0.0, top), scale_of(layer))
    paint(axes, world, accessible, np.zeros(world.shape) if layer.discs else layer.values, scale)
    points = cell_points(axes, world.shape)
    if layer.discs:
        rows, cols = np.nonzero(layer.values)
        size, colours = float(np.clip(points, 5.0, 11.0)) ** 2, scale.to_rgba(layer.values[rows, cols])
        axes.scatter(cols, rows, s=size, c=colours, edgecolors=INK, linewidths=0.6, zorder=3)
    _draw_parts(axes, maps, points)
    mark_starts(axes, starts, world.shape, points)
    heading = Key(layer.name, layer.about, scale, layer.unit and f"in {layer.unit}",
                  np.arange(len(layer.names), dtype=np.float64) if layer.names else None, layer.names,
                  handles=(start_handle(starts), *terrain_handles(world, accessible)), lines=maps.lines)  # fmt: skip
    with_key(figure, layout, heading)
    for axis in () if layer.names else (figure.axes[1].xaxis, figure.axes[1].yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{scaled * value:.3g}"))
    return figure


def _draw_parts(axes: Axes, maps: CellMaps, points: float) -> None:
    """Outline each part separately, because parts may overlap; label the first ones where the labels fit."""
    shape, thin, thick = maps.world.shape, min(0.8, 0.06 * points), float(np.clip(0.16 * points, 1.2, 2.4))
    for _, cells, stands_out in sorted(maps.parts, key=lambda part: part[2]):
        inside = np.zeros(shape, dtype=np.int64)
        inside.reshape(-1)[cells] = 1
        look = (PICK, thick, 1.0) if stands_out else (BORDER, thin, 0.75)
        draw_borders(axes, inside, *look)
    named = maps.parts[:NAMED]
    if not named:
        return
    middles = np.array([_middle(cells, shape) for _, cells, _ in named])
    for label in group_labels(middles, shape, points, lambda group: _short([named[one][0] for one in group])):
        row, col = label.place
        colour, weight = (PICK, "bold") if named[label.members[0]][2] else (INK, "normal")
        axes.text(col, row, label.name, ha="center", va="center", fontsize=7.5, color=colour, fontweight=weight,
                  path_effects=HALO, zorder=4)  # fmt: skip


def _short(names: Sequence[str]) -> str:
    """The first of some names, with "+" if there are more."""
    name = names[0].removeprefix("area ")
    return (name if len(name) <= LONGEST else f"{name[: LONGEST - 1]}…") + ("+" if len(names) > 1 else "")


def _middle(cells: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """The cell of a part that is nearest to its centroid, (row, col)."""
    places = np.stack(np.divmod(cells, shape[1]), axis=1)
    middle: NDArray[np.int64] = places[np.sum((places - places.mean(axis=0)) ** 2, axis=1).argmin()]
    return middle
