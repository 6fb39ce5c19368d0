"""Coverage over robots lost, beside the map: the quick front of `advice`, with the plan itself marked."""

from __future__ import annotations

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.advice import Advice
from analysis.page.curves import Chart, Series, curves_html
from analysis.page.markup import Html
from analysis.tradeoff.rules import Figures, efficient


def front_curve(evaluation: Evaluation) -> Html:
    """The settings that nothing beats as a curve, and the plan as a mark; nothing where no other was looked at."""
    found = evaluation.output(Advice)
    if found is None or not found.points:
        return Html()
    setting, coverage, losses = found.now
    figures = [Figures(point.coverage.mean, point.losses.mean, 0.0) for point in found.points]
    kept = [point for point, best in zip(found.points, efficient(figures), strict=True) if best]
    kept.sort(key=lambda point: (point.losses.mean, point.coverage.mean))
    lost, covered = [point.losses.mean for point in kept], [point.coverage for point in kept]
    curve = Series.of("per_cell by worth, and the policies", lost, covered)
    mark = Series.of(f"this plan ({setting})", [losses.mean], [coverage], kind="points", colour=3)
    chart = Chart(
        title="What coverage costs",
        series=(curve, mark),
        x_name="robots lost on average",
        y_name="visited, % of the accessible cells",
        unit="%",
        x_digits=2,
        x_whole=False,
        y_range=(0, 100),
        note="Farther up and to the left is better.",
    )
    return curves_html(chart)
