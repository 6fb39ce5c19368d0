"""The best of many: teams, trade-offs, starts, threats to remove or to fear."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Unpack

import numpy as np
from numpy.typing import ArrayLike

from analysis.api.options import FrontOptions, Loop, SearchOptions, SizeOptions, takes
from analysis.api.plans import check_world, settings_of
from analysis.kit.calls import Found, ask
from analysis.sampling import RolloutChoices, how_much, luck_of
from planner.settings import SETTINGS, Settings
from planner.worlds.starts import starts_of
from planner.worlds.world import World, check_starts

if TYPE_CHECKING:
    from analysis.adversary.answer import Attack
    from analysis.depots.answer import Starts
    from analysis.design.size import TeamSize
    from analysis.removal.answer import Clearing
    from analysis.tradeoff.front import Front


Answered = TypeVar("Answered", bound=Found)


def _settings(world: World, options: Mapping[str, Any]) -> Settings:
    """The settings among the options. Raises InputError."""
    check_world(world)
    return settings_of(world, **{name: options[name] for name in SETTINGS if name in options and name != "deadline"})


def _rollouts(options: Mapping[str, Any], **how: Any) -> RolloutChoices:
    """The rollouts among the options; `how`: more of them. Raises UsageError."""
    given = {name: options[name] for name in ("seed", "engine", "deadline", "exact")}
    luck = luck_of(options["luck"], how.get("mode"))
    return RolloutChoices(first_only=options["first_visit"], **{**given, "luck": luck, **how})


def _ask(search: Callable[..., Answered], options: Mapping[str, Any]) -> Answered:
    """The answer of a search that says how far it is."""
    work = lambda tell, doing: search(progress=tell, doing=doing)  # noqa: E731
    return ask(work, options["progress"], options["on_interrupt"])


@takes(SizeOptions)
def size(
    world: World,
    *,
    target: float | None = None,
    confidence: float | None = None,
    complete: bool = False,
    meaning: Literal["visited", "survived"] = "visited",
    most: int = 64,
    starts: ArrayLike | None = None,
    loop: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    mode: Literal["fast", "step"] | None = None,
    **options: Unpack[SizeOptions],
) -> TeamSize:
    """The smallest team that covers `target` on average, or with the chance `confidence`; `complete`: every cell.

    Args:
        meaning: of "covered". most: robots to look at.
        starts: `[[row, col], ...]`, of which a team takes the first; default: the world's own, else its start rule.
        loop, mode: as of `evaluate`. rollouts: of each team, at most (default: 100,000); or `precision`.
        options: settings, as of `plan`; seed, deadline, first_visit, engine, luck, exact (of each team), progress,
            on_interrupt, as of `evaluate`.
    """
    from analysis.design.size import find_size, make_goal

    settings = _settings(world, options)
    goal = make_goal(target, confidence, complete, meaning, most)
    amount = how_much(rollouts, precision, None, usual=100_000) | {"seconds": None}
    loop = loop or ("open" if settings.plan_for == "open" else "closed")
    choices = _rollouts(options, loop=loop, mode=mode, **amount)
    if starts is not None:
        world = world.with_starts(check_starts(starts, world.met, "starts"))

    search = partial(find_size, world, settings, goal, choices)
    return _ask(search, options)


@takes(FrontOptions)
def front(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    losses: float | None = None,
    target: float | None = None,
    reserves: Sequence[float] | None = None,
    worths: Sequence[float] | None = None,
    rollouts: int | None = None,
    **options: Unpack[FrontOptions],
) -> Front:
    """What more coverage costs in robots: policies, missions ended early, reserves and worths on common random numbers.

    Args:
        robots, starts: the team, as of `plan`.
        losses: pick the setting that covers most with at most so many robots lost on average; or `target`: the one
            that loses the fewest with so much covered. `answer.picked` is it, `answer.plan_of(answer.picked)` its plan.
        reserves, worths: to look at (default: as the map suggests).
        rollouts: of each setting, the same for all; None: 4,096, fewer above 2,048 accessible cells.
        options: settings, as of `plan`; deadline, at which every mission ends; seed, first_visit, engine, luck, exact
            (of all that is compared together), progress, on_interrupt, as of `evaluate`.
    """
    from analysis.tradeoff.rules import make_goal, usual_rollouts
    from analysis.tradeoff.search import Ladders, find_front

    settings, goal = _settings(world, options), make_goal(losses, target)
    ladders = Ladders(None if reserves is None else tuple(reserves), None if worths is None else tuple(worths))
    placed = np.asarray(starts_of(world, robots, starts))
    choices = _rollouts(options, rollouts=usual_rollouts(world, placed) if rollouts is None else rollouts)

    search = partial(find_front, world, placed, settings, choices, goal=goal, ladders=ladders)
    return _ask(search, options)


@takes(SearchOptions)
def starts(
    world: World,
    robots: int | None = None,
    *,
    depot: bool = False,
    candidates: ArrayLike = "border",
    rollouts: int = 4096,
    **options: Unpack[SearchOptions],
) -> Starts:
    """The best starts of a team, one each or (`depot`) one for all: `answer.starts`, `answer.world_with_starts`.

    Args:
        robots: how many; default: as many as the world's own team.
        candidates: "border", the safe cells on the border of the map; a mask `[H, W]`; or cells `[[row, col], ...]`.
        rollouts: of the last two places that are left, the same for all.
        options: as of `front` (progress, on_interrupt too), and policy, reserve, worth, as of `plan`.
    """
    from analysis.depots.search import find_starts, team_size

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    size = team_size(world, robots)

    search = partial(find_starts, world, size, settings, choices, depot=depot, candidates=candidates)
    return _ask(search, options)


@takes(SearchOptions)
def clear(
    world: World,
    robots: int | None = None,
    *,
    count: int = 1,
    remove: Literal["areas", "sources"] | None = None,
    starts: ArrayLike | None = None,
    rollouts: int = 4096,
    **options: Unpack[SearchOptions],
) -> Clearing:
    """Which threat to remove first, and `count` of them greedily: `answer.picks`, `answer.gain`.

    Args:
        remove: the connected "areas" of danger, or the "sources", the polygons, points and sites of a scenario's
            threats; None: these where there are several.
        robots, starts: the team, as of `plan`.
        rollouts: of the last two threats that are left, the same for all.
        options: as of `front` (progress, on_interrupt too), and policy, reserve, worth, as of `plan`.
    """
    from analysis.removal.search import find_clearing

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_clearing, world, placed, settings, choices, count=count, remove=remove)
    return _ask(search, options)


@takes(SearchOptions)
def attack(
    world: World,
    robots: int | None = None,
    *,
    count: int = 1,
    p: float = 0.2,
    starts: ArrayLike | None = None,
    rollouts: int = 4096,
    **options: Unpack[SearchOptions],
) -> Attack:
    """Where `count` threats would cost the team most: `answer.known`, `answer.hidden`, and the worlds with them.

    Args:
        p: the chance that a visit of one stops a robot, beside what else is there.
        robots, starts: the team, as of `plan`.
        rollouts: of the last two places that are left, the same for all.
        options: as of `front` (progress, on_interrupt too), and policy, reserve, worth, as of `plan`.
    """
    from analysis.adversary.search import find_attack

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_attack, world, placed, settings, choices, count=count, p=p)
    return _ask(search, options)
