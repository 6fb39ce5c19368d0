"""Text of objects in consoles and notebooks (a title and rows), counts, shares in percent, and times."""

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
"""Relative error of sums of float64: a figure this close to its largest value counts as that."""
FINEST = 6
"""Decimals of a percentage from which on a bound is given as 100."""


def text_of(title: str, rows: Rows) -> str:
    """Text for `__repr__`: the title, then a line per row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:<{width}}  {what}" for name, what in rows)])


def html_of(title: str, rows: Rows) -> str:
    """The same as an HTML table, for `_repr_html_`."""
    cells = (f'<tr><td>{escape(name)}</td><td style="text-align:left">{escape(what)}</td></tr>' for name, what in rows)
    return f"<b>{escape(title)}</b><table>{''.join(cells)}</table>"


def counted(number: float, thing: str, things: str = "") -> str:
    """ "1 chunk", "3,001 rollouts", "1.5 steps"; `things`: the plural, if it is not formed with s."""
    shown = f"{number:g}" if isinstance(number, float) else f"{number:,}"
    return f"{shown} {thing if number == 1 else things or thing + 's'}"


def at_least_text(number: int, of: int) -> str:
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
    """`count` of `of` as "62.4 %", exact: a share that is not quite 0 or 1 is never rounded to it."""
    return percent(Fraction(int(count), int(of)) if of else 0, digits)


def percent(fraction: float | Fraction, digits: int = 1) -> str:
    """A fraction as "62.4 %"; one that is not quite 0 or 1 is never rounded to it: "< 0.1 %", "> 99.9 %"."""
    return f"{in_percent(fraction, digits)} %"


def in_percent(fraction: float | Fraction, digits: int = 1) -> str:
    """The same without the sign, for a column in percent; "" for NaN."""
    return "" if isnan(fraction) else inside(100 * _whole(fraction), 100, digits)


def inside(value: float | Fraction, most: int, digits: int, finest: int = 0) -> str:
    """A figure in 0 .. `most` as text: "62.4"; one that is not quite at an end is never rounded to it.

    Decimals are added, up to `finest`, until it differs from the end: "99.97"; then "> 99.9".

    Args:
        value: the figure.
        most: its largest value.
        digits: decimals.
        finest: most decimals.
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
    """The exact value of a number."""
    return number if isinstance(number, Fraction) else Fraction(float(number))


def _scaled(fraction: float | Fraction, digits: int) -> Fraction:
    """In units of the last decimal of its percentage, without possible rounding errors."""
    scaled = 100 * 10**digits * _whole(fraction)
    return Fraction(round(scaled)) if abs(scaled - round(scaled)) < Fraction(1, 10**6) else scaled


def floored(fraction: float | Fraction, digits: int = 1) -> str:
    """A lower bound on a share, in percent, rounded down."""
    if fraction >= 1:
        return "100 %"
    return f"{float(floor(_scaled(fraction, digits)) / Fraction(10**digits)):.{digits}f} %"


def ceiled(fraction: float | Fraction, digits: int = 2, unit: str = " %") -> str:
    """An upper bound on a share, in percent, rounded up; with more decimals rather than as 100.

    Args:
        fraction: the bound.
        digits: decimals.
        unit: "" for a column in percent.
    """
    bound = ceil(_scaled(fraction, digits)) / Fraction(10**digits)
    if fraction < 1 <= bound / 100 and digits < FINEST:
        return ceiled(fraction, digits + 1, unit)
    return ("100" if bound == 100 else f"{float(bound):.{digits}f}") + unit


def chance(p: float, digits: int = 3, unit: str = " %") -> str:
    """A given probability as "5 %", with this many significant digits, and more if these would give 100 %.

    Args:
        p: the probability.
        digits: significant digits.
        unit: as in `ceiled`.
    """
    shown = f"{100 * p:.{digits}g}"
    return chance(p, digits + 1, unit) if float(shown) >= 100 > 100 * p else shown + unit


# Duration of a step, where given: times in steps are then also shown, and accepted, in minutes; and the steps that a
# quarter turn costs.
#
# No plan, tally, hash or count depends on it (docs/spec.md, section 18).

