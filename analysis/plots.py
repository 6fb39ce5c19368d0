"""Pictures, `mrac.plots`: of a world, of a plan on it, and of results; a notebook shows each as a cell's last line.

Each is a matplotlib figure: `figure.savefig("world.png")` writes it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from matplotlib.figure import Figure

from analysis.checking.check import MapCheck
from analysis.evaluation.evaluate import Evaluation
from analysis.pictures import picture_style, plan_figure
from analysis.report.rendering import figure_of
from analysis.report.result import Result, report_of
from analysis.search.pareto import Front
from analysis.search.start_positions import Starts
from analysis.search.team_size import TeamSize
from analysis.search.threats import Attack, Clearing
from planner.arguments import argument
from planner.errors import UsageError
from planner.plan.plan import Plan
from planner.world.world import World

__all__ = [
    "attack_figure", "check_figure", "clear_figure", "covered_figure", "distribution_figure", "front_figure",
    "left_figure", "losses_figure", "over_time_figure", "size_figure", "starts_figure", "world_figure",
]  # fmt: skip

Kind = TypeVar("Kind", bound=Result)
PICTURED = "a World, a World and a Plan, or an Evaluation"


def world_figure(what: World | Evaluation, plan: Plan | None = None) -> Figure:
    """The world by threat level, with a plan's areas and every robot's nominal path.

    Args:
        what: a world, alone or with a `plan` for it; or an evaluation, with its world and plan.
        plan: a plan for the world.

    Raises:
        InputError: the plan is for another map, or has no world.
    """
    with picture_style():
        if isinstance(what, Evaluation) and plan is None:
            return figure_of(report_of(what), "world.png")
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


def _picture(kind: type[Kind], shows: str, name: str = "", needs: str = "") -> Callable[[Kind], Figure]:
    """A function that draws a picture of a result's report, the first if none is named, in the style of this package.

    `shows`: its docstring. `needs`: condition for the picture. A result of another type is an InputError.
    """

    def figure(answer: Kind) -> Figure:
        if not isinstance(answer, kind):
            raise UsageError(argument("answer", answer), expected=f"a result of type {kind.__name__}")
        said = report_of(answer)
        if name and name not in said.pictures:
            raise UsageError(f"the evaluation has no {name}", expected=needs)
        with picture_style():
            return figure_of(said, name or next(iter(said.pictures)))

    figure.__doc__ = shows
    return figure


covered_figure = _picture(
    Evaluation, "The probability that each cell is covered; cells below one half are outlined.", "covered.png"
)
losses_figure = _picture(Evaluation, "Expected robots lost in each cell, with the worst cells.", "losses.png")
left_figure = _picture(
    Evaluation,
    "The expected value left in each cell; of an evaluation that has a `value`.",
    "left.png",
    "a world with values: `value:` in its scenario, or load(..., value=...)",
)
distribution_figure = _picture(
    Evaluation, "The probability of at least each coverage, and the histogram of rollouts.", "distribution.png"
)
over_time_figure = _picture(Evaluation, "Expected coverage over time.", "over_time.png")
front_figure = _picture(Front, "Coverage over robots lost and over steps, by setting.")
size_figure = _picture(TeamSize, "Coverage and the probability of the target by team size, with the answer.")
starts_figure = _picture(Starts, "Coverage by depot, or the threats, with the best starts on the map.")
attack_figure = _picture(Attack, "The cost of a known threat in each cell; the worst cells are highlighted.")
clear_figure = _picture(Clearing, "The gain of removing each threat, with replanning; selected ones are highlighted.")
check_figure = _picture(MapCheck, "Every formula on one scale of expected cells, with the truth of both loops.")


def __dir__() -> list[str]:
    return __all__
