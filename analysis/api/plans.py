"""Worlds and plans: what every other function is given."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from numpy.typing import ArrayLike

from analysis.api.options import Loop, ReturnTo
from analysis.inputs import load_world, plan_from_state
from analysis.kit.notes import say
from planner.arguments import argument
from planner.errors import UsageError
from planner.plan_team import plan_team, read_plan_on
from planner.plans.plan import Plan
from planner.plans.state import MissionState
from planner.plans.state_traces import read_state
from planner.policies.in_area import InAreaOrder
from planner.settings import BEST, SETTINGS, Choices, Policy, Settings
from planner.worlds.reported import with_route
from planner.worlds.starts import starts_of
from planner.worlds.world import World


def load(
    source: str | Path | ArrayLike,
    *,
    cell_size: float | None = None,
    step_seconds: float | None = None,
    speed: float | None = None,
    turn: float | None = None,
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
        turn: steps that a quarter turn costs: `evaluate` and `plan` say how long a mission takes with turns too.
        value, detect: what each cell is worth, and the chance that a visit which the robot survives finds what is in
            it: `[H, W]` or one number, in the place of what the source says (if that is nothing: 1 each).
        route: `[row, col]` of the corners of the route that is to be safe.

    A scenario's robots come along: `plan(world)` uses them. What loading did is in `world.notes`.
    """
    if isinstance(source, str | Path):
        world = load_world(str(source), cell_size)
        _say_if_large(world)
    else:
        world = World.create(source, cell_size=1.0 if cell_size is None else cell_size, source="array")
        world = replace(world, measured=cell_size is not None)
    world = world.with_pace(step_seconds, speed, turn)
    if value is not None or detect is not None:
        world = world.with_values(world.value if value is None else value, world.detect if detect is None else detect)
    return world if route is None else with_route(world, route)


def _say_if_large(world: World) -> None:
    """Say before anything takes long that a map has many cells, where nobody said how large they are."""
    from planner.worlds.scenario import MANY_CELLS, ROBOT_IS

    if world.threat.size > MANY_CELLS:
        say([f"{world.source}: {note}" for note in world.notes if ROBOT_IS in note])


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
    return_to: ReturnTo = None,
    recharge: int | None = None,
    state: MissionState | str | Path | None = None,
    in_area: InAreaOrder | None = None,
    types: str | Sequence[str] | None = None,
    steps_per_move: int | Sequence[int] | None = None,
    radio: float | None = None,
) -> Plan:
    """The plan of a team (Algorithms 1 to 3): its areas, and every robot's path if nobody is lost.

    Args:
        robots: how many, placed by the world's start rule unless it has as many starts; default: its team, else 1.
        starts: instead of that, `[[row, col], ...]`, one a robot.
        levels: most threat levels, p = 0 counted. density: least cells a robot of a safe area is to have.
        risk: cost of a dangerous cell, "paper" (eq. 3) or "log" (by survival). transit: "grid" or "area".
        max_steps: at which the run is cut off.
        policy: which area is next: "mrac" (the paper's) or "per_cell" (least cost per new cell); or a rule of your own,
            a `planner.policies.rule.Rule`, or a function of an `Offer` to order areas by, least first. "best": the one
            that covers most here, of a dozen settings that are raced on luck of their own, its areas then put in
            a better order, for `seconds` (10) at most.
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
        return_to: robots come home, "home" to their own starts, to the "nearest" start of anybody, or of the bases
            `[[row, col], ...]`: they turn once everything is covered or nothing more can be done, or while range and
            deadline still leave them the way.
        recharge: with `range` and `return_to`, steps at a base after which a robot has its range again.
        state: of a mission under way, or a file of it (a state, tracks, visited cells, a mask, an OccupancyGrid): the
            plan of the rest; the robots are its own, or at `starts` where the file does not say where they are.
        types: of robots, of the world's matrix, one for all or one a robot: each plans with its own p, and is stopped
            by it.
        steps_per_move: of robots that differ in speed, one a robot: `(1, 2)`, the second is half as fast.
        radio: cells over which robots hear each other, and a start or base: who is out of touch takes over nothing,
            and drives back.
        in_area: "boustrophedon", "rows" or "columns": in safe areas straight on, so with fewer turns; an order of your
            own is a function of a `CellOffer`, the least first.

    A rule or an order of your own cannot be saved, nor (yet) rolled out by the compiled engines.
    """
    from analysis.trials.best import BASE, plan_best

    given = {name: value for name, value in locals().items() if name in SETTINGS}
    check_world(world)
    sought = policy == BEST
    settings = settings_of(world, **given | ({"policy": BASE} if sought else {}))
    if sought and state is not None:
        raise UsageError(f"both {argument('policy', BEST)} and a state", expected="one of them")
    if state is not None:
        if robots is not None or (starts is not None and isinstance(state, MissionState)):
            raise UsageError(
                "a state and robots or starts", expected="one of them: the state says where its robots are"
            )
        found, notes = (state, ()) if isinstance(state, MissionState) else read_state(Path(state), world, starts)
        made = plan_from_state(world, found, settings)
        return replace(made, notes=(*made.notes, *notes))
    return (plan_best if sought else plan_team)(world, starts_of(world, robots, starts), settings, seconds)


def settings_of(world: World, **given: Any) -> Settings:
    """What is asked, by name, in the place of what the world came with. Raises InputError."""
    asked = Choices(**{name: _of_tuples(name, value) for name, value in given.items()})
    return asked.settings(world.team.settings, world.pace, by=world.source)


def _of_tuples(name: str, given: Any) -> Any:
    """The value of a setting, where it is a list, of one a robot or of cells, as a tuple."""
    if not isinstance(given, Iterable) or isinstance(given, str):
        return given
    return tuple(map(tuple, given)) if SETTINGS[name].places else tuple(given)


def check_world(world: object) -> None:
    """What is easily given instead: the name of an INPUT, an array."""
    if not isinstance(world, World):
        raise UsageError(argument("world", world), expected="a World, as mrac_jax.load makes one")


def plan_of(world: World, given: Plan | str | Path | int | None) -> tuple[World, Plan]:
    """A plan, the one in a file, or a new one (for so many robots); and the world that it is for (`read_plan_on`)."""
    check_world(world)
    if isinstance(given, Plan):
        given.require(world)
        return world, given
    return read_plan_on(given, world) if isinstance(given, str | Path) else (world, plan(world, given))
