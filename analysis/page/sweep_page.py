"""The page of a sweep, of `reproduce`, or of anything else that has curves and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.page.curves import Chart, curves_html
from analysis.page.document import KeyFigure, Page, Section
from analysis.page.markup import Html, element
from analysis.page.parts import findings_section, pictures_section, reproduce_section, settings_section
from analysis.page.tables import TableData, tables_html


def sweep_page(
    title: str,
    answer: str,
    curves: Sequence[Chart],
    tables: Sequence[TableData],
    findings: Sequence[str],
    settings: Mapping[str, object],
    command: str,
    pictures: Mapping[str, bytes],
    *,
    files: Sequence[str] = (),
    kind: str = "sweep",
    figures: Sequence[KeyFigure] = (),
    warnings: Sequence[str] = (),
) -> str:
    """The page as HTML; the same arguments give the same bytes.

    Args:
        title: what was looked at. answer: what came out, in a sentence.
        curves: charts, two abreast if there are more than two.
        tables: below them (`analysis.page.tables.from_rich` takes a rich Table).
        findings: sentences. settings: names and values.
        command: the command line that made it. pictures: PNG files by name, put into the page.
        files: names of the files beside it.
        kind: the command's name. figures: tiles below the answer. warnings: what must not be overlooked.
    """
    drawn = [html for html in map(curves_html, curves) if html]
    sections = (
        findings_section(findings),
        Section(
            "Curves", element("div", *drawn, class_="charts two" if len(drawn) > 2 else "charts") if drawn else Html()
        ),
        Section("Tables", tables_html(tables)),
        settings_section(settings),
        pictures_section(pictures),
        reproduce_section(command, files),
    )
    return Page(title, answer, sections, kind, tuple(figures), tuple(warnings)).html()
