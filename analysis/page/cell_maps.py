"""Maps by cell: one pixel a cell as a PNG inside the page, and the values under the pointer, packed.

Of maps with more than MOST_CELLS cells, square blocks of cells are shown: their mean chance, and their sum of losses.
"""

from __future__ import annotations

import base64
import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.colors import Colormap, Normalize, PowerNorm, to_hex
from numpy.typing import NDArray
from PIL import Image

from analysis.page.markup import Html, data, element
from analysis.page.ticks import label, ticks
from analysis.pictures.style import OBSTACLE, SHADES, UNREACHABLE

MOST_CELLS = 1_000_000
STEPS = 60_000
"""Values are packed as 0 .. STEPS of the largest; what is not quite 0 or 1 stays so."""
OUT_OF_REACH, NOT_FREE = STEPS + 1, STEPS + 2
FINE = 250
"""Cells a side from which a map is smoothed where its cells are smaller than pixels."""


@dataclass(frozen=True, eq=False)
class CellLayer:
    """A value for each cell.

    Attributes:
        name: its heading; about: a line below it.
        values: float64 `[H, W]`; unit: "%" for chances (then 0 .. 1), else "".
        colours: from the least to the largest. root: spread small values by a square root.
        blocks: how blocks of cells come together where a map is too large: their "mean" or their "sum".
        top: the scale's end; None: the largest value. norm: where values lie on the scale, instead of root and top.
        labels: values at which the scale is labelled; () for round ones.
        digits: of chances under the pointer; other values show what their packing keeps.
        short: its name where layers are switched; "": `name`.
        names: what the whole numbers 0, 1, ... stand for; () for values that are numbers.
        discs: few cells have a value above 0: a picture draws each as a disc.
    """

    name: str
    about: str
    values: NDArray[np.float64]
    colours: Colormap
    unit: str = ""
    root: bool = False
    blocks: Literal["mean", "sum"] = "mean"
    top: float | None = None
    norm: Normalize | None = None
    labels: tuple[float, ...] = ()
    digits: int = 1
    short: str = ""
    names: tuple[str, ...] = ()
    discs: bool = False


