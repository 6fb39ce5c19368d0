"""A report as a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from analysis.page.cell_maps import cell_maps_html
from analysis.page.curves import curves_html
from analysis.page.document import Section
from analysis.page.markup import Html, element, join
from analysis.page.parts import answer_page, noted_tables
from analysis.page.plan_paths import paths_legend, paths_svg
from analysis.page.runs import runs_html
from analysis.page.series import Chart
from analysis.page.tables import from_rich
from analysis.report.blocks import CellMaps, Drawn, Part, Report

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
    words, warnings, findings = (said, notes, ()) if shown is not None else ((), (), (*said, *report.notes))
    return answer_page(
        report.title, report.headline, [_section(part) for part in report.parts], command, pictures, files,
        kind=report.kind, findings=findings, settings=report.settings, heading=report.heading,
        figures=report.figures, warnings=[*report.warnings, *warnings], note=report.again, words=words,
        below=join(map(_html, report.below())),
        picture=None if shown is None else _html(shown), broad=width > BROAD * height,
    )  # fmt: skip


def _section(part: Part) -> Section:
    tables = [
        replace(from_rich(table), unfolded=part.unfolded and number == 0)
        for number, table in enumerate(part.whole or part.tables)
    ]
    return Section(part.title, join((_drawn(part), noted_tables(tables, part.notes))), part.lead, part.fold)


def _drawn(part: Part) -> Html:
    """Charts side by side where there are some; other things as they are."""
    shown = part.drawn()
    charts = [html for chart in shown if isinstance(chart, Chart) and (html := _html(chart))]
    abreast = element("div", *charts, class_="charts two" if len(charts) > 1 else "charts") if charts else Html()
    return join((abreast, *(_html(thing) for thing in shown if not isinstance(thing, Chart))))


def _html(drawn: Drawn) -> Html:
    if isinstance(drawn, Chart):
        return curves_html(drawn)
    if isinstance(drawn, CellMaps):
        return _maps_html(drawn)
    return drawn


def _maps_html(maps: CellMaps) -> Html:
    """The maps; those of a plan with its paths and runs."""
    world, plan, (runs, about) = maps.world, maps.plan, maps.runs
    starts = np.unique(maps.starts, axis=0) if plan is None else maps.starts
    accessible = world.accessible(starts)
    drawn = None if plan is None else paths_svg(plan)
    shown = cell_maps_html(
        maps.layers, world.free, accessible, starts, world.cell_size, world.origin, above=drawn,
        heading="h3" if plan is None else "h2", anchor=maps.anchor, values_of=maps.values_of,
    )  # fmt: skip
    if plan is None:
        return shown
    packed = runs_html(runs, accessible)
    note = element("p", about, class_="note") if packed else None
    return element("div", shown, packed, note, paths_legend(plan, drawn is not None), class_="plan-map")
