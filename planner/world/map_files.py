"""All kinds of map files as a Grid: world files, ROS maps and logs, MovingAI maps, pictures, GeoTIFF, and others."""

from __future__ import annotations

import codecs
import math
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import NonSeekingReader
from numpy.typing import NDArray

from planner.arguments import Numbers, argument, did_you_mean, whole
from planner.errors import MapError
from planner.files import Json, check_file, check_size, damage_reported, library_errors, mapped, read_json, why_no_file
from planner.formatting import counted
from planner.world.frame import Frame
from planner.world.grid import FREE, OCCUPIED, UNKNOWN, Grid, occupied
from planner.world.image_files import SUFFIXES as IMAGES
from planner.world.image_files import image_grid, read_ros_map
from planner.world.keys import CELL_SIZE, CHANCE, COORDINATE, FARTHEST, Key, read_yaml
from planner.world.raster_files import GEO_SUFFIXES, read_raster
from planner.world.robot_types import FACTOR, RobotTypes, checked_types
from planner.world.uncertain_maps import LARGEST
from planner.world.vector_files import SUFFIXES as FIELDS
from planner.world.vector_files import read_field
from planner.world.world import MAX_CELLS, MAX_ROBOTS, WORLD_FILES, World, load_world_file

# ROS 2 logs (MCAP, or a rosbag2 folder): the latest `nav_msgs/OccupancyGrid` as a map.

SCHEMA, ENCODING, TOPIC = "nav_msgs/msg/OccupancyGrid", "cdr", "/map"
MAX_BYTES = 2**30
"""Largest log that is read."""
OCCUPIED_PERCENT, FREE_PERCENT = 65, 25
"""Values from and up to which a pixel is occupied and free: the thresholds of nav2's map_saver."""
LEVEL = 1e-3
"""Largest x and y of a quaternion that only turns a map about the vertical."""
RECOVERED = ".recovered.mcap"
"""Suffix of the file into which `recover` saves messages of a log."""
MOST_LISTED, MOST_TOPICS = 12, 1000
"""Topics that an error lists, and that are kept for it."""
OTHER_STORAGE = {
    ".db3": "convert it: `ros2 bag convert -i {bag} -o out.yaml`, where out.yaml holds "
    "`output_bags: [{{uri: out, storage_id: mcap, all: true}}]`",
    ".zstd": "unpack it: `unzstd {log}`",
}
"""Suffixes of logs that are not read, and how to convert them to MCAP."""


def is_bag(path: Path) -> bool:
    """Whether this is a rosbag2 folder: one with logs."""
    return why_no_file(path) == "is a folder" and bool(_logs_in(path))


def _logs_in(folder: Path) -> list[Path]:
    """Log files of a rosbag2 folder in the order of their names, in any storage format."""
    return sorted(one for one in folder.glob("*") if one.name.endswith((".mcap", *OTHER_STORAGE)))


def log_files(path: Path) -> tuple[list[Path], tuple[str, ...]]:
    """MCAP files of a log.

    A recovered or unpacked copy of a log in the same folder is read instead of it.

    Args:
        path: an MCAP file, or a rosbag2 folder.

    Returns:
        (files, notes on replaced files).

    Raises:
        MapError: the folder has a log in another storage format, which may hold the latest map.
    """
    if not is_bag(path):
        return [path], ()
    logs = {one.name: one for one in _logs_in(path)}
    packed = {f"{name}.zstd" for name in logs}
    other = [one for name, one in logs.items() if one.suffix != ".mcap" and name not in packed]
    if other:
        raise other_storage(path, other[0])
    saved = {name: name.removesuffix(".mcap") + RECOVERED for name in logs}
    notes = tuple(f"{saved[name]} is read in place of {name}" for name in logs if saved[name] in logs)
    return [one for name, one in logs.items() if one.suffix == ".mcap" and saved[name] not in logs], notes


def other_storage(path: Path, log: Path) -> MapError:
    """The error for a log that is no MCAP file; `path`: the log, or its rosbag2 folder."""
    fix = next(fix for end, fix in OTHER_STORAGE.items() if log.name.endswith(end))
    problem = f"is a log that is not MCAP: {log.name}"
    return MapError(problem, source=path, expected="an MCAP log (.mcap)", fix=fix.format(bag=path, log=log))


