"""Charts, layers of cells and runs as data: what a page and a picture draw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.statistics.estimates import Estimate

if TYPE_CHECKING:
    from matplotlib.colors import Colormap, Normalize

CURVE_COLOURS = 8
"""Colours of curves; the ninth curve has the first one's."""


@dataclass(frozen=True, eq=False)
class Series:
    """A curve by name.

    Attributes:
        name: in the legend. x, y: of its points; NaN is omitted.
        low, high: of the interval of each point, if there are any.
        kind: "line", "step" (holds each value to the next x), "points" (marks only) or "bars".
        dashed: for reference curves. colour: index in the palette; None: the index of the series, for points the
            colour of what stands out.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    low: ArrayLike | None = None
    high: ArrayLike | None = None
    kind: Literal["line", "step", "points", "bars"] = "line"
    dashed: bool = False
    colour: int | None = None

    @classmethod
    def of(cls, name: str, x: ArrayLike, estimates: Sequence[Estimate], scale: float = 100.0, **look: Any) -> Series:
        """Means times `scale` with their intervals; without intervals if one is unknown."""
        means, low, high = scale * np.array([(one.mean, *one.ci95) for one in estimates]).reshape(-1, 3).T
        known = bool(np.isfinite((low, high)).all())
        return cls(name, x, means, low if known else None, high if known else None, **look)


@dataclass(frozen=True)
class Chart:
    """Curves on one pair of axes.

    Attributes:
        title: its heading. series: the curves. x_name, y_name: of the axes. note: a line below.
        unit: after every value of y, for example "%". x_words, y_words: labels of 0, 1, 2, ....
        y_range: smallest range of the y axis; None: as the curves need, from 0. fit: the y axis begins at the curves'
            minimum instead of 0, and `y_range` limits it.
        at_x: (x, label) of vertical lines. at_y: (y, label) of horizontal ones.
        interval: meaning of low and high.
    """

    title: str
    series: tuple[Series, ...]
    x_name: str
    y_name: str
    note: str = ""
    unit: str = ""
    x_words: Sequence[str] = ()
    y_words: Sequence[str] = ()
    y_range: tuple[float, float] | None = None
    fit: bool = False
    at_x: tuple[tuple[float, str], ...] = ()
    at_y: tuple[tuple[float, str], ...] = ()
    interval: str = "95 % interval"


@dataclass(frozen=True, eq=False)
class CellLayer:
    """Values by cell.

    Attributes:
        name: its heading; about: a line below it.
        values: float64 `[H, W]`; unit: "%" for probabilities (then 0 .. 1), else "".
        colours: from the smallest to the largest value, or a name in `analysis.pictures.SCALES`.
        root: a square-root scale, which spreads small values.
        blocks: aggregate of a block of cells if a map is too large: "mean" or "sum".
        top: end of the scale; None: the largest value. norm: positions of values on the scale, instead of root and top.
        labels: values at which the scale is labelled; () for round ones.
        digits: decimals of probabilities at the pointer; other values show the precision of their packing.
        short: its name in the switch of layers; "": `name`.
        names: names of the integer values 0, 1, ...; () for numbers.
        discs: few cells have a value above 0, and a picture draws each as a disc.
        since: first step of a threat that changes; None: the layer holds throughout.
    """

    name: str
    about: str
    values: NDArray[np.float64]
    colours: Colormap | str
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
    since: int | None = None


@dataclass(frozen=True, eq=False)
class Run:
    """A run of a team of `K` robots in `T - 1` steps.

    Attributes:
        name: on its button. cells: int32 `[T, K]`, cell (row * W + col) of each robot at the end of each step.
        lost: int64 `[K]`, the step at which each robot is lost; NO_STEP.
        threats: int64 `[T, M]`, cells of the moving threats; None: not shown.
        seen: int32 `[N]`, the step at which each cell is first seen, NO_STEP if never; None for a known map.
    """

    name: str
    cells: NDArray[np.int32]
    lost: NDArray[np.int64]
    threats: NDArray[np.int64] | None = None
    seen: NDArray[np.int32] | None = None
