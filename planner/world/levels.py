"""Threat levels: the distinct probabilities of a map, quantised when there are too many (SPEC section 1)."""

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


# Where the robots start when nobody says so: the rule `upper-left` (SPEC section 8).

RULES = ("upper-left",)
"""Start rules by name."""


def check_robots(robots: int | None) -> None:
    """Raise UsageError for a number of robots, as asked for by a user, that is none; None: nothing is asked."""
    whole(1, MAX_ROBOTS).check("robots", robots, optional=True)


def check_same_team(robots: int | None, starts: NDArray[np.int64], where: str) -> None:
    """Raise UsageError if so many robots, as asked for by a user, contradict the starts `[K, 2]` that `where` names."""
    check_robots(robots)
    if robots is not None and robots != len(starts):
        raise UsageError(
            f"{argument('robots', robots)} contradicts the {counted(len(starts), 'start')} of {where}",
            fix=f"leave {argument('robots')} out, or give as many {argument('starts')}",
        )


def starts_of(world: World, robots: int | None, starts: ArrayLike | None) -> NDArray[np.int64]:
    """Starts int64 `[K, 2]` of what a user asked for: if nothing, or as many as it has, the world's own, else one."""
    check_robots(robots)
    if starts is not None:
        placed = check_starts(starts, world.met, argument("starts"))
        check_same_team(robots, placed, argument("starts"))
        return placed
    if world.starts is not None and robots in (None, len(world.starts)):
        return world.starts
    return place_starts(world, world.team.robots or 1 if robots is None else robots, world.team.start)[0]


def place_starts(world: World, robots: int, rule: str = "upper-left") -> tuple[NDArray[np.int64], tuple[str, ...]]:
    """Starts (row, col), int64 `[K, 2]`, and notes.

    In the largest free component (of equal ones, that with the lowest cell index) the safe cell of least row + col
    (then index); from it breadth-first through free cells by (distance, index): the safe cells among them, one robot
    each, and from the first again when there are fewer than robots. Without a safe cell in that component: the same
    order over its cells of least p, with a note. Cost O(cells). Raises UsageError for a count or rule that is none.
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
    best = np.lexsort((lowest, -sizes))[0]
    return labels == names[best]


def _breadth_first(free: NDArray[np.bool_], source: int, wanted: NDArray[np.bool_], enough: int) -> NDArray[np.int64]:
    """The wanted cells in order of (distance from `source`, index), int64; at least `enough` unless there are fewer."""
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


# What else stops robots, beside which nothing can be said of a map (SPEC sections 13, 15, 16, 22).


def check_alone(world: World, what: str, over: type[Hazard | Uncertain] | None = None, or_else: str = "") -> None:
    """Raise WorldError for `what` beside another thing that is not known, or beside types of robots.

    `over`: the kind of doubt that it takes the place of. `or_else`: what else may be done, in words.
    """
    doubt = None if over is not None and isinstance(world.doubt, over) else world.doubt
    for other in (doubt, world.knowledge):
        if other is not None:
            problem, fix = f"`{what}` beside another thing that is not known: {other.said}", "leave one of the two out"
            raise WorldError(problem, source=world.source, expected="one known map", fix=fix + or_else)
    if world.types is not None:
        problem, fix = f"`{what}` beside {world.types.said}", "leave one of the two out"
        raise WorldError(problem, source=world.source, expected="one known map for all robots", fix=fix)


# Eq. (3) made exact: whole-number entry costs of safest paths (SPEC section 3), and the world as a NetworkX graph.


def entry_costs(levels: ThreatLevels, risk: Literal["paper", "log"], source: str = "") -> NDArray[np.int64]:
    """Cost of entering each cell, int64 `[N]`, BLOCKED where not accessible (eq. (3) times n, rounded).

    Raises WorldError, of `source`, if the sum over all cells, which no path can exceed, might not fit in 62 bits.
    """
    of_level = level_costs(levels.values, levels.of_cell.size, risk)
    counts = np.bincount(levels.of_cell[levels.accessible], minlength=len(of_level))
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
    """Cost of entering a cell of each level `[L]`, whole numbers.

    Safe 1; dangerous `floor(n * p / p_min + 0.5)`, or with logarithms of survival for `risk="log"`.
    """
    check_word("risk", risk, ("paper", "log"))
    of_level = np.ones(len(values), dtype=np.float64)
    if len(values) > 1:
        hazard = values[1:] if risk == "paper" else np.log1p(-values[1:])
        of_level[1:] = np.floor(n * hazard / hazard[0] + 0.5)
    return of_level


# The world as a NetworkX graph, for people who go on from there and as the reference for the cost tables.


def to_networkx(world: World) -> nx.DiGraph:
    """`World.to_networkx`."""
    import networkx as nx

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
