"""How an object shows itself in a console and in a notebook: a title, rows of a name and what it is; and counts,
times, shares.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from html import escape
from math import ceil, floor, isnan
from typing import Any

from planner.arguments import Numbers, argument
from planner.errors import UsageError

Rows = Sequence[tuple[str, str]]
NOTHING = 1e-12
"""By so much of itself a figure may miss the most that it can be and count as that: what sums of float64 lose."""
FINEST = 6
"""Decimals of a percentage beyond which a bound is said to be 100."""


def text_of(title: str, rows: Rows) -> str:
    """For `__repr__`: the title, then a line a row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {what}" for name, what in rows)])


def html_of(title: str, rows: Rows) -> str:
    """For `_repr_html_`: the same as a table."""
    cells = (f'<tr><td>{escape(name)}</td><td style="text-align:left">{escape(what)}</td></tr>' for name, what in rows)
    return f"<b>{escape(title)}</b><table>{''.join(cells)}</table>"


def counted(number: float, thing: str, things: str = "") -> str:
    """ "1 chunk", "3,001 rollouts", "1.5 steps"; `things`: the plural, where an s does not make it."""
    shown = f"{number:g}" if isinstance(number, float) else f"{number:,}"
    return f"{shown} {thing if number == 1 else things or thing + 's'}"


def at_least_words(number: int, of: int) -> str:
    """ "at least 1 robot is", "at least 2 robots are", "every robot is"."""
    if number == of:
        return "the robot is" if of == 1 else "every robot is"
    return f"at least {counted(number, 'robot')} {'is' if number == 1 else 'are'}"


def duration(seconds: float) -> str:
    """Seconds as "40 s", "2 min 5 s" or "1 h 20 min"."""
    whole = max(round(seconds), 1)
    if whole < 60:
        return f"{whole} s"
    larger, unit, smaller, rest = (whole // 60, "min", "s", whole % 60) if whole < 3600 else (
        whole // 3600, "h", "min", whole % 3600 // 60
    )  # fmt: skip
    return f"{larger} {unit}" + (f" {rest} {smaller}" if rest else "")


def share(count: int, of: int, digits: int = 1) -> str:
    """`count` of `of` as "62.4 %", in whole numbers: what is not quite none or all is never rounded to it."""
    return percent(Fraction(int(count), int(of)) if of else 0, digits)


def percent(fraction: float | Fraction, digits: int = 1) -> str:
    """A fraction as "62.4 %"; what is not quite 0 or 1 is never rounded to it: "< 0.1 %", "> 99.9 %"."""
    return f"{in_percent(fraction, digits)} %"


def in_percent(fraction: float | Fraction, digits: int = 1) -> str:
    """The same without its sign, for a column that says so; "" of what is not known (NaN)."""
    return "" if isnan(fraction) else inside(100 * _whole(fraction), 100, digits)


def inside(value: float | Fraction, most: int, digits: int, finest: int = 0) -> str:
    """A figure that lies in 0 .. `most`: "62.4"; what is not quite at an end is never rounded to it.

    It gets further decimals, up to `finest`, until it is told apart from the end: "99.97"; then "> 99.9".
    """
    if -NOTHING * most <= value <= 0 or abs(most - value) <= NOTHING * most:
        return "0" if value <= 0 else f"{most}"
    shown = f"{float(value):,.{digits}f}"
    if 0 < float(shown.replace(",", "")) < most or not 0 < value < most:
        return shown
    if digits < finest:
        return inside(value, most, digits + 1, finest)
    least = Fraction(1, 10**digits)
    return f"< {float(least):.{digits}f}" if value < least else f"> {float(most - least):.{digits}f}"


def _whole(number: float | Fraction) -> Fraction:
    """Exactly that number, of numpy's too."""
    return number if isinstance(number, Fraction) else Fraction(float(number))


def _scaled(fraction: float | Fraction, digits: int) -> Fraction:
    """In units of the last decimal of its percentage; what rounding may have added or lost is left out."""
    scaled = 100 * 10**digits * _whole(fraction)
    return Fraction(round(scaled)) if abs(scaled - round(scaled)) < Fraction(1, 10**6) else scaled


def floored(fraction: float | Fraction, digits: int = 1) -> str:
    """A bound that a share is not below, in percent, rounded downwards."""
    if fraction >= 1:
        return "100 %"
    return f"{float(floor(_scaled(fraction, digits)) / Fraction(10**digits)):.{digits}f} %"


def ceiled(fraction: float | Fraction, digits: int = 2, unit: str = " %") -> str:
    """A bound that a share does not exceed, in percent, rounded upwards; with further decimals rather than as 100.

    `unit`: "" for a column that says so.
    """
    bound = ceil(_scaled(fraction, digits)) / Fraction(10**digits)
    if fraction < 1 <= bound / 100 and digits < FINEST:
        return ceiled(fraction, digits + 1, unit)
    return ("100" if bound == 100 else f"{float(bound):.{digits}f}") + unit