def read_logged_map(path: Path, topic: str | None = None, choose: str = "") -> Grid:
    """Read the latest grid, by log time, of a log or a rosbag2 folder.

    Thresholds as in nav2's map_saver: occupied from 65, free up to 25, else unknown.

    Args:
        path: an MCAP file, or a rosbag2 folder of them.
        topic: of the map; None: `/map`, or the only topic with grids.
        choose: how to choose a map, for the error about a log with several.

    Raises:
        MapError: there is no such map, or the log cannot be read.
    """
    grids: dict[str, tuple[int, bytes]] = {}
    others: dict[str, str] = {}
    files, notes = log_files(path)
    for file in files:
        _add_grids(file, grids, others)
    if not grids:
        problem = f"holds no map, but {_listed(others)}" if others else "holds no map"
        raise MapError(problem, source=path, expected=f"messages {SCHEMA} (ROS 2, {ENCODING})")
    maps = _listed(dict.fromkeys(grids, SCHEMA))
    if topic is None and len(grids) > 1 and TOPIC not in grids:
        raise MapError(f"holds several maps: {maps}", source=path, expected=f"one, or {TOPIC} among them", fix=choose)
    taken = topic or (TOPIC if TOPIC in grids else next(iter(grids)))
    if taken not in grids:
        problem = f"holds no map on {taken}" + (f" ({others[taken]})" if taken in others else "")
        raise MapError(problem, source=path, expected=f"one of {maps}", fix=did_you_mean(taken, grids))
    with library_errors(f"the map on {taken} is cut short", path, SCHEMA):
        found = _decode(grids[taken][1], path)
    if topic is None and len(grids) > 1:
        notes += (f"{taken} is used of the maps {maps}; {choose}".rstrip("; "),)
    return replace(found, notes=(*found.notes, *notes))


def _listed(topics: dict[str, str]) -> str:
    """Topics with their types: "/map (nav_msgs/msg/OccupancyGrid), ..."."""
    said = [f"{topic} ({kind})" for topic, kind in sorted(topics.items())[:MOST_LISTED]]
    more = len(topics) - MOST_LISTED
    return ", ".join(said) + (f" and {more} more" if more > 0 else "")


def _add_grids(path: Path, grids: dict[str, tuple[int, bytes]], others: dict[str, str]) -> None:
    """Add log time and data of the latest grid of each topic of a file, and the types of topics without grids."""
    for kind, channel, message in log_messages(path, "cut the map's topic out"):
        if (kind, channel.message_encoding) == (SCHEMA, ENCODING):
            if message.log_time >= grids.get(channel.topic, (0, b""))[0]:
                grids[channel.topic] = message.log_time, message.data
        elif len(others) < MOST_TOPICS:
            said = channel.message_encoding
            others[channel.topic] = kind if said == ENCODING else f"{kind}, {said}"


def log_messages(path: Path, fix: str) -> Iterator[tuple[str, Any, Any]]:
    """(type, channel, message) of an MCAP file, in the file's order, chunk by chunk.

    Raises MapError: it is damaged, or too large; `fix` makes it smaller.
    """
    check_size(path, MAX_BYTES, MapError, "a log", fix)
    reader = NonSeekingReader(mapped(path, MapError), validate_crcs=True)
    with damage_reported(path, MapError):
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            yield schema.name if schema else "no type", channel, message


