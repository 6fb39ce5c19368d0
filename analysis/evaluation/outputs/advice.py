"""Alternatives to a plan: settings that cover almost as much with almost no losses, or more with the same losses.

A coarse Pareto front (`analysis.search.pareto`) has some tens to a thousand rollouts of each setting, ids 0, 1, ...,
within an eighth of the plan's rollouts. The advised setting is then compared with the plan on common random numbers,
which reduces the variance of the difference. If the plan loses few robots, another setting is advised only if its
coverage is significantly higher and its losses are not seen to be higher.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from analysis.comparison import Side, compare
from analysis.evaluation.figures import Elements, Output, Run
from analysis.page.elements import Chart, Series
from analysis.search.pareto import Figures, Goal, Point, Setting, efficient, knee, quick_points, settings_of
from analysis.statistics.estimates import Estimate, exactly, losses_sentence
from analysis.statistics.variance_reduction import tally_mean
from analysis.utils.tables import without_level
from planner.arguments import COMMAND_LINE, argument
from planner.errors import PlanError, WorldError
from planner.formatting import counted, percent
from planner.plan.plan import Plan
from planner.policies import RULES

FEWEST = 64
"""Fewest rollouts of the plan for which alternatives are computed."""
LEAST, MOST, SHARE, CELLS = 8, 1024, 8, 2**19
"""Rollouts of a setting: at least LEAST, at most MOST, one in SHARE of the plan's, at most CELLS covered cells."""
SECONDS = 4.0
"""Time on all cores after which no further setting is started; or the plan's own time if that is longer."""
CHEAP = 0.1
"""Largest mean share of the team that an advised setting may lose."""
CLEARLY = 0.01
"""Difference of coverage that justifies additional losses."""
USEFUL = 0.5
"""Smallest coverage of a setting with almost no losses, relative to the plan's."""


@dataclass(frozen=True)
class Alternative:
    """A setting with its estimates."""

    point: Point
    json_keys = """
        point.setting.policy point.setting.risk_cap point.setting.robot_value point.coverage point.losses
    """


@dataclass(frozen=True)
class Alternatives:
    """The advised setting, its lead in coverage over the plan, the rollouts of each setting, and all settings."""

    advised: Alternative
    difference: Estimate
    rollouts: int
    front: list[Alternative]
    json_keys = "*advised difference rollouts front"


