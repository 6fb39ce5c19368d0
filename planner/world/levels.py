"""Threat levels (distinct probabilities, quantised if there are too many), start rules, entry costs (SPEC 1, 3, 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import argument, check_word, did_you_mean, whole
from planner.errors import UsageError, WorldError
from planner.formatting import counted
from planner.simulator.codes import BLOCKED, NO_CELL
from planner.world.uncertain_maps import Hazard, Uncertain
from planner.world.world import MAX_ROBOTS, World, check_starts

if TYPE_CHECKING:
    import networkx as nx

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


def find_levels(world: World, accessible: NDArray[np.bool_], most: int) -> ThreatLevels:
    """Find the levels of a world.

    Args:
        world: the map.
        accessible: bool `[H, W]`, cells that count.
        most: levels, at most; `p = 0` counts and is always its own.

    Source: SPEC section 1.
    """
    values, (of_cell,), quantised = levels_of_maps(world.threat.reshape(1, -1), accessible.ravel(), most)
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


# Start rule `upper-left` (SPEC section 8), for inputs without starts.

RULES = ("upper-left",)
"""Start rules by name."""


def check_robots(robots: int | None) -> None:
    """Check a user's number of robots; None is valid.

    Raises:
        UsageError: it is out of range.
    """
    whole(1, MAX_ROBOTS).check("robots", robots, optional=True)


def check_same_team(robots: int | None, starts: NDArray[np.int64], where: str) -> None:
    """Check that a user's number of robots agrees with starts.

    Args:
        robots: or None.
        starts: int64 `[K, 2]`.
        where: source of the starts, for the message.

    Raises:
        UsageError: they contradict each other.
    """
    check_robots(robots)
    if robots is not None and robots != len(starts):
        raise UsageError(
            f"{argument('robots', robots)} contradicts the {counted(len(starts), 'start')} of {where}",
            fix=f"leave {argument('robots')} out, or give as many {argument('starts')}",
        )


def starts_of(world: World, robots: int | None, starts: ArrayLike | None) -> NDArray[np.int64]:
    """Starts for a user's request.

    Args:
        world: the map.
        robots: number of robots, or None.
        starts: `[K, 2]`, or None.

    Returns:
        int64 `[K, 2]`: the given starts; else the world's own, if `robots` agrees; else by the start rule, by default
        for one robot.

    Raises:
        UsageError, WorldError: an invalid or contradictory request.
    """
    check_robots(robots)
    if starts is not None:
        placed = check_starts(starts, world.met, argument("starts"))
        check_same_team(robots, placed, argument("starts"))
        return placed
    if world.starts is not None and robots in (None, len(world.starts)):
        return world.starts
    return place_starts(world, world.team.robots or 1 if robots is None else robots, world.team.start)[0]


def place_starts(world: World, robots: int, rule: str = "upper-left") -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Place robots by a start rule.

    In the largest free component (on a tie that with the lowest cell index) the first start is the safe cell of least
    row + col (then index). From it a breadth-first search through free cells gives the safe cells by (distance, index),
    one robot each, and from the first again if there are fewer cells than robots. Without a safe cell in the component:
    the same over its cells of least p, with a note. Cost: O(cells).

    Args:
        world: the map.
        robots: K.
        rule: name of the rule.

    Returns:
        (starts int64 `[K, 2]`, notes).

    Raises:
        UsageError: an invalid number or rule.

    Source: SPEC section 8.
    """
    check_robots(robots)
    if rule not in RULES:
        raise UsageError(f"start rule {rule!r}", expected=" or ".join(RULES), fix=did_you_mean(rule, RULES))
    component = _largest_component(world)
    wanted = component & (world.met == 0)
    notes: tuple[str, ...] = ()
    if not wanted.any():
        least = world.met[component].min()
        wanted = component & (world.met == least)
        notes = (f"no safe cell in the largest free part of the map: robots start on cells of least threat {least:g}",)
    rows, cols = np.nonzero(wanted)
    first = np.argmin(rows + cols)
    order = _breadth_first(component, int(rows[first]) * world.shape[1] + int(cols[first]), wanted, robots)
    starts = order[np.arange(robots) % len(order)]
    return np.stack(np.divmod(starts, world.shape[1]), axis=1), notes


