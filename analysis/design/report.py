"""What `mrac-jax size` says: the smallest team that is enough, the curve over the teams, a row for each."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from rich.table import Table

from analysis.design.rules import TeamVerdict
from analysis.design.size import Point, TeamSize
from analysis.kit.tables import make_table
from analysis.page.series import Chart, Series
from analysis.report.answer import json_end
from analysis.report.blocks import KeyFigure, Part, Report
from analysis.report.words import luck_words, map_words, share_figure
from analysis.statistics.estimate import Estimate
from analysis.statistics.intervals import ALPHA
from analysis.statistics.words import between, of_all
from planner.arguments import argument
from planner.files import Json
from planner.shown import ceiled, chance, counted, in_percent


def report(size: TeamSize) -> Report:
    """How many robots are enough, with the curve that decides; every team."""
    world, chart = size.world, _chart(size)
    return Report(
        "size", "size", f"{world.name}: how many robots for {_aim(size)}?", headline(size),
        lambda: _json(size), figures=_key_figures(size),
        heading=(f"{map_words(world, size.cells)}, so the target is {size.needed} of them",
                 f"{size.choices.loop} loop, {luck_words(world, size.choices, size.engine)}"),
        picture=lambda: chart, parts=[Part("Teams", [_table(size)], _footnotes(size))], notes=size.notes,
        settings=size.settings.shown(world.pace), pace=world.pace, pictures={"size.png": lambda: [chart]},
    )  # fmt: skip


def headline(size: TeamSize) -> str:
    """The answer in one sentence."""
    if size.partial:
        return f"Interrupted before the answer: {_so_far(size)}."
    undecided, goal = size.of(TeamVerdict.UNDECIDED), size.goal
    if size.robots is None:
        most = f"No team of up to {counted(len(size.starts), 'robot')} "
        if size.passed_over:
            most = f"No team that was looked at, up to {counted(len(size.starts), 'robot')}, "
        if undecided:
            return f"{most}is shown to be enough for {_aim(size)}: {_listed(undecided)} undecided{_after(size)}."
        last = size.points[-1]
        if last.verdict is TeamVerdict.IMPOSSIBLE:
            best = last.ideal_coverage if goal.confidence is None else last.ideal_chance
            ideal = f"the ideal of {last.robots} {'covers' if goal.confidence is None else 'has a chance of'}"
            return f"{most}can reach {_aim(size)}, whatever the strategy: {ideal} {_of(best)}."
        return f"{most}is enough for {_aim(size)}: with {last.robots}, {_figure(size, last)}."
    found = _figure(size, size.confirmed or size.point(size.robots))
    if undecided:
        are = f"{_listed(undecided)} {'is' if len(undecided) == 1 else 'are'} undecided{_after(size)}"
        return f"{_listed([*undecided, size.robots], 'or')} robots: with {size.robots}, {found}; {are}."
    rest = "; not every smaller team was looked at" if size.passed_over else ""
    are = "robot is" if size.robots == 1 else "robots are"
    return f"{size.robots:,} {are} enough: {found}{rest}."


def _deciding(size: TeamSize, point: Point) -> Estimate:
    estimate = point.coverage if size.goal.confidence is None else point.chance
    assert estimate is not None
    return estimate


def _figure(size: TeamSize, point: Point) -> str:
    """The deciding figure of a team that was rolled out, with its 95 % interval."""
    estimate = _deciding(size, point)
    low, high = estimate.ci95
    sure = "exact" if low == high else f"95 % interval {between(100 * low, 100 * high, 2, 100)}"
    sure += ", fresh rollouts" if point is size.confirmed else ""
    if size.goal.confidence is None:
        what = f"of the accessible cells {size.goal.meaning} on average"
    else:
        what = f"chance of {_share(size)} {size.goal.meaning}"
    return f"{_of(estimate.mean)} {what}{_by(size)} ({sure})"


def _aim(size: TeamSize) -> str:
    """What was asked for."""
    goal = size.goal
    if goal.confidence is None:
        return f"{_of(goal.target)} of the accessible cells {goal.meaning} on average{_by(size)}"
    return f"a chance of {_of(goal.confidence)} for {_share(size)} {goal.meaning}{_by(size)}"


def _by(size: TeamSize) -> str:
    end = size.deadline
    return "" if end is None else f" by step {end}{size.world.pace.also(end)}"


def _share(size: TeamSize) -> str:
    if size.goal.target == 1:
        return "every accessible cell"
    return f"at least {chance(size.goal.target, 12)} of the accessible cells"


def _so_far(size: TeamSize) -> str:
    enough = [point.robots for point in size.points if point.verdict is TeamVerdict.ENOUGH]
    short = [p.robots for p in size.points if p.verdict in (TeamVerdict.NOT_ENOUGH, TeamVerdict.IMPOSSIBLE)]
    known = [f"{counted(min(enough), 'robot')} are enough"] if enough else []
    known += [f"{_listed(short)} not enough"] if short else []
    return f"for {_aim(size)}, {', '.join(known)}" if known else f"nothing is decided yet on {_aim(size)}"


def _of(fraction: float) -> str:
    """A fraction in percent, in the digits that somebody gave, or four; one that is not 1 is not rounded to it."""
    return chance(fraction, 4)


def _after(size: TeamSize) -> str:
    """How long the undecided ones were looked at."""
    most = max(point.rollouts for point in size.points if point.verdict is TeamVerdict.UNDECIDED)
    return f" after {counted(most, 'rollout')}"


def _listed(numbers: Sequence[int], last: str = "and") -> str:
    """Whole numbers in words: "7", "7 and 8", "1 to 6 and 9"."""
    parts = []
    for _, group in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else [str(number) for number in run]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} {last} {parts[-1]}"


def _key_figures(size: TeamSize) -> list[KeyFigure]:
    if size.robots is None:
        return []
    point = size.confirmed or size.point(size.robots)
    fresh = ", fresh rollouts" if point is size.confirmed else ""
    name = f"{size.goal.meaning} on average" if size.goal.confidence is None else f"chance of {_target(size)}"
    undecided = size.of(TeamVerdict.UNDECIDED)
    note = f"{_listed(undecided)} undecided" if undecided else ""
    out = [KeyFigure(counted(size.robots, "robot"), "enough", note), share_figure(_deciding(size, point), name, fresh)]
    if point.alive is not None:
        alive, interval = point.alive.columns()
        out.append(KeyFigure(f"{alive} of {size.robots}", "robots alive at the end", interval))
    return out


def _target(size: TeamSize) -> str:
    return "every cell" if size.goal.target == 1 else f"{chance(size.goal.target, 12)} or more"


def _chart(size: TeamSize) -> Chart:
    """Both figures over the teams with their intervals, what no strategy exceeds, what is wanted, the answer."""
    goal, by_chance = size.goal, size.goal.confidence is not None
    rolled = [point for point in size.points if point.coverage]
    unsure = [point for point in rolled if point.verdict is TeamVerdict.UNDECIDED]
    ideals = [100 * (point.ideal_chance if by_chance else point.ideal_coverage) for point in size.points]
    curves = [
        Series.of(f"expected coverage ({goal.meaning})", _sizes(rolled), [p.coverage for p in rolled if p.coverage]),
        Series.of(f"chance of {_target(size)}", _sizes(rolled), [p.chance for p in rolled if p.chance]),
        Series(f"ideal of the team: no {'chance' if by_chance else 'mean coverage'} is above it", _sizes(size.points),
               ideals, dashed=True),
        Series.of("undecided", _sizes(unsure), [_deciding(size, point) for point in unsure], kind="points"),
    ]  # fmt: skip
    wanted = f"{'wanted chance' if by_chance else 'target'}: {chance(goal.wanted, 12)}"
    enough = () if size.robots is None else ((size.robots, f"enough: {size.robots}"),)
    return Chart(
        _title(size), tuple(curves), "robots", f"{goal.meaning}, and chance of {_target(size)}, %",
        unit="%", digits=2, y_range=(0, 100), at_x=enough, at_y=((100 * goal.wanted, wanted),),
    )  # fmt: skip


def _sizes(points: Sequence[Point]) -> list[int]:
    return [point.robots for point in points]


def _title(size: TeamSize) -> str:
    aim = f"{chance(size.goal.target, 12)} expected coverage"
    if size.goal.confidence is not None:
        aim = f"a {chance(size.goal.confidence, 12)} chance of {_target(size)}"
    undecided = size.of(TeamVerdict.UNDECIDED)
    if size.partial:
        return f"Interrupted: robots for {aim}"
    if size.robots is None:
        return f"No team of up to {len(size.starts)} shown to be enough for {aim}"
    also = "".join(f"{k} or " for k in undecided) if len(undecided) < 4 else "at most "
    return f"{also}{counted(size.robots, 'robot')} for {aim}"


def _table(size: TeamSize) -> Table:
    value = ["value"] * (size.world.value is not None)
    pace, minutes = size.world.pace, ["minutes"] * bool(size.world.pace)
    figures = (size.goal.meaning, "interval", "chance", "interval")
    names = ("robots", *figures, *value, "time", *minutes, "alive", "verdict")
    table = make_table(names, left=("verdict",), dropped=("time", "alive"), padding=(0, 1, 0, 0))
    ruled_out = [point for point in size.points if point.verdict is TeamVerdict.IMPOSSIBLE]
    if ruled_out:
        best = ruled_out[-1]
        sizes = "1" if len(ruled_out) == 1 else f"1..{best.robots}"
        most = (f"<= {ceiled(of, unit='')}" for of in (best.ideal_coverage, best.ideal_chance))
        below = (next(most), "", next(most), "")
        table.add_row(sizes, *below, *("" for _ in (*value, *minutes)), "", "", str(best.verdict))
    for point in size.points:
        if point.coverage and point.chance and point.time and point.alive:
            cells = (*point.coverage.columns(100.0, 100), *point.chance.columns(100.0, 100))
            worth = [in_percent(point.value.mean, 2) if point.value else "" for _ in value]
            times = [f"{pace.minutes * point.time.mean:,.1f}" for _ in minutes]
            others = (*worth, f"{point.time.mean:.0f}", *times, of_all(point.alive.mean, point.robots))
            table.add_row(str(point.robots), *cells, *others, str(point.verdict))
    return table


def _footnotes(size: TeamSize) -> list[str]:
    """What the columns are, how the verdicts were come to, and what was not looked at."""
    figure = "coverage" if size.goal.confidence is None else "chance"
    rolled = [point.rollouts for point in size.points if point.rollouts]
    lines = []
    if any(point.coverage for point in size.points):
        both = "both in %, with 95 % intervals" if rolled else "both in %"
        lines.append(
            f"{size.goal.meaning}: expected coverage; chance: of {_share(size)}; {both}. time: steps; alive: robots at "
            "the end."
        )
    if rolled:
        often = (f"{min(rolled):,} to " if min(rolled) < max(rolled) else "") + counted(max(rolled), "rollout")
        lines.append(
            f"{often} a team. The verdicts are on the {figure}, and hold together "
            f"with {100 * (1 - ALPHA):g} % confidence."
        )
    if size.of(TeamVerdict.UNDECIDED) and size.choices.precision is None and not size.partial:
        lines.append(f"undecided: more than {argument('rollouts', size.choices.rollouts)} may tell.")
    if size.of(TeamVerdict.IMPOSSIBLE):
        what = "on average exceeds" if size.goal.confidence is None else "has a chance above"
        lines.append(f"impossible: no strategy of so many robots {what} the value after the <=.")
    if size.passed_over and not size.partial:
        what = "they are not enough if coverage grows with the team" if size.robots else "they may be enough"
        lines.append(f"Not looked at: {_listed(size.passed_over)} robots; {what}.")
    if size.world.value is not None:
        lines.append("value: expected share of the value of all free cells, in %; the target is of cells.")
    return lines


def _json(size: TeamSize) -> Json:
    """Undefined values are None, coverage values fractions of the accessible cells."""
    goal, choices, world = size.goal, size.choices, size.world
    dangerous = world.accessible(size.starts) & (world.threat > 0)
    return {
        "target": goal.target,
        "confidence": goal.confidence,
        "complete": goal.complete,
        "meaning": goal.meaning,
        "most": goal.most,
        "deadline": size.deadline,
        "robots": size.robots,
        "starts": None if size.robots is None else size.starts[: size.robots],
        "undecided": size.of(TeamVerdict.UNDECIDED),
        "not_looked_at": size.passed_over,
        "curve": [_point_json(point) for point in size.points],
        "confirmed": None if size.confirmed is None else _point_json(size.confirmed),
        "cells": {
            "total": world.threat.size,
            "free": int(world.free.sum()),
            "accessible": size.cells,
            "dangerous": int(dangerous.sum()),
            "needed": size.needed,
        },
        "seed": choices.seed,
        "loop": choices.loop,
        "mode": choices.drawn,
        "luck": choices.luck,
        "engine": size.engine or None,
        **json_end(size, size.notes),
    }


def _point_json(point: Point) -> Json:
    told = {name: getattr(point, name) for name in ("coverage", "chance", "time", "alive", "rollouts")}
    return {
        "robots": point.robots,
        "verdict": str(point.verdict),
        **told,
        "verdict_interval": point.interval,
        "exact": point.exact,
        "ideal": {"coverage": point.ideal_coverage, "chance": point.ideal_chance},
        **({} if point.value is None else {"value": point.value}),
    }
