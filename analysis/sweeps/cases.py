"""What a sweep runs: a case (world, team, plan), a model (how it is rolled out), and the key of the two together.

The key of a run is a hash of content: the threats, the starts, what the plan follows from, the model, its seed and the
version of the semantics. Names of files, labels, the number of rollouts, the engine, and the machine are not in it.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from analysis.sweeps.worlds import Generated, Written
from planner.arguments import check_word
from planner.errors import InputError, UsageError
from planner.luck_names import LUCKS, LuckName
from planner.plans.plan import Plan
from planner.settings import Choices, Settings
from planner.worlds.generate import Kind
from planner.worlds.starts import place_starts
from planner.worlds.world import World, check_starts

if TYPE_CHECKING:
    from planner.rollouts.open_loop.compiled import Mode

SEMANTICS = 1
"""Version of what a rollout means (docs/spec.md). It is in every key: results of two versions never mix."""
REMEMBERED = 4
"""Worlds that `Places` keeps: the next case is mostly another team in the same one."""
Label = str | int | float | bool | None
Thing = TypeVar("Thing")


@dataclass(frozen=True)
class Case:
    """World, team and plan.

    Attributes:
        world: where. robots: how many, placed by the start rule; None: as many as the scenario says, else 1.
        starts: (row, col) of each robot, instead of `robots`; None: the scenario's, else the start rule's.
        choices: the planner's settings, those that are given. plan: a plan file to run instead of planning.
        labels: what the results are found by, (name, value); no part of the case's identity.
    """

    world: Generated | Written
    robots: int | None = None
    starts: tuple[tuple[int, int], ...] | None = None
    choices: Choices = Choices()  # noqa: RUF009 (frozen)
    plan: str | None = None
    labels: tuple[tuple[str, Label], ...] = field(default=(), compare=False)

    @property
    def name(self) -> str:
        """The labels, as messages name the case."""
        return " ".join(f"{name}={value}" for name, value in self.labels) or "case"


@dataclass(frozen=True)
class Model:
    """How a case is rolled out.

    Attributes:
        loop: "closed" (reallocate and share) or "open" (follow the plan).
        first_only: only the first visit of a cell by anybody can stop a robot; closed loop.
        seed: of the rollouts, 0 <= seed < 2**64. Maps of one mean must not share it: the luck would be the same on
            all of them.
        luck: by which robots are stopped.
        mode: of luck by step in the open loop; None: "fast". Else it is `luck`.
    """

    loop: Literal["closed", "open"] = "closed"
    first_only: bool = False
    seed: int = 0
    mode: Mode | None = None
    luck: LuckName = "step"

    def __post_init__(self) -> None:
        check_word("loop", self.loop, ("closed", "open"))
        check_word("luck", self.luck, LUCKS)
        if self.luck == "tolerance":
            if self.mode not in (None, "tolerance"):
                raise UsageError(f"mode {self.mode} is for luck by step", fix="leave it out, or use luck: step")
        elif self.mode is not None:
            check_word("mode", self.mode, ("fast", "step"))
        if self.loop == "open" and self.first_only:
            raise UsageError("threat_checks first_visit needs the closed loop", fix="use loop: closed")
        if self.loop == "closed" and self.mode == "fast":
            raise UsageError("mode fast is for the open loop", fix="leave it out, or use loop: open")
        if not 0 <= self.seed < 2**64:
            raise UsageError(f"seed is {self.seed}", expected="0 to 2**64 - 1")
        of_step = "step" if self.loop == "closed" else (self.mode or "fast")
        object.__setattr__(self, "mode", "tolerance" if self.luck == "tolerance" else of_step)

    def labels(self) -> dict[str, Label]:
        """What its results are found by."""
        checks = "first_visit" if self.first_only else "every_visit"
        return {"loop": self.loop, "mode": self.mode, "threat_checks": checks, "rollout_seed": self.seed}


@dataclass(frozen=True, eq=False)
class Team:
    """A case made ready for planning. `starts` is int64 `[K, 2]`; `plan`: from a file, else None."""

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    plan: Plan | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def identity(self) -> str:
        """Hash of all that its plan follows from."""
        said = {
            "shape": list(self.world.shape),
            "world": self.world.sha256,
            "starts": self.starts.tolist(),
            "plan": self.settings.to_json() if self.plan is None else _plan_hash(self.plan),
        }
        return hashlib.sha256(canonical(said).encode()).hexdigest()

    def build(self) -> Plan:
        """Its plan. Raises InputError."""
        from planner.plan_team import plan_team

        return plan_team(self.world, self.starts, self.settings) if self.plan is None else self.plan


def generated_case(
    kind: Kind = "contiguous",
    ratio: float = 0.25,
    robots: int = 1,
    seed: int = 0,
    size: tuple[int, int] = (20, 20),
    *,
    choices: Choices | None = None,
    **more: Any,
) -> Case:
    """The team of `robots` on the paper's random world with this seed; `more`: areas, levels, obstacles."""
    world = Generated(kind, ratio, seed, *size, **more)
    labels: list[tuple[str, Label]] = [("kind", kind), ("ratio", ratio), ("robots", robots), ("map", seed)]
    labels += [(name, value if isinstance(value, int | float) else str(value)) for name, value in more.items()]
    return Case(world, robots, choices=choices or Choices(), labels=tuple(labels))


