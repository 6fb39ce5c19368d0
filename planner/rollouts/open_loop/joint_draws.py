"""What is drawn of robots that share what is true: their dangerous entries in the order in which they are made.

Where hazards are there or not, or the map is one of several (`planner.worlds.doubt`), robots of one rollout are not
independent, so there is no inverse survival; and what one of them hits may be gone for the next. NumPy only.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from planner.bearing import Bearing
from planner.rollouts.open_loop.entries import Entries
from planner.rollouts.open_loop.groups import Groups
from planner.threefry import ROBOT_STRIDE
from planner.worlds.doubt import Draws

Exposures = tuple[NDArray[np.int64], NDArray[np.int64]]
"""`planner.worlds.world.World.exposures`."""


class JointDraws(NamedTuple):
    """Dangerous entries of all robots by (step, robot). Axis `E`; the others as in `planner.worlds.doubt.Draws`.

    Attributes:
        slot: int32 `[E]`, the robot's slot. place: int32 `[E]`, how many dangerous entries it made before.
        counter: uint32 `[E]`, counter word of the visit. own_counter, there, bound, column: `[E]`, of the cell.
        spot: int32 `[E]`, number of the cell among those entered. table: uint32 `[M, C]`.
        exposure: int64 `[E]`, what the visit adds; doses: int64 `[M, C]`, if the map is one of several. Empty: luck is
            by step. robot: uint32 `[S]`, of each slot, whose tolerance it is.
        nodes, times: what robots bear (`planner.bearing`): `wear_nodes`, and int64 `[S]`, susceptibilities.
        last: int32 `[S]`, the outcome of a slot that nothing stops.
        spots: cells that are kept for each rollout: 0 unless the first hit makes a cell harmless.
    """

    slot: NDArray[np.int32]
    place: NDArray[np.int32]
    counter: NDArray[np.uint32]
    own_counter: NDArray[np.uint32]
    there: NDArray[np.uint32]
    bound: NDArray[np.uint32]
    column: NDArray[np.int32]
    spot: NDArray[np.int32]
    table: NDArray[np.uint32]
    exposure: NDArray[np.int64]
    doses: NDArray[np.int64]
    robot: NDArray[np.uint32]
    nodes: NDArray[np.int64]
    times: NDArray[np.int64]
    last: NDArray[np.int32]
    spots: int


def joint_draws(
    draws: Draws, exposures: Exposures | None, entries: Entries, groups: Groups, bearing: Bearing
) -> JointDraws:
    """The draws of the dangerous ones among the entries; `exposures`: of the world, where luck is by tolerance."""
    exposure, doses = exposures or (np.zeros(0, dtype=np.int64), np.zeros((0, 0), dtype=np.int64))
    robot, step, cell = (one[entries.dangerous] for one in (entries.robot, entries.step, entries.cell))
    slot_of = groups.slot_of
    many = np.bincount(robot, minlength=len(slot_of))
    place = np.arange(len(robot)) - np.repeat(np.cumsum(many) - many, many)
    last = np.zeros(len(groups.slot_robot), dtype=np.int32)
    last[slot_of] = many
    order = np.lexsort((robot, step))
    robot, step, cell = robot[order], step[order], cell[order]
    entered, spot = np.unique(cell, return_inverse=True)
    return JointDraws(
        slot=slot_of[robot].astype(np.int32),
        place=place[order].astype(np.int32),
        counter=(step * ROBOT_STRIDE + robot).astype(np.uint32),
        own_counter=draws.counter[cell],
        there=draws.there[cell],
        bound=draws.bound[cell],
        column=draws.column[cell],
        spot=spot.astype(np.int32),
        table=draws.table,
        exposure=exposure[cell] if len(exposure) else exposure,
        doses=doses,
        robot=np.maximum(groups.slot_robot, 0).astype(np.uint32),
        nodes=bearing.nodes,
        times=bearing.times(len(slot_of))[np.maximum(groups.slot_robot, 0)],
        last=last,
        spots=len(entered) if draws.spends else 0,
    )
