"""Runs to be played over a map of the page: every robot's moves, a byte each, deflated.

The script unfolds them (`replay.js`): where each robot is at a step, and what is covered until then.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.pictures.robots import lane
from planner.files import Json
from planner.pace import UNPACED, Pace

MOST_LETTERS = 600_000
"""Of all runs together in the page; runs beyond it are left out, the last first."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run of a team of `K` robots in `T - 1` steps.

    Attributes:
        name: on its button. cells: int32 `[T, K]`, cell (row * W + col) of each robot at the end of each step.
        lost: int64 `[K]`, the step at which each robot was stopped; NO_STEP.
        movers: int64 `[T, M]`, cells of the threats that move; None where they are not told.
        seen: int32 `[N]`, the step at which each cell is first seen, NO_STEP if never; None where robots know the map.
    """

    name: str
    cells: NDArray[np.int32]
    lost: NDArray[np.int64]
    movers: NDArray[np.int64] | None = None
    seen: NDArray[np.int32] | None = None


def packed_runs(runs: Sequence[Run], accessible: NDArray[np.bool_], pace: Pace = UNPACED) -> Json:
    """What the script plays, inert; `accessible`: bool `[H, W]`. Nothing where not even the first run has room."""
    packed, letters = [], 0
    for run in runs:
        told = pack(run, accessible.shape[1])
        letters += sum(map(len, told["moves"] + told.get("movers", {"moves": []})["moves"])) + len(told.get("seen", ""))
        if letters > MOST_LETTERS:
            break
        packed.append(told)
    if not packed:
        return {}
    robots = runs[0].cells.shape[1]
    shifts = [round(lane(robot, robots), 3) for robot in range(robots)]
    told = {"shape": accessible.shape, "accessible": int(accessible.sum()), "shifts": shifts, "runs": packed}
    return told | ({"seconds": pace.seconds} if pace else {})


def pack(run: Run, width: int) -> Json:
    """A run as JSON: starts, losses, and the codes of each robot's moves until it is stopped or stays for good.

    A code is 0 (stay), 1 (up), 2 (down), 3 (left) or 4 (right). Raises ValueError for a robot that jumps.
    """
    told: Json = {} if run.seen is None else {"seen": _deflated(run.seen)}
    if run.movers is not None:
        told["movers"] = {"starts": run.movers[0].tolist(), "moves": moves_of(run.movers, width)}
    return told | {
        "name": run.name,
        "time": len(run.cells) - 1,
        "starts": run.cells[0].tolist(),
        "lost": run.lost.tolist(),
        "moves": moves_of(run.cells, width),
    }


def moves_of(cells: NDArray[np.integer], width: int) -> list[str]:
    """The codes of each way, a column of `cells` `[T, K]`, until it stays for good."""
    steps = np.diff(cells, axis=0)
    codes = np.zeros(steps.shape, dtype=np.uint8)
    for code, step in ((4, 1), (3, -1), (2, width), (1, -width)):  # a map of one column has up and down alone
        codes[steps == step] = code
    if ((codes == 0) & (steps != 0)).any():
        raise ValueError("a way does not lead from cell to cell")
    moves = []
    for way in codes.T:
        until = int(np.flatnonzero(way)[-1]) + 1 if way.any() else 0
        moves.append(_deflated(way[:until]))
    return moves


def _deflated(values: NDArray) -> str:
    return base64.b64encode(zlib.compress(values.astype(values.dtype.newbyteorder("<")).tobytes(), 9)).decode()
