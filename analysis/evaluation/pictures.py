"""The pictures of an evaluation, as PNG files: the world and the plan, coverage, losses, distribution, and time."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from analysis.evaluation.answer import Evaluation
from analysis.evaluation.outputs.map_doubt import MapDoubt
from analysis.evaluation.outputs.value import Value
from analysis.evaluation.pictures_curves import draw_distribution, draw_over_time, summary_marks
from analysis.evaluation.pictures_doubt import draw_doubt
from analysis.evaluation.pictures_maps import draw_covered, draw_left, draw_losses
from analysis.evaluation.pictures_rest import draw_rest
from analysis.evaluation.rest import Rest, rest_of
from analysis.kit.folder import write_all
from analysis.pictures.maps import map_figure, with_key
from analysis.pictures.plans import plan_figure
from analysis.pictures.style import WIDTH, inches, new_figure, png_of
from planner.errors import UsageError


def save_pictures(evaluation: Evaluation, folder: Path) -> list[Path]:
    """Write the five pictures into `folder` (made if it is not there); the paths in the order of `PICTURES`.

    Every picture is drawn before the first is written, and each is written whole or not at all. The same evaluation
    gives the same bytes.
    """
    return write_all(folder, draw_pictures(evaluation))


def draw_pictures(evaluation: Evaluation) -> dict[str, bytes]:
    """The five pictures as PNG files, by name; and of value left, of the rest of a mission, of an uncertain map."""
    told = PICTURES if evaluation.output(Value) is None else PICTURES | {"left.png": left_figure}
    rest = rest_of(evaluation.world, evaluation.plan)
    told = told if rest is None else told | {"rest.png": partial(rest_figure, rest=rest)}
    drawn = {name: png_of(make, evaluation) for name, make in told.items()}
    doubt = evaluation.output(MapDoubt)
    return drawn if doubt is None else drawn | {"doubt.png": png_of(doubt_figure, doubt)}


def rest_figure(evaluation: Evaluation, rest: Rest) -> Figure:
    """What a range cuts off, and what was done before the state that a plan goes on from."""
    figure, layout = map_figure(evaluation.world, 6)
    return with_key(figure, layout, draw_rest(figure.axes[0], evaluation, rest))


def doubt_figure(doubt: MapDoubt) -> Figure:
    """Mean coverage by map."""
    figure = new_figure((WIDTH, 5.0))
    draw_doubt(figure.add_axes(inches(figure, (0.8, 1.2, WIDTH - 1.65, 3.0))), doubt)
    return figure


def world_figure(evaluation: Evaluation) -> Figure:
    """The world by threat level, areas and every robot's nominal path."""
    closed = "; paths: the nominal ones (no robot lost)" if evaluation.loop == "closed" else ""
    return plan_figure(evaluation.world, evaluation.plan, closed)


def covered_figure(evaluation: Evaluation) -> Figure:
    """The chance that each cell is covered in the evaluated loop."""
    figure, layout = map_figure(evaluation.world)
    return with_key(figure, layout, draw_covered(figure.axes[0], evaluation))


def losses_figure(evaluation: Evaluation) -> Figure:
    """Where robots are lost in the evaluated loop: the expected number in each cell."""
    figure, layout = map_figure(evaluation.world)
    return with_key(figure, layout, draw_losses(figure.axes[0], evaluation))


def left_figure(evaluation: Evaluation) -> Figure:
    """The expected value left in each cell; of an evaluation that has a `value`."""
    value = evaluation.output(Value)
    if value is None:
        raise UsageError("the evaluation tells nothing of values", fix="evaluate(..., metrics='coverage')")
    figure, layout = map_figure(evaluation.world)
    return with_key(figure, layout, draw_left(figure.axes[0], evaluation, value))


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
