"""What `mrac-jax size` says: the answer in a sentence, the table of teams, the JSON object, the folder of `--out`."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.table import Table

from analysis.design.rules import TeamVerdict
from analysis.design.size import Point, TeamSize
from analysis.kit.face import json_end
from analysis.kit.folder import json_text, write_all
from analysis.kit.tables import make_table, print_lines
from analysis.kit.words import between, counted
from analysis.statistics.estimate import Estimate
from analysis.statistics.intervals import ALPHA
from planner.arguments import argument
from planner.files import Json


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
            what = "covers" if goal.confidence is None else "has a chance of"
            return (
                f"{most}can reach {_aim(size)}, whatever the strategy: the ideal of {last.robots} {what} {_of(best)}."
            )
        return f"{most}is enough for {_aim(size)}: with {last.robots}, {_figure(size, last)}."
    sizes = [*undecided, size.robots]
    found = _figure(size, size.confirmed or size.point(size.robots))
    if undecided:
        are = "is" if len(undecided) == 1 else "are"
        return (
            f"{_listed(sizes, 'or')} robots: with {size.robots}, {found}; {_listed(undecided)} {are} undecided"
            f"{_after(size)}."
        )
    rest = "; not every smaller team was looked at" if size.passed_over else ""
    are = "robot is" if size.robots == 1 else "robots are"
    return f"{size.robots:,} {are} enough: {found}{rest}."


def _figure(size: TeamSize, point: Point) -> str:
    """The deciding figure of a team that was rolled out, with its 95 % interval."""
    estimate = point.coverage if size.goal.confidence is None else point.chance
    assert estimate is not None
    low, high = estimate.ci95
    sure = "exact" if low == high else f"95 % interval {100 * low:.2f} to {100 * high:.2f}"
    sure += ", fresh rollouts" if point is size.confirmed else ""
    by = "" if size.choices.deadline is None else f" by step {size.choices.deadline}"
    if size.goal.confidence is None:
        return f"{_of(estimate.mean)} of the accessible cells {size.goal.meaning} on average{by} ({sure})"
    return f"{_of(estimate.mean)} chance of {_share(size)} {size.goal.meaning}{by} ({sure})"


def _aim(size: TeamSize) -> str:
    """What was asked for."""
    goal, by = size.goal, "" if size.choices.deadline is None else f" by step {size.choices.deadline}"
    if goal.confidence is None:
        return f"{_of(goal.target)} of the accessible cells {goal.meaning} on average{by}"
    return f"a chance of {_of(goal.confidence)} for {_share(size)} {goal.meaning}{by}"


def _share(size: TeamSize) -> str:
    if size.goal.target == 1:
        return "every accessible cell"
    return f"at least {100 * size.goal.target:g} % of the accessible cells"


def _so_far(size: TeamSize) -> str:
    enough = [point.robots for point in size.points if point.verdict is TeamVerdict.ENOUGH]
    short = [p.robots for p in size.points if p.verdict in (TeamVerdict.NOT_ENOUGH, TeamVerdict.IMPOSSIBLE)]
    known = [f"{counted(min(enough), 'robot')} are enough"] if enough else []
    known += [f"{_listed(short)} not enough"] if short else []
    return f"for {_aim(size)}, {', '.join(known)}" if known else f"nothing is decided yet on {_aim(size)}"


def _of(fraction: float) -> str:
    """A fraction in percent; one that is not 1 is not rounded to it."""
    return f"{100 * fraction:.2f} %" if 100 * fraction >= 99.95 and fraction < 1 else f"{100 * fraction:.4g} %"


def _after(size: TeamSize) -> str:
    """How long the undecided ones were looked at."""
    most = max(point.rollouts for point in size.points if point.verdict is TeamVerdict.UNDECIDED)
    return f" after {most:,} rollouts"


def _listed(numbers: Sequence[int], last: str = "and") -> str:
    """Whole numbers in words: "7", "7 and 8", "1 to 6 and 9"."""
    parts = []
    for _, group in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0]):
        run = [number for _, number in group]
        parts += [f"{run[0]} to {run[-1]}"] if len(run) > 2 else [str(number) for number in run]
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} {last} {parts[-1]}"


def print_size(size: TeamSize, console: Console) -> None:
    """Print the answer, what was asked, and the teams behind it; 80 columns are enough."""
    world, choices = size.world, size.choices
    cells = f"{world.source}: {size.cells} accessible cells, so the target is {size.needed} of them"
    loop = f"{choices.loop} loop, seed {choices.seed}, {size.engine or 'no rollouts'}"
    print_lines(console, (headline(size), cells, loop))
    console.print(_table(size))
    print_lines(console, _footnotes(size))


def _table(size: TeamSize) -> Table:
    valued = size.world.value is not None
    names = (
        "robots",
        size.goal.meaning,
        "interval",
        "chance",
        "interval",
        *["value"] * valued,
        "time",
        "alive",
        "verdict",
    )
    table = make_table(names, left=("verdict",), dropped=("time", "alive"), padding=(0, 1, 0, 0))
    ruled_out = [point for point in size.points if point.verdict is TeamVerdict.IMPOSSIBLE]
    if ruled_out:
        best = ruled_out[-1]
        sizes = "1" if len(ruled_out) == 1 else f"1..{best.robots}"
        below = (f"<= {100 * best.ideal_coverage:.2f}", "", f"<= {100 * best.ideal_chance:.2f}", *[""] * valued)
        table.add_row(sizes, *below, "", "", "", str(best.verdict))
    for point in size.points:
        if point.coverage and point.chance and point.time and point.alive:
            cells = (*_percent(point.coverage), *_percent(point.chance))
            worth = [f"{100 * point.value.mean:.2f}" if point.value else ""] * valued
            others = (*worth, f"{point.time.mean:.0f}", f"{point.alive.mean:.2f}")
            table.add_row(str(point.robots), *cells, *others, str(point.verdict))
    return table


def _percent(estimate: Estimate) -> tuple[str, str]:
    low, high = (100 * bound for bound in estimate.ci95)
    return f"{100 * estimate.mean:.2f}", "exact" if low == high else between(low, high)


def _footnotes(size: TeamSize) -> list[str]:
    """What the columns are, how the verdicts were come to, and what was not looked at."""
    figure = "coverage" if size.goal.confidence is None else "chance"
    rolled = [point.rollouts for point in size.points if point.rollouts]
    lines = []
    if rolled:
        lines.append(
            f"{size.goal.meaning}: expected coverage; chance: of {_share(size)}; both in %, with 95 % intervals. time: "
            "steps; alive: robots at the end."
        )
        often = f"{min(rolled):,} to {max(rolled):,}" if min(rolled) < max(rolled) else f"{rolled[0]:,}"
        lines.append(
            f"{often} rollouts a team. The verdicts are on the {figure}, and hold together "
            f"with {100 * (1 - ALPHA):g} % confidence."
        )
    if size.of(TeamVerdict.UNDECIDED) and size.choices.precision is None and not size.partial:
        lines.append(f"undecided: more than {argument('rollouts', size.choices.rollouts)} may tell.")
    if any(point.verdict is TeamVerdict.IMPOSSIBLE for point in size.points):
        what = "on average exceeds" if size.goal.confidence is None else "has a chance above"
        lines.append(f"impossible: no strategy of so many robots {what} the value after the <=.")
    if size.passed_over and not size.partial:
        what = "they are not enough if coverage grows with the team" if size.robots else "they may be enough"
        lines.append(f"Not looked at: {_listed(size.passed_over)} robots; {what}.")
    if size.world.value is not None:
        lines.append("value: expected share of the value of all free cells, in %; the target is of cells.")
    return lines + [f"note: {note}" for note in size.notes]


def size_json(size: TeamSize) -> Json:
    """The JSON object of `size`; undefined values are None, coverage values fractions of the accessible cells."""
    goal, choices, world = size.goal, size.choices, size.world
    accessible = world.accessible(size.starts)
    return {
        "target": goal.target,
        "confidence": goal.confidence,
        "complete": goal.complete,
        "meaning": goal.meaning,
        "most": goal.most,
        "deadline": choices.deadline,
        "robots": size.robots,
        "starts": None if size.robots is None else size.starts[: size.robots].tolist(),
        "undecided": list(size.of(TeamVerdict.UNDECIDED)),
        "not_looked_at": list(size.passed_over),
        "curve": [_point_json(point) for point in size.points],
        "confirmed": None if size.confirmed is None else _point_json(size.confirmed),
        "cells": {
            "total": world.threat.size,
            "free": int(world.free.sum()),
            "accessible": size.cells,
            "dangerous": int((accessible & (world.threat > 0)).sum()),
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
    def estimate(value: Estimate | None) -> Json | None:
        return None if value is None else value.to_json()

    return {
        "robots": point.robots,
        "verdict": str(point.verdict),
        "coverage": estimate(point.coverage),
        "chance": estimate(point.chance),
        "time": estimate(point.time),
        "alive": estimate(point.alive),
        "rollouts": point.rollouts,
        "verdict_interval": None if point.interval is None else list(point.interval),
        "exact": point.exact,
        "ideal": {"coverage": point.ideal_coverage, "chance": point.ideal_chance},
        **({} if point.value is None else {"value": point.value.to_json()}),
    }


def save_size(size: TeamSize, folder: Path, command: str) -> list[Path]:
    """Write `size.png` and `size.json` into `folder` (made if it is not there); returns the files."""
    from analysis.design.picture import size_figure
    from analysis.pictures.style import png_of

    return write_all(folder, {"size.png": png_of(size_figure, size), "size.json": json_text(size_json(size))})
