"""What a plan comes to, what two differ by, and which formulas hold."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike

from analysis.api.plans import (
    FrontOptions,
    Loop,
    SearchOptions,
    SizeOptions,
    check_world,
    judge,
    plan,
    plan_of,
    settings_of,
    takes,
)
from analysis.evaluation.evaluate import Evaluation
from analysis.sampling import Exactness, RolloutChoices, how_much
from analysis.utils.notes import Doing, ProgressCallback, UnknownArgument
from analysis.utils.progress import Found, OnInterrupt, ask
from planner.arguments import argument, check_word
from planner.errors import UsageError
from planner.plan.plan import Plan
from planner.plan.state import MissionState
from planner.rollouts.names import EngineName
from planner.settings import SETTINGS, Settings
from planner.world.levels import starts_of
from planner.world.world import World, check_starts

if TYPE_CHECKING:
    from analysis.checking.check import MapCheck
    from analysis.comparison import Comparison
    from analysis.policy_evaluation.policy_evaluation import Judged
    from analysis.search.pareto import Front
    from analysis.search.start_positions import Starts
    from analysis.search.team_size import TeamSize
    from analysis.search.threats import Attack, Clearing


@overload
def evaluate(world: World, plan: int | None = None, *, policy: Callable[..., Any], **how: Any) -> Judged: ...
@overload
def evaluate(world: World, plan: Plan | str | Path | int | None = None, **how: Any) -> Evaluation: ...
def evaluate(
    world: World,
    plan: Plan | str | Path | int | None = None,
    *,
    policy: Callable[..., Any] | None = None,
    state: MissionState | str | Path | None = None,
    loop: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    seconds: float | None = None,
    exact: Exactness = "auto",
    engine: EngineName = "auto",
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    threat_scale: Sequence[float] = (),
    sense: Sequence[float] = (),
    bound: bool | None = None,
    band: bool = True,
    advice: bool = True,
    metrics: Literal["coverage", "search", "clearance"] | None = None,
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
    **asked: Any,
) -> Evaluation | Judged:
    """How much of the world does the team cover, and how sure is that?

    Args:
        plan: a Plan, a plan file, how many robots to plan for, or None: the world's own team.
        policy: instead of a plan, a function of what the robots observe: the answer is that of `judge`, whose arguments
            are all that may stand beside it; `plan` is how many robots.
        state: instead of that, of a mission under way, or its file: the rest of it is planned and rolled out.
        loop: "closed": survivors take over; "open": every robot follows its path until it is stopped. None: open for
            paths alone, else closed.
        rollouts: how many; or `precision`: until the 95 % interval of mean coverage is within so much of it. Neither:
            within 0.001 of it, a tenth of a point, and after 10 seconds of rolling out whatever it is.
        seconds: of rolling out, after which it stops too.
        exact: whether the closed loop's exact values, which small teams have, are looked for: "auto" for about 2 s,
            "never", or for about so many seconds. The same work on every machine, so that no answer depends on it.
        engine: "auto" takes JAX where it has an accelerator, else Numba. seed: of the rollouts.
        deadline: a step at which coverage is reported too; robots that come home know it, and are home by then.
        first_visit: only the first visit of a cell by anybody can stop a robot.
        threat_scale: also if all threats are so many times the map's.
        sense: also if robots that are not told the map see so many cells far, on the same random numbers; 0: blind.
        bound: whether the bound for every strategy is worked out; None: on up to 500 accessible cells.
        band: also sample how coverage grows over time, for `plots`.
        advice: also a quick front: what other settings cover and lose.
        metrics: in whose words value covered, found and left are told; default: as the world says, if it says
            anything of values.
        asked: any further output of `analysis.evaluation.outputs`, by its key.
        progress: what is shown meanwhile. None: a bar on a terminal, a line in a notebook; True: lines on a pipe too;
            False: nothing; or a function that is called with (done, total, seconds) after every chunk.
        on_interrupt: "raise": Ctrl-C is raised as a KeyboardInterrupt that has what was done as `partial`; "return":
            what was done is the answer, `answer.partial` true.
    """
    if policy is not None:
        return _judged(**locals())
    from analysis.evaluation.evaluate import check_asked
    from analysis.evaluation.evaluate import evaluate as evaluate_plan

    if state is not None and plan is not None:
        raise UsageError("both a plan and a state", expected="one of them")
    check_world(world)
    _check_outputs(asked)
    asked |= {"threat_scale": tuple(threat_scale)} | ({} if metrics is None else {"value": metrics})
    asked |= {"knowledge": tuple(sense)} if len(sense) else {}
    check_asked(world, **asked)
    asked |= {"band": band, "advice": advice}
    amount = how_much(rollouts, precision, seconds)

    def work(tell: ProgressCallback, doing: Doing) -> Evaluation:
        doing("planning")
        of, made = plan_of(world, plan) if state is None else (world, _rest(world, state))
        choices = RolloutChoices(
            loop=loop or made.usual_loop, **amount, exact=exact, engine=engine, seed=seed, deadline=deadline,
            first_only=first_visit,
        )  # fmt: skip
        return evaluate_plan(of, made, choices, bound=bound, progress=tell, doing=doing, **asked)

    return ask(work, progress, on_interrupt)


def _check_outputs(asked: Mapping[str, Any]) -> None:
    """Raise UsageError for a keyword of `evaluate` that is neither an argument nor an output."""
    from analysis.evaluation.evaluate import OUTPUTS

    known = [name for name, one in signature(evaluate).parameters.items() if one.kind is one.KEYWORD_ONLY]
    for name in asked.keys() - OUTPUTS.keys():
        raise UnknownArgument.of(evaluate, name, asked[name], known)


def _judged(world: World, plan: Any, policy: Callable[..., Any], asked: dict[str, Any], **rest: Any) -> Judged:
    """`evaluate` of a policy: what it was given, as `judge` takes it. Raises UsageError for what is for plans alone."""
    parameters = signature(evaluate).parameters
    given = asked | {name: value for name, value in rest.items() if value is not parameters[name].default}
    known = [name for name in signature(judge).parameters if name not in ("world", "policy", "robots")]
    for name in given.keys() - known:
        problem = f"evaluate has no argument {name!r} for a policy"
        raise UsageError(problem, expected=f"one of {', '.join(known)}", fix="give it to `evaluate` of a plan")
    if isinstance(plan, Plan | str | Path):
        raise UsageError("both a plan and a policy", expected="one of them; beside a policy how many robots")
    return judge(world, policy, plan, **given)


def _rest(world: World, state: MissionState | str | Path) -> Plan:
    return plan(world, state=state)


def compare(
    a: tuple[World, Plan | str | Path | int | None],
    b: tuple[World, Plan | str | Path | int | None],
    *,
    loop: Loop | None = None,
    loop_b: Loop | None = None,
    rollouts: int | None = None,
    precision: float | None = None,
    seconds: float | None = None,
    exact: Exactness = "auto",
    engine: EngineName = "auto",
    seed: int = 0,
    deadline: int | str | None = None,
    first_visit: bool = False,
    first_visit_b: bool | None = None,
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Comparison:
    """How far apart are two plans, teams or maps? Both meet the same random numbers, so the difference is sharp.

    Args:
        a, b: a world and a plan for it: a Plan, a plan file, how many robots to plan for, or None, as of `evaluate`.
        loop: of both; `loop_b`: of b alone. None: open for paths alone, else closed.
        rollouts: how many; or `precision`: until the 95 % interval of the difference of mean coverage is within so much
            of it. Neither: 100,000, as far as 10 seconds go.
        first_visit: as of `evaluate`, of both; `first_visit_b`: of b alone.
        seconds, exact, engine, seed, deadline, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.comparison import Side, make_side
    from analysis.comparison import compare as compare_sides

    amount = how_much(rollouts, precision, seconds, usual=100_000) | {"exact": exact}
    for name, side in (("a", a), ("b", b)):
        if not (isinstance(side, tuple) and len(side) == 2 and isinstance(side[0], World)):
            raise UsageError(argument(name, side), expected="(world, plan), a World and a plan for it")

    def make(side: tuple[World, Plan | str | Path | int | None], loop: Loop | None, first_only: bool) -> Side:
        world, plan = plan_of(*side)
        choices = RolloutChoices(
            loop=loop or plan.usual_loop, **amount, engine=engine, seed=seed, deadline=deadline,
            first_only=first_only,
        )  # fmt: skip
        return make_side(world, plan, choices)

    def work(tell: ProgressCallback, doing: Doing) -> Comparison:
        doing("planning")
        other = first_visit if first_visit_b is None else first_visit_b
        return compare_sides(make(a, loop, first_visit), make(b, loop_b or loop, other), progress=tell)

    return ask(work, progress, on_interrupt)


