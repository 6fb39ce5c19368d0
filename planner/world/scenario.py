"""All inputs of the program as a world: scenario files (SPEC section 9) and all kinds of maps."""

from __future__ import annotations

import difflib
import itertools
import math
import os
import warnings
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from planner.arguments import ANY, Numbers, argument, whole
from planner.errors import InputError, MapError, RenamedWarning, ScenarioError, WorldError, with_new_names
from planner.files import Json, atomic_write, check_file
from planner.formatting import SPEEDS, STEP_SECONDS, TURNS, Pace
from planner.settings import SETTINGS as KNOWN
from planner.settings import Settings
from planner.world.grid import WHOLE, Grid, Ground, coarsen
from planner.world.image_files import read_datum
from planner.world.keys import CELL_SIZE, PLACE, Key, read_yaml
from planner.world.map_files import MAPS_KEY, YAML, is_bag, load_map, read_logged_map
from planner.world.raster_files import BUILTIN, JACKSBORO, elevation_grid, jacksboro, read_elevation
from planner.world.robot_types import COMBINE, Matrix, checked_types, read_matrix
from planner.world.scenario_features import KEYS as KNOWLEDGE
from planner.world.scenario_features import UNCERTAIN, read_knowledge
from planner.world.start_rule import RULES
from planner.world.threats import all_threats, layers, one_source
from planner.world.vector_files import BOUNDARIES, keep_out, read_field
from planner.world.world import MAX_ROBOTS, Team, World, check_starts

# The route that is to be safe: `route`, `route_xy`. The key `metrics` of release 0.3 is read and ignored.

ROUTE_KEYS = ("route", "route_xy")
SAMPLES = 16
"""Points sampled per cell length of a route."""


def reported(keys: dict[str, Key], world: World) -> Json:
    """`route` of `planner.world.world.Team`, if the keys name one."""
    found: Json = {}
    if "metrics" in keys:
        note = f"{world.source}: `metrics` left with release 0.4: the figures of every field are in docs/value.md"
        warnings.warn(note, RenamedWarning, stacklevel=2)
    named = [name for name in ROUTE_KEYS if name in keys]
    if len(named) > 1:
        raise keys["route"].wrong("route or route_xy, not both")
    for name in named:
        metres = name == "route_xy"
        expected = f"a list of two {'[x, y] in metres' if metres else '[row, col]'} or more"
        corners = [
            item.numbers(Numbers(PLACE.least, PLACE.most), expected, 2) for item in keys[name].items(expected, 2)
        ]
        with keys[name].naming():
            found["route"] = route_over(world, world.places(corners) if metres else np.array(corners) + 0.5)
    return found


def route_over(world: World, corners: ArrayLike) -> NDArray[np.int64]:
    """The cells of a polyline.

    Args:
        world: the map.
        corners: `[corners, 2]`, positions in cells (a centre is at .5).

    Returns:
        (row, col) int64 `[R, 2]`.

    Raises:
        WorldError: it leaves the map or meets an obstacle.
    """
    places = np.asarray(corners, dtype=np.float64)
    parts = []
    for start, stop in itertools.pairwise(places):
        # Sampled densely enough that no cell with a noticeable part of the line is missed.
        count = SAMPLES * int(np.ceil(np.abs(stop - start).max())) + 1
        if count > SAMPLES * (sum(world.shape) + 2):
            raise WorldError("leaves the map", expected=f"places on the {world.shape[0]} x {world.shape[1]} cells")
        parts.append(np.linspace(start, stop, count))
    cells = np.floor(np.concatenate(parts)).astype(np.int64)
    # Consecutive samples in one cell count once.
    cells = cells[np.append(True, (np.diff(cells, axis=0) != 0).any(axis=1))]
    off = ~((cells >= 0) & (cells < world.shape)).all(axis=1)
    if off.any():
        raise WorldError(f"leaves the map at {cells[off][0].tolist()}", expected="cells of the map")
    blocked = ~world.free[tuple(cells.T)]
    if blocked.any():
        raise WorldError(f"meets an obstacle at {cells[blocked][0].tolist()}", expected="free cells all the way")
    return cells


