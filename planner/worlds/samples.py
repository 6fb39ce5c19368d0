"""Samples of a survey, spread over the cells of a map: by inverse distances, or by ordinary kriging."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import KDTree

from planner.arguments import Numbers, whole
from planner.worlds.keys import Key
from planner.worlds.quantities import FARTHEST

KINDS = ("idw", "kriging")
MOST_KRIGED = 2**11
"""Samples that are kriged together: the cost grows with their cube."""
POWER, NEIGHBOURS = 2.0, 12
"""Of inverse distances, where nobody says otherwise."""


def interpolated(key: Key, samples: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Values at `places` (x, y) `[m, 2]`, float64 `[m]`, from samples (x, y, value) `[n, 3]`, as `key` says.

    idw: the mean of the nearest `neighbours`, weighted by distance ** -power; a place with a sample has its value.
    kriging: ordinary, with a linear variogram, in which a sample's own error is worth `nugget` metres of distance. No
    value leaves the range of the samples, of which those at one place count as one, their mean. Raises ScenarioError.
    """
    kind = key.mapping(("kind",), optional=("power", "neighbours", "nugget"))["kind"].choice(KINDS)
    at, which = np.unique(samples[:, :2], axis=0, return_inverse=True)
    values = np.bincount(which.reshape(-1), samples[:, 2]) / np.bincount(which.reshape(-1))
    if kind == "idw":
        keys = key.mapping(("kind",), defaults={"power": POWER, "neighbours": NEIGHBOURS})
        power = keys["power"].number(Numbers(0, 16, above=True))
        return _by_distance(at, values, places, power, keys["neighbours"].number(whole(1, 256)))
    nugget = key.mapping(("kind",), defaults={"nugget": 0.0})["nugget"].number(Numbers(0, FARTHEST, "metres"))
    if len(at) > MOST_KRIGED:
        raise key.wrong(f"idw: {len(at)} samples, and kriging is for up to {MOST_KRIGED}", "or thin the samples out")
    try:
        found = RBFInterpolator(at, values, smoothing=nugget, kernel="linear", degree=0)(places)
    except np.linalg.LinAlgError:
        raise key.wrong("a nugget, or idw: samples lie too near each other") from None
    return np.clip(found, values.min(), values.max())


def _by_distance(
    at: NDArray[np.float64], values: NDArray[np.float64], places: NDArray[np.float64], power: float, near: int
) -> NDArray[np.float64]:
    near = min(near, len(at))
    distance, index = (found.reshape(-1, near) for found in KDTree(at).query(places, k=near))
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = (distance[:, :1] / distance) ** power  # of the nearest: 1, so that nothing overflows
    weight = np.where(distance[:, :1] == 0, distance == 0, weight)
    return (weight * values[index]).sum(axis=1) / weight.sum(axis=1)


def farthest(samples: NDArray[np.float64], places: NDArray[np.float64]) -> float:
    """Metres from the place that is farthest from all samples to the nearest of them."""
    return float(KDTree(samples[:, :2]).query(places)[0].max())