STEP_SECONDS = Numbers(1e-6, 1e6, "seconds")
SPEEDS = Numbers(0, 1_000, "metres a second", above=True)
TURNS = Numbers(0, 1_000, "steps a quarter turn")
UNITS = {"h": 3600.0, "min": 60.0, "s": 1.0}
SPAN = re.compile(r"\s*".join(rf"(?:([0-9]{{1,9}}(?:\.[0-9]{{1,9}})?)\s*{unit})?" for unit in UNITS))
TIMES = "45min, 1h30min or 90s"
SPANS = f"steps, as 450, or a time, as {TIMES}"
WHOLE = 1e-12
"""Relative amount by which a quotient may lie below a whole number and count as it: rounding of floats."""
SHORT = 9.5
"""Seconds below which tenths are shown."""
HOW_TO_SAY = "the scenario's `step: {seconds: 2}` or `speed:` (m/s)"


def seconds_of(text: str) -> float | None:
    """Seconds of a time such as `1h30min`, `45 min` or `90s`, larger units first; None for other text."""
    found = SPAN.fullmatch(text.strip())
    if not found or not any(found.groups()):
        return None
    return sum(float(number) * unit for number, unit in zip(found.groups(), UNITS.values(), strict=True) if number)


@dataclass(frozen=True)
class Pace:
    """Duration of a step.

    Attributes:
        seconds: None: not given, times are shown in steps only.
        turn: steps per quarter turn.
    """

    seconds: float | None = None
    turn: float = 0.0

    def __bool__(self) -> bool:
        return self.seconds is not None

    @property
    def minutes(self) -> float:
        """Minutes per step; NaN if not given."""
        return math.nan if self.seconds is None else self.seconds / 60.0

    def also(self, steps: float) -> str:
        """Suffix of a time in steps: " (22 min 30 s)"; "" if the duration of a step is not given."""
        if self.seconds is None:
            return ""
        seconds = steps * self.seconds
        return f" ({seconds:.2g} s)" if seconds < SHORT else f" ({duration(seconds)})"

    @property
    def each(self) -> str:
        """Suffix of the name of an axis in steps: " (3 s each)"."""
        return "" if self.seconds is None else f" ({self.seconds:.3g} s each)"

    def step(self, step: float) -> str:
        """ "step 450 (22 min 30 s)"."""
        return f"step {round(step):,}{self.also(step)}"

    def steps(self, steps: float) -> str:
        """ "450 steps (22 min 30 s)"; for a mean the nearest whole number."""
        return f"{counted(round(steps), 'step')}{self.also(steps)}"

    def last_step(self, name: str, given: Any, source: str = "") -> Any:
        """The last step before a deadline, given as a step or a time; other values unchanged, for a later check.

        Args:
            name: of the argument, or of the key in `source`.
            given: its value.
            source: file, for messages.

        Raises:
            UsageError: the text is no time, or the duration of a step is not given.
        """
        if not isinstance(given, str):
            return given
        seconds, said = seconds_of(given), f"`{name}` is {given}" if source else argument(name, given)
        if seconds is None:
            raise UsageError(said, source=source, expected=SPANS)
        if self.seconds is None:
            options = "" if source else f"{argument('step_seconds')} or {argument('speed')}, or "
            fix = f"give {options}{HOW_TO_SAY}"
            problem = f"{said}, but the duration of a step is not given"
            raise UsageError(problem, source=source, expected="steps", fix=fix)
        return math.floor(seconds / self.seconds * (1 + WHOLE))


UNPACED = Pace()


def pace_of(step_seconds: Any, speed: Any, cell_size: float | None) -> Pace:
    """The pace from at most one of two arguments.

    Args:
        step_seconds: seconds per step, or None.
        speed: metres per second, or None.
        cell_size: metres; None: not given.

    Raises:
        UsageError: both are given, a value is out of range, or the cell size is missing.
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
        problem = f"{argument('speed', speed)}, but the cell size is not given"
        raise UsageError(problem, fix=f"give {argument('cell_size')}, or {argument('step_seconds')} instead")
    if not STEP_SECONDS.accepts(cell_size / speed):
        problem = f"{argument('speed', speed)} makes a step of {cell_size:g} m take {cell_size / speed:g} s"
        raise UsageError(problem, expected=STEP_SECONDS.expected)
    return Pace(cell_size / speed)
