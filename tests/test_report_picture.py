"""Charts as pictures: what a page draws is on paper too, every series by name, the same twice."""

from __future__ import annotations

import numpy as np

from analysis.page.charts import Chart, Series
from analysis.pictures.style import png_of
from analysis.report.picture import charts_figure

ROBOTS = (1, 2, 4)
CHARTS = (
    Chart(
        "Coverage over the team, on random maps of the paper's kind",
        (
            Series("closed loop", ROBOTS, (40, 60, 80), (35, 55, 78), (45, 65, 82)),
            Series("open loop", ROBOTS, (38, np.nan, 60), dashed=True),
            Series("stated", (1, 2), (44, 62), kind="points"),
        ),
        "robots", "covered", unit="%", y_range=(0.0, 100.0), at_y=((95.0, "ideal"),),
    ),
    Chart("Runs", (Series("runs", range(50), range(50), kind="bars"),), "steps", "runs"),
)  # fmt: skip


def test_every_series_and_line_is_drawn_by_name_within_its_axes() -> None:
    figure = charts_figure(CHARTS)
    assert len(figure.axes) == len(CHARTS)
    for axes, chart in zip(figure.axes, CHARTS, strict=True):
        legend = axes.get_legend()
        assert legend is not None
        names = {text.get_text() for text in legend.get_texts()}
        assert names == {*(series.name for series in chart.series), *(words for _, words in chart.at_y)}
        assert axes.get_xlabel() == chart.x_name
        title = axes.title if axes.title.get_text() else axes._left_title  # type: ignore[attr-defined]
        assert title.get_text().replace("\n", " ") == chart.title
    assert figure.axes[0].get_ylim() == (0.0, 100.0)
    drawn = {line.get_label(): line for line in figure.axes[0].lines}
    assert drawn["open loop"].get_xydata().tolist() == [[1, 38], [4, 60]] and drawn["open loop"].is_dashed()


def test_no_upright_line_has_the_colour_of_a_curve() -> None:
    curves = [Series(str(colour), ROBOTS, ROBOTS, colour=colour) for colour in (0, 3, 1, 4)]
    (axes,) = charts_figure([Chart("T", tuple(curves), "x", "y", at_x=((1, "one"), (2, "two")))]).axes
    assert len({str(line.get_color()) for line in axes.lines}) == 6


def test_names_do_not_run_into_the_next_chart() -> None:
    figure = charts_figure(CHARTS)
    left, right = figure.axes
    drawn = left._left_title.get_window_extent()  # type: ignore[attr-defined]
    assert drawn.x1 < right.get_window_extent().x0


def test_what_is_beyond_the_range_shown_at_least_and_long_words_stay_within_the_picture() -> None:
    curve = Series("a bound", ROBOTS, (40, 90, 180), (38, 85, 170), (44, 93, 185))
    words = "mean over the worlds, % of the accessible cells"
    chart = Chart("Coverage, what bounds it, and what claims to bound it", (curve,), "robots", words, unit="%",
                  y_range=(0, 100), interval="95 % interval of the mean over worlds")  # fmt: skip
    figure = charts_figure([chart, chart])
    page = figure.bbox
    for axes in figure.axes:
        assert axes.get_ylim() == (0.0, 185.0)
        title = axes._left_title.get_window_extent()  # type: ignore[attr-defined]
        below = axes.texts[0].get_window_extent()
        assert title.y1 < page.y1 and below.y1 < title.y0
        assert max(title.x1, below.x1) < (page.x1 if axes is figure.axes[1] else figure.axes[1].bbox.x0)


def test_it_is_drawn_the_same_twice() -> None:
    assert png_of(charts_figure, CHARTS) == png_of(charts_figure, CHARTS)
