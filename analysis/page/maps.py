"""Maps by cell: one pixel a cell as an embedded PNG, the values at the pointer, and planned paths."""

from __future__ import annotations

import base64
import io
import math
import zlib
from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import Colormap, ListedColormap, Normalize, PowerNorm, to_hex, to_rgb
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from analysis.page.document import Html, block
from analysis.page.elements import CellLayer, Run
from analysis.pictures import (
    MOST_LEVELS,
    OBSTACLE,
    ROBOT_COLOURS,
    SCALES,
    SHADES,
    UNREACHABLE,
    lane,
    threat_scale,
    whole_ticks,
)
from analysis.utils.tables import failure_text
from planner.files import Json
from planner.formatting import UNPACED, Pace, chance, counted
from planner.plan.plan import Plan
from planner.simulator.codes import NO_ROBOT
from planner.world.levels import find_levels
from planner.world.world import World

# Maps by cell: one pixel a cell as an embedded PNG, and the values at the pointer, packed.
#
# Maps with more than MOST_CELLS cells show square blocks of cells: their mean probability, and their sum of losses.

MOST_CELLS = 1_000_000
STEPS = 60_000
"""Values are packed as 0 .. STEPS of the largest; values near 0 or 1 are not rounded to them."""
OUT_OF_REACH, NOT_FREE = STEPS + 1, STEPS + 2
MOST_RINGS = 64
"""Most starts that are marked; more would hide the map."""
FINE = 250
"""Cells a side above which a map is smoothed if its cells are smaller than pixels."""