def with_route(world: World, route: ArrayLike) -> World:
    """A copy with a route to make safe.

    Args:
        world: the map.
        route: `[corners, 2]`, (row, col).

    Raises:
        WorldError: as in `route_over`.
    """
    corners = np.asarray(route)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2 or corners.dtype.kind not in "iuf":
        raise WorldError(f"route has shape {list(corners.shape)}", expected="two [row, col] or more")
    try:
        cells = route_over(world, np.clip(corners, -(2.0**31), 2.0**31) + 0.5)
    except WorldError as error:
        raise WorldError(f"route {error.problem}", source=world.source, expected=error.expected) from error
    return replace(world, team=replace(world.team, route=cells))


# Duration of a step: `step: {seconds: 2}`, or `speed: 0.5` in metres per second; and a `turn`.

TIME_KEYS = ("step", "speed", "turn")
CELLS_A_STEP = Numbers(0, 1, above=True)
NEARLY = 0.02
"""Largest relative distance of 1 / speed from a whole number of steps: 0.33 counts as a third."""


def steps_per_move(key: Key) -> Key:
    """Speed in cells per step, one number for all robots or one each, as whole steps per move.

    Raises:
        ScenarioError: it is not 1 over a whole number.
    """
    several = isinstance(key.value, list)
    steps = []
    for item in key.items("cells a step, one a robot") if several else [key]:
        speed = item.number(CELLS_A_STEP)
        steps.append(round(1 / speed))
        if abs(steps[-1] * speed - 1) > NEARLY:
            raise item.wrong("cells a step: 1, or 1 over a whole number, as 0.5", "or give steps_per_move: [2, 3]")
    return Key(steps if several else steps[0], key.path, key.source)


def _seconds_in(keys: dict[str, Key], world: World) -> float | None:
    """Seconds per step; None: not given."""
    if "step" in keys:
        if "speed" in keys:
            raise keys["speed"].wrong("none together with step", "leave one of the two out")
        return keys["step"].mapping(("seconds",))["seconds"].number(STEP_SECONDS)
    if "speed" not in keys:
        return None
    seconds = world.cell_size / keys["speed"].number(SPEEDS)
    if not world.measured:
        problem = "is given without a cell size in metres"
        raise keys["speed"].fault(
            problem, fix="give the metres of a pixel, `map: {file: ..., resolution: 0.5}`, or `step: {seconds: ...}`"
        )
    if not STEP_SECONDS.accepts(seconds):
        raise keys["speed"].fault(f"makes a step take {seconds:g} s", STEP_SECONDS.expected)
    return seconds


DEFAULTS = {"unknown": "obstacle", "threats": [], "combine": "product"}
"""Keys of a scenario file that are always there."""
SETTINGS = ("levels", "policy", "risk_cap", "robot_value", "plan_for", "weibull_shape", "deadline", "in_area")
OF_ROBOTS = (
    "range", "hazard_multiplier", "return_to", "recharge", "deliver_every", "deliver_value", "wrecks", "types",
    "steps_per_move", "radio",
)  # fmt: skip
"""Planner settings as keys of a scenario, and those under its key `robots`."""
OPTIONAL = (
    "cell_size", "datum", "keepout", "robots", *UNCERTAIN, "plan_on", "value", "detect", *KNOWLEDGE,
    "metrics", *ROUTE_KEYS, *TIME_KEYS, *SETTINGS,
)  # fmt: skip
"""Optional keys."""
OF_MAP = {
    "file": ("resolution", "topic"),
    "elevation": ("max_slope_deg", "resolution"),
    "polygons": ("boundary", "direction", "swath"),
}
"""Kinds of maps, and further keys under `map` of each."""
MAP_KEYS = tuple(dict.fromkeys(itertools.chain(OF_MAP, *OF_MAP.values())))
DEGREES_ROUND = Numbers(-180, 180, "degrees")
SMALL_ROBOT = 0.2
"""Metres: a cell is a robot's footprint, and few robots are smaller."""
USUAL_CELL = 0.5
"""Metres: suggested side of a cell if pixels are smaller than SMALL_ROBOT."""
MANY_CELLS = 10_000
"""Cells of a map without given cell size above which a note suggests larger cells."""
ROBOT_IS = "so a robot is"
"""Words that identify that note."""
CELLS_OF_A_MAP = "give `cell_size:` next to `map:`, the side of a cell in metres"


