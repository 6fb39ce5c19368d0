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
    threat = world.threat.ravel().astype(np.float64)
    free = ~np.isnan(threat)
    positive, group, sizes = np.unique(threat[free & (threat > 0)], return_inverse=True, return_counts=True)
    quantised = len(positive) + 1 > most
    values = positive
    if quantised:
        bin_of_value = _equal_count_bins(sizes, most - 1)
        weight = np.bincount(bin_of_value, weights=sizes)
        values = np.bincount(bin_of_value, weights=sizes * positive)[weight > 0] / weight[weight > 0]
        group = (np.cumsum(weight > 0) - 1)[bin_of_value][group]
    of_cell = np.full(threat.size, NO_LEVEL, dtype=np.int64)
    of_cell[free] = 0
    of_cell[free & (threat > 0)] = group + 1
    of_cell[~accessible.ravel()] = NO_LEVEL
    used = np.unique(np.append(of_cell[of_cell > 0], 0))
    of_cell[of_cell >= 0] = np.searchsorted(used, of_cell[of_cell >= 0])
    all_values = np.concatenate([[0.0], values])
    return ThreatLevels(all_values[used], of_cell.astype(np.int16), quantised)


def _equal_count_bins(sizes: NDArray[np.int64], bins: int) -> NDArray[np.int64]:
    """Bin of each value (given in increasing order with its count): equal counts, equal values never split.

    A value goes where the middle of its cells falls.
    """
    middle = np.cumsum(sizes) - sizes / 2
    return np.minimum((middle * bins / sizes.sum()).astype(np.int64), bins - 1)
