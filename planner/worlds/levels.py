"""Threat levels: the distinct probabilities of a map, quantised when there are too many (SPEC section 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planner.worlds.world import World

NO_LEVEL = -1


@dataclass(frozen=True, eq=False)
class ThreatLevels:
    """The levels that the planner sees. Axis `N` = H * W cells.

    Attributes:
        values: float64 `[L]`, increasing, `values[0] = 0` (level 0 exists even when it is empty).
        of_cell: int16 `[N]`, level index of every accessible cell, NO_LEVEL elsewhere.
        quantised: True if several probabilities share a level; stops and formulas keep each cell's own p.
    """

    values: NDArray[np.float64]
    of_cell: NDArray[np.int16]
    quantised: bool

    @property
    def accessible(self) -> NDArray[np.bool_]:
        """bool `[N]`: cells that some robot can reach."""
        return self.of_cell != NO_LEVEL


def find_levels(world: World, accessible: NDArray[np.bool_], most: int) -> ThreatLevels:
    """The levels of the accessible cells `[H, W]`; at most `most`, `p = 0` counted and always its own."""
    values, (of_cell,), quantised = levels_of_maps(world.threat.reshape(1, -1), accessible.ravel(), most)
    return ThreatLevels(values, np.where(accessible.ravel(), of_cell, NO_LEVEL).astype(np.int16), quantised)


def levels_of_maps(
    threats: NDArray[np.float32], within: NDArray[np.bool_], most: int
) -> tuple[NDArray[np.float64], NDArray[np.int16], bool]:
    """The levels of several maps `[M, N]` of the same cells together, on one scale; those of no cell `within` left out.

    Returns their values `[L]`, the level of every free cell of each map `[M, N]` (NO_LEVEL: an obstacle, or a level
    left out), and whether they are quantised.
    """
    threat = threats.astype(np.float64)
    free = ~np.isnan(threat)
    positive, group, sizes = np.unique(threat[free & (threat > 0)], return_inverse=True, return_counts=True)
    quantised = len(positive) + 1 > most
    values = positive
    if quantised:
        bin_of_value = _equal_count_bins(sizes, most - 1)
        weight = np.bincount(bin_of_value, weights=sizes)
        values = np.bincount(bin_of_value, weights=sizes * positive)[weight > 0] / weight[weight > 0]
        group = (np.cumsum(weight > 0) - 1)[bin_of_value][group]
    of_cell = np.full(threat.shape, NO_LEVEL, dtype=np.int64)
    of_cell[free] = 0
    of_cell[free & (threat > 0)] = group + 1
    used = np.unique(np.append(of_cell[:, within][free[:, within]], 0))
    place = np.full(len(values) + 1, NO_LEVEL)
    place[used] = np.arange(len(used))
    of_cell[free] = place[of_cell[free]]
    return np.concatenate([[0.0], values])[used], of_cell.astype(np.int16), quantised


def _equal_count_bins(sizes: NDArray[np.int64], bins: int) -> NDArray[np.int64]:
    """Bin of each value (given in increasing order with its count): equal counts, equal values never split.

    A value goes where the middle of its cells falls.
    """
    middle = np.cumsum(sizes) - sizes / 2
    return np.minimum((middle * bins / sizes.sum()).astype(np.int64), bins - 1)
