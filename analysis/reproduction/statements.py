"""The statements of the paper's section on experiments, each held against our maps: reproduced or not, by how much.

A statement that gives a number is held against ours by `(ours - paper's) / sqrt(se^2 + se_paper^2 + rounding^2)`; the
paper's standard error is that of its own design, one run on each of 500 maps. One that gives a direction is held
against the difference of two settings, map by map on the same random numbers, divided by its standard error.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.special import ndtri

from analysis.reproduction.points import FIGURE4, Point
from analysis.statistics.estimate import over_maps
from planner.shown import counted, in_percent, percent

PAPER_MAPS = 500
"""Maps a point in the paper, one run each (section 7)."""
ENOUGH = 3.0
"""Standard errors that decide."""
FIRST = ", first visits alone checked"
LOOPS = (("closed", ""), ("first", FIRST))
"""The closed loop's two readings of when a visit can stop a robot, and how statements name them."""


class StatementVerdict(StrEnum):
    """What our maps say of a statement."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """A statement and what was found.

    Attributes:
        figure: of the paper. statement: what it says. found: what we found. deviation: in standard errors; for a
            direction above 0 where the statement is right, for a number ours - paper's. verdict: of that.
    """

    figure: str
    statement: str
    found: str
    deviation: float
    verdict: StatementVerdict


def findings(points: Sequence[Point]) -> list[Finding]:
    """Every statement that these points say something about."""
    return [finding for of_figure in (_figure4, _figure5, _figure6, _figure7) for finding in of_figure(points)]


def _figure4(points: Sequence[Point]) -> Iterator[Finding]:
    """Its map is not in the text: where its two runs fall among all runs on our maps."""
    for point in _teams(points, "contiguous"):
        if ("share", "closed", "time") not in point.columns:
            continue
        coverage, steps = FIGURE4[point.robots]
        for loop, how in LOOPS:
            shares = [float(point.columns["share", loop, name].mean()) for name in ("coverage", "time")]
            less, faster = map(percent, shares)
            found = f"{less} of our runs cover no more of the free cells, {faster} take no longer"
            least = 0.5 / (len(point.columns["share", loop, "time"]) * point.rollouts)
            deviation = max((float(ndtri(np.clip(share, least, 1 - least))) for share in shares), key=abs)
            verdict = StatementVerdict.REPRODUCED if abs(deviation) <= ENOUGH else StatementVerdict.NOT_REPRODUCED
            said = f"one map, {counted(point.robots, 'robot')}: {100 * coverage:.2f} % in {counted(steps, 'step')}{how}"
            yield Finding("Fig. 4", said, found, deviation, verdict)


def _teams(points: Sequence[Point], kind: str) -> list[Point]:
    found = [p for p in points if p.kind == kind and p.ratio == 0.25]
    return sorted(found, key=lambda point: point.robots)


def _figure5(points: Sequence[Point]) -> Iterator[Finding]:
    teams = _teams(points, "contiguous")
    by_team = {point.robots: point for point in teams}
    for robots, said in ((1, 0.44), (2, 0.62)):
        if robots in by_team:
            for loop, how in LOOPS:
                yield _number(
                    "Fig. 5", f"{counted(robots, 'robot')}: {100 * said:g} % covered{how}", by_team[robots], said, loop
                )
    if 1 in by_team and 2 in by_team:
        one, two = by_team[1], by_team[2]
        for loop, how in LOOPS:
            yield _all_of("Fig. 5", f"time rises from one robot to two{how}", [(one, two)], "time", 1, loop)
    after = [point for point in teams if point.robots >= 2]
    if len(after) > 1:
        yield _every("Fig. 5", "time falls with every robot after the second", after, "time", -1)
    if len(teams) > 1:
        yield _every("Fig. 5", "coverage rises with every robot", teams, "visited", 1)


def _figure6(points: Sequence[Point]) -> Iterator[Finding]:
    teams = _teams(points, "scattered")
    others = {point.robots: point for point in _teams(points, "contiguous")}
    both = [(others[point.robots], point) for point in teams if point.robots in others]
    if both:
        yield _all_of("Fig. 6", "coverage is lower than in contiguous areas", both, "visited", -1)
        yield _all_of("Fig. 6", "coverage takes longer than in contiguous areas", both, "time", 1)
    if len(teams) > 1:
        yield _every("Fig. 6", "coverage rises with every robot", teams, "visited", 1)
        yield _every("Fig. 6", "time falls with every robot", teams, "time", -1)


def _figure7(points: Sequence[Point]) -> Iterator[Finding]:
    ratios = sorted((p for p in points if p.kind == "contiguous" and p.robots == 8), key=lambda point: point.ratio)
    if len({point.ratio for point in ratios}) < 3:
        return
    yield _every("Fig. 7", "coverage falls with the ratio of threats", ratios, "visited", -1)
    below = [point for point in ratios if point.ratio <= 0.15 + 1e-9]
    above = [point for point in ratios if point.ratio >= 0.15 - 1e-9]
    if len(below) > 1:
        yield _every("Fig. 7", "time rises up to a ratio of 15 %", below, "time", 1)
    if len(above) > 1:
        yield _every("Fig. 7", "time falls above 15 %", above, "time", -1)
        yield _every("Fig. 7", f"time falls above 15 %{FIRST}", above, "time", -1, "first")


def _number(figure: str, statement: str, point: Point, said: float, loop: str = "closed") -> Finding:
    ours = point.estimate(loop, "visited")
    paper = point.spread_of_a_run(loop, "visited") / math.sqrt(PAPER_MAPS)
    rounding = 0.01 / math.sqrt(12)
    deviation = (ours.mean - said) / math.sqrt(ours.se**2 + paper**2 + rounding**2)
    verdict = StatementVerdict.REPRODUCED if abs(deviation) <= ENOUGH else StatementVerdict.NOT_REPRODUCED
    return Finding(figure, statement, f"{in_percent(ours.mean)} +- {100 * ours.se:.1f} %", deviation, verdict)


Gap = tuple[float, float]
"""A mean difference and its standard error."""


def _gap(before: Point, after: Point, figure: str, loop: str) -> Gap:
    """after - before, map by map."""
    apart = over_maps(after.columns["mean", loop, figure] - before.columns["mean", loop, figure])
    return apart.mean, apart.se


def _steps(gap: Gap) -> str:
    return f"by {gap[0]:+.1f} +- {gap[1]:.1f} steps"


def _points(gap: Gap) -> str:
    return f"by {100 * gap[0]:+.1f} +- {100 * gap[1]:.1f} points"


def _judged(deviation: float) -> StatementVerdict:
    if deviation >= ENOUGH:
        return StatementVerdict.REPRODUCED
    return StatementVerdict.NOT_REPRODUCED if deviation <= -ENOUGH else StatementVerdict.UNDECIDED


def _deviation(gap: Gap, sign: int) -> float:
    mean, se = gap
    return sign * mean / se if se > 0 else sign * float(np.sign(mean)) * math.inf if mean else 0.0


def _every(figure: str, statement: str, points: list[Point], what: str, sign: int, loop: str = "closed") -> Finding:
    """From each point to the next: the worst of them decides."""
    return _all_of(figure, statement, list(itertools.pairwise(points)), what, sign, loop)


def _all_of(
    figure: str, statement: str, pairs: list[tuple[Point, Point]], what: str, sign: int, loop: str = "closed"
) -> Finding:
    """From the first to the second of every pair, `what` goes the way of `sign`: the worst pair decides."""
    gaps = [(_deviation(_gap(a, b, what, loop), sign), a, b) for a, b in pairs]
    worst, before, after = min(gaps, key=lambda one: one[0])
    gap = _gap(before, after, what, loop)
    words = _steps(gap) if what == "time" else _points(gap)
    wrong = sum(deviation <= -ENOUGH for deviation, *_ in gaps)
    said = f"{wrong} of {len(gaps)} the other way; " if wrong and len(gaps) > 1 else ""
    where = f"worst {_named(before, after)}: " if len(gaps) > 1 else ""
    return Finding(figure, statement, f"{said}{where}{words}", worst, _judged(worst))


def _named(before: Point, after: Point) -> str:
    if before.kind != after.kind:
        return f"k = {after.robots}"
    if before.robots != after.robots:
        return f"k = {before.robots} to {after.robots}"
    return f"{100 * before.ratio:g} to {100 * after.ratio:g} %"