def _decode(data: bytes, path: Path) -> Grid:
    """The map in a message (CDR): each value is aligned to its size, counted from the end of the 4-byte header."""
    order, data = "<" if data[1:2] == b"\x01" else ">", data[4:]
    at = 12 + struct.unpack_from(f"{order}iII", data)[2]  # after the stamp and the frame's name
    at += -at % 4
    *_, resolution, width, height = struct.unpack_from(f"{order}iIfII", data, at)
    at += 20 + -(at + 20) % 8
    x, y, _, *turn, count = struct.unpack_from(f"{order}7dI", data, at)
    values = np.frombuffer(data, np.int8, count, at + 60)
    size = float(f"{resolution:.7g}")  # the decimal number that a 32-bit float stands for
    is_whole = 0 < height * width <= MAX_CELLS and len(values) == height * width
    placed = CELL_SIZE.accepts(size) and all(map(COORDINATE.accepts, (x, y, *turn)))
    if not is_whole or not placed or max(abs(turn[0]), abs(turn[1])) > LEVEL:
        problem = f"its map claims {height} x {width} pixels of {size:g} m from ({x:g}, {y:g}), quaternion {turn}"
        expected = f"1 to {MAX_CELLS} pixels, {CELL_SIZE.expected}, none beyond {FARTHEST:g}, not tilted"
        raise MapError(f"{problem}, and holds {len(values)}", source=path, expected=expected)
    yaw = math.remainder(2 * math.atan2(turn[2], turn[3]), 2 * math.pi)
    grid = values.reshape(height, width)[::-1].astype(np.int16)
    state = np.where(
        grid >= OCCUPIED_PERCENT, OCCUPIED, np.where((grid >= 0) & (grid <= FREE_PERCENT), FREE, UNKNOWN)
    ).astype(np.int16)
    between = int(((grid > FREE_PERCENT) & (grid < OCCUPIED_PERCENT)).sum())
    note = f"unknown, since its value is between {FREE_PERCENT} and {OCCUPIED_PERCENT}: {counted(between, 'pixel')}"
    return Grid(state, Frame((height, width), size, (x, y, yaw)), str(path), notes=(note,) * (between > 0))


# Instances of other planners as worlds: MAPS (YAML), LS-MCPP (`.mcpp`) and DORA-Explorer (`.json`).

MAPS_KEY = "world_shape"
"""Key that identifies a MAPS file."""
MAPS_DEFAULTS: Json = {
    "obstacles_location": [], "threat_location": [], "agents_placement": [], "torodial": False,
    "random_placement": False,
}  # fmt: skip
MAX_SOURCES_BYTES = 2**20
"""Largest file of radiation sources."""
ARENA = Frame((17, 17), 1.0, (-8.5, -8.5, 0.0))
"""Arena of DORA-Explorer's robots: cells centred on whole metres, -8 to 8."""
CHECKS_A_METRE = 0.9 / (0.8 * 0.2)
"""Robots drive 0.8 m/s, a step is 0.2 s, and in nine of ten steps a robot may fail."""
METRES, INTENSITY = Numbers(-1e6, 1e6, "metres"), Numbers(0, 1e6, "an intensity")


def read_maps(path: Path, top: Key) -> World:
    """Read a map of YairKorn/MAPS: `world_shape`, obstacles, threats and robots at [row, col]; cells of 1 m.

    With a `types_matrix` threats are [row, col, p, type], and its rows are robot types "0", "1", ...; `agents_type`
    gives the type of each robot. Robots are the first `n_agents` of `agents_placement`, unless they are placed at
    random. A cell with p = 1, which a world cannot have, becomes an obstacle.

    Args:
        path: the file.
        top: its content.

    Raises:
        MapError, WorldError: a key is invalid.
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
    """Factors of p by robot type and threat type, float64 `[robots, threats]`."""
    rows = [row.numbers(FACTOR, "factors of p") for row in key.items("a list of rows of factors")]
    if len({len(row) for row in rows}) > 1:
        raise key.wrong("rows of one length")
    return np.array(rows, dtype=np.float64)


def _types(agents: Key | None, threat: NDArray[np.float64], world: World) -> RobotTypes:
    """The robot types with these threats `[types, H, W]`, and the type of each robot of the file."""
    names = tuple(map(str, range(len(threat))))
    found = checked_types(names, threat, world.free, world.source)
    if agents is None:
        return found
    of = agents.numbers(whole(0, len(names) - 1), f"a type of robot for each, 0 .. {len(names) - 1}")
    return replace(found, team=tuple(map(str, of)))


def _cell(key: Key, height: int, width: int, *more: str) -> tuple[int, int]:
    """A cell of the map, from two whole numbers (MAPS also writes 1.0); `more` values follow."""
    expected = f"[{', '.join(('row', 'col', *more))}], row 0..{height - 1} and col 0..{width - 1}"
    parts = key.items(expected)
    if len(parts) != 2 + len(more):
        raise key.wrong(expected)
    limits = (height, width) if key.path != MAPS_KEY else (height + 1, width + 1)
    row, col = (part.number(Numbers(0, n, below=True), expected) for part, n in zip(parts, limits, strict=False))
    if row % 1 or col % 1:
        raise key.wrong(expected)
    return int(row), int(col)


def read_mcpp(path: Path) -> World:
    """Read an instance of reso1/LS-MCPP: the map that it names, and a robot at each `root` (column, row).

    The map is `gridmaps/NAME.map` if the instance is in `instances/`, else NAME.map in its folder.

    Args:
        path: the instance.

    Raises:
        MapError, WorldError: a key is invalid, or the map is missing.
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
        raise keys["map"].wrong(f"a map {name[:60]}.map in its folder, or in gridmaps if it is in instances")
    grid = read_movingai(found)
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
    return World.create(np.where(grid.occupancy == FREE, 0.0, np.nan), starts, source=str(path))