@dataclass(frozen=True)
class Advice(Output):
    """A coarse Pareto front, and the advised setting.

    Attributes:
        now: setting, coverage and losses of the plan. robots: size of the team.
        points: other settings, by family, in descending order of coverage. rollouts: of each setting.
        advised: one of `points`; None: no setting is better.
        difference: mean coverage of `advised` minus the plan's, a fraction of the accessible cells.
    """

    now: tuple[Setting, Estimate, Estimate]
    robots: int
    points: tuple[Point, ...]
    rollouts: int
    advised: Point | None = None
    difference: Estimate | None = None

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        done = run.last.tally.rollouts
        if not _has_another(run) or run.certain or done < FEWEST:
            return
        run.doing("alternatives")
        settings, robots, tally = run.plan.require(run.world), len(run.plan.robots), run.last.tally
        rollouts = int(np.clip(min(done // SHARE, CELLS // tally.accessible), LEAST, MOST))
        choices = replace(run.choices, rollouts=rollouts, precision=None, deadline=None, engine="numba")
        coverage, losses = tally_mean(tally, "visited", 1.0 / tally.accessible), tally_mean(tally, "lost")
        if run.closed is not None and run.closed.alive is not None:  # as in the summary
            coverage, losses = exactly(run.closed.visited.value / tally.accessible), exactly(robots - run.closed.alive)
        now = Setting(settings.rule.name, settings.risk_cap, settings.robot_value, settings.deadline)
        try:
            points = quick_points(
                run.world, run.plan.starts, settings, choices, losses=losses.mean, kept=run.kept,
                seconds=max(SECONDS, run.last.seconds),
                doing=lambda stage: run.doing(f"alternatives: {stage.partition(',')[0]}"),
            )  # fmt: skip
        except (PlanError, WorldError):  # custom costs, or an engine, without the other policy
            return
        found = cls((now, coverage, losses), robots, tuple(p for p in points if p.setting != now), rollouts)
        yield found
        best = found.better()
        if best is not None:
            # The closed loop needs only starts and areas.
            other = replace(run.plan, settings=settings_of(settings, best.setting))
            more, lost = _differences(run, other, rollouts)
            if found.saves(best) or more.ci95[0] > 0 >= lost.ci95[0]:
                yield replace(found, advised=best, difference=more)

    def better(self) -> Point | None:
        """The setting to advise, subject to the comparison on common random numbers."""
        _, coverage, losses = self.now
        cheap = [point for point in self.points if point.losses.mean <= CHEAP * self.robots]
        free = [point for point in cheap if point.losses.ci95[1] == 0]
        best, safe = (max(of, key=lambda p: p.coverage.mean, default=None) for of in (cheap, free))
        if best is not None and safe is not None and best.coverage.mean < safe.coverage.mean + CLEARLY:
            best = safe
        if best is not None and best.coverage.mean < USEFUL * coverage.mean:
            best = self._bargain(best)
        if best is not None and self.saves(best):
            return best
        place = Goal(losses=losses.mean).pick([point.figures for point in self.points])
        most = None if place is None else self.points[place]
        return most if most is not None and most.coverage.mean > coverage.mean else None

    def _bargain(self, cheap: Point) -> Point | None:
        """The knee of the front between the setting with almost no losses and the plan; None: the front has no knee."""
        _, coverage, losses = self.now
        plan = cheap.figures._replace(coverage=coverage.mean, losses=losses.mean)
        place = knee([point.figures for point in self.points], cheap.figures, plan)
        return None if place is None else self.points[place]

    def more(self) -> Point | None:
        """The setting with the highest coverage, significantly above the plan's, and no higher losses."""
        _, coverage, losses = self.now
        above = [
            point
            for point in self.points
            if point.coverage.ci95[0] > coverage.ci95[1] + CLEARLY and point.losses.ci95[0] <= losses.mean
        ]
        return max(above, key=lambda point: point.coverage.mean, default=None)

    def saves(self, point: Point) -> bool:
        """Whether the plan loses a considerable share of the team, and this setting at most half of that."""
        return self.now[2].mean > CHEAP * self.robots and self.now[2].mean > 2 * point.losses.mean

    def to_json(self) -> Alternatives | None:
        if self.advised is None or self.difference is None:
            return None
        front = [Alternative(point) for point in self.points]
        return Alternatives(Alternative(self.advised), self.difference, self.rollouts, front)

    def elements(self) -> Elements:
        below = [self.chart()] if self.points else []
        if self.advised is None:
            return Elements(below=below)
        tried = counted(len(self.points), "other setting")
        note = (
            f"{_as_asked(self.advised.setting)} is the best of {tried} ({self.rollouts:,} rollouts "
            "each, common random numbers); `mrac-jax front` compares more."
        )
        return Elements(alternatives=list(self._sentences()), notes=[note], below=below)

    def chart(self) -> Chart:
        """The Pareto-optimal settings as a curve of coverage over losses, and the plan as a point."""
        setting, coverage, losses = self.now
        best = efficient([Figures(point.coverage.mean, point.losses.mean, 0.0) for point in self.points])
        kept = [point for point, is_best in zip(self.points, best, strict=True) if is_best]
        kept.sort(key=lambda point: (point.losses.mean, point.coverage.mean))
        lost, covered = [point.losses.mean for point in kept], [point.coverage for point in kept]
        curve = Series.of("per_cell by robot value, and the policies", lost, covered)
        mark = Series.of(f"this plan ({setting})", [losses.mean], [coverage], kind="points", colour=3)
        return Chart(
            "Coverage and losses", (curve, mark), "robots lost on average", "visited, % of the accessible cells",
            unit="%", y_range=(0, 100), fit=True,
            note="Farther up and to the left is better.",
        )  # fmt: skip

    def _sentences(self) -> Iterator[str]:
        """The alternatives: coverage and losses of each, and the options that select it."""
        if self.advised is None or self.difference is None:
            return
        advised, how, more = self.advised, _as_asked(self.advised.setting), self.more()
        if not self.saves(advised):
            gain = without_level(self.difference.describe(100, " points")).removesuffix(" (exact)")
            yield f"To cover {_covered(advised.coverage)} ({gain} more) without losing more robots: {how}."
            return
        said = f"To cover {_covered(advised.coverage)} and lose {self._lost(advised.losses)}: {how}"
        if more is not None:
            fewer = more.losses.ci95[1] < self.now[2].mean
            losses = f"and lose {self._lost(more.losses)}" if fewer else "with the same losses"
            said += f"; to cover {_covered(more.coverage)} {losses}: {_as_asked(more.setting)}"
        yield f"{said}."

    def _lost(self, losses: Estimate) -> str:
        return f"{losses_sentence(losses, self.robots, mean_only=True)} on average"


def _covered(coverage: Estimate) -> str:
    """Coverage in percent, with at most one decimal."""
    return percent(coverage.mean, min(coverage.digits(100), 1))


def _as_asked(setting: Setting) -> str:
    """The options that select a setting: of the command line, or arguments in Python."""
    given = {"policy": setting.policy} | {name: int(v) if v == int(v) else v for name, v in setting.limits.items()}
    words = (argument(name, value) for name, value in given.items())
    return "`" + (" " if COMMAND_LINE.get() else ", ").join(words) + "`"


def _differences(run: Run, other: Plan, rollouts: int) -> tuple[Estimate, Estimate]:
    """Coverage (a fraction) and robots lost of the other plan, minus the plan's, on common random numbers."""
    choices = replace(run.choices, engine="numba", rollouts=rollouts, precision=None, seconds=None, deadline=None)
    mine, theirs = (Side(run.world, plan, choices, None) for plan in (run.plan, other))
    found = compare(mine, theirs, kept=run.kept)
    left = found.difference("alive").estimate
    lost = Estimate(-left.mean, left.se, (-left.ci95[1], -left.ci95[0]))
    return found.difference("visited").estimate, lost


def _has_another(run: Run) -> bool:
    """Whether this is the closed loop of a whole mission, planned here by a policy that the front supports."""
    settings = run.plan.settings
    return (
        run.choices.loop == "closed"
        and settings is not None
        and run.plan.state is None
        and settings.plan_for == "closed_loop"
        and settings.rule.name in RULES
        and isinstance(settings.in_area, str)
    )
