"""Every input of the program as a world: scenario files (SPEC section 9) and all kinds of maps."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planner.arguments import ANY, Numbers, argument, whole
from planner.errors import InputError, MapError, ScenarioError, WorldError
from planner.files import check_file
from planner.settings import SETTINGS as KNOWN
from planner.worlds.changing import read_phases
from planner.worlds.elevation import BUILTIN, JACKSBORO, elevation_grid, jacksboro, read_elevation
from planner.worlds.fields import BOUNDARIES, read_field
from planner.worlds.grid import WHOLE, Grid, Ground, coarsen
from planner.worlds.keepout import keep_out
from planner.worlds.keys import PLACE, Key, read_yaml
from planner.worlds.learning import KEYS as KNOWLEDGE
from planner.worlds.learning import read_knowledge
from planner.worlds.logged_map import is_bag, read_logged_map
from planner.worlds.maps import YAML, load_map, world_grid
from planner.worlds.moving import read_movers
from planner.worlds.peers import MAPS_KEY
from planner.worlds.quantities import CELL_SIZE
from planner.worlds.reported import KEYS as REPORTED
from planner.worlds.reported import reported
from planner.worlds.robot_types import checked_types
from planner.worlds.ros_map import read_datum
from planner.worlds.sources import COMBINE
from planner.worlds.starts import RULES
from planner.worlds.threats import all_threats, one_source
from planner.worlds.timed import KEYS as TIMED
from planner.worlds.timed import pace_in, steps_per_move
from planner.worlds.typed import Matrix, read_matrix
from planner.worlds.values import layers
from planner.worlds.world import MAX_ROBOTS, Team, World, check_starts
from planner.worlds.wrong_maps import read_hazard, read_uncertain

DEFAULTS = {"unknown": "obstacle", "threats": [], "combine": "product"}
"""Keys of a scenario file that are always there."""
IN_DOUBT = ("hazard", "uncertain", "movers", "phases")
"""Keys that say by what else than the threats robots are stopped, one of them at most."""
SETTINGS = ("levels", "policy", "reserve", "worth", "plan_for", "wear", "deadline", "in_area")
OF_ROBOTS = ("range", "susceptibility", "return_to", "recharge", "types", "steps_per_move", "radio")
"""Settings of the planner that a scenario file may name, and those that stand under its key `robots`."""
OPTIONAL = (
    "cell_size", "datum", "keepout", "robots", *IN_DOUBT, "plan_on", "value", "detect", *KNOWLEDGE,
    *REPORTED, *TIMED, *SETTINGS,
)  # fmt: skip
"""Keys that may be there."""
OF_FIELDS = ("boundary", "direction", "swath")
"""What may stand beside the polygons of a field."""
OF_MAP = ("file", "elevation", "max_slope_deg", "resolution", "topic", "polygons", *OF_FIELDS)
"""Keys that may stand under `map`."""
DEGREES_ROUND = Numbers(-180, 180, "degrees")
SMALL_ROBOT = 0.2
"""Metres: a cell is a robot's footprint, and few are smaller."""
USUAL_CELL = 0.5
"""Metres: the side of a cell that is suggested where pixels are smaller than SMALL_ROBOT."""
MANY_CELLS = 10_000
"""Cells of a map, of a size that nobody gave, above which a note suggests larger ones."""
ROBOT_IS = "so a robot is"
"""Words of that note, and of no other."""
CELLS_OF_A_MAP = "give `cell_size:` beside `map:`, the side of a cell in metres"


def load_input(path: str | Path, cell_size: float | None = None) -> World:
    """The world in any input file, with what it says of the team (`World.team`) and of the loading (`World.notes`).

    Accepted are a scenario (a YAML file with the key `map`), a ROS map (a YAML file with the key `image`), world files
    (.npz, .npy, .csv), MovingAI .map, pictures (dark = obstacle), GeoTIFF (threat probabilities, no data = obstacle).
    A scenario's relative paths start from the folder of the name it was given by: for a symbolic link, the link's.
    Raises InputError: one line naming the file, the value, what was expected, the fix.
    """
    path = Path(path)
    if not is_bag(path):
        check_file(path, "a scenario, a map or a world file")
    top = read_yaml(path) if path.suffix.lower() in YAML else None
    if top is None or _is_map(top):
        keys = Key({}, "", path).mapping(defaults=DEFAULTS)
        world = _scenario(coarsen(load_map(path, cell_size, top), cell_size), keys, path)
        return world if cell_size is not None else _with_size_note(world, bare=True)
    if cell_size is not None:
        raise ScenarioError(
            "the scenario says what its cell_size is", source=path, fix=f"leave {argument('cell_size')} out"
        )
    world = read_scenario(top, path)
    return world if "cell_size" in top.value else _with_size_note(world, bare=False)


