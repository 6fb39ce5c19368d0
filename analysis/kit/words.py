"""Numbers with their things, and shares, as the commands say them."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

from planner.shown import counted

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
    shared = f", shared {plan.shares} time{'s' * (plan.shares != 1)}" if plan.shares else ""
    policy = "" if plan.settings is None else policy_words(plan.settings)
    by = "" if policy in ("", "mrac") else f"{policy}; "
    return f"{by}{counted(len(plan.areas), 'area')}{shared}; {plan.ends}"


def span_words(plan: Plan, pace: Pace) -> str:
    """ "makespan 1,315 steps, 2,612 moves, 511 quarter turns"; with what turns cost, if somebody says.

    A run that ends before all is covered waits a few steps before it ends.
    """
    from planner.plans.turns import drive_of

    drive = drive_of(robot.path for robot in plan.robots)
    driven = f"{counted(int(drive.moves.sum()), 'move')}, {counted(int(drive.turns.sum()), 'quarter turn')}"
    if pace.turn:
        steps = drive.time(pace.turn)
        driven += f": with turns {steps:,.0f} steps{pace.also(steps)}"
    if plan.outcome in ("called_off", "stuck"):
        later = plan.time - plan.makespan
        end = f", the end {counted(later, 'step')} later" if later else ""
        return f"the last move is at {pace.step(plan.makespan)}{end}, {driven}"
    return f"makespan {plan.makespan:,} steps{pace.also(plan.makespan)}, {driven}"


def bearing_words(plan: Plan, world: World) -> str:
    """What the map's p means where robots wear, or exposure counts differently on them; "" where p is a chance."""
    bearing, worst = plan.bearing, float(world.threat[world.free].max(initial=0.0))
    if bearing.is_plain:
        return ""
    if bearing.is_even:
        return f"{bearing.said}: each is stopped by the p of its type; the map's own p is that of no type"
    chances = [bearing.first_chance(worst, robot) for robot in range(len(plan.robots))]
    least, most = (f"{100 * chance:.3g} %" for chance in (min(chances), max(chances)))
    fresh = least if least == most else f"{least} to {most}, by robot"
    return (
        f"{bearing.said}: p is a dose, of which a visit adds -ln(1 - p); the first visit of the worst cell, "
        f"p = {100 * worst:.3g} %, stops a fresh robot with {fresh}"
    )


def without_level(said: str) -> str:
    """What `Estimate.said` says, without "(95 %)": for a sentence in which % stands for coverage alone."""
    return said.replace(" (95 %)", "").replace(", 95 %)", ")")


def share(count: int, of: int, digits: int = 1) -> str:
    """`count` of `of` as "62.4 %", in whole numbers: what is not quite none or all is never rounded to it."""
    return percent(Fraction(int(count), int(of)) if of else 0, digits)


def percent(fraction: float | Fraction, digits: int = 1) -> str:
    """A fraction as "62.4 %"; what is not quite 0 or 1 is never rounded to it."""
    if fraction in (0, 1):
        return f"{100 * int(fraction)} %"
    least = Fraction(1, 10**digits)
    if 0 < fraction * 100 < least:
        return f"< {float(least):.{digits}f} %"
    if 0 < (1 - fraction) * 100 < least:
        return f"> {float(100 - least):.{digits}f} %"
    return f"{float(100 * fraction):.{digits}f} %"
