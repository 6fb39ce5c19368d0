"""Instances of other planners as worlds: MAPS (YAML), LS-MCPP (`.mcpp`) and DORA-Explorer (`.json`)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import Numbers, argument, whole
from planner.errors import MapError
from planner.files import Json, read_json
from planner.worlds.doubt import LARGEST
from planner.worlds.grid import Frame, Grid
from planner.worlds.keys import Key, read_yaml
from planner.worlds.quantities import CHANCE
from planner.worlds.robot_types import RobotTypes, checked_types
from planner.worlds.typed import FACTOR
from planner.worlds.world import MAX_CELLS, MAX_ROBOTS, World, check_starts

MAPS_KEY = "world_shape"
"""The key that a MAPS file is known by."""
MAPS_DEFAULTS: Json = {
    "obstacles_location": [], "threat_location": [], "agents_placement": [], "torodial": False,
    "random_placement": False,
}  # fmt: skip
MAX_SOURCES_BYTES = 2**20
"""Largest file of radiation sources."""
ARENA = Frame((17, 17), 1.0, (-8.5, -8.5, 0.0))
"""Where DORA-Explorer's robots look: cells centred on whole metres, -8 to 8."""
CHECKS_A_METRE = 0.9 / (0.8 * 0.2)
"""They drive 0.8 m/s, a step has 0.2 s, and in nine of ten steps a robot may fail."""
METRES, INTENSITY = Numbers(-1e6, 1e6, "metres"), Numbers(0, 1e6, "an intensity")


def read_maps(path: Path, top: Key) -> World:
    """A map of YairKorn/MAPS: `world_shape`, and obstacles, threats and robots in places [row, col]; cells of 1 m.

    With a `types_matrix` threats are [row, col, p, type], and its rows are types of robots, "0", "1", ..., by their
    number; `agents_type` says which each robot is of. Robots are the first `n_agents` of `agents_placement`, unless
    their placement is random. A cell with p = 1, which no world here can have, is an obstacle. Raises MapError,
    WorldError.
    """
    top = Key(top.value, "", path, MapError)
    keys = top.mapping((MAPS_KEY,), ("n_agents", "types_matrix", "agents_type"), MAPS_DEFAULTS, strict=False)
    if keys["torodial"].value is not False:
        raise keys["torodial"].wrong("False: cells at opposite edges are no neighbours here")
    height, width = _cell(keys[MAPS_KEY], MAX_CELLS, MAX_CELLS)
    if not 0 < height * width <= MAX_CELLS:
        raise keys[MAPS_KEY].wrong(f"[rows, columns], 1 to {MAX_CELLS} cells")
    matrix = _types_matrix(keys["types_matrix"]) if "types_matrix" in keys else np.zeros((0, 0))
    threat, factor = np.zeros((height, width)), np.ones((len(matrix), height, width))
    more = ("p", "type")[: 1 + bool(len(matrix))]
    for key in keys["threat_location"].items(f"a list of [row, col, {', '.join(more)}]", least=0):
        cell = _cell(key, height, width, *more)
        p, *of = key.items("p")[2:]
        chance = p.number(CHANCE)
        threat[cell] = np.nan if chance == 1 else chance
        if of:
            factor[:, cell[0], cell[1]] = matrix[:, of[0].number(whole(0, matrix.shape[1] - 1, "a type"))]
    lost = int(np.isnan(threat).sum())
    notes = (f"cells that stop every visit (p = 1) and so count as obstacles: {lost}",) if lost else ()
    for key in keys["obstacles_location"].items("a list of [row, col]", least=0):
        threat[_cell(key, height, width)] = np.nan
    world = replace(World.create(threat, source=str(path), notes=notes), measured=False)
    if len(matrix):
        world = replace(world, types=_types(keys.get("agents_type"), factor * threat, world))
    places = [_cell(key, height, width) for key in keys["agents_placement"].items("a list of [row, col]", least=0)]
    if "n_agents" in keys:
        count = keys["n_agents"].number(whole(1, MAX_ROBOTS))
        places = places[:count]
    if world.types is not None:
        world = replace(world, types=replace(world.types, team=world.types.team[: len(places) or None]))
    if keys["random_placement"].value is not False or not places:
        return replace(
            world, notes=(*notes, f"its robots are placed at random: give {argument('robots')} or {argument('starts')}")
        )
    return world.with_starts(places)


def _types_matrix(key: Key) -> NDArray[np.float64]:
    """Factors of p by type of robot and of threat, `[robots, threats]`."""
    rows = [row.numbers(FACTOR, "factors of p") for row in key.items("a list of rows of factors")]
    if len({len(row) for row in rows}) > 1:
        raise key.wrong("rows of one length")
    return np.array(rows, dtype=np.float64)


def _types(agents: Key | None, threat: NDArray[np.float64], world: World) -> RobotTypes:
    """The types of robots with these threats `[types, H, W]`, and of which each robot of the file is."""
    names = tuple(map(str, range(len(threat))))
    found = checked_types(names, threat, world.free, world.source)
    if agents is None:
        return found
    of = agents.numbers(whole(0, len(names) - 1), f"a type of robot for each, 0 .. {len(names) - 1}")
    return replace(found, team=tuple(map(str, of)))


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


def read_sources(path: Path) -> World:
    """A map of MISTLab/DORA-Explorer: `sources: [{x, y, intensity}, ...]`, x and y in metres.

    As in the logs of its ten maps, I = sum of intensity / (1 + d**2 / 5), at most 1, at a cell's centre, and a robot
    fails in a check with (I - 0.2) / 0.8; p is of as many checks as a robot has that drives 1 m. Raises MapError.
    """
    top = Key(read_json(path, MAX_SOURCES_BYTES, MapError, "radiation sources"), "", path, MapError)
    if not isinstance(top.value, dict) or "sources" not in top.value:
        fix = "a plan or a state holds no map: name the map, and this beside it"
        raise MapError("holds no map", source=path, expected="DORA-Explorer's `sources: [{x, y, intensity}]`", fix=fix)
    intensity = np.zeros(ARENA.shape)
    for key in top.mapping(("sources",), strict=False)["sources"].items("a list of {x, y, intensity}"):
        keys = key.mapping(("x", "y", "intensity"))
        at = [keys[name].number(METRES) for name in ("x", "y")]
        squared = ((ARENA.centres() - at) ** 2).sum(axis=-1)
        intensity += keys["intensity"].number(INTENSITY) / (1 + squared / 5)
    survived = np.clip((1 - intensity) / 0.8, 0, 1) ** CHECKS_A_METRE
    return World.create(np.minimum(1 - survived, LARGEST), None, ARENA.size, ARENA.origin, str(path))
