"""Reading the state of a mission: state files, and files that robots leave (masks, tracks, logs), against a world."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from planner.arguments import MAX_PLAN_BYTES, MAX_STEP, Numbers, argument, whole
from planner.errors import MapError, StateError, UsageError
from planner.files import is_header, read_json, read_npy
from planner.formatting import counted, share
from planner.plan.reading import at, check_map, check_moves, check_partition, read_cell, read_cells, read_path
from planner.plan.state import (
    AREA_STATES,
    FORMAT,
    NAT,
    ON_ITS_WAY,
    RETURNING,
    STATUSES,
    VERSION,
    AreaState,
    MissionState,
    RobotState,
)
from planner.simulator.codes import NO_AREA, NO_ROBOT, Outcome
from planner.tally import OF_CLOSED_LOOP, WORDS_OF_0_3
from planner.world.frame import WGS84, Frame
from planner.world.grid import OCCUPIED, Grid
from planner.world.image_files import SUFFIXES as IMAGES
from planner.world.image_files import read_image, read_ros_map
from planner.world.keys import Key
from planner.world.map_files import is_bag, read_logged_map
from planner.world.points import LATITUDE, LONGITUDE, Table, X, Y, check_range, on_map, read_table
from planner.world.world import MAX_CELLS, MAX_ROBOTS, World, check_starts

OVER = tuple(one.word for one in OF_CLOSED_LOOP if one not in (Outcome.STEP_LIMIT, Outcome.DEADLINE))
"""Outcomes for which robots may be on their return to base."""
NATS = Numbers(0, 1e6, "nats")
Fault = tuple[str, ...]
"""Problem, expectation, and the fix if those do not imply it."""
ANEW = "write it with `record --state-at`, or leave areas, ahead and to_do out: areas are then allocated again"
DEFAULTS = {"world": {}, "step": 0, "survived": None, "areas": [], "to_do": None, "held": [], "quiet": 0}
DEFAULTS |= {"over": None, "delivered": None}
OF_ROBOTS = {"status": "idle", "area": NO_AREA, "ahead": [], "moves": 0, "exposure": None, "home": None}
OF_ROBOTS |= {"turned": False, "undelivered": []}
"""Keys that a state, and each of its robots, may lack."""


def load_state(path: str | Path, world: World) -> MissionState:
    """Read a state file (JSON), checked against a world (SPEC section 12).

    Raises:
        StateError: the file is invalid.
    """
    return parse_state(read_json(Path(path), MAX_PLAN_BYTES, StateError, "a state file (JSON)"), world, str(path))


def parse_state(
    data: object, world: World, source: str, before: World | None = None, *, waits: bool = False
) -> MissionState:
    """The state in a file's JSON, checked as by `load_state`.

    Args:
        data: the JSON.
        world: the map.
        source: names the file in errors.
        before: the world at the start of the mission, if cells were closed since; one may be a robot's first cell.
        waits: whether all cells in reach may be visited.

    Raises:
        StateError: it is invalid.
    """
    top = Key(data, "", source, StateError)
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StateError("is no state of a mission", source=source, expected=f'an object with "format": "{FORMAT}"')
    if data.get("version") != VERSION:
        problem = f"state version {reprlib.repr(data.get('version'))}"
        raise StateError(problem, source=source, expected=f"version {VERSION}")
    if data.get("begun") is False:
        problem, fix = "holds a mission whose first step is not over", "leave it out: nothing is done yet"
        raise StateError(problem, source=source, expected="a mission under way", fix=fix)
    keys = top.mapping(("robots", "visited"), defaults=DEFAULTS, strict=False)
    check_map(keys["world"], world, "state of", "give the map that the mission is on")
    given = keys["robots"].items("a list of robots")
    if len(given) > MAX_ROBOTS:
        raise keys["robots"].fault(f"has {len(given)} robots", f"1 to {MAX_ROBOTS}")
    held = [one.number(whole(0, len(given) - 1)) for one in keys["held"].items("a list of numbers of robots", least=0)]
    to_do = [Key([], "", source)] * len(given)
    if keys["to_do"].value is not None:
        to_do = keys["to_do"].items(f"{len(given)} lists of cells, one a robot", exactly=len(given))
    before = before or world
    robots = tuple(
        _state_file_robot(one, to_do[number], number in held, world, before) for number, one in enumerate(given)
    )
    areas = tuple(_area(one, world) for one in keys["areas"].items("a list of areas", least=0))
    visited = np.union1d(read_cells(keys["visited"], world), [robot.cell for robot in robots])
    survived = visited
    if keys["survived"].value is not None:
        standing = np.array([robot.cell for robot in robots if robot.alive], dtype=np.int64)
        survived = np.union1d(read_cells(keys["survived"], world), standing)
    step, quiet = keys["step"].number(whole(0, MAX_STEP)), keys["quiet"].number(whole(0, 1))
    over = None if keys["over"].value is None else keys["over"].choice(OVER, WORDS_OF_0_3)
    got = keys["delivered"]
    delivered = None if got.value is None else read_cells(got, before)
    found = MissionState(world.shape, world.sha256, step, visited, survived, robots, areas, quiet, over, delivered)
    check_state(found, world, source, waits=waits)
    return found


def _state_file_robot(key: Key, to_do: Key, held: bool, world: World, before: World) -> RobotState:
    keys = key.mapping(("cell",), defaults=OF_ROBOTS, strict=False)
    status, cell = keys["status"].choice(STATUSES), read_cell(keys["cell"], world)
    area = keys["area"].number(whole(NO_AREA, text=f"the id of an area, or {NO_AREA}"))
    ahead, moves = read_path(keys["ahead"], world), keys["moves"].number(whole(0, MAX_STEP))
    if status not in ON_ITS_WAY and (area != NO_AREA or len(ahead)):
        what = "both lost and moving" if status == "dead" else f"{status}, and has an area or a path"
        raise key.fault(f"is {what}", "no area and nothing ahead", "leave area and ahead out")
    check_moves(keys["ahead"], np.array([cell, *ahead]), world)
    exposure = None if keys["exposure"].value is None else round(keys["exposure"].number(NATS) * NAT)
    home = None if keys["home"].value is None else read_cell(keys["home"], before)
    if not isinstance(keys["turned"].value, bool):
        raise keys["turned"].wrong("true or false")
    turned = keys["turned"].value or status == RETURNING
    to_do_, undelivered = read_cells(to_do, world), read_cells(keys["undelivered"], before)
    return RobotState(cell, status, area, ahead, to_do_, moves, held, exposure, home, turned, undelivered)


def _area(key: Key, world: World) -> AreaState:
    key = Key(key.value, key.path, key.source, key.error, ANEW)
    keys = key.mapping(("level", "robot", "state", "cells"), strict=False)
    level = keys["level"].number(whole(0, what="the index of a level"))
    robot = keys["robot"].number(whole(NO_ROBOT, text=f"a robot, or {NO_ROBOT}"))
    state, cells = keys["state"].choice(AREA_STATES), read_cells(keys["cells"], world)
    if not len(cells):
        raise keys["cells"].wrong("at least one cell")
    return AreaState(level, robot, state, cells)


def check_state(state: MissionState, world: World, source: str, *, waits: bool = False) -> None:
    """Check that a state can be that of a mission on `world` that goes on; `waits`: as in `parse_state`.

    Raises:
        StateError: it cannot.
    """
    for problem, expected, *fix in chain(_of_cover(state, world, waits), _of_areas(state, world, source)):
        raise StateError(problem, source=source, expected=expected, fix="".join(fix))


def _of_cover(state: MissionState, world: World, waits: bool) -> Iterator[Fault]:
    """Faults of coverage: unreachable visited cells, survived cells not visited, nothing left to do, no robot."""
    accessible = world.accessible(state.starts).ravel()
    for name, cells in (("visited", state.visited), ("survived", state.survived)):
        for wrong in cells[~accessible[cells]]:
            yield f"{name}: no robot can have reached cell {at(wrong, world)}", "cells in its reach"
    for extra in np.setdiff1d(state.survived, state.visited):
        yield f"survived: cell {at(extra, world)} is not visited", "some of the visited cells"
    if not any(robot.alive for robot in state.robots):
        yield "every robot is dead", "a robot that goes on"
    waits = waits or any(robot.status == RETURNING for robot in state.robots)
    if len(state.visited) == int(accessible.sum()) and not waits:
        yield "every cell in reach is visited", "something left to do"


def _of_areas(state: MissionState, world: World, source: str) -> Iterator[Fault]:
    """Faults of areas: cells not in exactly one area, robots and areas that contradict each other."""
    moving = [(number, robot) for number, robot in enumerate(state.robots) if robot.status in ON_ITS_WAY]
    if not state.areas:
        for number, robot in moving:
            yield f"robot {number} is {robot.status}, and there are no areas", "idle, done or dead", ANEW
        return
    check_partition(state.areas, world, state.starts, StateError, source, ANEW)
    for number, area in enumerate(state.areas):
        unvisited = area.cells[~np.isin(area.cells, state.visited)]
        if area.state == "completed" and len(unvisited):
            cell = at(unvisited[0], world)
            yield f"area {number} is completed, and its cell {cell} is not visited", "visited ones", ANEW
        if area.state == "unassigned" and not len(unvisited):
            yield f"area {number} is unassigned, and has only visited cells", "completed", ANEW
        holders = [one for one, robot in enumerate(state.robots) if one == area.robot and robot.area == number]
        if area.state == "assigned" and not holders:
            problem = f"area {number} is assigned to robot {area.robot}, which has another or none"
            yield problem, "its own robot", ANEW
    for number, robot in moving:
        own = state.areas[robot.area] if NO_AREA < robot.area < len(state.areas) else None
        if own is None or own.robot != number or own.state == "unassigned":
            yield f"robot {number} is {robot.status}, but area {robot.area} is not its own", "its area", ANEW
        elif not len(robot.ahead):
            yield f"robot {number} is {robot.status}, and nothing is ahead", "the cells of its path", ANEW
        elif len(np.setdiff1d(robot.to_do, own.cells)) or (robot.status == "traveling" and len(robot.to_do)):
            yield f"robot {number}: to_do is not of its area", "the cells it still has to cover", ANEW


# States from files that robots leave: masks and grids of visited cells, lists of cells, tracks.

HALF = 0.5
"""Share of a cell's pixels that must be marked for the cell to count as visited."""
SUFFIXES = (".json", ".csv", ".npy", ".yaml", ".yml", ".mcap", *IMAGES)
"""Suffixes of files that a state is read from."""
TIMES = ("time", "t", "time_s", "t_s", "timestamp", "stamp", "datetime")
"""Columns of tracks with times, in numbers or ISO 8601; a column `step` has priority."""
KEEP_ONE = "keep one of them: `mcap filter LOG -y TOPIC -o OUT.mcap`"
"""How to select a topic of a log."""


