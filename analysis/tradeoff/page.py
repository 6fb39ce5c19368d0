"""The page of `mrac-jax front --out`: what coverage costs, in robots and in steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.kit.words import counted
from analysis.page.curves import Chart, Series, curves_html
from analysis.page.document import KeyFigure, Section
from analysis.page.markup import element
from analysis.page.parts import answer_page, input_name, map_settings, noted_tables
from analysis.page.tables import from_rich
from analysis.tradeoff.front import Front, settings_of
from analysis.tradeoff.rules import Setting
from analysis.tradeoff.table import TITLES, footnotes, headline, pick_lines, points_table, prices_table


def front_page(front: Front, command: str, pictures: Mapping[str, bytes], files: Sequence[str]) -> str:
    """The page as HTML; the same front gives the same bytes. Arguments as of `analysis.page.sweep_page.sweep_page`."""
    charts = element("div", curves_html(_chart(front, "time")), class_="charts")
    tables = noted_tables(
        [from_rich(prices_table(front)), from_rich(points_table(front, whole=True))], footnotes(front)
    )
    return answer_page(
        f"{input_name(front.world.source)}, {counted(len(front.starts), 'robot')}: what does coverage cost?",
        headline(front), (Section("Prices and settings", tables), Section("What coverage costs in steps", charts)),
        command, pictures, files, kind="front", findings=(), settings=_settings(front),
        picture=curves_html(_chart(front, "losses")),
        figures=_key_figures(front),
        warnings=("Interrupted: these are the settings that were done until then.",) if front.partial else (),
        words=pick_lines(front),
    )  # fmt: skip


def _key_figures(front: Front) -> tuple[KeyFigure, ...]:
    point = front.confirmed
    if point is None:
        return ()
    ends = [f"{100 * end:.2f}" for end in point.coverage.ci95]
    lost = [f"{end:.2f}" for end in point.losses.ci95]
    return (
        KeyFigure(
            f"{100 * point.coverage.mean:.1f} %", "visited on average", f"{ends[0]} .. {ends[1]} %, fresh rollouts"
        ),
        KeyFigure(f"{point.losses.mean:.2f} of {len(front.starts)}", "robots lost", f"{lost[0]} .. {lost[1]}"),
        KeyFigure(f"{point.time.mean:,.0f} steps", "mean time", f"{point.setting}"),
    )


def _chart(front: Front, which: str) -> Chart:
    """Coverage over robots lost, or over steps: a curve for each family, through its settings in order."""
    series = []
    for family, name in TITLES.items():
        points = [p for p in front.points if p.setting.family == family]
        if points:
            y = [(100 * p.coverage.mean, *(100 * end for end in p.coverage.ci95)) for p in points]
            mean, low, high = zip(*y, strict=True)
            series.append(Series(name, [getattr(p, which).mean for p in points], mean, low, high))
    robots = which == "losses"
    return Chart(
        title="Over robots lost" if robots else "Over time",
        series=tuple(series),
        x_name="robots lost on average" if robots else "steps on average",
        y_name="visited, % of the accessible cells",
        unit="%",
        digits=2,
        x_digits=2 if robots else 0,
        x_whole=not robots,
        y_range=(0, 100),
        note="Farther up and to the left is better. Press a name to hide a curve.",
    )


def _settings(front: Front) -> dict[str, object]:
    world, choices = front.world, front.choices
    plain = settings_of(front.settings, Setting("mrac")).shown()
    return {
        **map_settings(world),
        "accessible cells": f"{front.cells:,}",
        "robots": f"{len(front.starts)}",
        "rollouts": f"{choices.rollouts:,} of each setting, the same ids",
        "seed": f"{choices.seed}",
        "engine": front.engine,
        **{name: value for name, value in plain.items() if name not in ("policy", "reserve", "worth")},
    }