def chance(p: float, digits: int = 3, unit: str = " %") -> str:
    """A chance that somebody gave, as "5 %", in so many digits that count, and more where these would say 100 %.

    `unit`: as of `ceiled`.
    """
    shown = f"{100 * p:.{digits}g}"
    return chance(p, digits + 1, unit) if float(shown) >= 100 > 100 * p else shown + unit


# How long a step takes, where somebody says it: a time in steps is then said in minutes too, and given in either; and
# how many steps a quarter turn costs, which is said beside it.
#
# No plan, tally, hash or count knows it (docs/spec.md, section 18).

STEP_SECONDS = Numbers(1e-6, 1e6, "seconds")
SPEEDS = Numbers(0, 1_000, "metres a second", above=True)
TURNS = Numbers(0, 1_000, "steps a quarter turn")
UNITS = {"h": 3600.0, "min": 60.0, "s": 1.0}
SPAN = re.compile(r"\s*".join(rf"(?:([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?)\s*{unit})?" for unit in UNITS))
TIMES = "45min, 1h30min or 90s"
SPANS = f"steps, as 450, or a time, as {TIMES}"
WHOLE = 1e-12
"""By how much of itself a quotient may lie below a whole number and count as it: what floats lose."""
SHORT = 9.5
"""Seconds below which tenths are said."""
HOW_TO_SAY = "the scenario's `step: {seconds: 2}` or `speed:` (m/s)"


def seconds_of(text: str) -> float | None:
    """Seconds of a time as `1h30min`, `45 min` or `90s`, larger units first; None for what is none."""
    found = SPAN.fullmatch(text.strip())
    if not found or not any(found.groups()):
        return None
    return sum(float(number) * unit for number, unit in zip(found.groups(), UNITS.values(), strict=True) if number)


@dataclass(frozen=True)
class Pace:
    """The seconds that a step takes; None: nobody says, and times are in steps alone. `turn`: steps a quarter turn."""

    seconds: float | None = None
    turn: float = 0.0

    def __bool__(self) -> bool:
        return self.seconds is not None

    @property
    def minutes(self) -> float:
        """That a step takes; NaN where nobody says."""
        return math.nan if self.seconds is None else self.seconds / 60.0

    def also(self, steps: float) -> str:
        """What stands after a time in steps: " (22 min 30 s)"; "" where nobody says how long a step takes."""
        if self.seconds is None:
            return ""
        seconds = steps * self.seconds
        return f" ({seconds:.2g} s)" if seconds < SHORT else f" ({duration(seconds)})"

    @property
    def each(self) -> str:
        """What stands after the name of an axis of steps: " (3 s each)"."""
        return "" if self.seconds is None else f" ({self.seconds:.3g} s each)"

    def step(self, step: float) -> str:
        """ "step 450 (22 min 30 s)"."""
        return f"step {round(step):,}{self.also(step)}"

    def steps(self, steps: float) -> str:
        """ "450 steps (22 min 30 s)", of a mean the nearest whole number of them."""
        return f"{counted(round(steps), 'step')}{self.also(steps)}"

    def last_step(self, name: str, given: Any, source: str = "") -> Any:
        """The last step that is over by a deadline, which is one or a time; anything else as it is, for a check.

        Raises UsageError, naming the argument `name`, or the key of that name in `source`, for a text that is no time,
        and where nobody says how long a step takes.
        """
        if not isinstance(given, str):
            return given
        seconds, said = seconds_of(given), f"`{name}` is {given}" if source else argument(name, given)
        if seconds is None:
            raise UsageError(said, source=source, expected=SPANS)
        if self.seconds is None:
            options = "" if source else f"{argument('step_seconds')} or {argument('speed')}, or "
            fix = f"give {options}{HOW_TO_SAY}"
            problem = f"{said}, but nobody says how long a step takes"
            raise UsageError(problem, source=source, expected="steps", fix=fix)
        return math.floor(seconds / self.seconds * (1 + WHOLE))


UNPACED = Pace()


def pace_of(step_seconds: Any, speed: Any, cell_size: float | None) -> Pace:
    """The pace that is asked for by one of the two, or by none; `cell_size`: metres, None where nobody says.

    Raises UsageError.
    """
    if step_seconds is not None and speed is not None:
        both = f"both {argument('step_seconds')} and {argument('speed')} are given"
        raise UsageError(both, expected="one of them")
    if step_seconds is not None:
        STEP_SECONDS.check("step_seconds", step_seconds)
        return Pace(float(step_seconds))
    if speed is None:
        return UNPACED
    SPEEDS.check("speed", speed)
    if cell_size is None:
        problem = f"{argument('speed', speed)}, but nobody says how many metres a cell has"
        raise UsageError(problem, fix=f"give {argument('cell_size')}, or {argument('step_seconds')} instead")
    if not STEP_SECONDS.accepts(cell_size / speed):
        problem = f"{argument('speed', speed)} makes a step of {cell_size:g} m take {cell_size / speed:g} s"
        raise UsageError(problem, expected=STEP_SECONDS.expected)
    return Pace(cell_size / speed)