def _with_size_note(world: World, bare: bool) -> World:
    note = _size_note(world, bare)
    return replace(world, notes=(*world.notes, note)) if note else world


def _size_note(world: World, bare: bool) -> str:
    """What the cells of a map take a robot for, where they are smaller than most robots, or many; else "".

    `bare`: the map is no part of a scenario, which would say how large its cells are.
    """
    (height, width), side, count = world.shape, world.cell_size, world.threat.size
    if side >= SMALL_ROBOT and count <= MANY_CELLS:
        return ""
    many = math.ceil((count / MANY_CELLS) ** 0.5) if side >= SMALL_ROBOT else math.ceil(USUAL_CELL / side - WHOLE)
    ratio = max(1, min(many, height, width))
    larger = round(ratio * side, 9)
    usual = argument("cell_size", larger) if bare else f"`cell_size: {larger:g}` in the scenario"
    pixel = f"{side:g} m" if world.measured else f"{side:g} m (presumed)"
    return (
        f"{height} x {width} = {count:,} cells: a cell is a pixel of {pixel}, {ROBOT_IS} {side:g} m wide; give its "
        f"footprint, {'usually ' * (side < SMALL_ROBOT)}{usual} ({(height // ratio) * (width // ratio):,} cells)"
    )


def place_of(name: str) -> str:
    """How a scenario says what this key of one does, "" for no key of one."""
    if name in OF_MAP:
        return f"`map: {{file: ..., {name}: ...}}`"
    return f"`{name}: ...` beside `map: ...`" if name in (*OPTIONAL, *DEFAULTS) else ""


def read_scenario(top: Key, path: Path) -> World:
    """What the keys of a scenario file say; relative paths start from its folder. Raises InputError."""
    if isinstance(top.value, dict) and "map" not in top.value:
        raise _no_map(top)
    keys = top.mapping(("map",), optional=OPTIONAL, defaults=DEFAULTS)
    cell_size = keys["cell_size"].number(CELL_SIZE) if "cell_size" in keys else None
    unknown_free = keys["unknown"].choice(("obstacle", "free")) == "free"
    grid = _map(keys["map"], cell_size)
    if "datum" in keys:
        if grid.georeference is not None:
            raise keys["datum"].wrong("none: the map says where it lies", "leave it out")
        grid = replace(grid, georeference=read_datum(keys["datum"]))
    if "keepout" in keys:
        grid = keep_out(keys["keepout"], grid)
    return _scenario(coarsen(grid, cell_size, unknown_free), keys, path)


def read_on(world: World, top: Key) -> World:
    """The world with what these keys of a scenario say of its threats and its robots. Raises InputError."""
    keys = top.mapping(optional=OPTIONAL, defaults=DEFAULTS)
    return _scenario(coarsen(world_grid(world), None), keys, Path(top.source))


def _no_map(top: Key) -> InputError:
    """The error for a YAML file that is neither a scenario nor a ROS map."""
    names = [str(name)[:60] for name in top.value]
    close = [(name, key) for key in ("map", "image") for name in difflib.get_close_matches(key, names, n=1)]
    fix = f"did you mean {close[0][1]!r} by {close[0][0]!r}?" if close else ""
    fix = "it describes a rosbag2: name its folder" if "rosbag2_bagfile_information" in names else fix
    expected = "the key map (a scenario) or image (a ROS map)"
    return ScenarioError("is neither a scenario nor a ROS map", source=top.source, expected=expected, fix=fix)


def _is_map(top: Key) -> bool:
    """True for the YAML of a map by itself: of ROS, or of MAPS."""
    return isinstance(top.value, dict) and bool({"image", MAPS_KEY} & top.value.keys()) and "map" not in top.value


def _map(key: Key, cell_size: float | None) -> Grid:
    """The map of a scenario: `{file: ...}` (or just the name), or `{elevation: ..., max_slope_deg: ...}`."""
    if isinstance(key.value, str):
        key = Key({"file": key.value}, key.path, key.source)
    keys = key.mapping(optional=OF_MAP)
    kind = one_source(key, ("file", "elevation", "polygons"))
    if kind == "elevation":
        return _elevation(key.mapping(optional=("elevation", "max_slope_deg", "resolution")), cell_size)
    if kind == "polygons":
        return _field(key.mapping(("polygons",), optional=OF_FIELDS), cell_size)
    path = key.mapping(("file",), optional=("resolution", "topic"))["file"].file("a map file", folder=is_bag)
    top = read_yaml(path, MapError) if path.suffix.lower() in YAML else None
    if top is not None and isinstance(top.value, dict) and "map" in top.value and not _is_map(top):
        raise keys["file"].wrong("a map", "this is a scenario: run it itself")
    grid = _logged(path, keys["topic"]) if "topic" in keys else load_map(path, cell_size, top)
    if "resolution" not in keys:
        return grid
    resolution = keys["resolution"].number(CELL_SIZE)
    if grid.measured:
        raise keys["resolution"].wrong(f"none: the file says that a pixel has {grid.frame.size:g} m", CELLS_OF_A_MAP)
    return replace(grid, frame=replace(grid.frame, size=resolution), measured=True)