class Places:
    """Makes teams of cases; keeps the last few worlds, so that a world's teams follow each other at no cost."""

    def __init__(self) -> None:
        self._worlds: OrderedDict[object, Any] = OrderedDict()

    def team(self, case: Case) -> Team:
        """The case's world, starts and settings. Raises InputError naming the case."""
        try:
            team = self._team(case)
            team.world.check_settled("a sweep")
            team.world.check_alike("a sweep")
            return team
        except InputError as error:
            raise naming(error, case.name) from error

    def _team(self, case: Case) -> Team:
        world = self._kept(case.world, case.world.world)
        notes, team = world.notes, world.team
        if case.plan is not None:
            return self._planned(case, world, notes)
        if case.starts is not None:
            starts = check_starts(np.array(case.starts), world.threat, case.name)
            if case.robots not in (None, len(starts)):
                raise UsageError(f"{case.robots} robots contradict {len(starts)} starts", fix="leave robots out")
        elif case.robots is None and world.starts is not None:
            starts = world.starts
        else:
            count = case.robots if case.robots is not None else (team.robots or 1)
            starts, more = place_starts(world, count, team.start)
            notes += more
        settings = Settings(**case.choices.over(team.settings))
        settings.check(case.name)
        return Team(world, starts, settings, notes=notes)

    def _planned(self, case: Case, world: World, notes: tuple[str, ...]) -> Team:
        from planner.plan_team import read_plan

        plan = self._kept((case.plan, world.sha256), lambda: read_plan(str(case.plan), world))
        if case.robots not in (None, len(plan.robots)) or case.starts is not None or case.choices.given():
            expected = f"its own {len(plan.robots)} robots, starts and settings"
            raise UsageError(f"{case.plan} with other robots, starts or settings", expected=expected)
        return Team(world, plan.starts, plan.settings or Settings(), plan, notes + plan.notes)

    def _kept(self, key: object, make: Callable[[], Thing]) -> Thing:
        if key not in self._worlds:
            self._worlds[key] = make()
            if len(self._worlds) > REMEMBERED:
                self._worlds.popitem(last=False)
        self._worlds.move_to_end(key)
        return self._worlds[key]


def build(case: Case) -> tuple[World, Plan]:
    """The case's world and plan. Raises InputError naming the case."""
    team = Places().team(case)
    return team.world, team.build()


def run_key(team: Team, model: Model) -> str:
    """The identity of a run: sha256, as 64 hex digits, of all that its rollouts follow from. Cheap: nothing planned."""
    drawn = {name: value for name, value in asdict(model).items() if name != "luck"}  # which `mode` says too
    said = {"semantics": SEMANTICS, "team": team.identity, "model": drawn}
    return hashlib.sha256(canonical(said).encode()).hexdigest()


def _plan_hash(plan: Plan) -> str:
    """Of a plan file: its paths, and for one of ours the allocation and the settings that the closed loop goes by."""
    width = plan.shape[1]
    paths = [[list(divmod(cell, width)) for cell in robot.path.tolist()] for robot in plan.robots]
    areas = [[area.level, area.robot, area.cells.tolist()] for area in plan.areas]
    settings = None if plan.settings is None else plan.settings.to_json()
    bears = [] if plan.bears.is_plain else [plan.bears.to_json()]
    return hashlib.sha256(canonical([paths, areas, settings, *bears]).encode()).hexdigest()


def canonical(value: object) -> str:
    """JSON with sorted keys and no blanks: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def shown(value: Label) -> str:
    """A label's value as text."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def naming(error: InputError, case: str) -> InputError:
    """The same error, of the same kind, naming the case first."""
    if case in error.source:
        return error
    source = f"{case}: {error.source}" if error.source else case
    return type(error)(error.problem, source=source, expected=error.expected, fix=error.fix)