def cell_maps_html(
    layers: Sequence[CellLayer],
    world: World,
    starts: NDArray[np.int64],
    *,
    above: Html | None = None,
    heading: str = "h3",
    anchor: str | None = None,
    values_of: str | None = None,
) -> Html:
    """The layers side by side, or below each other on a phone; the cell at the pointer is marked in all of them.

    Args:
        starts: int64 `[K, 2]`, (row, col). above: drawn over each layer's cells. heading: the element of their names.
        anchor: the group's id. values_of: id of another group of the same map whose values are shown instead.
    """
    height, width = world.shape
    free, accessible, side = world.free, world.accessible(starts), 1
    # The smallest blocks of which there are at most MOST_CELLS.
    while -(-height // side) * -(-width // side) > MOST_CELLS:
        side += 1
    blocked = [_Blocks(layer, free, accessible, side) for layer in layers]
    packed = {
        "shape": [height, width],
        "side": side,
        "metres": world.cell_size,
        "origin": [float(value) for value in world.origin],
        "steps": STEPS,
        "layers": [] if values_of else [block.packed() for block in blocked],
        "from": values_of,
        "starts": starts.tolist() if len(starts) <= 256 else [],
    }
    note = "Point at a cell, or tap it, for its values; with the keyboard, the arrow keys go from cell to cell."
    if side > 1:
        note += f" This map is large: values are those of blocks of {side} x {side} cells, means, for losses sums."
    ringed = np.unique(starts, axis=0).tolist() if len(starts) <= MOST_RINGS else []
    key = {
        "chip start": ("robots' starts", len(ringed) > 0),
        "chip obstacle": ("obstacle", not free.all()),
        "chip unreachable": ("free, out of reach", (free & ~accessible).any()),
    }
    sides = [
        (look, edge, int(at), cells)
        for look, edge, cells in (("row", "top", height), ("col", "left", width))
        for at in whole_ticks(4).tick_values(0, cells - 1)
        if 0 <= at < cells
    ]
    entries = [(look, name) for look, (name, there) in key.items() if there]
    return block("cell_maps", blocked, world.shape, ringed, sides, entries, packed, above, heading, anchor, note)


def packed_layer(layer: CellLayer, free: NDArray[np.bool_], accessible: NDArray[np.bool_]) -> dict[str, object]:
    """A layer's values, in the form that the page's script unpacks."""
    return _Blocks(layer, free, accessible, 1).packed()


def scale_of(layer: CellLayer) -> Colormap:
    """The colours of a layer."""
    return SCALES[layer.colours] if isinstance(layer.colours, str) else layer.colours


class _Blocks:
    """A layer by blocks of `side` x `side` cells (usually one cell)."""

    def __init__(self, layer: CellLayer, free: NDArray[np.bool_], accessible: NDArray[np.bool_], side: int) -> None:
        self.layer, self.colours = layer, scale_of(layer)
        self.free, self.accessible = _any(free, side), _any(accessible, side)
        sums = _sums(np.where(accessible, layer.values, 0.0), side)
        counts = _sums(accessible.astype(np.float64), side)
        self.values = sums / np.maximum(counts, 1) if layer.blocks == "mean" else sums
        top = layer.top if layer.top is not None else float(self.values.max(initial=0.0)) or 1.0
        self.norm = layer.norm or PowerNorm(0.5 if layer.root else 1.0, 0.0, top)

    def shades(self) -> NDArray[np.uint8]:
        """The colour index of each block, uint8 `[rows, cols]`; SHADES: unreachable, SHADES + 1: obstacle."""
        part = np.clip(np.asarray(self.norm(self.values)), 0.0, 1.0)
        shade = np.minimum((part * SHADES).astype(np.int64), SHADES - 1)
        shade[~self.accessible] = SHADES
        shade[~self.free] = SHADES + 1
        return shade.astype(np.uint8)

    def png(self) -> str:
        """One pixel a block, as a data URL; equal values give equal bytes."""
        image = Image.fromarray(self.shades())
        scale = self.colours(np.linspace(0, 1, SHADES))[:, :3]
        palette = [*(scale * 255).round().astype(int).ravel().tolist(), *_rgb(UNREACHABLE), *_rgb(OBSTACLE)]
        image.putpalette(palette)
        out = io.BytesIO()
        image.save(out, format="png", optimize=False)
        return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()

    @property
    def is_fine(self) -> bool:
        """Whether it is smoothed if its cells are smaller than pixels."""
        return max(self.layer.values.shape) > FINE

    @property
    def stops(self) -> str:
        """The colours of the scale, for CSS."""
        return ",".join(to_hex(self.colours(x)) for x in np.linspace(0, 1, 33))

    def bar_words(self) -> Iterator[tuple[float, str]]:
        """Positions on the scale, 0 to 1, and labels of values, as far apart as is readable."""
        layer, last = self.layer, -1.0
        scale, unit = (100.0, " %") if layer.unit == "%" else (1.0, "")
        top = float(self.norm.vmax if self.norm.vmax is not None else 1.0) * scale
        every = np.asarray(MaxNLocator(3 if layer.root else 4, steps=[1, 2, 5, 10]).tick_values(0, top))
        for value in (scale * np.array(layer.labels) if layer.labels else every[every <= top]).tolist():
            at = float(self.norm(value / scale))
            if at - last > 0.12:
                yield at, (chance(value / scale, unit="") if layer.unit == "%" else f"{value:.3g}") + unit
                last = at

    def packed(self) -> dict[str, object]:
        """The values as deflated little-endian uint16, base64; STEPS is the largest value."""
        largest = 1.0 if self.layer.unit == "%" else float(self.values.max(initial=0.0)) or 1.0
        part = self.values / largest
        codes = np.clip((part * STEPS).round(), 0, STEPS).astype(np.int64)
        # A value near 0 or 1 must not be shown as 0 or 1.
        codes[(part > 0) & (codes == 0)] = 1
        codes[(part < 1) & (codes == STEPS)] = STEPS - 1
        codes[~self.accessible] = OUT_OF_REACH
        codes[~self.free] = NOT_FREE
        packed = base64.b64encode(zlib.compress(codes.astype("<u2").tobytes(), 9)).decode()
        layer = self.layer
        return {
            "name": layer.name,
            "unit": layer.unit,
            "largest": largest,
            "digits": layer.digits if layer.unit else max(0, 3 - math.floor(math.log10(largest))),
            "names": layer.names or None,
            "codes": packed,
        }


def _sums(values: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    height, width = values.shape
    padded = np.pad(values, ((0, -height % side), (0, -width % side)))
    return padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side).sum(axis=(1, 3))


def _any(mask: NDArray[np.bool_], side: int) -> NDArray[np.bool_]:
    return _sums(mask.astype(np.float64), side) > 0


def _rgb(colour: str) -> list[int]:
    return [int(colour[place : place + 2], 16) for place in (1, 3, 5)]


# A plan on its map, cell by cell: threat, probability of coverage, robots lost, areas.


def _tint(colour: str, part: float) -> tuple[float, ...]:
    """A colour mixed with white; `part`: share of the colour."""
    return tuple(part * shade + 1 - part for shade in to_rgb(colour))


TINTS = ListedColormap(["#efece4", *(_tint(colour, part) for colour in ROBOT_COLOURS for part in (0.6, 0.42))])
"""The colour of unassigned areas, and two tints a robot, to distinguish its neighbouring areas."""


def chance_layers(
    world: World, plan: Plan, visited: NDArray[np.float64], lost: NDArray[np.float64], known: str
) -> list[CellLayer]:
    """Threat, probability of coverage, and robots lost, `[N]`; `known`: source of the values."""
    return [
        threat_layer(world, plan),
        CellLayer("Chance that the cell is covered", f"Visited; {known}.",
                  visited.reshape(world.shape), "covered", "%", top=1.0, digits=2, short="Coverage"),
        CellLayer("Robots lost in the cell", f"Expected number; {known}.",
                  lost.reshape(world.shape), "losses", root=True, blocks="sum", short="Losses"),
    ]  # fmt: skip


def threat_layer(world: World, plan: Plan) -> CellLayer:
    """The threat map as a layer, in the colours of the pictures."""
    accessible = world.accessible(plan.starts)
    threat = np.where(accessible, np.nan_to_num(world.threat.astype(np.float64)), 0.0)
    levels = find_levels(world.threat, accessible, plan.settings.levels if plan.settings else MOST_LEVELS)
    scale = threat_scale(levels.values, float(threat.max()))
    words = p_text(plan, world)
    about = f"{words[0].upper()}{words[1:]}."
    labels = (0.0, *levels.values[1:])
    return CellLayer("Threat", about, threat, scale.colours, "%", norm=scale.norm, labels=labels, digits=2)


def p_text(plan: Plan, world: World) -> str:
    """The meaning of p on a map."""
    return failure_text(plan, world) or "the chance that one visit destroys a robot"


def area_layers(plan: Plan) -> Iterator[CellLayer]:
    """The areas at the start, in the colours of their robots; none for an external plan."""
    if not plan.areas or plan.shape[0] * plan.shape[1] > MOST_CELLS:
        return
    area = np.zeros(plan.shape)
    for number, held in enumerate(plan.areas):
        area.reshape(-1)[held.cells] = number
    owners = np.array([held.robot for held in plan.areas])
    tints = np.where(owners == NO_ROBOT, 0, 1 + 2 * (owners % len(ROBOT_COLOURS)) + np.arange(len(owners)) % 2)
    names = tuple(
        f"{number}, level {held.level}, " + ("unassigned" if held.robot == NO_ROBOT else f"robot {held.robot}")
        for number, held in enumerate(plan.areas)
    )
    about = "Assignment at the start: the colour of the robot's path, in two tints; pale: unassigned."
    yield CellLayer("Areas", about, area, TINTS, norm=Tint(tints), names=names)


class Tint(Normalize):
    """The position of each area on TINTS, by its number."""

    def __init__(self, tints: NDArray[np.int64]) -> None:
        super().__init__(0, 1)
        self._places = (tints + 0.5) / TINTS.N

    def __call__(self, value: Any, clip: bool | None = None) -> Any:
        """Positions in 0 .. 1 of areas `[H, W]`."""
        return self._places[np.asarray(value, dtype=np.int64)]


# The planned paths over a map of the page: one line a robot, drawn by the browser.

# Runs that the page plays: every robot's moves, a byte each, deflated.
#
# The script (`replay.js`) computes from them each robot's position at a step, and the cells covered by then.

RUNS_MOST_LETTERS = 600_000
"""Most characters of all runs in the page; further runs are omitted."""


def packed_runs(runs: Sequence[Run], accessible: NDArray[np.bool_], pace: Pace = UNPACED) -> Json:
    """The runs as JSON for the script; `accessible`: bool `[H, W]`. Empty if the first run is already too long."""
    packed, letters = [], 0
    for run in runs:
        data = pack(run, accessible.shape[1])
        moves = data["moves"] + data.get("threats", {"moves": []})["moves"]
        letters += sum(map(len, moves)) + len(data.get("seen", ""))
        if letters > RUNS_MOST_LETTERS:
            break
        packed.append(data)
    if not packed:
        return {}
    robots = runs[0].cells.shape[1]
    shifts = [round(lane(robot, robots), 3) for robot in range(robots)]
    data = {"shape": accessible.shape, "accessible": int(accessible.sum()), "shifts": shifts, "runs": packed}
    return data | ({"seconds": pace.seconds} if pace else {})


def pack(run: Run, width: int) -> Json:
    """A run as JSON: starts, losses, and the codes of each robot's moves until it is lost or stays for good.

    A code is 0 (stay), 1 (up), 2 (down), 3 (left) or 4 (right). Raises ValueError for a move to a cell that is not next
    to the last one.
    """
    data: Json = {} if run.seen is None else {"seen": _deflated(run.seen)}
    if run.threats is not None:
        data["threats"] = {"starts": run.threats[0].tolist(), "moves": moves_of(run.threats, width)}
    return data | {
        "name": run.name,
        "time": len(run.cells) - 1,
        "starts": run.cells[0].tolist(),
        "lost": run.lost.tolist(),
        "moves": moves_of(run.cells, width),
    }


def moves_of(cells: NDArray[np.integer], width: int) -> list[str]:
    """The codes of each column of `cells` `[T, K]`, until it stays for good."""
    steps = np.diff(cells, axis=0)
    codes = np.zeros(steps.shape, dtype=np.uint8)
    for code, step in ((4, 1), (3, -1), (2, width), (1, -width)):  # in a map of one column, a step of 1 is up or down
        codes[steps == step] = code
    if ((codes == 0) & (steps != 0)).any():
        raise ValueError("a path does not lead from cell to cell")
    moves = []
    for way in codes.T:
        until = int(np.flatnonzero(way)[-1]) + 1 if way.any() else 0
        moves.append(_deflated(way[:until]))
    return moves


def _deflated(values: NDArray) -> str:
    return base64.b64encode(zlib.compress(values.astype(values.dtype.newbyteorder("<")).tobytes(), 9)).decode()


PLAN_PATHS_MOST_LETTERS = 400_000
"""Most characters of all paths; longer ones would make the page slow and hide the map."""
LISTED = 16
"""Most robots with a separate entry in the legend."""
DASHES = ("", "5 1.6", "1.5 1.5", "6 1.5 1.2 1.5")


class Line(NamedTuple):
    """A robot's path: SVG path data, index of its colour, dashes, and its shift in cells."""

    letters: str
    colour: int
    dashes: str
    shift: float


def path_lines(plan: Plan) -> list[Line] | None:
    """Every robot's path over the cells of the plan's map, in cells; None if they are too long to draw."""
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
    """Width of the lines, in CSS pixels."""
    return round(float(np.clip(270 / max(plan.shape) / max(len(plan.robots), 3), 0.6, 1.6)), 2)


def plan_map_html(
    layers: Sequence[CellLayer], world: World, plan: Plan, runs: Sequence[Run], about: str, values_of: str | None
) -> Html:
    """The map with the plan's paths, and the runs that are played on it; arguments as in `CellMaps`."""
    lines, robots = path_lines(plan), len(plan.robots)
    drawn = None if lines is None else block("paths", plan, lines, thickness(plan))
    maps = cell_maps_html(layers, world, plan.starts, above=drawn, heading="h2", values_of=values_of)
    entries = [(f"swatch r{robot % len(ROBOT_COLOURS)}", f"robot {robot}") for robot in range(robots)]
    note = "" if robots <= LISTED else f"{counted(robots, 'line')}: one a robot."
    if lines is None:
        note = "The paths are too long to be drawn here."
    packed = packed_runs(runs, world.accessible(plan.starts), world.pace)
    return block("plan_map", maps, packed, about, [] if note else entries, note)


def path_letters(plan: Plan, robot: int) -> str:
    """A path as SVG path data: moves in one direction are one stroke, waits are omitted."""
    rows, cols = np.divmod(plan.robots[robot].path, plan.shape[1])
    moves = zip(np.diff(rows).tolist(), np.diff(cols).tolist(), strict=True)
    strokes = [f"M{cols[0]} {rows[0]}"]
    for (down, across), group in groupby(move for move in moves if move != (0, 0)):
        times = len(list(group))
        strokes.append(f"v{down * times}" if down else f"h{across * times}")
    return "".join(strokes) if len(strokes) > 1 else f"{strokes[0]}h0"