def read_sources(path: Path) -> World:
    """Read a map of MISTLab/DORA-Explorer: `sources: [{x, y, intensity}, ...]`, x and y in metres.

    As in the logs of its ten maps, I = sum of intensity / (1 + d**2 / 5), at most 1, at a cell's centre, and a robot
    fails in a check with probability (I - 0.2) / 0.8. p is that of the checks during 1 m of driving.

    Raises:
        MapError: the file is invalid.
    """
    top = Key(read_json(path, MAX_SOURCES_BYTES, MapError, "radiation sources"), "", path, MapError)
    if not isinstance(top.value, dict) or "sources" not in top.value:
        fix = "a plan or a state holds no map: name the map, and this file in addition"
        raise MapError("holds no map", source=path, expected="DORA-Explorer's `sources: [{x, y, intensity}]`", fix=fix)
    intensity = np.zeros(ARENA.shape)
    for key in top.mapping(("sources",), strict=False)["sources"].items("a list of {x, y, intensity}"):
        keys = key.mapping(("x", "y", "intensity"))
        at = [keys[name].number(METRES) for name in ("x", "y")]
        squared = ((ARENA.centres() - at) ** 2).sum(axis=-1)
        intensity += keys["intensity"].number(INTENSITY) / (1 + squared / 5)
    survived = np.clip((1 - intensity) / 0.8, 0, 1) ** CHECKS_A_METRE
    return World.create(np.minimum(1 - survived, LARGEST), None, ARENA.size, ARENA.origin, str(path))


YAML = (".yaml", ".yml")
MOVINGAI_FREE = b".GS"
"""Characters of free cells in a MovingAI map; all others are blocked."""


CHOOSE_TOPIC = "choose one in a scenario: `map: {file: ..., topic: ...}`"
CORNERS = "octile-corner"
"""A type of MovingAI maps that is not supported."""


def load_map(path: Path, cell_size: float | None = None, top: Key | None = None) -> Grid:
    """Read the map in any file except a scenario, chosen by the file's name. A rosbag2 folder is read as its logs.

    Args:
        path: the file.
        cell_size: metres, used if pixels have to be resampled (`raster_files.read_raster`).
        top: content of a YAML file, if already read.

    Raises:
        MapError, WorldError: name file, value and expectation.
    """
    if is_bag(path):
        return read_logged_map(path, choose=CHOOSE_TOPIC)
    suffix = path.suffix.lower()
    if suffix in OTHER_STORAGE:
        raise other_storage(path, path)
    if suffix not in FORMATS:
        raise MapError(f"unknown map format {path.suffix!r}", source=path, expected=" ".join(FORMATS))
    check_file(path, "a map")
    return FORMATS[suffix](path, cell_size, top)


def _yaml_map(path: Path, top: Key | None) -> Grid:
    """A map of ROS, or of MAPS."""
    top = read_yaml(path, MapError) if top is None else top
    if isinstance(top.value, dict) and MAPS_KEY in top.value:
        return Grid.of(read_maps(path, top))
    return read_ros_map(path, top)


def _threat_raster(path: Path, cell_size: float | None) -> Grid:
    """A GeoTIFF of threat probabilities; no data = obstacle. Without a georeference: one metre a pixel."""
    raster = read_raster(path, cell_size)
    size, origin = (1.0, (0.0, 0.0, 0.0)) if raster.frame is None else (raster.frame.size, raster.frame.origin)
    world = World.create(raster.values, None, size, origin, str(path), raster.notes, raster.georeference)
    return replace(Grid.of(world), bounds=raster.bounds, measured=raster.frame is not None)


