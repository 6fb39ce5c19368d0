"""The world: a grid of threat probabilities, where it lies on the ground, and the world file that holds it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.errors import MapError, WorldError

if TYPE_CHECKING:
    import networkx as nx

MAX_CELLS = 2**26
"""Largest grid accepted, in cells; a header that claims more is refused before memory is taken."""
MAX_ROBOTS = 1024
"""Most robots that the random-number counter can address (SPEC section 6)."""
FOUR_NEIGHBOURS = ndimage.generate_binary_structure(2, 1)


@dataclass(frozen=True, eq=False)
class World:
    """A grid world `[H, W]`, row 0 at the top (largest y). Build it with `World.create`, which checks it.

    Attributes:
        threat: float32 `[H, W]`; NaN = obstacle, else the probability `0 <= p < 1` that one visit stops the robot.
        starts: int64 `[K, 2]`, (row, col) of each robot, or None when the input names none.
        cell_size: side of a cell in metres.
        origin: (x, y, yaw) in metres and radians: the pose of the grid's lower-left corner in the map's frame.
        source: where the world came from, for messages.
        notes: what loading did that a user should know (cells dropped, values clipped, ...).
    """

    threat: NDArray[np.float32]
    starts: NDArray[np.int64] | None = None
    cell_size: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    source: str = "world"
    notes: tuple[str, ...] = field(default=())

    @staticmethod
    def create(
        threat: ArrayLike,
        starts: ArrayLike | None = None,
        cell_size: float = 1.0,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        source: str = "world",
        notes: tuple[str, ...] = (),
    ) -> World:
        """A checked world. Raises WorldError naming the first offending cell, start or number."""
        array = _checked_threat(threat, source)
        pose = np.asarray(origin, dtype=np.float64).reshape(-1)
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise WorldError(f"origin is {origin!r}", source=source, expected="three finite numbers [x, y, yaw]")
        if not (np.isfinite(cell_size) and cell_size > 0):
            raise WorldError(f"cell_size is {cell_size!r}", source=source, expected="a positive number of metres")
        checked = None if starts is None else check_starts(starts, array, source)
        pose_tuple = (float(pose[0]), float(pose[1]), float(pose[2]))
        return World(array, checked, float(cell_size), pose_tuple, source, tuple(notes))

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return (int(self.threat.shape[0]), int(self.threat.shape[1]))

    @property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are not obstacles."""
        return ~np.isnan(self.threat)

    @property
    def sha256(self) -> str:
        """Hash of the threat array as little-endian float32 in C order (SPEC section 9): the identity of the map."""
        return hashlib.sha256(np.ascontiguousarray(self.threat, dtype="<f4").tobytes()).hexdigest()

    def components(self) -> NDArray[np.int32]:
        """int32 `[H, W]`: 4-connected components of the free cells, numbered from 1; 0 = obstacle."""
        labels, _ = ndimage.label(self.free, structure=FOUR_NEIGHBOURS)
        return labels.astype(np.int32)

    def accessible(self, starts: ArrayLike) -> NDArray[np.bool_]:
        """bool `[H, W]`: free cells that some robot can reach from its start `[K, 2]`."""
        labels = self.components()
        rows, cols = check_starts(starts, self.threat, self.source).T
        return self.free & np.isin(labels, np.unique(labels[rows, cols]))

    def with_starts(self, starts: ArrayLike | None) -> World:
        """The same world with other starts, checked."""
        checked = None if starts is None else check_starts(starts, self.threat, self.source)
        return replace(self, starts=checked)

    def to_xy(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Centres in metres, map frame, float64 `[..., 2]`, of cell indices `row * W + col`."""
        height, width = self.shape
        rows, cols = np.divmod(np.asarray(cells, dtype=np.int64), width)
        across, up = (cols + 0.5) * self.cell_size, (height - rows - 0.5) * self.cell_size
        east, north, yaw = self.origin
        cos, sin = np.cos(yaw), np.sin(yaw)
        return np.stack([east + cos * across - sin * up, north + sin * across + cos * up], axis=-1)

    def to_cells(self, points: ArrayLike) -> NDArray[np.int64]:
        """(row, col) int64 `[..., 2]` of the cells that hold points (x, y) in metres; they may lie off the map."""
        east, north, yaw = self.origin
        moved = np.asarray(points, dtype=np.float64) - (east, north)
        cos, sin = np.cos(yaw), np.sin(yaw)
        across, up = cos * moved[..., 0] + sin * moved[..., 1], -sin * moved[..., 0] + cos * moved[..., 1]
        rows = self.shape[0] - 1 - np.floor(up / self.cell_size)
        return np.stack([rows, np.floor(across / self.cell_size)], axis=-1).astype(np.int64)

    def to_networkx(self) -> nx.DiGraph:
        """The free cells as a directed graph: nodes (row, col) with `threat` and `pos` (metres).

        An edge into a cell has `cost` after eq. (3), in the integers of SPEC section 3 (no quantisation), and
        `hazard = -log(1 - p)`, the additive form of the survival probability.
        """
        from planner.graph import world_graph

        return world_graph(self)

    def save(self, path: str | Path) -> None:
        """Write the world file (`.npz`) of SPEC section 9, whole or not at all."""
        from planner.files import atomic_write

        arrays: dict[str, NDArray] = {
            "threat": self.threat,
            "cell_size": np.float64(self.cell_size),  # type: ignore[dict-item]
            "origin": np.array(self.origin, dtype=np.float64),
        }
        if self.starts is not None:
            arrays["starts"] = self.starts
        with atomic_write(Path(path), "wb") as out:
            np.savez_compressed(out, **arrays)  # type: ignore[arg-type]


def check_starts(starts: ArrayLike, threat: NDArray[np.float32], source: str) -> NDArray[np.int64]:
    """Starts as int64 `[K, 2]`, each on a free cell of `threat`; WorldError names the robot that is not."""
    given = np.asarray(starts)
    if given.ndim != 2 or given.shape[1] != 2 or len(given) == 0:
        raise WorldError(f"starts have shape {given.shape}", source=source, expected="one [row, col] a robot: [K, 2]")
    if len(given) > MAX_ROBOTS:
        raise WorldError(f"{len(given)} robots", source=source, expected=f"at most {MAX_ROBOTS}")
    if given.dtype.kind not in "iu" and not (given.dtype.kind == "f" and (given == np.round(given)).all()):
        raise WorldError("starts are not whole numbers", source=source, expected="[row, col] as integers")
    cells = given.astype(np.int64)
    height, width = threat.shape
    for robot, (row, col) in enumerate(cells.tolist()):
        if not (0 <= row < height and 0 <= col < width):
            raise WorldError(
                f"robot {robot} starts at [{row}, {col}], outside the map",
                source=source,
                expected=f"row 0..{height - 1} and col 0..{width - 1}",
            )
        if np.isnan(threat[row, col]):
            raise WorldError(
                f"robot {robot} starts at [{row}, {col}], an obstacle",
                source=source,
                expected="a free cell",
                fix="move the start, or leave starts out and use --robots",
            )
    return cells


def _checked_threat(threat: ArrayLike, source: str) -> NDArray[np.float32]:
    array = np.asarray(threat)
    if array.ndim != 2 or array.size == 0:
        raise WorldError(f"threat has shape {array.shape}", source=source, expected="a grid [H, W] of at least 1 x 1")
    if array.size > MAX_CELLS:
        raise WorldError(f"{array.size} cells", source=source, expected=f"at most {MAX_CELLS}", fix="coarsen the map")
    if array.dtype.kind not in "fiub":
        raise WorldError(f"threat holds {array.dtype}", source=source, expected="numbers")
    values = array.astype(np.float32)
    wrong = ~np.isnan(values) & ~((values >= 0) & (values < 1))
    if wrong.any():
        row, col = (int(i) for i in np.argwhere(wrong)[0])
        raise WorldError(
            f"threat at [{row}, {col}] is {array[row, col]:g} ({int(wrong.sum())} such cells)",
            source=source,
            expected="a probability 0 <= p < 1, or NaN for an obstacle",
            fix="p = 1 is an obstacle: write NaN",
        )
    if np.isnan(values).all():
        raise WorldError("every cell is an obstacle", source=source, expected="at least one free cell")
    canonical = np.where(np.isnan(values), np.float32(np.nan), values + np.float32(0.0)).astype(np.float32)
    canonical.setflags(write=False)
    return canonical


def load_world_file(path: str | Path) -> World:
    """Read a world file: `.npz` (SPEC section 9), a bare `.npy` threat array, or a `.csv` of it (-1 or nan = obstacle).

    Raises MapError if the file cannot be read, WorldError if what it holds is no world.
    """
    path = Path(path)
    readers = {".npz": _read_npz, ".npy": _read_npy, ".csv": _read_csv}
    if path.suffix.lower() not in readers:
        raise MapError(f"unknown world format {path.suffix!r}", source=path, expected=" ".join(readers))
    if not path.is_file():
        raise MapError("no such file", source=path, expected="a world file")
    return readers[path.suffix.lower()](path)


def _read_npz(path: Path) -> World:
    from planner.files import read_npz

    arrays = read_npz(path, 8 * MAX_CELLS)
    if "threat" not in arrays:
        raise MapError(f"holds {sorted(arrays)}", source=path, expected="an array named 'threat'")
    size = np.asarray(arrays.get("cell_size", 1.0), dtype=np.float64).reshape(-1)
    if size.shape != (1,):
        raise WorldError(f"cell_size has {size.size} values", source=str(path), expected="one number of metres")
    origin = arrays.get("origin", np.zeros(3))
    return World.create(arrays["threat"], arrays.get("starts"), float(size[0]), origin, str(path))


def _read_npy(path: Path) -> World:
    from planner.files import read_npy

    return World.create(read_npy(path, MAX_CELLS), source=str(path))


def _read_csv(path: Path) -> World:
    from planner.files import read_csv_grid

    values = read_csv_grid(path, MAX_CELLS)
    return World.create(np.where(values == -1, np.nan, values), source=str(path))
