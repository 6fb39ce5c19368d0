"""Figures as far as their intervals allow: how many digits, how an interval is rounded, what is almost none."""

from __future__ import annotations

from math import ceil, floor, isfinite, log10


def digits_of(half: float) -> int:
    """The fewest decimals with which a figure, rounded, stays within `half` of itself: what its interval allows."""
    return max(0, ceil(-log10(2.0 * half) - 1e-9))


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
        return f"almost {'always ' * (robots == 1)}{all_of_them}" if near else f"almost none of {robots}"
    return f"{mean:.{digits}f} of {robots}"
