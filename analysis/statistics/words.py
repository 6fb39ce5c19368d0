"""Figures as far as their intervals allow: how many digits, how an interval is rounded, what is almost none."""

from __future__ import annotations

from math import ceil, floor, isfinite, log10

from planner.shown import NOTHING, inside

MOST_DIGITS = 4
"""Decimals that tell a sampled figure apart from none and all."""


def digits_of(half: float) -> int:
    """The fewest decimals with which a figure, rounded, stays within `half` of itself: what its interval allows."""
    return max(0, ceil(-log10(2.0 * half) - 1e-9))


def between(low: float, high: float, digits: int = 2, most: float | None = None, less: str = "less") -> str:
    """An interval as "85.60 .. 85.76", rounded outwards; "" where nothing is known.

    Of a figure in 0 .. `most`: "0.40 or less" (or "fewer") where it begins at 0, "99.60 or more" where it ends at
    `most`.
    """
    if not (isfinite(low) and isfinite(high)):
        return ""
    ends = (floor(low * 10**digits + 1e-6), ceil(high * 10**digits - 1e-6))
    down, up = (f"{end / 10**digits:,.{digits}f}" for end in ends)
    lowest, highest = low == 0, most is not None and abs(high - most) <= NOTHING * most
    if most is not None and (lowest or highest):
        return f"0 .. {most:g}" if lowest and highest else f"{up} or {less}" if lowest else f"{down} or more"
    return f"{down} .. {up}"


def in_unit(interval: str, unit: str = " %") -> str:
    """An interval as of `between` with its unit: "99.5 % or more", "56.4 .. 56.6 %"; as it is where it is none."""
    if interval in ("", "exact"):
        return interval
    ends, comma, how = interval.partition(", ")
    ends, word, rest = ends.partition(" or ")
    return f"{ends}{unit}{word}{rest}{comma}{how}"


def lost_words(mean: float, robots: int, digits: int = 2) -> str:
    """A mean number of robots lost: "1.87 of 5", "all 5"; what is not quite none or all of them is never said to be.

    One decimal at least, two where fewer would say none or all; "almost" what two decimals cannot tell apart.
    """
    all_of_them = {1: "the robot", 2: "both robots"}.get(robots, f"all {robots}")
    if mean in (0, robots):
        return all_of_them if mean else f"none of {robots}"
    if min(near := round(mean, 2), robots - near) <= 0:
        return f"almost {'always ' * (robots == 1)}{all_of_them}" if near else f"almost none of {robots}"
    return f"{of_all(mean, robots, digits)} of {robots}"


def robots_words(mean: float, robots: int, digits: int = 2) -> str:
    """`lost_words` with what they count: "no robot", "both robots", "all 5 robots", "1.87 of 5 robots"."""
    words = lost_words(mean, robots, digits) if mean else "no robot"
    return words if words.endswith(("robot", "robots")) else f"{words} robot{'s' * (robots != 1)}"


def of_all(mean: float, robots: int, digits: int = 2) -> str:
    """A mean number of so many robots in figures: "1.87", "> 4.99"; one decimal at least, two where few would lie."""
    return inside(mean, robots, max(digits, 1), 2)