def load_input(path: str | Path, cell_size: float | None = None) -> World:
    """Load any input file as a world, with requests about the team (`World.team`) and notes (`World.notes`).

    Accepted are a scenario (a YAML file with the key `map`), a ROS map (a YAML file with the key `image`), world files
    (.npz, .npy, .csv), MovingAI .map, pictures (dark = obstacle), GeoTIFF (threat probabilities, no data = obstacle).
    Relative paths in a scenario start from the folder of the given name: for a symbolic link, the link's folder.

    Args:
        path: the file.
        cell_size: metres, for a map that is no scenario.

    Raises:
        InputError: the file or a value in it is invalid.
    """
    path = Path(path)
    if not is_bag(path):
        check_file(path, "a scenario, a map or a world file")
    top = read_yaml(path) if path.suffix.lower() in YAML else None
    # A map without scenario is read as a scenario with defaults only: one path for both.
    if top is None or _is_map(top):
        keys = Key({}, "", path).mapping(defaults=DEFAULTS)
        world = _scenario(coarsen(load_map(path, cell_size, top), cell_size), keys, path)
        return world if cell_size is not None else _with_size_note(world, bare=True)
    if cell_size is not None:
        raise ScenarioError(
            "the scenario determines its cell_size", source=path, fix=f"leave {argument('cell_size')} out"
        )
    world = read_scenario(top, path)
    return world if "cell_size" in top.value else _with_size_note(world, bare=False)


def _with_size_note(world: World, bare: bool) -> World:
    """The world with a note on the size of cells if they are smaller than most robots, or many.

    `bare`: the map is not part of a scenario, which could give the size.
    """
    (height, width), side, count = world.shape, world.cell_size, world.threat.size
    if side >= SMALL_ROBOT and count <= MANY_CELLS:
        return world
    many = math.ceil((count / MANY_CELLS) ** 0.5) if side >= SMALL_ROBOT else math.ceil(USUAL_CELL / side - WHOLE)
    ratio = max(1, min(many, height, width))
    larger = round(ratio * side, 9)
    usual = argument("cell_size", larger) if bare else f"`cell_size: {larger:g}` in the scenario"
    pixel = f"{side:g} m" if world.measured else f"{side:g} m (presumed)"
    note = (
        f"{height} x {width} = {count:,} cells: a cell is a pixel of {pixel}, {ROBOT_IS} {side:g} m wide; give its "
        f"footprint, {'usually ' * (side < SMALL_ROBOT)}{usual} ({(height // ratio) * (width // ratio):,} cells)"
    )
    return replace(world, notes=(*world.notes, note))


def place_of(name: str) -> str:
    """Where a scenario has this key, for messages; "" if it has none of this name."""
    if name in MAP_KEYS:
        return f"`map: {{file: ..., {name}: ...}}`"
    return f"`{name}: ...` next to `map: ...`" if name in (*OPTIONAL, *DEFAULTS) else ""


def read_scenario(top: Key, path: Path) -> World:
    """The world of a scenario file; relative paths start from its folder.

    Args:
        top: content of the file.
        path: the file.

    Raises:
        InputError: a key or file is invalid.
    """
    if isinstance(top.value, dict) and "map" not in top.value:
        raise _no_map(top)
    keys = top.mapping(("map",), optional=OPTIONAL, defaults=DEFAULTS)
    cell_size = keys["cell_size"].number(CELL_SIZE) if "cell_size" in keys else None
    unknown_free = keys["unknown"].choice(("obstacle", "free")) == "free"
    grid = _map(keys["map"], cell_size)
    if "datum" in keys:
        if grid.georeference is not None:
            raise keys["datum"].wrong("none: the map has a georeference", "leave it out")
        grid = replace(grid, georeference=read_datum(keys["datum"]))
    if "keepout" in keys:
        grid = keep_out(keys["keepout"], grid)
    return _scenario(coarsen(grid, cell_size, unknown_free), keys, path)


def read_on(world: World, top: Key) -> World:
    """A world with the threats and robots of a scenario's keys.

    Args:
        world: the map.
        top: the keys.

    Raises:
        InputError: a key or file is invalid.
    """
    keys = top.mapping(optional=OPTIONAL, defaults=DEFAULTS)
    return _scenario(coarsen(Grid.of(world), None), keys, Path(top.source))


