"""What a sweep runs: a case (world, team, plan), a model (how it is rolled out), and the key of the two together.

The key of a run is a hash of content: the threats, the starts, what the plan follows from, the model, its seed and the
version of the rules that it follows. Names of files, labels, the number of rollouts, the engine, and the machine are
not in it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from analysis.sampling import RolloutChoices
from analysis.sweeps.worlds import Generated, Written
from planner.errors import InputError, UsageError
from planner.plan_team import plan_team, read_plan_on
from planner.plans.plan import Plan
from planner.rules import BEFORE, RELEASES, rules_of
from planner.settings import Choices, Settings
from planner.worlds.generate import Kind
from planner.worlds.moving import as_before
from planner.worlds.starts import check_same_team, place_starts
from planner.worlds.world import World, check_starts

RULES = "rules"
"""The label of runs whose rules an earlier release had otherwise (`planner.rules`), and of those of that release."""
REMEMBERED = 4
"""Worlds that `Places` keeps: the next case is mostly another team in the same one."""
Label = str | int | float | bool | None


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


@dataclass(frozen=True, eq=False)
class Team:
    """A case made ready for planning. `starts` is int64 `[K, 2]`; `plan`: from a file, else None."""

    world: World
    starts: NDArray[np.int64]
    settings: Settings
    plan: Plan | None = None

    @cached_property
    def identity(self) -> str:
        """Hash of all that its plan follows from."""
        said = {
            "shape": list(self.world.shape),
            "world": self.world.luck_sha256,
            "starts": self.starts.tolist(),
            "plan": self.settings.to_json() if self.plan is None else _plan_hash(self.plan),
        }
        return hashlib.sha256(canonical(said).encode()).hexdigest()

    def build(self) -> Plan:
        """Its plan. Raises InputError."""
        return plan_team(self.world, self.starts, self.settings) if self.plan is None else self.plan


def labels_of(case: Case, team: Team, model: RolloutChoices) -> dict[str, Label]:
    """What a run is found by: the case's labels, the number of robots, how it is rolled out."""
    checks = "first_visit" if model.first_only else "every_visit"
    drawn: dict[str, Label] = {"loop": model.loop, "mode": model.drawn, "threat_checks": checks}
    told = dict(case.labels) | {"robots": len(team.starts)} | drawn | {"rollout_seed": model.seed}
    rules = _rules(team, model)
    return told if rules == BEFORE else told | {RULES: RELEASES[rules]}


def generated_case(
    kind: Kind = "contiguous",
    ratio: float = 0.25,
    robots: int = 1,
    seed: int = 0,
    size: tuple[int, int] = (20, 20),
    *,
    choices: Choices | None = None,
) -> Case:
    """The team of `robots` on the paper's random world with this seed."""
    labels = (("kind", kind), ("ratio", ratio), ("robots", robots), ("map", seed))
    return Case(Generated(kind, ratio, seed, size), robots, choices=choices or Choices(), labels=labels)


class Places:
    """Makes teams of cases; keeps the last few worlds, so that a world's teams follow each other at no cost."""

    def __init__(self) -> None:
        self._world = lru_cache(REMEMBERED)(lambda where: where.world())
        self._plan = lru_cache(REMEMBERED)(lambda path, where: read_plan_on(path, self._world(where)))

    def team(self, case: Case) -> Team:
        """The case's world, starts and settings. Raises InputError naming the case."""
        return self._checked(case, lambda world: world)

    def earlier_key(self, case: Case, team: Team, model: RolloutChoices) -> str | None:
        """The key of the run as releases before 0.4 made it; None where their rules for it are today's.

        `team`: the case's.
        """
        if _rules(team, model) == BEFORE:
            return None
        return run_key(self._checked(case, as_before), model, BEFORE)

    def _checked(self, case: Case, of: Callable[[World], World]) -> Team:
        try:
            team = self._team(case, of)
            team.world.check_alike("a sweep")
            team.settings.check_alike("a sweep")
            team.settings.check_team(len(team.starts))
            return team
        except InputError as error:
            raise naming(error, case.name) from error

    def _team(self, case: Case, of: Callable[[World], World]) -> Team:
        world: World = of(self._world(case.world))
        if case.plan is not None:
            return self._planned(case)
        if case.starts is not None:
            if case.robots not in (None, len(case.starts)):
                raise UsageError(f"{case.robots} robots and {len(case.starts)} starts", fix="leave robots out")
            starts = check_starts(np.array(case.starts), world.threat, case.name)
        elif world.starts is not None:
            if case.robots is None or case.robots > len(world.starts):
                check_same_team(case.robots, world.starts, world.source)
            starts = world.starts[: case.robots]  # as `size` has it
        else:
            count = case.robots if case.robots is not None else (world.team.robots or 1)
            starts, _ = place_starts(world, count, world.team.start)
        settings = case.choices.settings(world.team.settings, world.pace, case.name, by=world.source)
        return Team(world, starts, settings)

    def _planned(self, case: Case) -> Team:
        world, plan = self._plan(case.plan, case.world)
        if case.robots not in (None, len(plan.robots)) or case.starts is not None or case.choices.given():
            expected = f"its own {len(plan.robots)} robots, starts and settings"
            raise UsageError(f"{case.plan} with other robots, starts or settings", expected=expected)
        return Team(world, plan.starts, plan.settings or Settings(), plan)


def _rules(team: Team, model: RolloutChoices) -> int:
    return rules_of(team.world, team.settings, closed=model.loop == "closed")


def run_key(team: Team, model: RolloutChoices, rules: int | None = None) -> str:
    """The identity of a run: sha256, as 64 hex digits, of all that its rollouts follow from. Cheap: nothing planned.

    `rules`: the version that it follows; None: today's for such a team (`planner.rules.rules_of`), so that runs which
    no change of the rules concerns keep their keys.
    """
    drawn = {"loop": model.loop, "first_only": model.first_only, "seed": model.seed, "mode": model.drawn}
    said = {"semantics": rules or _rules(team, model), "team": team.identity, "model": drawn}
    return hashlib.sha256(canonical(said).encode()).hexdigest()


def _plan_hash(plan: Plan) -> str:
    """Of a plan file: its paths, and for one of ours the allocation and the settings that the closed loop goes by, and
    the state that it goes on from."""
    width = plan.shape[1]
    paths = [[list(divmod(cell, width)) for cell in robot.path.tolist()] for robot in plan.robots]
    areas = [[area.level, area.robot, area.cells.tolist()] for area in plan.areas]
    settings = None if plan.settings is None else plan.settings.to_json()
    bears = [] if plan.bears.is_plain else [plan.bears.to_json()]
    begun = [] if plan.state is None else [plan.state.to_json()]
    return hashlib.sha256(canonical([paths, areas, settings, *bears, *begun]).encode()).hexdigest()


def canonical(value: object) -> str:
    """JSON with sorted keys and no blanks: equal values give equal text."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def shown(value: Label) -> str:
    """A label's value as text."""
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def naming(error: InputError, case: str) -> InputError:
    """The same error, of the same kind, naming the case first."""
    if case in error.source:
        return error
    source = f"{case}: {error.source}" if error.source else case
    return type(error)(error.problem, source=source, expected=error.expected, fix=error.fix)
