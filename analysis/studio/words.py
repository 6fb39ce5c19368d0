"""What the studio says of an answer: a headline, and the few figures below it."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from analysis.kit.words import without_level
from analysis.statistics.coverage import losses_shown
from analysis.statistics.estimate import Estimate
from analysis.statistics.words import lost_words
from analysis.theory.exact import OpenLoopExact
from analysis.trials.measured import Measured
from planner.arguments import exactly
from planner.pace import Pace
from planner.shown import counted, percent

WAITING = "..."
"""In the place of a figure that is not known yet."""


class Figure(NamedTuple):
    """A figure to take away: its value, what it is, how sure."""

    value: str
    name: str
    note: str


def headline(robots: int, mean: Estimate, losses: Estimate, alone: bool = False) -> str:
    """The closed loop's answer in a sentence; `alone`: the open loop's, in which nobody takes over."""
    covers = f"{counted(robots, 'robot covers', 'robots cover')} {without_level(coverage(mean))} of what can be reached"
    if alone:
        covers = f"If nobody took over, {counted(robots, 'robot')} would cover {without_level(coverage(mean))}"
    lost = lost_words(losses.mean, robots, min(losses.digits(), 2))
    return f"{covers}; {lost} {'is' if robots == 1 else 'are'} lost."


def coverage(mean: Estimate) -> str:
    """A mean coverage in percent with its interval; an exact one says so."""
    return f"{percent(mean.mean, 2)} (exact)" if mean.half_width == 0 else mean.said(100.0, " %")


def figures(
    cells: int, robots: int, mean: Estimate | None, losses: Estimate | None, rollouts: int, exact: OpenLoopExact | None
) -> list[Figure]:
    """Covered, lost, and what the open loop comes to, if anybody drives it; None: not known yet."""
    runs = f"{counted(rollouts, 'rollout')}, {counted(cells, 'accessible cell')}" if rollouts else "rolling out"
    lost, sure = (WAITING, "") if losses is None else losses_shown(losses, robots)
    found = [
        Figure(WAITING if mean is None else coverage(mean), "covered on average", runs),
        Figure(lost, "robots lost", sure),
    ]
    if exact is not None:
        alone = f"exact; {lost_words(exact.expected_losses, robots)} lost"
        found.append(Figure(percent(exact.visited / cells, 2), "if nobody took over (open loop)", alone))
    return found


def knowledge_figures(found: Sequence[Measured]) -> list[Figure]:
    """What not to know the map costs, and what it is worth to look.

    `found`: the team told, as it is, and perhaps blind; empty: not known yet.
    """
    if not found:
        return [Figure(WAITING, "not knowing costs", "")]
    told, learning, *blind = found
    unit = 1.0 / told.largest("visited")

    def figure(more: Measured, less: Measured, names: tuple[str, str], known: str, team: Measured) -> Figure:
        alone, ahead = percent(team.mean("visited", unit).mean), more.ahead(less, "visited", unit)
        name, ahead = (names[0], ahead) if ahead.mean >= 0 else (names[1], ahead.negated)
        return Figure(ahead.said(100.0, " points"), name, f"{known}, they cover {alone}")

    costs = figure(told, learning, ("not knowing costs", "not knowing gains"), "told the map", told)
    looking = ("to look is worth", "to look costs")
    return [costs, *(figure(learning, one, looking, "blind", one) for one in blind)]


def deadline_figures(
    step: int | None, pace: Pace, mean: Estimate | None, exact: OpenLoopExact | None, cells: int
) -> list[Figure]:
    """Coverage by a deadline, if there is one."""
    if step is None:
        return []
    alone = "" if exact is None else f"open loop: {percent(exact.by_deadline(step)[0] / cells, 2)}, exact"
    return [Figure(WAITING if mean is None else coverage(mean), f"covered by {pace.step(step)}", alone)]


def command_words(out: Path, rollouts: int | None, precision: float, deadline: int | None, seed: int) -> str:
    """The command that repeats the answer to a saved board; without `rollouts` one that is as sure."""
    many = ("--precision", exactly(precision)) if rollouts is None else ("--rollouts", str(rollouts))
    more = (() if deadline is None else ("--deadline", str(deadline))) + (() if seed == 0 else ("--seed", str(seed)))
    return shlex.join(["mrac-jax", "evaluate", str(out), *many, *more])