def _no_map(top: Key) -> InputError:
    """The error for a YAML file that is neither a scenario nor a ROS map."""
    names = [str(name)[:60] for name in top.value]
    close = [(name, key) for key in ("map", "image") for name in difflib.get_close_matches(key, names, n=1)]
    fix = f"did you mean {close[0][1]!r} by {close[0][0]!r}?" if close else ""
    fix = "it describes a rosbag2: name its folder" if "rosbag2_bagfile_information" in names else fix
    expected = "the key map (a scenario) or image (a ROS map)"
    return ScenarioError("is neither a scenario nor a ROS map", source=top.source, expected=expected, fix=fix)


def _is_map(top: Key) -> bool:
    """True for the YAML of a map without scenario: of ROS, or of MAPS."""
    return isinstance(top.value, dict) and bool({"image", MAPS_KEY} & top.value.keys()) and "map" not in top.value


def _map(key: Key, cell_size: float | None) -> Grid:
    """The map of a scenario: `{file: ...}` (or just the name), or `{elevation: ..., max_slope_deg: ...}`."""
    # A file name alone is short for `{file: ...}`.
    if isinstance(key.value, str):
        key = Key({"file": key.value}, key.path, key.source)
    keys = key.mapping(optional=MAP_KEYS)
    kind = one_source(key, OF_MAP)
    key.mapping((kind,), optional=OF_MAP[kind])
    resolution = keys["resolution"].number(CELL_SIZE) if "resolution" in keys else None
    if kind == "file":
        grid = _of_file(keys, cell_size)
    else:
        grid = _field(keys, cell_size) if kind == "polygons" else _elevation(keys, cell_size, resolution)
    if resolution is None:
        return grid
    # The file's own cell size is not overridden: a contradiction is an error, not a choice.
    if grid.measured:
        raise keys["resolution"].wrong(f"none: in the file a pixel has {grid.frame.size:g} m", CELLS_OF_A_MAP)
    return replace(grid, frame=replace(grid.frame, size=resolution), measured=True)


def _of_file(keys: dict[str, Key], cell_size: float | None) -> Grid:
    """The map in a file, or on a topic of a log."""
    path = keys["file"].file("a map file", folder=is_bag)
    if "topic" in keys:
        if path.suffix.lower() != ".mcap" and not is_bag(path):
            raise keys["topic"].wrong("none: the map is not in a log (.mcap)", "leave it out")
        return read_logged_map(path, keys["topic"].text("the name of a topic, as /map"))
    top = read_yaml(path, MapError) if path.suffix.lower() in YAML else None
    if top is not None and isinstance(top.value, dict) and "map" in top.value and not _is_map(top):
        # A scenario within a scenario would have two sets of threats and robots.
        raise keys["file"].wrong("a map", "this is a scenario: run it directly")
    return load_map(path, cell_size, top)


def _field(keys: dict[str, Key], cell_size: float | None) -> Grid:
    key = keys["polygons"]
    if cell_size is None:
        raise key.fault("has no pixels", fix="give `cell_size:`, metres, next to `map:`")
    boundary = keys["boundary"].choice(BOUNDARIES) if "boundary" in keys else BOUNDARIES[0]
    direction = math.radians(keys["direction"].number(DEGREES_ROUND)) if "direction" in keys else 0.0
    swath = keys["swath"].number(CELL_SIZE) if "swath" in keys else None
    if swath is not None and (swath < cell_size or abs(swath / cell_size - round(swath / cell_size)) > WHOLE):
        raise keys["swath"].fault(f"is {swath:g} m", f"a whole number of cells of {cell_size:g} m, `cell_size`")
    return read_field(key.file("a file of polygons"), cell_size, boundary, direction, swath)


def _elevation(keys: dict[str, Key], cell_size: float | None, resolution: float | None) -> Grid:
    steepest = None
    if "max_slope_deg" in keys:
        steepest = keys["max_slope_deg"].number(Numbers(0, 90, "degrees", above=True))
    expected = f"an elevation file, or {BUILTIN}{JACKSBORO}"
    if keys["elevation"].text(expected).startswith(BUILTIN):
        keys["elevation"].choice((BUILTIN + JACKSBORO,))
        raster = jacksboro(cell_size)
    else:
        raster = read_elevation(keys["elevation"].file(expected), cell_size)
    return replace(elevation_grid(raster, resolution or 1.0, steepest), measured=raster.frame is not None)


