"""A report as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.page.charts import Chart, curves_html
from analysis.page.document import Html, Section, block, document, from_rich, pictures_section, reproduce_section
from analysis.page.maps import cell_maps_html
from analysis.page.paths import plan_map_html
from analysis.report.model import CellMaps, Part, Report

BROAD = 1.6
"""Times as wide as high from which a map stands below the answer."""


def page_of(report: Report, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML; the same report gives the same bytes.

    Args:
        command: the command line that made it. pictures: PNG files by name. files: names of those beside the page.
    """
    shown = None if report.picture is None else report.picture()
    height, width = shown.world.shape if isinstance(shown, CellMaps) else (1, 1)
    said, notes = report.findings, [f"Note: {note}" for note in report.notes]
    findings = [] if shown is not None else [*said, *report.notes]
    words, notes = (said, notes) if shown is not None else ([], [])
    sections = (
        Section("Findings", block("findings", findings)),
        *map(_section, report.parts),
        Section("Settings", block("settings", report.heading, report.settings)),
        pictures_section(pictures),
        reproduce_section(command, files, report.again),
    )
    return document(
        sections, report=report, words=words, notes=notes, warnings=report.warnings,
        below=_charts(report.below(), "h2"), picture=None if shown is None else _html(shown),
        broad=width > BROAD * height,
    )  # fmt: skip


def _section(part: Part) -> Section:
    tables = [from_rich(table, part.unfolded and number == 0) for number, table in enumerate(part.whole or part.tables)]
    shown = part.drawn()
    drawn = _charts([one for one in shown if isinstance(one, Chart)])
    drawn += Html("").join(_html(one) for one in shown if not isinstance(one, Chart))
    return Section(part.title, block("part", drawn, tables, part.notes), part.lead, part.fold)


def _charts(charts: Sequence[Chart], heading: str = "h3") -> Html:
    """Side by side where there are some."""
    return block("charts", [html for chart in charts if (html := curves_html(chart, heading))])


def _html(drawn: Chart | CellMaps) -> Html:
    return curves_html(drawn) if isinstance(drawn, Chart) else _maps_html(drawn)


def _maps_html(maps: CellMaps) -> Html:
    """The maps; those of a plan with its paths and runs."""
    world, plan = maps.world, maps.plan
    if plan is not None:
        return plan_map_html(maps.layers, world, plan, *maps.runs, values_of=maps.values_of)
    return cell_maps_html(maps.layers, world, np.unique(maps.starts, axis=0), anchor=maps.anchor)