class Found(NamedTuple):
    """Content of a file: visited cells, int64; the robots, if known; the step; notes."""

    visited: NDArray[np.int64]
    robots: tuple[RobotState, ...] = ()
    step: int = 0
    notes: tuple[str, ...] = ()


def read_state(path: str | Path, world: World, starts: ArrayLike | None = None) -> tuple[MissionState, tuple[str, ...]]:
    """Read the state of a mission from any file, checked.

    Args:
        path: a state file (JSON); driven tracks (.csv: robot and row, col, or x, y in metres, or lon, lat; also step or
            time, status); visited cells (.csv: row, col, with or without a header); a mask of the map's cells or pixels
            (.npy: above 0; a picture: bright), or an OccupancyGrid (.yaml of map_server, .mcap or a rosbag2 folder:
            occupied), in which marked cells are visited.
        world: the map.
        starts: `[K, 2]`, (row, col) of the robots now; required unless the file is a state or tracks.

    Returns:
        (state, notes).

    Raises:
        StateError, MapError, UsageError: the file or the starts are invalid.
    """
    path = Path(path)
    suffix = _suffix(path)
    if suffix == ".json":
        _check_no_starts(starts, path)
        return load_state(path, world), ()
    if suffix not in SUFFIXES:
        expected = "a state (.json), tracks or cells (.csv), a mask (.npy, .png) or a grid (.yaml, .mcap)"
        raise StateError(f"no state is read from {path.suffix!r}", source=path, expected=expected)
    found = _listed(path, world) if suffix == ".csv" else _marked(path, world)
    if found.robots:
        _check_no_starts(starts, path)
    elif starts is None:
        fix = f"give {argument('starts')}, one cell for each robot that goes on"
        raise StateError("does not give the robots' places", source=path, fix=fix)
    else:
        cells = check_starts(starts, world.threat, argument("starts"))
        found = found._replace(robots=tuple(RobotState(int(cell), "idle") for cell in cells @ (world.shape[1], 1)))
    return _state(found, world, path)


