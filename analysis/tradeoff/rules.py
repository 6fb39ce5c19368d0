"""The rules behind `mrac-jax front`: which settings are looked at, which of them nothing beats, which one is picked.

Pure functions of numbers; what rolls out is `analysis.tradeoff.front`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.coverage import TARGETS
from planner.arguments import Numbers, argument, exactly, numbers_of
from planner.errors import UsageError
from planner.pace import UNPACED, Pace
from planner.worlds.world import World

LANDMARKS = (*(tenth / 10 for tenth in range(1, 10)), 0.95, 0.99)
"""Coverage, fractions of the accessible cells, that prices are named for; missions are cut where they reach it."""
RESERVES = (0.1, 0.25, 0.5)
MOST_WORTHS = 16
"""Steps of the ladder of `worth`, each twice the one before."""
NEXT_TO_NONE = 0.02
"""Robots lost on average below which the ladder ends."""
USUAL, CELLS = 4096, 2**23
"""Rollouts of a setting where nobody says how many, and the cells that they cover together at most."""
HALVINGS = 3
"""Values of `worth` tried between the two that a goal lies between; and missions ended between those that are left."""
KNEE = 0.1
"""How far above the straight price between two settings a third has to be to be named: a share of what it costs."""
FAMILIES = ("mrac", "per_cell", "reserve", "worth")


def usual_rollouts(world: World, starts: NDArray[np.int64]) -> int:
    """Of each setting, where nobody says how many: fewer on large maps, so that a front is a matter of a minute.

    By the map alone, as the same seed has to give the same answer on any machine: a power of two, 16 to USUAL.
    """
    cells = int(world.accessible(starts).sum())
    return max(16, min(USUAL, 1 << (CELLS // cells).bit_length() - 1))


class Setting(NamedTuple):
    """What a point of the front stands for: a policy with its limits, and the step at which the mission is ended."""

    policy: str
    reserve: float | None = None
    worth: float | None = None
    deadline: int | None = None

    @property
    def family(self) -> str:
        """What it is varied with, one of FAMILIES: a policy alone and cut short, a reserve, a worth."""
        return "worth" if self.worth is not None else "reserve" if self.reserve is not None else self.policy

    @property
    def limits(self) -> dict[str, float]:
        """The limits that are set, by name."""
        both = {"reserve": self.reserve, "worth": self.worth}
        return {name: value for name, value in both.items() if value is not None}

    def limits_json(self) -> dict[str, str | float | None]:
        """The policy and both limits, for JSON."""
        return {"policy": self.policy, "reserve": self.reserve, "worth": self.worth}

    def __str__(self) -> str:
        return self.said(UNPACED)

    def said(self, pace: Pace) -> str:
        """In words: "per_cell, worth 40, ended at step 120"."""
        cut = "" if self.deadline is None else f", ended at {pace.step(self.deadline)}"
        return self.policy + "".join(f", {name} {value:g}" for name, value in self.limits.items()) + cut

    def options(self) -> list[str]:
        """The options of `evaluate` that ask for it."""
        words = ["--policy", self.policy]
        for name, value in self.limits.items():
            words += [f"--{name}", exactly(value)]
        return words if self.deadline is None else [*words, "--deadline", str(self.deadline)]


class Figures(NamedTuple):
    """Means that settings are compared by: coverage (more is better), robots lost and steps (less is better)."""

    coverage: float
    losses: float
    time: float

    def beats(self, other: Figures) -> bool:
        """Nowhere worse, somewhere better."""
        return (
            self.coverage >= other.coverage
            and self.losses <= other.losses
            and self.time <= other.time
            and tuple(self) != tuple(other)
        )


@dataclass(frozen=True)
class Goal:
    """What to pick by: most coverage at no more than `losses` robots lost, or fewest lost with `target` covered."""

    losses: float | None = None
    target: float | None = None

    def __bool__(self) -> bool:
        return self.losses is not None or self.target is not None

    def allows(self, figures: Figures) -> bool:
        """Whether a setting may be picked."""
        return figures.losses <= self.losses if self.losses is not None else figures.coverage >= (self.target or 0.0)

    def ranked(self, points: Sequence[Figures]) -> list[int]:
        """The places of those that it allows, the best first; of equal ones the first."""

        def rank(place: int) -> tuple[float, float, float]:
            coverage, losses, time = points[place]
            return (-coverage, losses, time) if self.losses is not None else (losses, -coverage, time)

        return sorted((place for place, figures in enumerate(points) if self and self.allows(figures)), key=rank)

    def pick(self, points: Sequence[Figures]) -> int | None:
        """The place of the best; None: it allows none."""
        return next(iter(self.ranked(points)), None)


def make_goal(losses: float | None, target: float | None) -> Goal:
    """The goal that options ask for; raises UsageError for one out of range, or for both."""
    if losses is not None and target is not None:
        raise UsageError(f"both {argument('losses')} and {argument('target')} are given", expected="one of them")
    Numbers(0, what="a number of robots lost on average").check("losses", losses, optional=True)
    TARGETS.check("target", target, optional=True)
    return Goal(losses, target)


def check_goal(goal: Goal, robots: int) -> None:
    """Raise UsageError for a limit on losses that no team of so many robots can break."""
    if goal.losses is not None and goal.losses > robots:
        expected = f"at most {robots}, the robots that there are to lose"
        raise UsageError(argument("losses", goal.losses), expected=expected, fix="leave it out to see what all costs")


def efficient(points: Sequence[Figures]) -> list[bool]:
    """Which of them no other one beats."""
    return [not any(other.beats(one) for other in points) for one in points]


def knee(points: Sequence[Figures], low: Figures, high: Figures) -> int | None:
    """The place of the best bargain between two settings: farthest above the straight line from one to the other.

    Coverage and robots lost are counted in shares of the way from `low` to `high`. None: no point is KNEE above it.
    """
    more, lost = high.coverage - low.coverage, high.losses - low.losses
    if not points or more <= 0 or lost <= 0:
        return None
    above = [(one.coverage - low.coverage) / more - (one.losses - low.losses) / lost for one in points]
    place = max(range(len(points)), key=above.__getitem__)
    return place if above[place] >= KNEE else None


def first_worth(largest_threat: float) -> float:
    """Where the ladder begins: a robot is worth what the worst cell costs, 1 / p, in two digits."""
    return float(f"{1 / largest_threat:.2g}")


def careful_first(largest_threat: float, smallest_threat: float, cells: int) -> list[float]:
    """The whole ladder of `worth` from its end, with which every danger is refused, down to `first_worth`."""
    first, ladder = first_worth(largest_threat), list[float]()
    for step in range(MOST_WORTHS):
        ladder.insert(0, first * 2**step)
        if ladder[0] > cells / smallest_threat:
            break
    return ladder


def between(low: float, high: float) -> float:
    """The worth half-way between two, as a ratio, in three digits."""
    return float(f"{(low * high) ** 0.5:.3g}")


def parse_numbers(name: str, text: str | None) -> tuple[float, ...] | None:
    """The numbers of "5,10,20"; "" for none of them; None stays None. Raises UsageError naming the option."""
    if text is None:
        return None
    return numbers_of(name, text, 'numbers, as "5,10,20"') if text.strip() else ()
