"""Every kind of map file as a Grid: world files, ROS maps and logs, MovingAI maps, pictures, GeoTIFF, peers' maps."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from planner.arguments import argument
from planner.errors import MapError
from planner.files import check_file
from planner.worlds.fields import SUFFIXES as FIELDS
from planner.worlds.fields import read_field
from planner.worlds.grid import FREE, OCCUPIED, Frame, Grid
from planner.worlds.images import SUFFIXES as IMAGES
from planner.worlds.keys import Key, read_yaml
from planner.worlds.logged_map import OTHER_STORAGE, is_bag, other_storage, read_logged_map
from planner.worlds.peers import MAPS_KEY, read_maps, read_mcpp, read_sources
from planner.worlds.rasters import GEO_SUFFIXES, read_raster
from planner.worlds.ros_map import image_grid, read_ros_map
from planner.worlds.world import MAX_CELLS, WORLD_FILES, World, load_world_file

YAML = (".yaml", ".yml")
MOVINGAI_FREE = b".GS"
"""Characters of free cells in a MovingAI map; all others are blocked."""


CHOOSE_TOPIC = "choose one in a scenario: `map: {file: ..., topic: ...}`"
CORNERS = "octile-corner"
"""A type of MovingAI maps that is not read."""


def load_map(path: Path, cell_size: float | None = None, top: Key | None = None) -> Grid:
    """The map in any file but a scenario, chosen by the file's name (`top`: its YAML, if already read).

    `cell_size` in metres only matters where pixels must be resampled (see `rasters.read_raster`). A rosbag2 folder is
    read as the logs in it. Raises MapError or WorldError naming the file, the value and what was expected.
    """
    if is_bag(path):
        return read_logged_map(path, choose=CHOOSE_TOPIC).grid()
    suffix = path.suffix.lower()
    if suffix in OTHER_STORAGE:
        raise other_storage(path, path)
    if suffix not in FORMATS:
        raise MapError(f"unknown map format {path.suffix!r}", source=path, expected=" ".join(FORMATS))
    check_file(path, "a map")
    return FORMATS[suffix](path, cell_size, top)


def world_grid(world: World) -> Grid:
    """A world as a map that brings its threats and starts along."""
    state = np.where(world.free, FREE, OCCUPIED).astype(np.uint8)
    return Grid(
        state, world.frame, world.source, threat=world.threat, starts=world.starts, notes=world.notes,
        georeference=world.georeference, value=world.value, detect=world.detect, doubt=world.doubt,
        knowledge=world.knowledge, measured=world.measured, types=world.types,
    )  # fmt: skip


def _yaml_map(path: Path, top: Key | None) -> Grid:
    """A map of ROS, or of MAPS."""
    top = read_yaml(path, MapError) if top is None else top
    if isinstance(top.value, dict) and MAPS_KEY in top.value:
        return world_grid(read_maps(path, top))
    return read_ros_map(path, top).grid()


def _threat_raster(path: Path, cell_size: float | None) -> Grid:
    """A GeoTIFF of threat probabilities; no data = obstacle. Without a georeference: one metre a pixel."""
    raster = read_raster(path, cell_size)
    size, origin = (1.0, (0.0, 0.0, 0.0)) if raster.frame is None else (raster.frame.size, raster.frame.origin)
    world = World.create(raster.values, None, size, origin, str(path), raster.notes, raster.georeference)
    return replace(world_grid(world), bounds=raster.bounds, measured=raster.frame is not None)


def _picture(path: Path) -> Grid:
    """A picture as a map; a world file beside it is not read, which a note says."""
    grid, suffix = image_grid(path), path.suffix
    beside = (path.with_suffix(end) for end in (f".{suffix[1]}{suffix[-1]}w", f"{suffix}w", ".wld"))
    notes = (
        f"{one.name} beside it is not read: give `map: {{file: ..., resolution: ...}}`, or a GeoTIFF"
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
    """A MovingAI `.map`: lines `type`, `height H`, `width W`, `map`, then H rows of W characters; 1 m a pixel.

    Free are `.`, `G` and `S`; all else is blocked. Lines end in LF, CRLF or CR; a byte order mark is skipped. Raises
    MapError for a header that claims more than the file holds (before memory is taken), and for missing, short and
    long rows.
    """
    check_file(path, "a MovingAI map")
    size = path.stat().st_size
    if size > 2 * MAX_CELLS:
        raise MapError(f"{size} bytes", source=path, expected=f"at most {2 * MAX_CELLS}")
    try:
        lines = path.read_bytes().removeprefix(codecs.BOM_UTF8).splitlines()
    except OSError as error:
        raise MapError(f"cannot be read ({error.strerror})", source=path, expected="a MovingAI map") from error
    start, header = _movingai_header(lines, path)
    height, width = header["height"], header["width"]
    if height * width > size:
        raise MapError(f"{size} bytes claim {height} x {width} cells", source=path, expected="a complete map")
    rows = lines[start:]
    while rows and not rows[-1].strip() and len(rows) > height:
        rows.pop()
    if len(rows) != height:
        raise MapError(f"{len(rows)} rows", source=path, expected=f"{height} as the header says")
    for number, row in enumerate(rows, start=start + 1):
        if len(row) != width:
            problem = f"line {number} has {len(row)} characters"
            raise MapError(problem, source=path, expected=f"{width} as the header says")
    cells = np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(height, width)
    free = np.isin(cells, np.frombuffer(MOVINGAI_FREE, dtype=np.uint8))
    frame = Frame((height, width), 1.0)
    return Grid(np.where(free, FREE, OCCUPIED).astype(np.uint8), frame, str(path), measured=False)


def _movingai_header(lines: list[bytes], path: Path) -> tuple[int, dict[str, int]]:
    """Index of the first row, and height and width, named in any order."""
    header: dict[str, int] = {}
    for number, line in enumerate(lines[:10]):
        text = line.decode("latin-1")
        words = text.split()
        if words == ["map"]:
            if set(header) != {"height", "width"}:
                raise MapError("height or width is missing", source=path, expected="height H, width W before `map`")
            return number + 1, header
        if words == ["type", CORNERS]:
            problem = f"line {number + 1}: its type is {CORNERS}, whose characters are corners of cells"
            raise MapError(problem, source=path, expected="type octile", fix="use the map's file of that type")
        if words and words[0] in ("height", "width"):
            digits = words[1] if len(words) == 2 and words[1].isdecimal() and len(words[1]) < 20 else "0"
            if not 1 <= int(digits) <= MAX_CELLS:
                expected = f"{words[0]} N, a whole number 1..{MAX_CELLS}"
                raise MapError(f"line {number + 1}: {text[:60]!r}", source=path, expected=expected)
            if words[0] in header:
                problem = f"line {number + 1}: {text[:60]!r} is the second {words[0]}"
                raise MapError(problem, source=path, expected=f"one line `{words[0]} N`")
            header[words[0]] = int(digits)
    raise MapError("no line `map` in the header", source=path, expected="a MovingAI map: type, height, width, map")


Reader = Callable[[Path, float | None, Key | None], Grid]
FORMATS: dict[str, Reader] = {
    **dict.fromkeys(YAML, lambda path, cell_size, top: _yaml_map(path, top)),
    **dict.fromkeys(WORLD_FILES, lambda path, cell_size, top: world_grid(load_world_file(path))),
    **dict.fromkeys(GEO_SUFFIXES, lambda path, cell_size, top: _threat_raster(path, cell_size)),
    ".map": lambda path, cell_size, top: read_movingai(path),
    ".mcap": lambda path, cell_size, top: read_logged_map(path, choose=CHOOSE_TOPIC).grid(),
    ".mcpp": lambda path, cell_size, top: read_mcpp(path, read_movingai),
    ".json": lambda path, cell_size, top: world_grid(read_sources(path)),
    **dict.fromkeys(IMAGES, lambda path, cell_size, top: _picture(path)),
    **dict.fromkeys(FIELDS, lambda path, cell_size, top: _field(path, cell_size)),
}
"""What reads a map, by the end of its file's name: of (path, cell size in metres or None, its YAML if already read)."""
