"""What is compared: ways to know a map, or for its threats to stand and move, and the teams that meet them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import get_args

from analysis.sweeps.cases import Case, canonical
from analysis.sweeps.worlds import Generated
from planner.files import Json
from planner.policies import DEFAULT
from planner.settings import Choices
from planner.worlds.generate import Kind

Team = tuple[Kind, int, str]
"""Kind of map, robots, policy."""
ROBOTS = (1, 2, 4, 8, 20)
P = 0.04
"""The threat that robots expect of cells that they know nothing of."""


@dataclass(frozen=True)
class Question:
    """Ways that a random map may be met, compared on the same maps and luck.

    Attributes:
        name: of the command. title: in words.
        ways: by name, what the map has beside itself: keys of a scenario (`analysis.sweeps.worlds.BESIDE`).
        policies: of the teams; the last one is also compared with the one before.
        less: (one, other): by how much more one covers. main: of these, those that the headline tells, with its words.
    """

    name: str
    title: str
    ways: dict[str, Json]
    policies: tuple[str, ...]
    less: tuple[tuple[str, str], ...]
    main: dict[tuple[str, str], str]

    @property
    def teams(self) -> tuple[Team, ...]:
        """Those that meet it."""
        return tuple(product(get_args(Kind), ROBOTS, self.policies))


@dataclass(frozen=True)
class Setting:
    """A team on maps of a kind that it meets in one way."""

    kind: Kind
    way: str
    robots: int
    policy: str

    def case(self, question: Question, seed: int) -> Case:
        """It on the map with this seed."""
        world = Generated(self.kind, seed=seed, unsaid=canonical(question.ways[self.way]))
        labels = {**vars(self), "map": seed}
        policy = None if self.policy == DEFAULT else self.policy
        return Case(world, self.robots, choices=Choices(policy=policy), labels=tuple(labels.items()))


def settings_of(question: Question, teams: Sequence[Team]) -> list[Setting]:
    """All of them, those of one world after the other."""
    found = [Setting(kind, way, robots, policy) for way in question.ways for kind, robots, policy in teams]
    return sorted(found, key=lambda one: one.kind)


TOLD, BLIND, SEES = "told", "blind", "obstacles told, see 3"


def _see(cells: int) -> str:
    return f"see {cells}"


ONLINE = Question(
    "online",
    "What is a map worth?",
    {
        TOLD: {},
        **{_see(cells): {"prior": {"p": P}, "sense": cells} for cells in (5, 3, 2, 1)},
        SEES: {"prior": {"p": P, "obstacles": "known"}, "sense": 3},
        BLIND: {"prior": {"p": P, "obstacles": "known"}, "sense": 0},
    },
    ("mrac", "per_cell", "frontier"),
    (*((TOLD, _see(cells)) for cells in (5, 3, 2, 1)), (SEES, BLIND)),
    {
        (TOLD, _see(3)): "Robots that know nothing of the map and see three cells cover {} points less than those told",
        (SEES, BLIND): "to see three cells is worth {} points to robots that know the obstacles",
    },
)

STAND, LOST, WALK, PLANNED = "stand, told where", "stand, not told where", "walk", "walk, planned on p joined"


def _moving(stay: float, plan_on: str = "patrols") -> Json:
    return {"movers": [{"walk": stay, "h": "threats"}], "plan_on": plan_on}


MOVING = Question(
    "moving",
    "What if the threats walk?",
    {STAND: {}, LOST: _moving(1), WALK: _moving(0.5), PLANNED: _moving(0.5, "joined")},
    ("mrac", "per_cell"),
    ((STAND, LOST), (WALK, LOST), (PLANNED, WALK)),
    {
        (STAND, LOST): "To be told where threats stand is worth {} points",
        (WALK, LOST): "where nobody is told, robots cover {} points more if they walk",
    },
)
QUESTIONS = {question.name: question for question in (ONLINE, MOVING)}
