"""The planned paths over a map of the page: one line a robot, drawn by the browser."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.page.document import Html, block
from analysis.page.maps import CellLayer, cell_maps_html
from analysis.pictures.maps import lane
from analysis.pictures.style import ROBOT_COLOURS
from planner.files import Json
from planner.formatting import UNPACED, Pace, counted
from planner.plan.plan import Plan
from planner.world.world import World

# Runs to be played over a map of the page: every robot's moves, a byte each, deflated.
#
# The script unfolds them (`replay.js`): where each robot is at a step, and what is covered until then.

RUNS_MOST_LETTERS = 600_000
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
        if letters > RUNS_MOST_LETTERS:
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


PLAN_PATHS_MOST_LETTERS = 400_000
"""Of all paths together; longer ones would make the page heavy and the map a blur."""
LISTED = 16
"""Robots with an entry of their own in the legend."""
DASHES = ("", "5 1.6", "1.5 1.5", "6 1.5 1.2 1.5")


class Line(NamedTuple):
    """A robot's path to draw: letters of an SVG path, a colour's number, dashes, and how far to shift it, in cells."""

    letters: str
    colour: int
    dashes: str
    shift: float


def path_lines(plan: Plan) -> list[Line] | None:
    """Every robot's path over the cells of the plan's map, in cells; None where they are too long to draw."""
    lines, letters, robots = [], 0, len(plan.robots)
    for robot in range(robots):
        line = path_letters(plan, robot)
        letters += len(line)
        if letters > PLAN_PATHS_MOST_LETTERS:
            return None
        turn, colour = divmod(robot, len(ROBOT_COLOURS))
        lines.append(Line(line, colour, DASHES[turn % len(DASHES)], round(0.5 + lane(robot, robots), 3)))
    return lines


def thickness(plan: Plan) -> float:
    """Of the lines, in CSS pixels."""
    return round(float(np.clip(270 / max(plan.shape) / max(len(plan.robots), 3), 0.6, 1.6)), 2)


def plan_map_html(
    layers: Sequence[CellLayer], world: World, plan: Plan, runs: Sequence[Run], about: str, values_of: str | None
) -> Html:
    """The map with the plan's paths over it, and runs to be played there; arguments as of `CellMaps`."""
    lines, robots = path_lines(plan), len(plan.robots)
    drawn = None if lines is None else block("paths", plan, lines, thickness(plan))
    maps = cell_maps_html(layers, world, plan.starts, above=drawn, heading="h2", values_of=values_of)
    whose = [(f"swatch r{robot % len(ROBOT_COLOURS)}", f"robot {robot}") for robot in range(robots)]
    note = "" if robots <= LISTED else f"{counted(robots, 'line')}: one a robot."
    if lines is None:
        note = "The paths are too long to be drawn here."
    packed = packed_runs(runs, world.accessible(plan.starts), world.pace)
    return block("plan_map", maps, packed, about, [] if note else whose, note)


def path_letters(plan: Plan, robot: int) -> str:
    """A path as the letters of an SVG path: moves of one direction in one stroke, waiting left out."""
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    moves = zip(np.diff(rows).tolist(), np.diff(cols).tolist(), strict=True)
    strokes = [f"M{cols[0]} {rows[0]}"]
    for (down, across), group in groupby(move for move in moves if move != (0, 0)):
        times = len(list(group))
        strokes.append(f"v{down * times}" if down else f"h{across * times}")
    return "".join(strokes) if len(strokes) > 1 else f"{strokes[0]}h0"
