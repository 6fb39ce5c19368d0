"""Threat levels (distinct probabilities, quantised if there are too many) and their entry costs (SPEC 1, 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from planner.arguments import check_word
from planner.errors import WorldError
from planner.simulator.codes import BLOCKED

NO_LEVEL = -1


@dataclass(frozen=True, eq=False)
class ThreatLevels:
    """Levels of the planner. Axis `N` = H * W cells.

    Attributes:
        values: float64 `[L]`, increasing, `values[0] = 0` (level 0 exists even if it is empty).
        of_cell: int16 `[N]`, level index of every accessible cell, NO_LEVEL elsewhere.
        quantised: True if several probabilities share a level; losses and formulas use each cell's own p.
    """

    values: NDArray[np.float64]
    of_cell: NDArray[np.int16]
    quantised: bool

    @property
    def accessible(self) -> NDArray[np.bool_]:
        """bool `[N]`: cells that some robot can reach."""
        return self.of_cell != NO_LEVEL


def find_levels(threat: NDArray[np.float32], accessible: NDArray[np.bool_], most: int) -> ThreatLevels:
    """Find the levels of a map.

    Args:
        threat: float32 `[H, W]`, NaN = obstacle.
        accessible: bool `[H, W]`, cells that count.
        most: levels, at most; `p = 0` counts and is always its own.

    Source: SPEC section 1.
    """
    values, (of_cell,), quantised = levels_of_maps(threat.reshape(1, -1), accessible.ravel(), most)
    return ThreatLevels(values, np.where(accessible.ravel(), of_cell, NO_LEVEL).astype(np.int16), quantised)


def levels_of_maps(
    threats: NDArray[np.float32], within: NDArray[np.bool_], most: int
) -> tuple[NDArray[np.float64], NDArray[np.int16], bool]:
    """Common levels of several maps of the same cells. Levels of no cell in `within` are omitted.

    Args:
        threats: float32 `[M, N]`.
        within: bool `[N]`.
        most: levels, at most.

    Returns:
        (values float64 `[L]`; level of every free cell of each map int16 `[M, N]`, NO_LEVEL for obstacles and omitted
        levels; whether levels are quantised).
    """
    threat = threats.astype(np.float64)
    free = ~np.isnan(threat)
    # Over all maps together, so that a level means the same p on each of them.
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
    # Level 0 is always used; levels of no cell are closed up.
    used = np.unique(np.append(of_cell[:, within][free[:, within]], 0))
    place = np.full(len(values) + 1, NO_LEVEL)
    place[used] = np.arange(len(used))
    of_cell[free] = place[of_cell[free]]
    return np.concatenate([[0.0], values])[used], of_cell.astype(np.int16), quantised


def _equal_count_bins(sizes: NDArray[np.int64], bins: int) -> NDArray[np.int64]:
    """Bin of each value: equal counts, equal values never split. A value belongs to the bin of its middle cell.

    Args:
        sizes: int64, counts of the values in increasing order.
        bins: number of bins.
    """
    middle = np.cumsum(sizes) - sizes / 2
    return np.minimum((middle * bins / sizes.sum()).astype(np.int64), bins - 1)


# Eq. (3) with whole-number entry costs of safest paths (SPEC section 3), and the world as a NetworkX graph.


def entry_costs(levels: ThreatLevels, risk: Literal["paper", "log"], source: str = "") -> NDArray[np.int64]:
    """Entry cost of each cell: eq. (3) times n, rounded.

    Args:
        levels: of the map.
        risk: "paper" or "log".
        source: for messages.

    Returns:
        int64 `[N]`, BLOCKED for cells that are not accessible.

    Raises:
        WorldError: the sum over all cells, which bounds all paths, might not fit in 62 bits.

    Source: paper, eq. (3); SPEC section 3.
    """
    of_level = level_costs(levels.values, levels.of_cell.size, risk)
    counts = np.bincount(levels.of_cell[levels.accessible], minlength=len(of_level))
    # No path can cost more than the sum of all cells.
    if float(of_level @ counts) >= 2.0**62:
        raise WorldError(
            f"threat levels from {levels.values[1]:g} to {levels.values[-1]:g} make path costs too large for 64 bits",
            source=source,
            expected="a ratio of the largest to the smallest threat below about 2**62 / cells**2",
            fix="raise the smallest threats or set them to 0",
        )
    costs = of_level.astype(np.int64)[np.maximum(levels.of_cell, 0)]
    return np.where(levels.accessible, costs, BLOCKED)


def level_costs(values: NDArray[np.float64], n: int, risk: Literal["paper", "log"]) -> NDArray[np.float64]:
    """Entry cost of a cell of each level, whole numbers.

    Safe 1; dangerous `floor(n * p / p_min + 0.5)`, or for `risk="log"` with log(1 - p) in place of p.

    Args:
        values: float64 `[L]`.
        n: cells of the map.
        risk: "paper" or "log".

    Source: paper, eq. (3); SPEC section 3.
    """
    check_word("risk", risk, ("paper", "log"))
    of_level = np.ones(len(values), dtype=np.float64)
    if len(values) > 1:
        hazard = values[1:] if risk == "paper" else np.log1p(-values[1:])
        of_level[1:] = np.floor(n * hazard / hazard[0] + 0.5)
    return of_level
