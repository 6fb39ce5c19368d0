"""Common parts of plan files and state files: the map that they belong to, and lists of its cells."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.errors import InputError
from planner.plan.plan import Area
from planner.plan.state import AreaState
from planner.world.keys import Key
from planner.world.world import World


def check_map(key: Key, world: World, what: str, fix: str) -> None:
    """Check that `shape` and `sha256` in a file, where given, are those of `world`.

    Args:
        key: with both.
        world: the map.
        what: subject of the message, for example "plan for".
        fix: of the message.

    Raises:
        InputError: of `key.error`, "... another map".
    """
    # Files of external plans may lack the hash: what is missing is not compared.
    known = {"shape": list(world.shape), "sha256": world.sha256}
    given = {name: one.value for name, one in key.mapping(optional=known, strict=False).items()}
    if given != {name: known[name] for name in given}:
        said = f"{what} another map: {given.get('shape', 'unknown')} cells, sha256 {str(given.get('sha256'))[:12]}..."
        expected = f"{known['shape']}, {world.sha256[:12]}... as {world.source}"
        raise key.error(said, source=key.source, expected=expected, fix=fix)


def read_cell(key: Key, world: World) -> int:
    """Read a free cell: its index, or [row, col]."""
    return int(_cells_in(key, [key.value], world)[0])


def read_path(key: Key, world: World) -> NDArray[np.int64]:
    """Read free cells in the order of the file, int64 `[cells]`."""
    if not isinstance(key.value, list):
        raise key.wrong("a list of cells")
    return _cells_in(key, key.value, world)


def read_cells(key: Key, world: World) -> NDArray[np.int64]:
    """Read free cells without repetition, int64 `[cells]`, increasing."""
    cells = np.sort(read_path(key, world))
    twice = cells[:-1][np.diff(cells) == 0]
    if len(twice):
        raise key.fault(f"holds cell {at(twice[0], world)} twice", "each once")
    return cells


def check_partition(
    areas: Iterable[Area | AreaState],
    world: World,
    starts: NDArray[np.int64],
    error: type[InputError],
    source: str,
    fix: str = "",
) -> None:
    """Check that every cell that a robot can reach is in exactly one area: engines rely on it.

    Args:
        areas: of the file.
        world: the map.
        starts: int64 `[K, 2]`, (row, col).
        error: exception to raise.
        source, fix: of the message.

    Raises:
        InputError: of type `error`.
    """
    # Counted, not marked: a cell in two areas is an error too.
    held = np.zeros(world.threat.size, dtype=np.int64)
    for area in areas:
        held[area.cells] += 1
    wrong = np.flatnonzero(held != world.accessible(starts).ravel())
    if len(wrong):
        problem = f"cell {at(wrong[0], world)} is in {held[wrong[0]]} areas ({len(wrong)} such cells)"
        expected = "every cell that a robot can reach in one area, no other cell in any"
        raise error(problem, source=source, expected=expected, fix=fix)


def at(cell: int | np.integer, world: World) -> str:
    """A cell as text: `[row, col]`."""
    return str(list(divmod(int(cell), world.shape[1])))


def _cells_in(key: Key, given: list[Any], world: World) -> NDArray[np.int64]:
    found = [_index(one, world) for one in given]
    if None in found:
        (height, width), wrong = world.shape, given[found.index(None)]
        expected = f"cells of the map: the index row * {width} + col, 0..{height * width - 1}, or [row, col]"
        raise key.fault(f"holds {reprlib.repr(wrong)}, no cell of the map", expected)
    cells = np.array(found, dtype=np.int64)
    blocked = cells[~world.enterable.ravel()[cells]]
    if len(blocked):
        raise key.fault(f"holds cell {at(blocked[0], world)}, an obstacle", "free cells")
    return cells


def _index(given: object, world: World) -> int | None:
    """A cell's index, from an index or [row, col]; None for no cell of the map."""
    height, width = world.shape
    if isinstance(given, list) and len(given) == 2 and all(type(one) is int for one in given):
        row, col = given
        return row * width + col if 0 <= row < height and 0 <= col < width else None
    return given if type(given) is int and 0 <= given < height * width else None
