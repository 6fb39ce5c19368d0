"""Who hears whom: robots in a chain of short enough links from a base (SPEC section 22)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from planner.settings import Settings

EPSILON = 1e-9
"""Squares of distances are whole numbers: a radius of 5 reaches (3, 4)."""


def reach_of(settings: Settings) -> int:
    """The largest squared distance of a link, in cells; `radio` is set."""
    assert settings.radio is not None
    return math.floor(settings.radio**2 + EPSILON)


def in_contact(places: NDArray[np.int64], bases: NDArray[np.int64], reach: int) -> NDArray[np.bool_]:
    """Which robots at `places` `[K, 2]`, (row, col), are in a chain from one of the `bases` `[B, 2]`, bool `[K]`."""

    def near(one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray((np.square(one[:, None] - other).sum(axis=-1) <= reach).any(axis=1))

    heard = near(places, bases)
    while (more := near(places, places[heard]) & ~heard).any():
        heard |= more
    return heard
