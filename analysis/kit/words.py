"""Numbers with their things, and shares, as the commands say them."""

from __future__ import annotations

from math import ceil, floor, isfinite, log10
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from planner.plans.plan import Plan
    from planner.worlds.world import World


def counted(number: int, thing: str, things: str = "") -> str:
    """ "1 chunk", "3,001 rollouts"; `things`: the plural, where an s does not make it."""
    return f"{number:,} {thing if number == 1 else things or thing + 's'}"


def plan_words(plan: Plan) -> str:
    """A plan of ours: "6 areas, shared 10 times; if nobody is lost, the mission visits every accessible cell"."""
    shared = f", shared {plan.shares} time{'s' * (plan.shares != 1)}" if plan.shares else ""
    return f"{counted(len(plan.areas), 'area')}{shared}; {plan.ends}"


def span_words(plan: Plan) -> str:
    """ "makespan 1,315 steps"; a run that ends before all is covered ends STUCK_AFTER steps after the last move."""
    from planner.mrac.simulate import STUCK_AFTER

    if plan.outcome in ("called_off", "stuck"):
        return f"the last move is at step {plan.makespan:,}, the end {STUCK_AFTER} steps later"
    return f"makespan {plan.makespan:,} steps"


def bearing_words(plan: Plan, world: World) -> str:
    """What the map's p means where robots wear, or exposure counts differently on them; "" where p is a chance."""
    bearing, worst = plan.bearing, float(world.threat[world.free].max(initial=0.0))
    if bearing.is_plain:
        return ""
    chances = [bearing.first_chance(worst, robot) for robot in range(len(plan.robots))]
    least, most = (f"{100 * chance:.3g} %" for chance in (min(chances), max(chances)))
    fresh = least if least == most else f"{least} to {most}, by robot"
    return (
        f"{bearing.said}: p is a dose, of which a visit adds -ln(1 - p); the first visit of the worst cell, "
        f"p = {100 * worst:.3g} %, stops a fresh robot with {fresh}"
    )


def digits_of(half: float) -> int:
    """The fewest decimals with which a figure, rounded, stays within `half` of itself: what its interval allows."""
    return max(0, ceil(-log10(2.0 * half) - 1e-9))


def typed(value: float) -> str:
    """A number as an option takes it, and no other: "20", "0.1", "1e-05"."""
    short = f"{value:g}"
    return short if float(short) == value else repr(float(value))


def duration(seconds: float) -> str:
    """Seconds as "40 s", "2 min 5 s" or "1 h 20 min"."""
    whole = max(round(seconds), 1)
    if whole < 60:
        return f"{whole} s"
    larger, unit, smaller, rest = (whole // 60, "min", "s", whole % 60) if whole < 3600 else (
        whole // 3600, "h", "min", whole % 3600 // 60
    )  # fmt: skip
    return f"{larger} {unit}" + (f" {rest} {smaller}" if rest else "")


def meant_fraction(value: object) -> str:
    """What somebody who wrote a percentage for a fraction meant, as the fix of an error; "" for what is none."""
    is_percent = isinstance(value, int | float) and not isinstance(value, bool) and 1 < value <= 100
    return f"did you mean {value / 100:g}?" if is_percent else ""  # type: ignore[operator]


def share(count: int, of: int, digits: int = 1) -> str:
    """`count` of `of` as "62.4 %", in whole numbers: what is not quite none or all is never rounded to it."""
    if count in (0, of):
        return "0 %" if count == 0 else "100 %"
    least = f"{10.0**-digits:.{digits}f}"
    if count * 100 * 10**digits < of:
        return f"< {least} %"
    if (of - count) * 100 * 10**digits < of:
        return f"> {100 - 10.0**-digits:.{digits}f} %"
    return f"{100 * count / of:.{digits}f} %"


def percent(fraction: float, digits: int = 1) -> str:
    """A fraction as "62.4 %"; what is not quite 0 or 1 is never rounded to it."""
    if fraction in (0, 1):
        return f"{100 * fraction:.0f} %"
    least = 10.0**-digits
    if 0 < fraction * 100 < least:
        return f"< {least:.{digits}f} %"
    if 0 < (1 - fraction) * 100 < least:
        return f"> {100 - least:.{digits}f} %"
    return f"{100 * fraction:.{digits}f} %"


def between(low: float, high: float, digits: int = 2) -> str:
    """An interval as "85.60 .. 85.76", rounded outwards; "" where nothing is known."""
    if not (isfinite(low) and isfinite(high)):
        return ""
    ends = (floor(low * 10**digits + 1e-6), ceil(high * 10**digits - 1e-6))
    return " .. ".join(f"{end / 10**digits:,.{digits}f}" for end in ends)


def lost_words(mean: float, robots: int, digits: int = 2) -> str:
    """A mean number of robots lost: "1.87 of 5", "all 5"; what is not quite none or all of them is never said to be."""
    all_of_them = {1: "the robot", 2: "both robots"}.get(robots, f"all {robots}")
    if mean in (0, robots):
        return all_of_them if mean else f"none of {robots}"
    near = round(mean, digits)
    if near >= robots or near <= 0:
        return f"next to {all_of_them}" if near else f"next to none of {robots}"
    return f"{mean:.{digits}f} of {robots}"
