"""Common parts of plan files and state files: the map that they belong to, and lists of its cells."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import MAX_STEP
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


def read_path(key: Key, world: World, *, planned: bool = False) -> NDArray[np.int64]:
    """Read a robot's path over free cells, in the order of the file, int64 `[cells]`.

    Args:
        key: the list, possibly empty.
        world: the map.
        planned: of a plan: from the start on, as [row, col] only, where a robot may also wait.
    """
    if not isinstance(key.value, list) or (planned and not key.value):
        raise key.wrong("at least the start: [[row, col], ...]" if planned else "a list of cells")
    if len(key.value) - 1 > MAX_STEP:
        raise key.fault(f"has {len(key.value) - 1} steps", f"at most {MAX_STEP}")
    return _cells_in(key, key.value, world, planned)


def check_moves(key: Key, cells: NDArray[np.int64], world: World, *, waits: bool = False) -> None:
    """Check that successive cells int64 are neighbours; `waits`: or the same cell."""
    away = np.abs(np.diff(np.divmod(cells, world.shape[1]))).sum(axis=0)
    jumps = np.flatnonzero((away != 1) & ~(waits & (away == 0)))
    if len(jumps):
        before, after = (at(cell, world) for cell in cells[jumps[0] : jumps[0] + 2])
        problem = f"jumps from {before} to cell {after} at step {jumps[0] + 1} ({len(jumps)} such steps)"
        raise key.fault(problem, "one cell north, south, east or west at a time", "write every cell on the way")


def read_cells(key: Key, world: World) -> NDArray[np.int64]:
    """Read free cells without repetition, int64 `[cells]`, increasing."""
    if not isinstance(key.value, list):
        raise key.wrong("a list of cells")
    cells = np.sort(_cells_in(key, key.value, world))
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


def _cells_in(key: Key, given: list[Any], world: World, pairs: bool = False) -> NDArray[np.int64]:
    """The indices of cells, int64, checked; `pairs`: as [row, col] only."""
    (height, width), found = world.shape, [_index(one, world, pairs) for one in given]
    # The error names the first wrong cell and counts obstacles: a wrong order of coordinates affects many.
    fix = "" if key.fix and not pairs else "cells are [row, col] from 0, row 0 at the top, not [x, y]"
    if None in found:
        place = found.index(None)
        expected = f"a cell of the map, [row, col] with row 0..{height - 1} and col 0..{width - 1}"
        index = "" if pairs else f", or its index row * {width} + col, 0..{height * width - 1}"
        raise _named(key, given, place).fault(f"is {reprlib.repr(given[place])}, off the map", expected + index, fix)
    cells = np.array(found, dtype=np.int64)
    blocked = np.flatnonzero(~world.enterable.ravel()[cells])
    if len(blocked):
        problem = f"is cell {at(cells[blocked[0]], world)}, an obstacle ({len(blocked)} such cells)"
        raise _named(key, given, int(blocked[0])).fault(problem, "free cells", fix)
    return cells


def _named(key: Key, given: list[Any], place: int) -> Key:
    """The key of a cell in a list, or of the only one."""
    return key if given is not key.value else Key(given[place], f"{key.path}[{place}]", key.source, key.error, key.fix)


def _index(given: object, world: World, pairs: bool) -> int | None:
    """A cell's index, from an index or [row, col]; None for no cell of the map."""
    height, width = world.shape
    # Only `int`: booleans and floats are no cells, although NumPy would convert them.
    if type(given) is list and len(given) == 2 and type(given[0]) is type(given[1]) is int:
        row, col = given
        return row * width + col if 0 <= row < height and 0 <= col < width else None
    return given if type(given) is int and not pairs and 0 <= given < height * width else None