def _picture(path: Path) -> Grid:
    """A picture as a map; a note says that a world file next to it is not read."""
    grid, suffix = image_grid(path), path.suffix
    beside = (path.with_suffix(end) for end in (f".{suffix[1]}{suffix[-1]}w", f"{suffix}w", ".wld"))
    notes = (
        f"its world file {one.name} is not read: give `map: {{file: ..., resolution: ...}}`, or a GeoTIFF"
        for one in beside
        if one.is_file()
    )
    return replace(grid, notes=(*grid.notes, *notes))


def _field(path: Path, cell_size: float | None) -> Grid:
    if cell_size is None:
        size = argument("cell_size")
        raise MapError("a field has no pixels", source=path, fix=f"give {size}, the side of a cell in metres")
    return read_field(path, cell_size)


def read_movingai(path: Path) -> Grid:
    """Read a MovingAI `.map`: lines `type`, `height H`, `width W`, `map`, then H rows of W characters; 1 m per pixel.

    `.`, `G` and `S` are free, all other characters blocked. Lines end in LF, CRLF or CR; a byte order mark is skipped.

    Raises:
        MapError: the header claims more than the file holds (checked before memory is allocated), or rows are missing,
            short or long.
    """
    expected = "a MovingAI map: type, height, width, map"
    check_size(path, 2 * MAX_CELLS, MapError, expected)
    with library_errors("cannot be read", path, expected):
        lines = path.read_bytes().removeprefix(codecs.BOM_UTF8).splitlines()
    header = [line.decode("latin-1").split() for line in lines[:10]]
    start = header.index(["map"]) + 1 if ["map"] in header else 0
    sides: dict[str, int] = {}
    for number, words in enumerate(header[:start], start=1):
        # Nine digits at most: the product is compared with the size of the file.
        is_side = re.fullmatch(r"(height|width) [1-9][0-9]{0,8}", " ".join(words))
        if (words[:1] in (["height"], ["width"]) and (not is_side or words[0] in sides)) or words == ["type", CORNERS]:
            fix = "use the map's file of type octile: characters are corners here" * (words[0] == "type")
            problem = f"line {number}: {' '.join(words)[:60]!r}"
            raise MapError(
                problem, source=path, expected="one line `height N` and `width N`, whole numbers from 1", fix=fix
            )
        sides |= {words[0]: int(words[1])} if is_side else {}
    if len(sides) < 2:
        raise MapError("has no header with height, width and map", source=path, expected=expected)
    (height, width), size = (sides["height"], sides["width"]), path.stat().st_size
    if height * width > size:
        raise MapError(f"{size} bytes claim {height} x {width} cells", source=path, expected="a complete map")
    rows = lines[start:]
    while len(rows) > height and not rows[-1].strip():
        rows.pop()
    uneven = [
        f"line {number} has {len(row)} characters" for number, row in enumerate(rows, start + 1) if len(row) != width
    ]
    if len(rows) != height or uneven:
        problem = uneven[0] if uneven else f"{len(rows)} rows"
        raise MapError(problem, source=path, expected=f"{height} rows of {width} as the header says")
    cells = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(height, width)
    free = np.isin(cells, np.frombuffer(MOVINGAI_FREE, dtype=np.uint8))
    frame = Frame((height, width), 1.0)
    return Grid(occupied(~free), frame, str(path), measured=False)


Reader = Callable[[Path, float | None, Key | None], Grid]
FORMATS: dict[str, Reader] = {
    **dict.fromkeys(YAML, lambda path, cell_size, top: _yaml_map(path, top)),
    **dict.fromkeys(WORLD_FILES, lambda path, cell_size, top: Grid.of(load_world_file(path))),
    **dict.fromkeys(GEO_SUFFIXES, lambda path, cell_size, top: _threat_raster(path, cell_size)),
    ".map": lambda path, cell_size, top: read_movingai(path),
    ".mcap": lambda path, cell_size, top: read_logged_map(path, choose=CHOOSE_TOPIC),
    ".mcpp": lambda path, cell_size, top: Grid.of(replace(read_mcpp(path), measured=False)),
    ".json": lambda path, cell_size, top: Grid.of(read_sources(path)),
    **dict.fromkeys(IMAGES, lambda path, cell_size, top: _picture(path)),
    **dict.fromkeys(FIELDS, lambda path, cell_size, top: _field(path, cell_size)),
}
"""Readers by file suffix, with arguments (path, cell size in metres or None, YAML content if already read)."""
