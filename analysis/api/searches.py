"""The best of many: teams, trade-offs, starts, threats to remove or to fear."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from analysis.api.plans import Loop, ReturnTo, check_world, settings_of
from analysis.kit.calls import Found, OnInterrupt, ask
from analysis.kit.notes import Progress
from analysis.sampling import Exactness, RolloutChoices
from planner.luck_names import LuckName
from planner.rollouts.names import EngineName
from planner.settings import SETTINGS, Choices, Policy, Settings
from planner.worlds.starts import starts_of
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.adversary.answer import Attack
    from analysis.depots.answer import Starts
    from analysis.design.size import TeamSize
    from analysis.removal.answer import Clearing
    from analysis.tradeoff.front import Front


Answered = TypeVar("Answered", bound=Found)


ROLLED = ("rollouts", "seed", "engine", "deadline", "luck", "exact")
"""Arguments that say what is rolled out, as `RolloutChoices` names them."""


def _chosen(world: World, first_visit: bool, **given: Any) -> tuple[Settings, RolloutChoices]:
    """The settings and the rollouts among the arguments of a search. Raises InputError."""
    check_world(world)
    settings = settings_of(world, **{name: given.get(name) for name in SETTINGS if name != "deadline"})
    return settings, RolloutChoices(first_only=first_visit, **{name: given[name] for name in ROLLED})


def _ask(search: Callable[..., Answered], progress: Progress | bool | None, on_interrupt: OnInterrupt) -> Answered:
    """The answer of a search that says how far it is."""
    return ask(lambda tell, doing: search(progress=tell, doing=doing), progress, on_interrupt)


def size(
    world: World,
    *,
    target: float | None = None,
    confidence: float | None = None,
    complete: bool = False,
    meaning: Literal["visited", "survived"] = "visited",
    most: int = 64,
    loop: Loop = "closed",
    rollouts: int = 100_000,
    seed: int = 0,
    deadline: int | str | None = None,
    exact: Exactness = "auto",
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> TeamSize:
    """The smallest team that covers `target` on average, or with the chance `confidence`; `complete`: every cell.

    Args:
        meaning: of "covered". most: robots to look at.
        loop, rollouts, seed, deadline, exact, progress, on_interrupt: as of `evaluate`; `exact`: of each team.
    """
    from analysis.design.size import find_size, make_goal

    check_world(world)
    choices = RolloutChoices(loop=loop, rollouts=rollouts, seed=seed, deadline=deadline, exact=exact)
    settings = Choices().settings(world.team.settings, world.pace, by=world.source)
    goal = make_goal(target, confidence, complete, meaning, most)

    search = partial(find_size, world, settings, goal, choices)
    return _ask(search, progress, on_interrupt)


def front(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    levels: int | None = None,
    density: float | None = None,
    risk: Literal["paper", "log"] | None = None,
    transit: Literal["grid", "area"] | None = None,
    max_steps: int | None = None,
    range: int | Sequence[int] | None = None,
    wear: float | None = None,
    susceptibility: float | Sequence[float] | None = None,
    return_to: ReturnTo = None,
    recharge: int | None = None,
    losses: float | None = None,
    target: float | None = None,
    reserves: Sequence[float] | None = None,
    worths: Sequence[float] | None = None,
    rollouts: int | None = None,
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    engine: EngineName = "auto",
    luck: LuckName = "tolerance",
    exact: Exactness = "auto",
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Front:
    """What more coverage costs in robots: policies, missions ended early, reserves and worths on the same luck.

    Args:
        robots, starts, levels, density, risk, transit, max_steps, range, wear, susceptibility, return_to, recharge: as
            of `plan`.
        losses: pick the setting that covers most with at most so many robots lost on average; or `target`: the one
            that loses the fewest with so much covered. `answer.picked` is it, `answer.plan_of(answer.picked)` its plan.
        reserves, worths: to look at (default: as the map suggests).
        rollouts: of each setting, the same for all; None: 4,096, fewer above 2,048 accessible cells.
        deadline: end every mission at this step.
        luck, exact, progress, on_interrupt: as of `evaluate`; `exact`: of all that is compared together.
    """
    from analysis.tradeoff.rules import make_goal, usual_rollouts
    from analysis.tradeoff.search import Ladders, find_front

    check_world(world)
    given, goal = locals(), make_goal(losses, target)
    ladders = Ladders(None if reserves is None else tuple(reserves), None if worths is None else tuple(worths))
    placed = np.asarray(starts_of(world, robots, starts))
    count = usual_rollouts(world, placed) if rollouts is None else rollouts
    settings, choices = _chosen(**given | {"rollouts": count})

    search = partial(find_front, world, placed, settings, choices, goal=goal, ladders=ladders)
    return _ask(search, progress, on_interrupt)


def starts(
    world: World,
    robots: int | None = None,
    *,
    depot: bool = False,
    candidates: ArrayLike = "border",
    levels: int | None = None,
    density: float | None = None,
    risk: Literal["paper", "log"] | None = None,
    transit: Literal["grid", "area"] | None = None,
    max_steps: int | None = None,
    policy: Policy | None = None,
    reserve: float | None = None,
    worth: float | None = None,
    range: int | Sequence[int] | None = None,
    wear: float | None = None,
    susceptibility: float | Sequence[float] | None = None,
    return_to: ReturnTo = None,
    recharge: int | None = None,
    rollouts: int = 4096,
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    engine: EngineName = "auto",
    luck: LuckName = "tolerance",
    exact: Exactness = "auto",
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Starts:
    """The best starts of a team, one each or (`depot`) one for all: `answer.starts`, `answer.world_with_starts`.

    Args:
        robots: how many; default: as many as the world's own team. The settings are those of `plan`.
        candidates: "border", the safe cells on the border of the map; a mask `[H, W]`; or cells `[[row, col], ...]`.
        rollouts: of the last two places that are left, the same for all. deadline: end every mission at this step.
        luck, exact, progress, on_interrupt: as of `evaluate`; `exact`: of all that is compared together.
    """
    from analysis.depots.search import find_starts, team_size

    settings, choices = _chosen(**locals())
    size = team_size(world, robots)

    search = partial(find_starts, world, size, settings, choices, depot=depot, candidates=candidates)
    return _ask(search, progress, on_interrupt)


def clear(
    world: World,
    robots: int | None = None,
    *,
    count: int = 1,
    remove: Literal["areas", "sources"] | None = None,
    starts: ArrayLike | None = None,
    levels: int | None = None,
    density: float | None = None,
    risk: Literal["paper", "log"] | None = None,
    transit: Literal["grid", "area"] | None = None,
    max_steps: int | None = None,
    policy: Policy | None = None,
    reserve: float | None = None,
    worth: float | None = None,
    range: int | Sequence[int] | None = None,
    wear: float | None = None,
    susceptibility: float | Sequence[float] | None = None,
    return_to: ReturnTo = None,
    recharge: int | None = None,
    rollouts: int = 4096,
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    engine: EngineName = "auto",
    luck: LuckName = "tolerance",
    exact: Exactness = "auto",
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Clearing:
    """Which threat to remove first, and `count` of them greedily: `answer.picks`, `answer.gain`.

    Args:
        remove: the connected "areas" of danger, or the "sources", the polygons, points and sites of a scenario's
            threats; None: these where there are several.
        robots, starts: the team; the settings are those of `plan`.
        rollouts: of the last two threats that are left, the same for all. deadline: end every mission at this step.
        luck, exact, progress, on_interrupt: as of `evaluate`; `exact`: of all that is compared together.
    """
    from analysis.removal.search import find_clearing

    settings, choices = _chosen(**locals())
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_clearing, world, placed, settings, choices, count=count, remove=remove)
    return _ask(search, progress, on_interrupt)


def attack(
    world: World,
    robots: int | None = None,
    *,
    count: int = 1,
    p: float = 0.2,
    starts: ArrayLike | None = None,
    levels: int | None = None,
    density: float | None = None,
    risk: Literal["paper", "log"] | None = None,
    transit: Literal["grid", "area"] | None = None,
    max_steps: int | None = None,
    policy: Policy | None = None,
    reserve: float | None = None,
    worth: float | None = None,
    range: int | Sequence[int] | None = None,
    wear: float | None = None,
    susceptibility: float | Sequence[float] | None = None,
    return_to: ReturnTo = None,
    recharge: int | None = None,
    rollouts: int = 4096,
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    engine: EngineName = "auto",
    luck: LuckName = "tolerance",
    exact: Exactness = "auto",
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Attack:
    """Where `count` threats would cost the team most: `answer.known`, `answer.hidden`, and the worlds with them.

    Args:
        p: the chance that a visit of one stops a robot, beside what else is there.
        robots, starts: the team; the settings are those of `plan`.
        rollouts: of the last two places that are left, the same for all. deadline: end every mission at this step.
        luck, exact, progress, on_interrupt: as of `evaluate`; `exact`: of all that is compared together.
    """
    from analysis.adversary.search import find_attack

    settings, choices = _chosen(**locals())
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_attack, world, placed, settings, choices, count=count, p=p)
    return _ask(search, progress, on_interrupt)
