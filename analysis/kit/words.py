"""Numbers with their things, and shares, as the commands say them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from planner.shown import chance, counted

if TYPE_CHECKING:
    from planner.pace import Pace
    from planner.plans.plan import Plan
    from planner.settings import Settings
    from planner.worlds.world import World


def policy_words(settings: Settings) -> str:
    """A policy and its limits: "watchful, reserve 0.25, order of areas found"."""
    limits = {name: getattr(settings, name) for name in ("reserve", "worth", "density")}
    own = [f"{name} {value:g}" for name, value in limits.items() if value != getattr(type(settings), name)]
    own += ["order of areas found"] * (settings.priority is not None)
    return ", ".join([settings.rule.name, *own])


def plan_words(plan: Plan) -> str:
    """A plan of ours: "6 areas, shared 10 times; if nobody is lost, the mission visits every accessible cell".

    With its policy first, unless it is the paper's with nothing of its own.
    """
    often = "once" if plan.shares == 1 else f"{plan.shares:,} times"
    shared = f", shared {often}" if plan.shares else ""
    policy = "" if plan.settings is None else policy_words(plan.settings)
    by = "" if policy in ("", "mrac") else f"{policy}; "
    return f"{by}{counted(len(plan.areas), 'area')}{shared}; {plan.ends}"


def span_words(plan: Plan, pace: Pace) -> str:
    """ "makespan 1,315 steps, 2,612 moves, 511 quarter turns"; with what turns cost, if somebody says.

    A run that ends before all is covered waits a few steps before it ends.
    """
    from planner.plans.turns import drive_of
    from planner.tally import Outcome

    drive = drive_of(robot.path for robot in plan.robots)
    driven = f"{counted(int(drive.moves.sum()), 'move')}, {counted(int(drive.turns.sum()), 'quarter turn')}"
    if pace.turn:
        steps = drive.time(pace.turn)
        driven += f": with turns {pace.steps(steps)}"
    if plan.outcome in (Outcome.NOT_WORTH_THE_RISK.word, Outcome.NO_PROGRESS.word):
        later = plan.time - plan.makespan
        end = f", the end {counted(later, 'step')} later" if later else ""
        return f"the last move is at {pace.step(plan.makespan)}{end}, {driven}"
    return f"makespan {pace.steps(plan.makespan)}, {driven}"


def bearing_words(plan: Plan, world: World) -> str:
    """What the map's p means where robots wear, or exposure counts differently on them; "" where p is a chance."""
    bearing, worst = plan.bearing, float(world.threat[world.free].max(initial=0.0))
    if bearing.is_plain:
        return ""
    if bearing.is_even:
        return f"{bearing.said}: each is stopped by the p of its type; the map's own p is that of no type"
    chances = [bearing.first_chance(worst, robot) for robot in range(len(plan.robots))]
    least, most = (chance(one) for one in (min(chances), max(chances)))
    fresh = least if least == most else f"{least} to {most}, by robot"
    return (
        f"{bearing.said}: p is a dose, of which a visit adds -ln(1 - p); the first visit of the worst cell, "
        f"p = {chance(worst)}, stops a fresh robot with {fresh}"
    )


def without_level(said: str) -> str:
    """What `Estimate.said` says, without "(95 %)": for a sentence in which % stands for coverage alone."""
    return said.replace(" (95 %)", "").replace(", 95 %)", ")")
