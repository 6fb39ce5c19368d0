"""What the policies are compared on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import get_args

from planner.settings import Choices
from planner.worlds.generate import Kind

KINDS: tuple[Kind, ...] = get_args(Kind)
TEAMS = (1, 2, 4, 8, 20)
FRONT_TEAMS = (4, 8, 20)
RESERVE = 0.25
WORTHS = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)
CUTS = (20, 40, 60, 80, 150)
"""Steps at which runs of `mrac` are cut off."""
LARGE, LARGE_TEAM = 40, 8
PART = 10
"""One map in so many has the large maps too, and the bound for every strategy."""


@dataclass(frozen=True)
class Setting:
    """A team and its policy on square maps of `side` cells. `cut`: the step at which its runs are cut off."""

    kind: Kind
    robots: int
    policy: str = "mrac"
    reserve: float | None = None
    worth: float | None = None
    cut: int | None = None
    side: int = 20

    @property
    def choices(self) -> Choices:
        """The planner's settings."""
        policy = None if self.policy == "mrac" else self.policy
        return Choices(policy=policy, reserve=self.reserve, worth=self.worth, max_steps=self.cut)

    @property
    def name(self) -> str:
        """The policy with its limits, in words."""
        limits = {"reserve": self.reserve, "worth": self.worth, "cut at step": self.cut}
        return ", ".join([self.policy, *(f"{name} {value:g}" for name, value in limits.items() if value is not None)])


def rivals(kind: Kind, robots: int, side: int = 20) -> tuple[Setting, ...]:
    """`mrac`, `per_cell`, and for two robots or more `per_cell` with a reserve."""
    plain = (Setting(kind, robots, side=side), Setting(kind, robots, "per_cell", side=side))
    return plain + (Setting(kind, robots, "per_cell", RESERVE, side=side),) * (robots > 1)


def ladder(kind: Kind, robots: int) -> tuple[Setting, ...]:
    """`per_cell` without and with a worth, the least willing last."""
    return tuple(Setting(kind, robots, "per_cell", worth=worth) for worth in (None, *WORTHS))


def cuts(kind: Kind, robots: int) -> tuple[Setting, ...]:
    """`mrac` to its end, and cut off earlier and earlier."""
    return tuple(Setting(kind, robots, cut=cut) for cut in (None, *reversed(CUTS)))


SMALL: tuple[Setting, ...] = tuple(
    dict.fromkeys(
        setting
        for kind in KINDS
        for found in (
            *(rivals(kind, robots) for robots in TEAMS),
            *(of(kind, robots) for robots in FRONT_TEAMS for of in (ladder, cuts)),
        )
        for setting in found
    )
)
"""The settings of every map."""
ON_LARGE: tuple[Setting, ...] = tuple(setting for kind in KINDS for setting in rivals(kind, LARGE_TEAM, LARGE)[:2])