def _scenario(ground: Ground, keys: dict[str, Key], source: Path) -> World:
    sources = keys["threats"].items("a list of sources", least=0)
    matrix = read_matrix(keys.get("robots"))
    threat, notes, apart, by_type = all_threats(sources, keys["combine"].choice(COMBINE), ground, matrix)
    frame = ground.frame
    if not ground.free.any():  # the notes on reading the map give the reason
        raise WorldError("every cell is an obstacle", source=source, fix="; ".join(ground.notes))
    cells = np.where(ground.free, threat, np.nan)
    of_cells, more = layers(keys, ground)
    world = World.create(
        cells, None, frame.size, frame.origin, str(source), (*ground.notes, *notes, *more), ground.grid.georeference,
        **of_cells,
    )  # fmt: skip
    world = replace(world, sources=apart, measured=ground.grid.measured)
    # Order: uncertainty before the unknown map, since sensors may choose among its candidates.
    pace = Pace(_seconds_in(keys, world), keys["turn"].number(TURNS) if "turn" in keys else 0.0)
    world = _with_uncertainty(replace(world, pace=pace), ground, keys)
    if "weibull_shape" in keys and isinstance(keys["weibull_shape"].value, dict):  # 0.3's `wear: {shape: 2}`
        keys["weibull_shape"] = keys["weibull_shape"].mapping(("shape",))["shape"]
    asked = _settings(SETTINGS, keys)
    world = replace(world, team=Team(settings=asked, **reported(keys, world)))
    world = _with_types(_with_knowledge(world, ground, keys), ground, keys, matrix, by_type)
    file = ground.grid.world
    # Starts of a world file are pixels: the cell that contains them is the start.
    own = None if file is None or file.starts is None else file.starts // ground.ratio
    return _with_robots(world, keys["robots"], own) if "robots" in keys else world.with_starts(own)


def _with_uncertainty(world: World, ground: Ground, keys: dict[str, Key]) -> World:
    """The world with the uncertainty or change of threats in the scenario, or in its map's world file."""
    named = [name for name in UNCERTAIN if name in keys]
    if (kept := _kept("uncertainty", world, ground, named, keys)) is not None:
        return replace(world, uncertainty=kept)
    if "plan_on" in keys and not {"moving_threats", "phases"} & keys.keys():
        expected, fix = "none without moving_threats or phases", "of uncertain maps it is a key of `map_uncertainty`"
        raise keys["plan_on"].wrong(expected, fix)
    if len(named) > 1:
        raise keys[named[1]].wrong(f"none together with {named[0]}", "leave one of the two out")
    return UNCERTAIN[named[0]](keys, world, ground) if named else world


def _with_knowledge(world: World, ground: Ground, keys: dict[str, Key]) -> World:
    """The world with the unknown map in the scenario, or in its map's world file."""
    kept = _kept("knowledge", world, ground, [name for name in KNOWLEDGE if name in keys], keys)
    return read_knowledge(keys, world, load_input) if kept is None else replace(world, knowledge=kept)


def _with_types(
    world: World, ground: Ground, keys: dict[str, Key], matrix: Matrix, by_type: NDArray[np.float64]
) -> World:
    """The world with the robot types of the scenario's matrix, or of its map's world file."""
    if (kept := _kept("types", world, ground, matrix, keys)) is not None:
        # Keys of the scenario have priority over the assignment in the world file.
        team = {"types": kept.team} if kept.team else {}
        return replace(world, types=kept, team=replace(world.team, settings=team | {**world.team.settings}))
    types = checked_types(tuple(matrix), by_type, world.free, world.source) if matrix else None
    return replace(world, types=types)


def _kept(name: str, world: World, ground: Ground, added: Collection[str], keys: dict[str, Key]) -> Any:
    """This attribute of the map's world file, or None.

    It belongs to exactly the threats of the file: any other would contradict it.

    Raises:
        MapError: the scenario adds threats, or names the keys `added`.
    """
    file = ground.grid.world
    kept = None if file is None else getattr(file, name)
    if file is None or kept is None:
        return None
    if added or keys["threats"].value or not np.array_equal(world.threat, file.threat, equal_nan=True):
        problem, fix = f"nothing can be added to its {kept.description}", "use the world file without a scenario"
        raise MapError(problem, source=ground.grid.source, fix=fix)
    return kept


