"""Pictures, `mrac.plots`: of a world, of a plan on it, and of answers; a notebook shows each as a cell's last line.

Each is a matplotlib figure: `figure.savefig("world.png")` writes it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TypeVar

from matplotlib.figure import Figure

from analysis.checking.check_map import MapCheck
from analysis.checking.picture import check_figure as draw_check
from analysis.depots.answer import Starts
from analysis.depots.report import report as starts_report
from analysis.design.report import report as size_report
from analysis.design.size import TeamSize
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.report import report as evaluation_report
from analysis.pictures.plans import plan_figure
from analysis.pictures.style import house_style
from analysis.removal.answer import Clearing
from analysis.removal.report import report as clear_report
from analysis.report.blocks import Report
from analysis.report.picture import figure_of
from analysis.tradeoff.front import Front
from analysis.tradeoff.report import report as front_report
from planner.arguments import argument
from planner.errors import UsageError
from planner.plans.plan import Plan
from planner.worlds.world import World

__all__ = [
    "check_figure", "clear_figure", "covered_figure", "distribution_figure", "front_figure", "left_figure",
    "losses_figure", "over_time_figure", "size_figure", "starts_figure", "world_figure",
]  # fmt: skip

Kind = TypeVar("Kind")
PICTURED = "a World, a World and a Plan, or an Evaluation"


def world_figure(what: World | Evaluation, plan: Plan | None = None) -> Figure:
    """The world by threat level, with a plan's areas and every robot's nominal path.

    Args:
        what: a world, alone or with a `plan` for it; or an evaluation: its world and plan.

    Raises InputError for a plan of another map, or one without its world.
    """
    with house_style():
        if isinstance(what, Evaluation) and plan is None:
            return figure_of(evaluation_report(what), "world.png")
        if isinstance(what, Plan):
            fix = "use world_figure(world, plan)"
            raise UsageError("world_figure(what) is a Plan", expected=PICTURED, fix=fix)
        if not isinstance(what, World):
            raise UsageError(argument("what", what), expected=PICTURED)
        if plan is not None:
            if not isinstance(plan, Plan):
                raise UsageError(argument("plan", plan), expected="a Plan, as mrac_jax.plan makes one")
            plan.require(what)
        return plan_figure(what, plan)


def _of(kind: type[Kind], draw: Callable[[Kind], Figure]) -> Callable[[Kind], Figure]:
    """What draws answers of a kind, in the house's style; anything else is an InputError."""

    @wraps(draw)
    def figure(answer: Kind) -> Figure:
        if not isinstance(answer, kind):
            raise UsageError(argument("answer", answer), expected=f"the answer {kind.__name__}")
        with house_style():
            return draw(answer)

    return figure


def _picture(
    kind: type[Kind], report: Callable[[Kind], Report], shows: str, name: str = ""
) -> Callable[[Kind], Figure]:
    """What draws a picture of a report, the first if none is named; `shows`: its docstring."""

    def draw(answer: Kind) -> Figure:
        said = report(answer)
        if name and name not in said.pictures:
            raise UsageError(f"the evaluation has no {name}", fix="evaluate(..., metrics='coverage')")
        return figure_of(said, name or next(iter(said.pictures)))

    draw.__doc__ = shows
    return _of(kind, draw)


def _evaluated(name: str, shows: str) -> Callable[[Evaluation], Figure]:
    return _picture(Evaluation, evaluation_report, shows, name)


covered_figure = _evaluated("covered.png", "The chance that each cell is covered, those below one half outlined.")
losses_figure = _evaluated("losses.png", "Expected robots lost in each cell, with the worst cells' numbers.")
left_figure = _evaluated("left.png", "The expected value left in each cell; of an evaluation that has a `value`.")
distribution_figure = _evaluated("distribution.png", "The chance of so much coverage, and rollouts by coverage.")
over_time_figure = _evaluated("over_time.png", "Expected coverage over time.")
front_figure = _picture(Front, front_report, "Coverage over robots lost and over steps, by setting.")
size_figure = _picture(TeamSize, size_report, "Coverage and the chance of the target over the team, with the answer.")
starts_figure = _picture(Starts, starts_report, "Coverage by depot, or the threats, with the best starts on the map.")
clear_figure = _picture(Clearing, clear_report, "What clearing each threat wins after replanning; the picks stand out.")
check_figure = _of(MapCheck, draw_check)


def __dir__() -> list[str]:
    return __all__
