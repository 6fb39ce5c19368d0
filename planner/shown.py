"""How an object shows itself in a console and in a notebook: a title, rows of a name and what it is; and counts,
times, shares."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from html import escape
from math import ceil, floor, isnan

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
