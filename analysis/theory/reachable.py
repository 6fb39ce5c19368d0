"""Which cells a range leaves within a team's moves, whatever it does: what bounds for every strategy may leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from planner.mrac.costs import neighbour_table
from planner.none import NO_CELL
from planner.plans.plan import Plan
from planner.worlds.world import World


def moves_left(plan: Plan) -> list[int] | None:
    """Of each robot, -1 of one that is lost; None: without end. Of robots that are recharged: with a full battery."""
    limit = None if plan.settings is None else plan.settings.range
    if limit is None:
        return None
    moves = list(limit) if isinstance(limit, tuple) else [limit] * len(plan.robots)
    if plan.state is None:
        return moves
    return [most - robot.moves if robot.alive else -1 for most, robot in zip(moves, plan.state.robots, strict=True)]


def within(world: World, plan: Plan) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells that some robot alive could enter with the moves that it has left, were there no danger.

    A robot that comes home must also be able to go from the cell to one of its bases: the fewest moves there and the
    fewest moves back are together at most its moves. Of robots that are recharged: from its start or from any base that
    it can go to.
    """
    moves, settings = moves_left(plan), plan.settings
    if moves is None or settings is None:
        return world.accessible(plan.starts)
    width, steps = world.shape[1], _graph(world)
    found = np.zeros(world.threat.size, dtype=bool)
    starts = (plan.starts @ (width, 1)).tolist()
    bases = [()] * len(starts) if settings.return_to is None else _bases(plan, settings.return_to, width)
    for start, most, own in sorted(set(zip(starts, moves, bases, strict=True))):
        if most >= 0:
            found |= _visitable(steps, start, most, own, recharged=settings.recharge is not None)
    return found.reshape(world.shape)


def _visitable(
    steps: csr_array, start: int, most: int, bases: tuple[int, ...], *, recharged: bool
) -> NDArray[np.bool_]:
    """bool `[N]`: cells that a robot with so many moves can visit. `bases`: to one of which it comes home, if any."""
    back = _moves(steps, bases) if bases else np.zeros(steps.shape[0])
    if back[start] > most:  # of a mission under way: it comes home no more, wherever it turns
        back[:] = 0
    reached = np.array([start])
    while True:
        found = np.asarray(_moves(steps, reached) + back <= most)
        full = np.union1d([start], [base for base in bases if found[base]]).astype(np.int64)
        if not recharged or np.array_equal(full, reached):
            return found
        reached = full


def _bases(plan: Plan, return_to: str | tuple[tuple[int, int], ...], width: int) -> list[tuple[int, ...]]:
    """The cells of each robot's bases."""
    homes = (plan.starts @ (width, 1)) if plan.state is None else plan.state.homes(return_to)
    assert homes is not None
    if return_to == "home":
        return [(home,) for home in homes.tolist()]
    shared = np.unique(homes) if isinstance(return_to, str) else np.unique(np.array(return_to) @ (width, 1))
    return [tuple(shared.tolist())] * len(homes)


def _graph(world: World) -> csr_array:
    """The moves between free cells, `[N, N]`."""
    near = neighbour_table(world.shape, world.free.ravel())
    source, side = np.nonzero(near != NO_CELL)
    free = world.free.ravel()[source]
    source, target = source[free], near[source, side][free]
    return csr_array((np.ones(len(source)), (source, target)), shape=(world.threat.size, world.threat.size))


def _moves(steps: csr_array, cells: NDArray[np.int64] | tuple[int, ...]) -> NDArray[np.float64]:
    """float64 `[N]`: the fewest moves from the nearest of these cells to each, and so of the way back; inf: none."""
    return np.asarray(dijkstra(steps, unweighted=True, indices=np.array(cells), min_only=True))


def trimmed(world: World, plan: Plan) -> World:
    """`world` with obstacles where no robot has the moves to go: a bound for every strategy there is one here too."""
    if moves_left(plan) is None:
        return world
    return replace(world, threat=np.where(within(world, plan), world.threat, np.float32(np.nan)))