def _logged(path: Path, topic: Key) -> Grid:
    """The map on a topic of a log."""
    if path.suffix.lower() != ".mcap" and not is_bag(path):
        raise topic.wrong("none: the map is not in a log (.mcap)", "leave it out")
    return read_logged_map(path, topic.text("the name of a topic, as /map")).grid()


def _field(keys: dict[str, Key], cell_size: float | None) -> Grid:
    key = keys["polygons"]
    if cell_size is None:
        raise key.fault("has no pixels", fix="give `cell_size:`, metres, beside `map:`")
    boundary = keys["boundary"].choice(BOUNDARIES) if "boundary" in keys else BOUNDARIES[0]
    direction = math.radians(keys["direction"].number(DEGREES_ROUND)) if "direction" in keys else 0.0
    swath = keys["swath"].number(CELL_SIZE) if "swath" in keys else None
    if swath is not None and (swath < cell_size or abs(swath / cell_size - round(swath / cell_size)) > WHOLE):
        raise keys["swath"].fault(f"is {swath:g} m", f"a whole number of cells of {cell_size:g} m, `cell_size`")
    return read_field(key.file("a file of polygons"), cell_size, boundary, direction, swath)


def _elevation(keys: dict[str, Key], cell_size: float | None) -> Grid:
    steepest = None
    if "max_slope_deg" in keys:
        steepest = keys["max_slope_deg"].number(Numbers(0, 90, "degrees", above=True))
    expected = f"an elevation file, or {BUILTIN}{JACKSBORO}"
    if keys["elevation"].text(expected).startswith(BUILTIN):
        keys["elevation"].choice((BUILTIN + JACKSBORO,))
        raster = jacksboro(cell_size)
    else:
        raster = read_elevation(keys["elevation"].file(expected), cell_size)
    resolution = 1.0
    if "resolution" in keys:
        resolution = keys["resolution"].number(CELL_SIZE)
        if raster.frame is not None:
            raise keys["resolution"].wrong(f"none: the file says that a pixel has {raster.frame.size:g} m")
    grid = elevation_grid(raster, resolution, steepest)
    return replace(grid, measured=raster.frame is not None or "resolution" in keys)


def _scenario(ground: Ground, keys: dict[str, Key], source: Path) -> World:
    sources = keys["threats"].items("a list of sources", least=0)
    matrix = read_matrix(keys.get("robots"))
    threat, notes, apart, by_type = all_threats(sources, keys["combine"].choice(COMBINE), ground, matrix)
    frame = ground.frame
    if not ground.free.any():  # what reading the map noted is why
        raise WorldError("every cell is an obstacle", source=source, fix="; ".join(ground.notes))
    cells = np.where(ground.free, threat, np.nan)
    of_cells, more = layers(keys, ground)
    world = World.create(
        cells, None, frame.size, frame.origin, str(source), (*ground.notes, *notes, *more), ground.grid.georeference,
        **of_cells,
    )  # fmt: skip
    world = replace(world, sources=apart, measured=ground.grid.measured)
    world = _in_doubt(replace(world, pace=pace_in(keys, world)), ground, keys)
    if "wear" in keys:
        keys["wear"] = keys["wear"].mapping(("shape",))["shape"]
    asked = _settings(SETTINGS, keys)
    world = replace(world, team=Team(settings=asked, **reported(keys, world)))
    world = _of_types(_in_the_dark(world, ground, keys), ground, matrix, by_type)
    own = None if ground.grid.starts is None else ground.grid.starts // ground.ratio
    return _with_robots(world, keys["robots"], own) if "robots" in keys else world.with_starts(own)