def _suffix(path: Path) -> str:
    """The suffix that determines the format; a rosbag2 folder is a log."""
    return ".mcap" if is_bag(path) else path.suffix.lower()


def _check_no_starts(starts: ArrayLike | None, path: Path) -> None:
    if starts is not None:
        other = argument("starts")
        raise UsageError(f"{other} and {path}, which gives the robots' places", fix=f"leave {other} out")


def _state(found: Found, world: World, path: Path) -> tuple[MissionState, tuple[str, ...]]:
    """The state, without cells that none of its robots can have reached; a note counts those."""
    at = np.array([robot.cell for robot in found.robots], dtype=np.int64)
    # Masks and tracks are inexact: marked cells out of the robots' reach are left out, and counted.
    reach = world.accessible(np.stack(np.divmod(at, world.shape[1]), axis=1)).ravel()
    visited, notes = np.union1d(found.visited[reach[found.visited]], at), found.notes
    lost = len(np.unique(found.visited)) - int(reach[np.unique(found.visited)].sum())
    if lost:
        notes += (f"{lost} of its cells are obstacles or out of the robots' reach: left out",)
    of_all, are = share(len(visited), max(int(reach.sum()), 1)), "is" if len(visited) == 1 else "are"
    notes += (f"{counted(len(visited), 'cell')} {are} visited ({of_all} of those in reach), step {found.step}",)
    # The file has no areas, so a plan from this state allocates the unvisited cells by Algorithm 1.
    state = MissionState(world.shape, world.sha256, found.step, visited, visited, found.robots)
    check_state(state, world, str(path))
    return state, tuple(f"{path.name}: {note}" for note in notes)