def cell_maps_html(
    layers: Sequence[CellLayer],
    free: NDArray[np.bool_],
    accessible: NDArray[np.bool_],
    starts: NDArray[np.int64] | None = None,
    cell_size: float = 1.0,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    above: Html | None = None,
    heading: str = "h3",
    anchor: str | None = None,
    values_of: str | None = None,
) -> Html:
    """The layers side by side, or below each other on a phone; pointing at a cell of one marks it in all.

    Args:
        free, accessible: bool `[H, W]`. starts: int64 `[K, 2]`, (row, col). cell_size: metres.
        origin: (x, y, yaw) of the grid's lower-left corner in metres and radians.
        above: drawn over each layer's cells. heading: the element of the layers' names.
        anchor: the group's id. values_of: the id of a group of the same map whose values are shown instead of these.
    """
    height, width = free.shape
    side = 1
    while -(-height // side) * -(-width // side) > MOST_CELLS:
        side += 1
    blocked = [_Blocks(layer, free, accessible, side) for layer in layers]
    starts = np.zeros((0, 2), dtype=np.int64) if starts is None else np.asarray(starts)
    maps = [_map(block, (height, width), starts, number, above, heading) for number, block in enumerate(blocked)]
    packed = {
        "shape": [height, width],
        "side": side,
        "metres": cell_size,
        "origin": [float(value) for value in origin],
        "steps": STEPS,
        "layers": [] if values_of else [block.packed() for block in blocked],
        "from": values_of,
        "starts": starts.tolist() if len(starts) <= 256 else [],
    }
    note = "Point at a cell, or tap it, for its values; with the keyboard, the arrow keys go from cell to cell."
    if side > 1:
        note += f" This map is large: values are of blocks of {side} x {side} cells, their mean, of losses their sum."
    return element(
        "div",
        element("div", *maps, class_="maps wide" if width > 2 * height else "maps"),
        element("p", note, class_="note screen"),
        _key(free, accessible, len(starts)),
        data(packed),
        class_="cell-maps",
        id=anchor,
    )


def packed_layer(
    layer: CellLayer, free: NDArray[np.bool_], accessible: NDArray[np.bool_], side: int = 1
) -> dict[str, object]:
    """A layer's values by blocks of `side` x `side` cells, as the page's script unpacks them."""
    return _Blocks(layer, free, accessible, side).packed()


class _Blocks:
    """A layer by blocks of `side` x `side` cells (one cell, mostly)."""

    def __init__(self, layer: CellLayer, free: NDArray[np.bool_], accessible: NDArray[np.bool_], side: int) -> None:
        self.layer = layer
        self.free, self.accessible = _any(free, side), _any(accessible, side)
        sums = _sums(np.where(accessible, layer.values, 0.0), side)
        counts = _sums(accessible.astype(np.float64), side)
        self.values = sums / np.maximum(counts, 1) if layer.blocks == "mean" else sums
        top = layer.top if layer.top is not None else float(self.values.max(initial=0.0)) or 1.0
        self.norm = layer.norm or PowerNorm(0.5 if layer.root else 1.0, 0.0, top)

    def shades(self) -> NDArray[np.uint8]:
        """The colour of each block, uint8 `[rows, cols]`; SHADES and SHADES + 1 are what is not accessible."""
        part = np.clip(np.asarray(self.norm(self.values)), 0.0, 1.0)
        shade = np.minimum((part * SHADES).astype(np.int64), SHADES - 1)
        shade[~self.accessible] = SHADES
        shade[~self.free] = SHADES + 1
        return shade.astype(np.uint8)

    def png(self) -> str:
        """One pixel a block, as a data address; the same values give the same bytes."""
        image = Image.fromarray(self.shades())
        scale = self.layer.colours(np.linspace(0, 1, SHADES))[:, :3]
        palette = [*(scale * 255).round().astype(int).ravel().tolist(), *_rgb(UNREACHABLE), *_rgb(OBSTACLE)]
        image.putpalette(palette)
        out = io.BytesIO()
        image.save(out, format="png", optimize=False)
        return "data:image/png;base64," + base64.b64encode(out.getvalue()).decode()

    def packed(self) -> dict[str, object]:
        """The values as deflated little-endian uint16, base64; STEPS is the largest value."""
        largest = 1.0 if self.layer.unit == "%" else float(self.values.max(initial=0.0)) or 1.0
        part = self.values / largest
        codes = np.clip((part * STEPS).round(), 0, STEPS).astype(np.int64)
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


def _map(
    block: _Blocks,
    shape: tuple[int, int],
    starts: NDArray[np.int64],
    number: int,
    above: Html | None,
    heading: str,
) -> Html:
    layer, (height, width) = block.layer, shape
    words = f"{layer.name}, a map of {height} rows and {width} columns, row 0 at the top. {layer.about}"
    picture = element(
        "img",
        src=Html(block.png()),
        alt=words,
        class_="cells fine" if max(shape) > FINE else "cells",
        draggable="false",
    )
    box = element(
        "div",
        picture,
        above,
        *_start_marks(starts, shape),
        *_sides(shape),
        element("div", class_="here", hidden=True),
        class_="grid-box",
        tabindex="0",
        role="group",
        aria_label=f"{layer.name}: cell by cell",
        data_layer=number,
        style=f"aspect-ratio:{width}/{height}",
    )
    return element(
        "figure",
        element(heading, layer.name),
        element("p", layer.about, class_="about"),
        element("div", box, class_="view", style=f"--ratio:{width / height:.4f};--cols:{width}"),
        _bar(block),
        class_="map",
        data_short=layer.short or layer.name,
    )


def _start_marks(starts: NDArray[np.int64], shape: tuple[int, int]) -> list[Html]:
    """A ring at each start; many would hide the map."""
    if len(starts) > 64:
        return []
    height, width = shape
    return [
        element(
            "i",
            class_="start",
            style=f"left:{100 * (col + 0.5) / width:.3f}%;top:{100 * (row + 0.5) / height:.3f}%",
        )
        for row, col in np.unique(starts, axis=0)
    ]


def _sides(shape: tuple[int, int]) -> list[Html]:
    """Numbers of rows and columns along the left and the upper side."""
    out = []
    for look, side, cells in (("row", "top", shape[0]), ("col", "left", shape[1])):
        places = ticks(0, cells - 1, 5 if cells > 5 else cells, whole=True)
        out += [
            element("span", f"{int(at)}", class_=f"word {look}", style=f"{side}:{100 * (at + 0.5) / cells:.3f}%")
            for at in places
        ]
    return out


def _bar(block: _Blocks) -> Html:
    """The colour scale with its values; of a layer of names, nothing."""
    layer, norm = block.layer, block.norm
    if layer.names:
        return element("div", class_="bar-box", aria_hidden="true")
    stops = ",".join(to_hex(layer.colours(x)) for x in np.linspace(0, 1, 33))
    scale, unit = (100.0, " %") if layer.unit == "%" else (1.0, "")
    top = float(norm.vmax if norm.vmax is not None else 1.0)
    values = scale * np.array(layer.labels) if layer.labels else ticks(0, top * scale, 3 if layer.root else 4)
    gap = float(values[1] - values[0]) if len(values) > 1 else top * scale
    names, last = [], -1.0
    for value in values:
        at = float(norm(value / scale))
        if at - last > 0.12:
            words = f"{value:.3g}" if layer.labels else label(float(value), gap)
            names.append(element("span", words + unit, class_="word x", style=f"left:{100 * at:.2f}%"))
            last = at
    return element(
        "div",
        element("div", *names, class_="bar", style=f"background:linear-gradient(90deg,{stops})"),
        class_="bar-box",
        aria_hidden="true",
    )


def _key(free: NDArray[np.bool_], accessible: NDArray[np.bool_], starts: int) -> Html:
    entries = [("start", "robots' starts")] if 0 < starts <= 64 else []
    if not free.all():
        entries.append(("obstacle", "obstacle"))
    if (free & ~accessible).any():
        entries.append(("unreachable", "free, out of reach"))
    names = [element("li", element("i", class_=f"chip {look}", aria_hidden="true"), name) for look, name in entries]
    return element("ul", *names, class_="legend key") if names else Html()
