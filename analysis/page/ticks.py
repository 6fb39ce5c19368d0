"""Where axes are labelled, and how numbers on them are written."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def nice_step(rough: float) -> float:
    """The least of 1, 2, 5 times a power of ten that is at least `rough` (> 0)."""
    power = 10.0 ** math.floor(math.log10(rough))
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * (1 - 1e-9))


def ticks(low: float, high: float, most: int = 6, whole: bool = False) -> NDArray[np.floating]:
    """At most about `most` round numbers in `low .. high`; whole ones if asked."""
    step = nice_step(max(high - low, 1e-12) / max(most, 1))
    if whole:
        step = max(step, 1.0)
    first = math.ceil(low / step - 1e-9)
    return np.arange(first, math.floor(high / step + 1e-9) + 1) * step


def label(value: float, step: float) -> str:
    """A tick's number, with the digits that its step needs: "20", "0.25", "1,500"."""
    digits = max(0, -math.floor(math.log10(step) + 1e-9)) if step > 0 else 0
    return f"{value + 0.0:,.{min(digits, 9)}f}"