# --- masks and grids ---


def _marked(path: Path, world: World) -> Found:
    """Cells half of whose pixels are marked, or (pixels larger than cells) whose centre is in a marked pixel."""
    suffix, frame = _suffix(path), world.frame
    if suffix in (".yaml", ".yml", ".mcap"):
        grid = read_logged_map(path, choose=KEEP_ONE) if suffix == ".mcap" else read_ros_map(path)
        return Found(np.flatnonzero(_under(grid, frame)), notes=grid.notes)
    mask = _mask(path)
    ratio = _ratio(mask.shape, world.shape)
    if not ratio:
        problem, (height, width) = f"a mask of {mask.shape[0]} x {mask.shape[1]}", world.shape
        expected = f"the map's {height} x {width} cells, or its pixels"
        raise StateError(problem, source=path, expected=expected)
    (height, width), share = world.shape, mask[: world.shape[0] * ratio, : world.shape[1] * ratio]
    return Found(np.flatnonzero(share.reshape(height, ratio, width, ratio).mean(axis=(1, 3)) >= HALF))


def _mask(path: Path) -> NDArray[np.bool_]:
    if path.suffix.lower() != ".npy":
        picture = read_image(path)
        return (picture.bright >= HALF) & (True if picture.alpha is None else picture.alpha >= HALF)
    # Pickled arrays are refused by `read_npy`: a file must not run code.
    array = read_npy(path, MAX_CELLS)
    expected = "a mask [H, W]: True or above 0 where visited, 0 elsewhere"
    if array.ndim != 2 or array.size == 0 or array.dtype.kind not in "biuf":
        raise StateError(f"holds {array.dtype} {array.shape}", source=path, expected=expected)
    wrong = ~(np.isfinite(array) & (array >= 0))
    if wrong.any():
        row, col = np.argwhere(wrong)[0]
        problem = f"{array[row, col]} at row {row}, col {col} ({counted(int(wrong.sum()), 'such value')})"
        raise StateError(problem, source=path, expected=expected, fix="write 0 where it is unknown")
    return array > 0