def _with_robots(world: World, key: Key, own: NDArray[np.int64] | None) -> World:
    """The world with the robots of its file; `own`: the starts in its map's world file.

    A `start` rule, or starts, replace those of the world file; a `count` without them must agree with it.
    """
    keys = key.mapping(optional=("count", "start", "starts", "starts_xy", "matrix", "speed", *OF_ROBOTS))
    if "speed" in keys:
        if "steps_per_move" in keys:
            raise keys["speed"].wrong("none together with steps_per_move", "leave one of the two out")
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
        fix = "leave out one of them" if named else f"or give start: {RULES[0]} to place the robots again"
        raise keys["count"].wrong(f"{len(starts)}, as there are {len(starts)} starts", fix)
    return world.with_starts(starts)


def _settings(names: Iterable[str], keys: dict[str, Key]) -> dict[str, Any]:
    """The values of these planner settings that the keys name."""
    return {name: keys[name].setting(KNOWN[name]) for name in names if name in keys}


def _starts(key: Key, world: World) -> NDArray[np.int64]:
    """Starts (row, col) int64 `[K, 2]` from `starts` or `starts_xy`, each on a free cell of the world."""
    metres = key.path.endswith("_xy")
    expected = "[x, y] in metres" if metres else "[row, col], whole numbers"
    of = ANY if metres else PLACE
    values = [item.numbers(of, expected, 2) for item in key.items(f"a list of {expected}")]
    with key.naming():
        # Clipped, since the conversion of huge numbers to integers is undefined.
        return check_starts(world.to_cells(np.clip(values, -1e12, 1e12)) if metres else values, world.met, key.path)


# Writing scenario files: with other starts (`starts --scenario-out`), and a team's settings.

PLACED = ("count", "start", "starts", "starts_xy")
"""Keys of `robots` for number and starts."""


def team_keys(team: dict[str, Any], settings: Settings, pace: Pace) -> dict[str, Any]:
    """Keys of a scenario for a team.

    Args:
        team: keys of `robots`.
        settings: planner settings; defaults are left out.
        pace: duration of a step.
    """
    usual = Settings()
    given = {name: value for name, value in vars(settings).items() if value != getattr(usual, name)}
    keys = {name: given[name] for name in SETTINGS if name in given}
    keys |= {"step": {"seconds": pace.seconds}} if pace else {}
    keys |= {"turn": pace.turn} if pace.turn else {}
    return {"robots": team | {name: given[name] for name in OF_ROBOTS if name in given}} | keys


def write_scenario(
    out: Path, source: Path, starts: NDArray[np.int64], settings: Settings, pace: Pace, cell_size: float | None = None
) -> None:
    """Write a scenario with other starts, atomically; comments are lost.

    Args:
        out: the file to write; paths in it are relative to its folder.
        source: a scenario, or a map without scenario.
        starts: int64 `[K, 2]`, (row, col).
        settings: of the planner; those with a scenario key are written.
        pace: duration of a step.
        cell_size: metres, for a map without scenario.

    Raises:
        InputError: a file cannot be read or written.
    """
    top = read_yaml(source).value if source.suffix.lower() in YAML else None
    if isinstance(top, dict) and "map" in top:
        keys = _moved(with_new_names(top, OPTIONAL, source), source.parent, out.parent)
    else:
        keys = {"map": {"file": _moved(source.name, source.parent, out.parent)}}
        keys |= {} if cell_size is None else {"cell_size": cell_size}
    robots = with_new_names(keys.pop("robots", {}), OF_ROBOTS, source)
    team = {name: key for name, key in robots.items() if name not in (*PLACED, *OF_ROBOTS, "speed")}
    keys = {name: key for name, key in keys.items() if name not in (*SETTINGS, *TIME_KEYS)}
    keys |= team_keys({"starts": starts.tolist()} | team, settings, pace)
    with atomic_write(out) as stream:
        yaml.safe_dump(keys, stream, sort_keys=False, default_flow_style=None, width=120)


def _moved(value: Any, before: Path, after: Path) -> Any:
    """A value in which paths of files relative to `before` become relative to `after`."""
    if isinstance(value, dict):
        return {name: _moved(item, before, after) for name, item in value.items()}
    if isinstance(value, list):
        return [_moved(item, before, after) for item in value]
    if isinstance(value, str) and value and not Path(value).is_absolute() and (before / value).is_file():
        return Path(os.path.relpath(before.resolve() / value, after.resolve())).as_posix()
    return value
