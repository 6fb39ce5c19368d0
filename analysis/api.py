"""The functions behind the door, `import mrac_jax as mrac`: plain arguments in, the house's answers out.

Each does one of the everyday jobs and is documented for somebody who knows nothing of the rooms behind it. Coverage is
a fraction of the accessible cells; cells are `[row, col]`, row 0 at the top; every error is an `InputError`.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from analysis.evaluation.answer import Evaluation
from analysis.inputs import load_world, plan_from_state
from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Doing, Progress
from analysis.sampling import Exactness, RolloutChoices, how_much, luck_of
from planner.arguments import argument, as_whole
from planner.errors import UsageError
from planner.luck_names import LuckName
from planner.missions.mission import PATIENCE
from planner.plan_team import plan_team, read_plan
from planner.plans.plan import Plan
from planner.plans.state import MissionState
from planner.plans.state_traces import read_state
from planner.policies.in_area import InAreaOrder, cheapest_first
from planner.rollouts.names import EngineName
from planner.settings import Choices, Policy, Settings
from planner.worlds.reported import with_route
from planner.worlds.starts import starts_of
from planner.worlds.world import World

if TYPE_CHECKING:
    from analysis.checking.check_map import MapCheck
    from analysis.comparison.compare import Comparison
    from analysis.depots.answer import Starts
    from analysis.design.size import TeamSize
    from analysis.driving.outlook import DrivenMission
    from analysis.judging.judge import Judged
    from analysis.recording.pick import Pick
    from analysis.recording.record import Recorded
    from analysis.recording.rollouts import RecordedOutcomes, RecordedRollout
    from analysis.removal.answer import Clearing
    from analysis.reproduction.reproduce import Reproduction
    from analysis.standings.suite import Suite
    from analysis.sweeps.results import Results
    from analysis.sweeps.sweep import Sweep
    from analysis.tradeoff.front import Front

__all__ = [
    "check", "clear", "compare", "evaluate", "export", "front", "judge", "load", "mission", "plan", "read_outcomes",
    "read_rollouts", "record", "reproduce", "results", "size", "starts", "suite", "sweep",
]  # fmt: skip

Loop = Literal["closed", "open"]


def load(
    source: str | Path | ArrayLike,
    *,
    cell_size: float | None = None,
    step_seconds: float | None = None,
    speed: float | None = None,
    value: ArrayLike | None = None,
    detect: ArrayLike | None = None,
    route: ArrayLike | None = None,
) -> World:
    """The world in a file, in a shipped example, or in an array.

    Args:
        source: any INPUT of the command line ("depot.yaml", a scenario, "example:paper", ...), or an array `[H, W]` of
            the chance that one visit stops a robot, NaN (or masked) = obstacle.
        cell_size: side of a cell in metres; coarsens a map, and is what an array's cells measure (default 1).
        step_seconds: that a step takes, or `speed`, metres a second: every time is said in minutes too, and deadlines
            may be given so, as "45min" (in the place of what the source says).
        value, detect: what each cell is worth, and the chance that a visit which the robot survives finds what is in
            it: `[H, W]` or one number, in the place of what the source says (if that is nothing: 1 each).
        route: `[row, col]` of the corners of the route that is to be safe.

    A scenario's robots come along: `plan(world)` uses them. What loading did is in `world.notes`.
    """
    if isinstance(source, str | Path):
        world = load_world(str(source), cell_size)
    else:
        world = World.create(source, cell_size=1.0 if cell_size is None else cell_size, source="array")
        world = replace(world, measured=cell_size is not None)
    world = world.with_pace(step_seconds, speed)
    if value is not None or detect is not None:
        world = world.with_values(world.value if value is None else value, world.detect if detect is None else detect)
    return world if route is None else with_route(world, route)


def plan(
    world: World,
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    levels: int | None = None,
    density: float | None = None,
    risk: Literal["paper", "log"] | None = None,
    transit: Literal["grid", "area"] | None = None,
    max_steps: int | None = None,
    policy: Policy | None = None,
    reserve: float | None = None,
    worth: float | None = None,
    plan_for: Loop | None = None,
    effort: int | None = None,
    seconds: float | None = None,
    range: int | Sequence[int] | None = None,
    deadline: int | str | None = None,
    wear: float | None = None,
    susceptibility: float | Sequence[float] | None = None,
    state: MissionState | str | Path | None = None,
    in_area: InAreaOrder = cheapest_first,
) -> Plan:
    """The plan of a team (Algorithms 1 to 3): its areas, and every robot's path if nobody is lost.

    Args:
        robots: how many, placed by the world's start rule; default: the world's own team, else 1.
        starts: instead of that, `[[row, col], ...]`, one a robot.
        levels: most threat levels, p = 0 counted. density: least cells a robot of a safe area is to have.
        risk: cost of a dangerous cell, "paper" (eq. 3) or "log" (by survival). transit: "grid" or "area".
        max_steps: at which the run is cut off.
        policy: which area is next: "mrac" (the paper's) or "per_cell" (least cost per new cell); or a rule of your own,
            a `planner.policies.rule.Rule`, or a function of an `Offer` to order areas by, least first.
        reserve: with "per_cell", at most this share of the robots alive are at risk at once.
        worth: with "per_cell", a robot is worth so many new cells: areas that cost more are refused.
        plan_for: "open": paths for robots that do not take over from each other, found by a search; they have no areas.
        effort: of that search, in paths evaluated: the same effort gives the same plan; seconds: end it after so many.
        range: moves that a robot can make, then it stays where it is; one number for all, or one a robot.
        deadline: the step at which the mission is ended: the plan, and all that is made of it, keep to it. Here as
            everywhere it may be a time, "45min", where the world knows how long a step takes (`load`).
        wear: shape of the Weibull amount of exposure that robots bear; above 1 they wear out, and p is a dose.
        susceptibility: how many times exposure counts, one number for all, or one a robot. No decision knows the two;
            rollouts need `luck="tolerance"`.
        state: of a mission under way, or a file of it (a state, tracks, visited cells, a mask, an OccupancyGrid): the
            plan of the rest; the robots are its own, or at `starts` where the file does not say where they are.
        in_area: which cell of an area is next; an order of your own is a function of a `CellOffer`, least first.

    A rule or an order of your own cannot be saved, nor (yet) rolled out by the compiled engines.
    """
    _check_world(world)
    asked = (levels, density, risk, transit, max_steps, policy, reserve, worth, plan_for, effort)
    bears = {"wear": wear, "susceptibility": _one_or_each(susceptibility)}
    settings = _settings_of(world, range, *asked, deadline=deadline, in_area=in_area, **bears)
    if state is not None:
        if robots is not None or (starts is not None and isinstance(state, MissionState)):
            raise UsageError(
                "a state and robots or starts", expected="one of them: the state says where its robots are"
            )
        found, notes = (state, ()) if isinstance(state, MissionState) else read_state(Path(state), world, starts)
        made = plan_from_state(world, found, settings)
        return replace(made, notes=(*made.notes, *notes))
    return plan_team(world, starts_of(world, robots, starts), settings, seconds)


def _settings_of(
    world: World,
    range: Any,
    *asked: object,
    deadline: int | str | None = None,
    in_area: InAreaOrder = cheapest_first,
    **more: Any,
) -> Settings:
    """What is asked, in the order of `Settings`, in the place of what the world came with."""
    given = Choices(*asked, range=_one_or_each(range), deadline=deadline, **more)
    return given.settings(world.team.settings, world.pace, in_area=in_area)


def _one_or_each(given: Any) -> Any:
    """One number, or a tuple of one a robot."""
    return tuple(given) if isinstance(given, Iterable) and not isinstance(given, str) else given


def _check_world(world: object) -> None:
    """What is easily given instead: the name of an INPUT, an array."""
    if not isinstance(world, World):
        raise UsageError(argument("world", world), expected="a World, as mrac_jax.load makes one")


def _plan_of(world: World, given: Plan | str | Path | int | None) -> Plan:
    """A plan, the one in a file, or a new one (for so many robots)."""
    _check_world(world)
    if isinstance(given, Plan):
        given.require(world)
        return given
    return read_plan(given, world) if isinstance(given, str | Path) else plan(world, given)


def _check_outputs(asked: Mapping[str, Any]) -> None:
    """Raise UsageError for a keyword of `evaluate` that is neither an argument nor an output."""
    from analysis.evaluation.outputs.table import OUTPUTS

    known = [name for name, one in signature(evaluate).parameters.items() if one.kind is one.KEYWORD_ONLY]
    for name in asked.keys() - OUTPUTS.keys():
        fix = "give it to `plan`, and the plan to `evaluate`" if name in signature(plan).parameters else ""
        for close in difflib.get_close_matches(name, [*known, *OUTPUTS], n=1):
            fix = f"did you mean {close!r}?"
        raise UsageError(f"evaluate has no argument {name!r}", expected=f"one of {', '.join(known)}", fix=fix)


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
    mode: Literal["fast", "step"] | None = None,
    luck: LuckName | None = None,
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
    progress: Progress | bool | None = None,
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
        luck: "tolerance": a number for every robot says how much danger it bears before it is stopped; "step": one for
            every visit, as releases before 0.3 had it. The law is the same. None: tolerance.
        mode: of luck by step in the open loop: "fast" or "step". seed: of the rollouts.
        engine: "auto" takes JAX where it has an accelerator, else Numba.
        deadline: a step at which coverage is reported too.
        first_visit: only the first visit of a cell by anybody can stop a robot.
        threat_scale: also if all threats are so many times the map's.
        sense: also if robots that are not told the map see so many cells far, on the same luck; 0: blind.
        bound: whether the bound for every strategy is worked out; None: on up to 500 accessible cells.
        band: also sample how coverage grows over time, for `plots`.
        advice: also a quick front: what of the coverage costs no robot, and what the rest costs.
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
    _check_world(world)
    _check_outputs(asked)
    asked |= {"threat_scale": tuple(threat_scale)} | ({} if metrics is None else {"value": metrics})
    asked |= {"knowledge": tuple(sense)} if len(sense) else {}
    check_asked(world, **asked)
    asked |= {"band": band, "advice": advice}
    amount = how_much(rollouts, precision, seconds)

    def work(tell: Progress, doing: Doing) -> Evaluation:
        doing("planning")
        made = _plan_of(world, plan) if state is None else _rest(world, state)
        choices = RolloutChoices(
            loop=loop or made.usual_loop, **amount, exact=exact, mode=mode, luck=luck_of(luck, mode), engine=engine,
            seed=seed,
            deadline=deadline, first_only=first_visit,
        )  # fmt: skip
        return evaluate_plan(world, made, choices, bound=bound, progress=tell, doing=doing, **asked)

    return ask(work, progress, on_interrupt)


def mission(
    world: World,
    plan: Plan | str | Path | int | None = None,
    *,
    state: MissionState | str | Path | None = None,
    patience: int | None = PATIENCE,
    gain: float = 1.0,
) -> DrivenMission:
    """A mission to be driven: it gives orders and takes reports, step by step, and goes on after a crash.

    Args:
        plan: a Plan, a plan file, how many robots to plan for, or None: the world's own team.
        state: where it stands: what `Mission.save` wrote, or anything that `plan` takes as a state.
        patience: steps in which a robot that was to move did not, after which others get its work; None: any number.
        gain: a robot leaves what it is under way to for work that became free, or a nearer cell of its area after it
            was pushed, where that saves more than this share of the cost of its way; 1: it never does.
    """
    from analysis.driving.outlook import DrivenMission

    made = _plan_of(world, plan)
    if isinstance(state, str | Path) and Path(state).suffix == ".json":
        return DrivenMission.resume(state, world, made, patience=patience, gain=gain)
    if state is not None:
        found = state if isinstance(state, MissionState) else read_state(state, world)[0]
        made = plan_from_state(world, found, made.require(world))
    return DrivenMission(world, made, patience=patience, gain=gain)


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
    luck: LuckName = "tolerance",
    engine: EngineName = "auto",
    seed: int = 0,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Comparison:
    """How far apart are two plans, teams or maps? Both meet the same luck, so the difference is sharp.

    Args:
        a, b: a world and a plan for it: a Plan, a plan file, how many robots to plan for, or None, as of `evaluate`.
        loop: of both; `loop_b`: of b alone. None: open for paths alone, else closed.
        rollouts: how many; or `precision`: until the 95 % interval of the difference of mean coverage is within so much
            of it. Neither: 100,000, as far as 10 seconds go.
        seconds, exact, luck, engine, seed, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.comparison.compare import Side, make_side
    from analysis.comparison.compare import compare as compare_sides

    amount = how_much(rollouts, precision, seconds, usual=100_000) | {"exact": exact}
    for name, side in (("a", a), ("b", b)):
        if not (isinstance(side, tuple) and len(side) == 2 and isinstance(side[0], World)):
            raise UsageError(argument(name, side), expected="(world, plan), a World and a plan for it")

    def make(side: tuple[World, Plan | str | Path | int | None], loop: Loop | None) -> Side:
        plan = _plan_of(*side)
        choices = RolloutChoices(loop=loop or plan.usual_loop, **amount, luck=luck, engine=engine, seed=seed)
        return make_side(side[0], plan, choices)

    def work(tell: Progress, doing: Doing) -> Comparison:
        doing("planning")
        return compare_sides(make(a, loop), make(b, loop_b or loop), progress=tell)

    return ask(work, progress, on_interrupt)


def judge(
    world: World,
    policy: Callable[..., Any],
    robots: int | None = None,
    *,
    starts: ArrayLike | None = None,
    actions: Literal["moves", "areas"] = "moves",
    view: int | None = None,
    rule: Policy | None = None,
    offers: int | None = None,
    max_steps: int | None = None,
    rollouts: int = 1000,
    seed: int = 0,
    against: Sequence[str] = ("mrac", "per_cell"),
    processes: int | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Judged:
    """What is a policy of one's own worth: its coverage, and its score between a random walk and the proven bound.

    Args:
        policy: a function of what all robots observe, float32 `[K, 6, h, w]`, or of areas `[K, offers, 8]` (`env`),
            that returns an action for each; of two arguments, then of a random key (a NumPy generator) of the rollout
            too. Under `jax.jit` it runs inside the compiled rollouts, if its actions are moves.
            It is asked for many rollouts in turn, and is to remember none.
        robots, starts, actions, view, rule, offers, max_steps: as of `env`.
        rollouts, seed: rollout r of the seed has the luck that it has in `evaluate`.
        against: policies of the planner that are rolled out on the same luck, and ended at the same step.
        processes: that ask a policy in Python; the figures are the same. None: one a core, where it can be imported.
        progress, on_interrupt: as of `evaluate`.
    """
    from analysis.judging.judge import judge as judge_policy
    from planner.rollouts.names import of_jax

    _check_world(world)
    if not callable(policy):
        raise UsageError(argument("policy", policy), expected="a function of what the robots observe")
    given: dict[str, Any] = {"starts": starts, "actions": actions, "view": view, "rule": rule, "offers": offers}
    env = of_jax("environment")(world, robots, **given, max_steps=max_steps)
    choices = RolloutChoices(rollouts=rollouts, seed=seed)

    def work(tell: Progress, doing: Doing) -> Judged:
        return judge_policy(world, policy, env, choices, against, processes, tell)

    return ask(work, progress, on_interrupt)


def suite(only: str | Sequence[str] | None = None) -> Suite:
    """Thirty named worlds, the same for ever, as a mapping from names to worlds; `.judge(policy)` plays them.

    Args:
        only: names, or patterns as ``contiguous-10-*``; None: all.
    """
    from analysis.standings.suite import Suite

    return Suite(only)


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

    _check_world(world)
    choices = RolloutChoices(loop=loop, rollouts=rollouts, seed=seed, deadline=deadline, exact=exact)
    settings = Choices().settings(world.team.settings, world.pace)
    goal = make_goal(target, confidence, complete, meaning, most)

    search = partial(find_size, world, settings, goal, choices)
    return ask(lambda tell, doing: search(progress=tell, doing=doing), progress, on_interrupt)


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
        robots, starts, levels, density, risk, transit, max_steps, range, wear, susceptibility: as of `plan`.
        losses: pick the setting that covers most with at most so many robots lost on average; or `target`: the one
            that loses the fewest with so much covered. `answer.picked` is it, `answer.plan_of(answer.picked)` its plan.
        reserves, worths: to look at (default: as the map suggests).
        rollouts: of each setting, the same for all; None: 4,096, fewer above 2,048 accessible cells.
        deadline: end every mission at this step.
        luck, exact, progress, on_interrupt: as of `evaluate`; `exact`: of all that is compared together.
    """
    from analysis.tradeoff.rules import make_goal, usual_rollouts
    from analysis.tradeoff.search import Ladders, find_front

    _check_world(world)
    goal, bears = make_goal(losses, target), {"wear": wear, "susceptibility": _one_or_each(susceptibility)}
    settings = _settings_of(world, range, levels, density, risk, transit, max_steps, **bears)
    ladders = Ladders(None if reserves is None else tuple(reserves), None if worths is None else tuple(worths))
    placed = np.asarray(starts_of(world, robots, starts))
    count = usual_rollouts(world, placed) if rollouts is None else rollouts
    choices = RolloutChoices(
        rollouts=count, seed=seed, engine=engine, deadline=deadline, first_only=first_visit, luck=luck, exact=exact
    )

    search = partial(find_front, world, placed, settings, choices, goal=goal, ladders=ladders)
    return ask(lambda tell, doing: search(progress=tell, doing=doing), progress, on_interrupt)


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

    _check_world(world)
    bears = {"wear": wear, "susceptibility": _one_or_each(susceptibility)}
    settings = _settings_of(world, range, levels, density, risk, transit, max_steps, policy, reserve, worth, **bears)
    choices = RolloutChoices(
        rollouts=rollouts, seed=seed, engine=engine, deadline=deadline, first_only=first_visit, luck=luck, exact=exact
    )
    size = team_size(world, robots)

    search = partial(find_starts, world, size, settings, choices, depot=depot, candidates=candidates)
    return ask(lambda tell, doing: search(progress=tell, doing=doing), progress, on_interrupt)


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

    _check_world(world)
    bears = {"wear": wear, "susceptibility": _one_or_each(susceptibility)}
    settings = _settings_of(world, range, levels, density, risk, transit, max_steps, policy, reserve, worth, **bears)
    choices = RolloutChoices(
        rollouts=rollouts, seed=seed, engine=engine, deadline=deadline, first_only=first_visit, luck=luck, exact=exact
    )
    placed = np.asarray(starts_of(world, robots, starts))

    search = partial(find_clearing, world, placed, settings, choices, count=count, remove=remove)
    return ask(lambda tell, doing: search(progress=tell, doing=doing), progress, on_interrupt)


def check(
    world: World,
    plan: Plan | str | Path | int | None = None,
    *,
    rollouts: int = 20_000,
    seed: int = 0,
    engine: EngineName = "auto",
    bound: bool | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> MapCheck:
    """Which of the paper's formulas, and of ours, hold for this plan?

    Args:
        plan, rollouts, seed, engine, bound, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.checking.check_map import check_input

    choices = RolloutChoices(rollouts=rollouts, seed=seed, engine=engine)

    def work(tell: Progress, doing: Doing) -> MapCheck:
        return check_input(world, _plan_of(world, plan), choices, tell, bound)

    return ask(work, progress, on_interrupt)


def record(
    world: World,
    plan: Plan | str | Path | int | None,
    path: str | Path,
    *,
    pick: Iterable[str] = (),
    ids: Iterable[int] = (),
    rollouts: int = 10_000,
    loop: Loop | None = None,
    seed: int = 0,
    step_seconds: float | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Recorded:
    """Rollouts in full as an MCAP file, for Foxglove, Lichtblick and Rerun; read back with `read_rollouts`.

    Args:
        plan: as of `evaluate`. path: of the file (.mcap); a layout for Foxglove and Lichtblick is written beside it.
        ids: rollouts to record; or `pick`: some of `rollouts` evaluated ones, of "worst", "median", "best", ...
            (default: those three).
        step_seconds: how long a step takes in the viewer; None: as long as the world says, or 1.
        loop, seed, progress, on_interrupt: as of `evaluate`.
    """
    from analysis.recording.names import SUFFIX, check_name, layout_name
    from analysis.recording.pick import parse_picks
    from analysis.recording.record import record as record_rollouts
    from analysis.recording.rolling import Request
    from analysis.recording.viewers.layout import write_layout

    check_name(Path(path), SUFFIX)
    chosen, names = tuple(ids), tuple(pick)
    picks: tuple[Pick, ...] = () if chosen and not names else tuple(parse_picks(",".join(names or PICKS)))
    count = as_whole(rollouts) if picks else 0

    def work(tell: Progress, doing: Doing) -> Recorded:
        given = _plan_of(world, plan)
        made = not given.is_foreign
        seconds = world.with_pace(step_seconds).pace.seconds or 1.0
        how: Any = {"loop": loop or given.usual_loop, "seed": seed, "step_seconds": seconds, "made": made}
        request = Request(chosen, picks, count, **how)
        done = record_rollouts(world, given, request, path, progress=tell)
        write_layout(layout_name(done.path), world, len(given.robots))
        return done

    return ask(work, progress, on_interrupt)


def read_rollouts(path: str | Path) -> Iterator[RecordedRollout]:
    """The rollouts of a recording, one after the other; one is held at a time.

    Of a partial or recovered recording, rollouts that are not all there are left out.
    """

    from analysis.recording import rollouts

    return rollouts.read_rollouts(path)


def read_outcomes(path: str | Path) -> RecordedOutcomes:
    """Every outcome that `record --outcomes` wrote, none if it did not."""

    from analysis.recording import rollouts

    return rollouts.read_outcomes(path)


def export(
    world: World,
    plan: Plan | str | Path | int | None,
    out: str | Path,
    *,
    to: Literal["qgc", "nav2", "geojson", "kml", "gpx", "csv", "geotiff"] | None = None,
    altitude: float | None = None,
    speed: float | None = None,
) -> list[Path]:
    """The plan for ground stations, nav2 and GIS; returns the files.

    Args:
        plan: as of `evaluate`. out: a file or a folder. to: the format; None: by the suffix of `out`.
        altitude: QGroundControl: metres above take-off (default 20), 0 for robots on the ground. speed: metres a
            second (default: as the world says, or 3).
    """
    from analysis.exporting.export import choose_format
    from analysis.exporting.export import export as write
    from analysis.exporting.mission import make_mission

    form = choose_format(Path(out), to)
    return write(make_mission(world, _plan_of(world, plan), altitude, speed), Path(out), form)


PICKS = ("worst", "median", "best")


def sweep(
    spec: str | Path,
    store: str | Path | None = None,
    *,
    precision: float | None = None,
    processes: int | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Sweep:
    """A sweep file run, on all cores, into a store that resumes (default: NAME.store beside you).

    Args:
        precision: more maps until every interval of mean coverage is within so much of it. processes: at a time.
        progress, on_interrupt: as of `evaluate`; jobs are counted.
    """
    from analysis.sweeps.spec import read_spec
    from analysis.sweeps.store.store import Store
    from analysis.sweeps.sweep import run_sweep

    asked = read_spec(Path(spec))

    def work(tell: Progress, doing: Doing) -> Sweep:
        with Store.open(Path(f"{asked.source.stem}.store") if store is None else Path(store)) as opened:
            how: Any = {"precision": precision, "processes": processes}
            return run_sweep(asked, opened, watch=lambda *now: tell(*now[:3]), **how)

    return ask(work, progress, on_interrupt, "jobs")


def reproduce(
    figure: Literal["fig4", "fig5", "fig6", "fig7", "all"] = "all",
    *,
    maps: int = 500,
    rollouts: int = 50,
    seed: int = 0,
    store: str | Path | None = None,
    processes: int | None = None,
    progress: Progress | bool | None = None,
    on_interrupt: OnInterrupt = "raise",
) -> Reproduction:
    """The paper's experiments again, with intervals; results are kept in `store` if one is named.

    Args:
        maps: of each setting; rollouts: of each map. progress, on_interrupt: as of `evaluate`; jobs are counted.
    """
    from analysis.reproduction.reproduce import reproduce as run_experiments
    from analysis.sweeps.store.store import Store

    def work(tell: Progress, doing: Doing) -> Reproduction:
        with Store.memory() if store is None else Store.open(Path(store)) as kept:
            how: Any = {"maps": maps, "rollouts": rollouts, "seed": seed, "store": kept, "processes": processes}
            return run_experiments(figure, **how, progress=tell)

    return ask(work, progress, on_interrupt, "jobs")


def results(store: str | Path, *, by: Sequence[str] = (), where: dict[str, Any] | None = None) -> Results:
    """What a store holds, as rows: a mean over maps for each setting.

    Args:
        by: labels that tell rows apart (default: all that vary). where: values wanted of labels, one or several each.
    """
    from analysis.sweeps.results import collect
    from analysis.sweeps.store.store import Store

    def texts(value: object) -> tuple[str, ...]:
        several = value if isinstance(value, list | tuple | set | np.ndarray) else [value]
        return tuple(str(one) for one in several)

    wanted = {name: texts(value) for name, value in (where or {}).items()}
    with Store.open(Path(store), write=False) as opened:
        return collect(opened, wanted, list(by))