def _ratio(pixels: tuple[int, ...], cells: tuple[int, ...]) -> int:
    """Pixels per side of a cell, 0 if these are not the pixels of the cells; incomplete blocks are dropped."""
    exact = [size // count for size, count in zip(pixels, cells, strict=True)]
    if exact[0] == exact[1] and exact[0] and pixels == tuple(exact[0] * count for count in cells):
        return exact[0]
    # More than one fit is ambiguous: the caller then refuses the mask and does not guess.
    fits = [n for n in range(1, max(exact) + 1) if all(p // n == c for p, c in zip(pixels, cells, strict=True))]
    return fits[0] if len(fits) == 1 else 0


def _under(grid: Grid, frame: Frame) -> NDArray[np.bool_]:
    """bool `[H, W]`: cells of the frame whose part on the grid is occupied by at least half."""
    # Pixels larger than cells: a cell may hold no pixel centre, so its own centre is looked up.
    if grid.frame.size > frame.size:
        at = grid.frame.pixels(frame.centres())
        held = grid.frame.holds(at)
        marked = np.zeros(frame.shape, dtype=bool)
        marked[held] = grid.occupancy[tuple(at[held].T)] >= OCCUPIED
        return marked
    under = frame.pixels(grid.frame.centres())
    held = frame.holds(under)
    cells = np.ravel_multi_index(tuple(under[held].T), frame.shape)
    size = frame.shape[0] * frame.shape[1]
    count = np.bincount(cells, minlength=size)
    marked = np.bincount(cells, grid.occupancy[held] >= OCCUPIED, minlength=size)
    return ((count > 0) & (marked >= HALF * count)).reshape(frame.shape)


# --- cells and tracks ---


class Track(NamedTuple):
    """The places of a robot; a reader may give several of one robot, and other coordinates.

    Attributes:
        name: of the robot.
        times: `[n]`, seconds or steps, as numbers or, before they are checked, texts; None: not known.
        points: float64 `[n, 2]`, (x, y) or (longitude, latitude) in `crs`.
        crs: of the points; "": metres of the map frame.
        status: "idle", "done", or "dead": the robot is lost.
    """

    name: str
    times: Any
    points: NDArray[np.float64]
    crs: str = ""
    status: str = "idle"


TRACK_STATUS = {"": "idle", "idle": "idle", "done": "done", "dead": "dead", "lost": "dead"}
"""Status by the words of a column `status`."""


def tracks_of(table: Table, world: World) -> list[Track]:
    """The tracks in a table, each in order of steps, else times, else the file.

    Robots are in order of their numbers or, if they have names, of the file; the last `status` of a robot counts.

    Raises MapError: no column `robot`, places, times or words that are none.
    """
    which, status, clock = table.column("robot"), table.column("status"), table.column("step", *TIMES)
    if which is None:
        expected = "robot, a time or step, and row, col or x, y or lon, lat"
        raise MapError(table.described, source=table.path, expected=expected)
    points, times = _places(table, world), None if clock is None else _times(table, clock)
    rows: dict[str, list[int]] = {}
    for number, (_, row) in enumerate(table.rows):
        rows.setdefault(row[which].strip(), []).append(number)
    found = []
    for name, held in rows.items():
        # A stable sort keeps the order of the file where steps or times are equal.
        held = held if times is None else sorted(held, key=times.__getitem__)
        line, last = table.rows[held[-1]]
        word = "" if status is None else last[status].strip().lower()
        if word not in TRACK_STATUS:
            problem = f"line {line}: status {word[:40]!r}"
            raise MapError(problem, source=table.path, expected="idle, done, dead or lost")
        own = None if times is None else [times[number] for number in held]
        found.append(Track(name, own, points[held], "", TRACK_STATUS[word]))
    # Ten digits and more are serial numbers, not indices of robots. As text, robot 10 would come before robot 2.
    if all(track.name.isdecimal() and len(track.name) < 10 for track in found):
        found.sort(key=lambda track: int(track.name))
    return found


def _times(table: Table, clock: int) -> list[float]:
    """Steps, numbers, or seconds of times in ISO 8601, of every line."""
    name, found = table.names[clock], []
    in_iso, in_steps = is_header(row[clock] for _, row in table.rows), name == "step"
    for line in table.rows:
        value = moment(line[1][clock]) if in_iso and not in_steps else table.number(line, clock, name)
        if math.isnan(value) or (in_steps and not (0 <= value <= MAX_STEP and value == int(value))):
            expected = "numbers or times in ISO 8601, as 2026-05-01T12:00:00.5Z, in all of its lines"
            problem, steps = f"line {line[0]}: {name} is {line[1][clock][:40]!r}", f"a whole number, 0 to {MAX_STEP}"
            raise MapError(problem, source=table.path, expected=steps if in_steps else expected)
        found.append(value)
    return found


def moment(text: str) -> float:
    """Seconds of a time in ISO 8601, of UTC without a time zone; NaN for any other text."""
    with suppress(ValueError, OverflowError):
        found = datetime.fromisoformat(text.strip())
        return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
    return math.nan


def _places(table: Table, world: World) -> NDArray[np.float64]:
    """(x, y) of every line in the map's frame, float64 `[lines, 2]`."""
    if cells := cell_columns(table):
        return world.at(*(table.places(cells, ("row", "col")) + 0.5).T)
    for names, crs in (((X, Y), ""), ((LONGITUDE, LATITUDE), WGS84)):
        if columns := table.columns(*names):
            return metres(table.lonlat(columns) if crs else table.places(columns), crs, world, table.path)
    expected = "row and col, or x and y in metres, or lon and lat"
    raise MapError(table.described, source=table.path, expected=expected)


def cell_columns(table: Table) -> list[int]:
    """The columns of row and col, the two of a table without a header; []: none."""
    if not table.names and len(table.rows[0][1]) == 2:
        return [0, 1]
    return table.columns(["row"], ["col", "column"])


def metres(points: NDArray[np.float64], crs: str, world: World, path: Path) -> NDArray[np.float64]:
    """Points of a file as metres of the map frame. Raises MapError where their CRS and the map's do not meet."""
    if not crs:
        return points
    if world.georeference is None:
        fix = "give columns x and y in metres, or a map with a `datum`"
        raise MapError(f"its places are in {crs}, and the map has no georeference", source=path, fix=fix)
    if crs == WGS84:
        check_range(points, "", path)
        return on_map(points, world.frame, world.georeference, path)
    try:
        return world.georeference.from_crs(points, crs)
    except MapError as error:
        raise MapError(error.problem, source=path, expected=error.expected, fix=error.fix) from error


def _check_cells(table: Table, cells: list[int], world: World) -> None:
    """Check rows and columns: they are exact, so that a wrong one is an error, where measured metres are left out."""
    places = table.places(cells, ("row", "col"))
    wrong = (places != np.rint(places)).any(axis=1) | ~((places >= 0) & (places < world.shape)).all(axis=1)
    expected, problem = "row 0..{} and col 0..{}".format(*np.subtract(world.shape, 1)), "no cell of the map"
    if not wrong.any():
        wrong = ~world.enterable[tuple(places.astype(np.int64).T)]
        expected, problem = "free cells", "an obstacle"
    if wrong.any():
        line, given = table.rows[int(np.argmax(wrong))]
        raise MapError(f"line {line}: {', '.join(given)[:60]!r} is {problem}", source=table.path, expected=expected)


def _listed(path: Path, world: World) -> Found:
    """Visited cells, or tracks if a column names the robots: each is at the place of its last line."""
    table = read_table(path, "lines row, col, or robot, row, col")
    if columns := cell_columns(table):
        _check_cells(table, columns, world)
    named = table.column("robot") is not None
    tracks = tracks_of(table, world) if named else [Track("", None, _places(table, world))]
    if len(tracks) > MAX_ROBOTS:
        raise MapError(f"{len(tracks)} robots", source=path, expected=f"at most {MAX_ROBOTS}")
    visited, robots, off = [], [], 0
    for track in tracks:
        pixels = world.to_cells(track.points)
        on = world.frame.holds(pixels)
        on[on] = world.enterable[tuple(pixels[on].T)]
        off += int((~on).sum())
        cells = pixels[on] @ (world.shape[1], 1)
        visited.append(cells)
        if named and not on[-1]:
            problem = f"robot {track.name[:40]} ends off the map or on an obstacle"
            raise MapError(problem, source=path, expected="its last place on a free cell")
        if named:
            # The Manhattan distance of successive places: a lower bound of the moves, since a log may skip cells.
            away = min(int(np.abs(np.diff(pixels[on], axis=0)).sum()), MAX_STEP)
            robots.append(RobotState(int(cells[-1]), track.status, moves=away, home=int(cells[0])))
    notes = table.notes
    if off:
        notes += (f"{off} of {len(table.rows)} places lie off the map or on obstacles: left out",)
    # Without steps, the mission has lasted at least as long as the most moves of one robot.
    in_steps = named and table.column("step") is not None
    steps = [track.times[-1] for track in tracks] if in_steps else [robot.moves for robot in robots]
    return Found(np.unique(np.concatenate(visited)), tuple(robots), int(max(steps, default=0)), notes)