def _largest_component(world: World) -> NDArray[np.bool_]:
    labels = world.components
    names, lowest, sizes = np.unique(labels[labels > 0], return_index=True, return_counts=True)
    # On a tie the component with the lowest cell: the same on every platform.
    best = np.lexsort((lowest, -sizes))[0]
    return labels == names[best]


def _breadth_first(free: NDArray[np.bool_], source: int, wanted: NDArray[np.bool_], enough: int) -> NDArray[np.int64]:
    """The wanted cells by (distance from `source`, index), int64; at least `enough` unless there are fewer."""
    width = free.shape[1] + 2  # a closed border on every side
    framed = np.zeros((2, len(free) + 2, width), dtype=np.bool_)
    framed[:, 1:-1, 1:-1] = free, wanted
    unseen, padded_wanted = framed.reshape(2, -1)
    layer = np.array([(source // free.shape[1] + 1) * width + source % free.shape[1] + 1])
    unseen[layer] = False
    found: list[NDArray[np.int64]] = []
    count = 0
    while len(layer) and count < enough:
        found.append(layer[padded_wanted[layer]])
        count += len(found[-1])
        near = np.unique(np.concatenate([layer - width, layer - 1, layer + 1, layer + width]))
        layer = near[unseen[near]]
        unseen[layer] = False
    cells = np.concatenate(found)
    return (cells // width - 1) * free.shape[1] + cells % width - 1


# Features that exclude each other (SPEC sections 13, 15, 16, 22).


def require_single_uncertainty(
    world: World, what: str, over: type[Hazard | Uncertain] | None = None, or_else: str = ""
) -> None:
    """Check that a feature is the only uncertainty of a world.

    Args:
        world: the map.
        what: name of the feature.
        over: kind of uncertainty that it replaces.
        or_else: further text of the fix.

    Raises:
        WorldError: the world has another uncertainty, or robot types.
    """
    uncertainty = None if over is not None and isinstance(world.uncertainty, over) else world.uncertainty
    for other in (uncertainty, world.knowledge):
        if other is not None:
            problem, fix = (
                f"`{what}` together with another uncertainty: {other.description}",
                "leave one of the two out",
            )
            raise WorldError(problem, source=world.source, expected="one known map", fix=fix + or_else)
    if world.types is not None:
        problem, fix = f"`{what}` together with {world.types.description}", "leave one of the two out"
        raise WorldError(problem, source=world.source, expected="one known map for all robots", fix=fix)


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


# The world as a NetworkX graph, for users and as the reference for the cost tables.


def to_networkx(world: World) -> nx.DiGraph:
    """`World.to_networkx`."""
    import networkx as nx

    # Imported here: only this function needs the searches, and NetworkX is slow to load.
    from planner.simulator.searches import neighbour_table

    levels = find_levels(world, world.free, most=world.threat.size + 1)
    costs, threat = entry_costs(levels, "paper"), world.threat.ravel()
    free = np.flatnonzero(world.free.ravel())
    name = {int(cell): divmod(int(cell), world.shape[1]) for cell in free}
    points = world.to_xy(free)
    graph = nx.DiGraph(shape=world.shape, cell_size=world.cell_size, origin=world.origin)
    for cell, (x, y) in zip(free.tolist(), points.tolist(), strict=True):
        graph.add_node(name[cell], threat=float(threat[cell]), pos=(x, y))
    for side in neighbour_table(world.shape, world.free.ravel()).T:
        for cell in free[side[free] != NO_CELL].tolist():
            entered = int(side[cell])
            hazard = float(-np.log1p(-np.float64(threat[entered])))
            graph.add_edge(name[cell], name[entered], cost=int(costs[entered]), hazard=hazard)
    return graph
