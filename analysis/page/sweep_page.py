"""The page of a sweep, of `reproduce`, or of anything else that has curves and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.page.curves import Chart, curves_html
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import Html, element
from analysis.page.parts import answer_page
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
        curves: charts, two abreast if there are more than two.
        tables: below them (`analysis.page.tables.from_rich` takes a rich Table).
        findings: sentences. settings: names and values. The others as of `answer_page`.
    """
    drawn = [html for html in map(curves_html, curves) if html]
    abreast = element("div", *drawn, class_="charts two" if len(drawn) > 2 else "charts") if drawn else Html()
    sections = (Section("Curves", abreast), Section("Tables", tables_html(tables)))
    return answer_page(
        title, answer, sections, command, pictures, files,
        kind=kind, findings=findings, settings=settings, figures=figures, warnings=warnings,
    )  # fmt: skip