def check(
    world: World,
    plan: Plan | str | Path | int | None = None,
    *,
    rollouts: int = 20_000,
    seed: int = 0,
    engine: EngineName = "auto",
    first_visit: bool = False,
    bound: bool | None = None,
    theory: Literal["main", "all"] = "main",
    progress: ProgressCallback | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> MapCheck:
    """Which of the paper's formulas, and of ours, hold for this plan?

    Args:
        plan, rollouts, seed, engine, first_visit, bound, progress, on_interrupt: as of `evaluate`.
        theory: what its table lists: "main", a row for each formula; "all", every reading and meaning of each.
    """
    check_word("theory", theory, ("main", "all"))
    from analysis.checking.check import check_input

    choices = RolloutChoices(rollouts=rollouts, seed=seed, engine=engine, first_only=first_visit)

    def work(tell: ProgressCallback, doing: Doing) -> MapCheck:
        return check_input(*plan_of(world, plan), choices, tell, bound, theory)

    return ask(work, progress, on_interrupt)


# The best of many: teams, trade-offs, starts, threats to remove or to fear.

Answered = TypeVar("Answered", bound=Found)


def _settings(world: World, options: Mapping[str, Any]) -> Settings:
    """The settings among the options. Raises InputError."""
    check_world(world)
    return settings_of(world, **{name: options[name] for name in SETTINGS if name in options and name != "deadline"})


def _rollouts(options: Mapping[str, Any], **how: Any) -> RolloutChoices:
    """The rollouts among the options; `how`: more of them. Raises UsageError."""
    given = {name: options[name] for name in ("seed", "engine", "deadline", "exact")}
    return RolloutChoices(first_only=options["first_visit"], **{**given, **how})


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
    **options: Unpack[SizeOptions],
) -> TeamSize:
    """The smallest team that covers `target` on average, or with the chance `confidence`; `complete`: every cell.

    Args:
        meaning: of "covered". most: robots to look at.
        starts: `[[row, col], ...]`, of which a team takes the first; default: the world's own, else its start rule.
        loop: as of `evaluate`. rollouts: of each team, at most (default: 100,000); or `precision`.
        options: settings, as of `plan`; seed, deadline, first_visit, engine, exact (of each team), progress,
            on_interrupt, as of `evaluate`.
    """
    from analysis.search.team_size import find_size, make_goal

    settings = _settings(world, options)
    goal = make_goal(target, confidence, complete, meaning, most)
    amount = how_much(rollouts, precision, None, usual=100_000) | {"seconds": None}
    loop = loop or ("open" if settings.plan_for == "open" else "closed")
    choices = _rollouts(options, loop=loop, **amount)
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
        options: settings, as of `plan`; deadline, at which every mission ends; seed, first_visit, engine, exact
            (of all that is compared together), progress, on_interrupt, as of `evaluate`.
    """
    from analysis.search.pareto import Ladders, find_front, make_goal, usual_rollouts

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
    from analysis.search.start_positions import find_starts, team_size

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
    from analysis.search.threats import find_clearing

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
    from analysis.search.threats import find_attack

    settings, choices = _settings(world, options), _rollouts(options, rollouts=rollouts)
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_attack, world, placed, settings, choices, count=count, p=p)
    return _ask(search, options)
