"""Instances of other planners as worlds: MAPS (adversarial coverage, YAML) and LS-MCPP (`.mcpp`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from planner.arguments import Numbers, argument, whole
from planner.errors import MapError
from planner.files import Json
from planner.worlds.grid import Grid
from planner.worlds.keys import Key, read_yaml
from planner.worlds.quantities import CHANCE
from planner.worlds.world import MAX_CELLS, MAX_ROBOTS, World, check_starts

MAPS_KEY = "world_shape"
"""The key that a MAPS file is known by."""
MAPS_DEFAULTS: Json = {
    "obstacles_location": [], "threat_location": [], "agents_placement": [], "torodial": False,
    "random_placement": False,
}  # fmt: skip


def read_maps(path: Path, top: Key) -> World:
    """A map of YairKorn/MAPS: `world_shape`, and obstacles, threats and robots in places [row, col]; cells of 1 m.

    Robots are the first `n_agents` of `agents_placement`, unless their placement is random. A cell with p = 1, which no
    world here can have, is an obstacle. Raises MapError, WorldError.
    """
    top = Key(top.value, "", path, MapError)
    keys = top.mapping((MAPS_KEY,), ("n_agents",), MAPS_DEFAULTS, strict=False)
    if keys["torodial"].value is not False:
        raise keys["torodial"].wrong("False: cells at opposite edges are no neighbours here")
    height, width = _cell(keys[MAPS_KEY], MAX_CELLS, MAX_CELLS)
    if not 0 < height * width <= MAX_CELLS:
        raise keys[MAPS_KEY].wrong(f"[rows, columns], 1 to {MAX_CELLS} cells")
    threat = np.zeros((height, width))
    for key in keys["threat_location"].items("a list of [row, col, p]", least=0):
        cell = _cell(key, height, width, "p")
        p = key.items("p")[2].number(CHANCE)
        threat[cell] = np.nan if p == 1 else p
    lost = int(np.isnan(threat).sum())
    notes = (f"cells that stop every visit (p = 1) and so count as obstacles: {lost}",) if lost else ()
    for key in keys["obstacles_location"].items("a list of [row, col]", least=0):
        threat[_cell(key, height, width)] = np.nan
    world = replace(World.create(threat, source=str(path), notes=notes), measured=False)
    places = [_cell(key, height, width) for key in keys["agents_placement"].items("a list of [row, col]", least=0)]
    if "n_agents" in keys:
        count = keys["n_agents"].number(whole(1, MAX_ROBOTS))
        places = places[:count]
    if keys["random_placement"].value is not False or not places:
        return replace(
            world, notes=(*notes, f"its robots are placed at random: give {argument('robots')} or {argument('starts')}")
        )
    return world.with_starts(places)


def _cell(key: Key, height: int, width: int, *more: str) -> tuple[int, int]:
    """Two whole numbers (MAPS writes 1.0 as well), a cell of the map where `key` names one; `more` values follow."""
    expected = f"[{', '.join(('row', 'col', *more))}], row 0..{height - 1} and col 0..{width - 1}"
    parts = key.items(expected)
    if len(parts) != 2 + len(more):
        raise key.wrong(expected)
    limits = (height, width) if key.path != MAPS_KEY else (height + 1, width + 1)
    row, col = (part.number(Numbers(0, n, below=True), expected) for part, n in zip(parts, limits, strict=False))
    if row % 1 or col % 1:
        raise key.wrong(expected)
    return int(row), int(col)


def read_mcpp(path: Path, read_map: Any) -> Grid:
    """An instance of reso1/LS-MCPP: the map that it names, and a robot at each `root` (column, row).

    The map is `gridmaps/NAME.map` where the instance lies in `instances/NAME.mcpp`, else NAME.map beside it. Raises
    MapError, WorldError.
    """
    keys = read_yaml(path, MapError).mapping(("map", "root"), strict=False)
    name = keys["map"].text("the name of a map")
    places = [path.with_name(f"{name}.map")]
    for number, part in enumerate(path.parts):
        if part == "instances":
            folder = Path(*path.parts[:number], "gridmaps")
            places = [folder.joinpath(*path.parts[number + 1 :]).with_suffix(".map"), folder / f"{name}.map", *places]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise keys["map"].wrong(f"a map {name[:60]}.map beside it, or in gridmaps where it is in instances")
    grid: Grid = read_map(found)
    height, width = grid.frame.shape
    starts = []
    for key in keys["root"].items("a list of [column, row]"):
        expected = f"[column, row], column 0..{width - 1} and row 0..{height - 1}, or column * {height} + row"
        parts = [key] if not isinstance(key.value, list) else key.items(expected)
        if len(parts) > 2:
            raise key.wrong(expected)
        numbers = [part.number(whole(0, height * width - 1), expected) for part in parts]
        col, row = numbers if len(numbers) == 2 else divmod(numbers[0], height)
        starts.append([row, col])
    threat = np.where(grid.state == 0, 0.0, np.nan).astype(np.float32)
    return replace(grid, source=str(path), starts=check_starts(starts, threat, str(path)))