def _in_doubt(world: World, ground: Ground, keys: dict[str, Key]) -> World:
    """The world with what the scenario, or its map's world file, says is in doubt about its threats."""
    named = [name for name in IN_DOUBT if name in keys]
    if ground.grid.doubt is not None:
        if named or keys["threats"].value or ground.grid.threat is None or not _same(world.threat, ground.grid.threat):
            problem = "brings hazards, uncertain maps, movers or phases along, which nothing can be added to"
            raise MapError(problem, source=ground.grid.source, fix="use the world file by itself, as it is")
        return replace(world, doubt=ground.grid.doubt)
    if "plan_on" in keys and not {"movers", "phases"} & keys.keys():
        raise keys["plan_on"].wrong("none without movers or phases", "of uncertain maps it stands under `uncertain`")
    if len(named) > 1:
        raise keys[named[1]].wrong(f"none beside {named[0]}", "leave one of the two out")
    if "movers" in keys:
        return read_movers(keys["movers"], keys.get("plan_on"), world)
    if "phases" in keys:
        return read_phases(keys, world, ground)
    if "hazard" in keys:
        return read_hazard(keys["hazard"], world, ground)
    return read_uncertain(keys["uncertain"], world, ground, keys["combine"].value) if named else world


def _in_the_dark(world: World, ground: Ground, keys: dict[str, Key]) -> World:
    """The world with what the scenario, or its map's world file, does not tell the robots."""
    if ground.grid.knowledge is None:
        return read_knowledge(keys, world, load_input)
    named = [name for name in KNOWLEDGE if name in keys]
    if named or keys["threats"].value or ground.grid.threat is None or not _same(world.threat, ground.grid.threat):
        problem = "brings a truth along that its robots are not told, which nothing can be added to"
        raise MapError(problem, source=ground.grid.source, fix="use the world file by itself, as it is")
    return replace(world, knowledge=ground.grid.knowledge)


def _of_types(world: World, ground: Ground, matrix: Matrix, by_type: NDArray[np.float64]) -> World:
    """The world with the types of robots that the scenario's matrix names, or its map's world file."""
    if not matrix and ground.grid.types is None:
        return world
    if ground.grid.types is not None:
        if matrix or ground.grid.threat is None or not _same(world.threat, ground.grid.threat):
            problem = "brings types of robots along, which nothing can be added to"
            raise MapError(problem, source=ground.grid.source, fix="use the world file by itself, as it is")
        given = ground.grid.types.team
        team = replace(world.team, settings={"types": given, **world.team.settings}) if given else world.team
        return replace(world, types=ground.grid.types, team=team)
    return replace(world, types=checked_types(tuple(matrix), by_type, world.free, world.source))


def _same(one: NDArray[np.float32], other: NDArray[np.float32]) -> bool:
    return np.array_equal(one, other, equal_nan=True)


def _with_robots(world: World, key: Key, own: NDArray[np.int64] | None) -> World:
    """The world with the robots that its file names; `own`: the starts in its map's world file.

    A `start` rule, or starts, replace those of the world file; a `count` alone must agree with them.
    """
    keys = key.mapping(optional=("count", "start", "starts", "starts_xy", "matrix", "speed", *OF_ROBOTS))
    if "speed" in keys:
        if "steps_per_move" in keys:
            raise keys["speed"].wrong("none beside steps_per_move", "leave one of the two out")
        keys["steps_per_move"] = steps_per_move(keys["speed"])
    named = [name for name in ("start", "starts", "starts_xy") if name in keys]
    if len(named) > 1:
        raise key.wrong(f"one of start, starts and starts_xy, not both {named[0]} and {named[1]}")
    world = replace(world, team=replace(world.team, settings={**world.team.settings, **_settings(OF_ROBOTS, keys)}))
    count = None
    if "count" in keys:
        count = keys["count"].number(whole(1, MAX_ROBOTS))
    if named == ["start"] or (not named and own is None):
        if count is None:
            raise key.wrong("a count, or starts")
        rule = keys["start"].choice(RULES) if named else RULES[0]
        return replace(world, team=replace(world.team, robots=count, start=rule))
    starts = _starts(keys[named[0]], world) if named else own
    assert starts is not None
    if count not in (None, len(starts)):
        fix = "leave out one of them" if named else f"or give start: {RULES[0]} to place the robots anew"
        raise keys["count"].wrong(f"{len(starts)}, as there are {len(starts)} starts", fix)
    return world.with_starts(starts)


def _settings(names: Iterable[str], keys: dict[str, Key]) -> dict[str, Any]:
    """Those of these settings of the planner that the keys name."""
    return {name: keys[name].setting(KNOWN[name]) for name in names if name in keys}


def _starts(key: Key, world: World) -> NDArray[np.int64]:
    """Starts (row, col) int64 `[K, 2]` from `starts` or `starts_xy`, each on a free cell of the world."""
    metres = key.path.endswith("_xy")
    expected = "[x, y] in metres" if metres else "[row, col], whole numbers"
    of = ANY if metres else PLACE
    values = [item.numbers(of, expected, 2) for item in key.items(f"a list of {expected}")]
    with key.naming():
        return check_starts(world.to_cells(np.clip(values, -1e12, 1e12)) if metres else values, world.met, key.path)
