"""Debrief of a mission: coverage of tracks, gaps, the loss rate against the map's, and the rest of the mission."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.stats import gamma

from analysis.inputs import plan_from_state
from analysis.page.elements import CellLayer
from analysis.report.model import CellMaps, KeyFigure, Report, Section
from analysis.report.result import Result, map_text
from analysis.theory.exact import open_loop_exact
from analysis.tracks import Walk, read_tracks, walk
from analysis.utils.tables import Column, json_text, table_of
from planner.arguments import MAX_STEP, argument
from planner.errors import InputError, UsageError
from planner.failure_model import FailureModel
from planner.formatting import counted, in_percent, percent
from planner.json_objects import as_json
from planner.mrac.areas import connected_parts
from planner.plan.plan import Plan
from planner.plan.state import NAT, MissionState, RobotState
from planner.plan.state_file import Track
from planner.settings import Settings
from planner.simulator.codes import NO_CELL
from planner.world.world import MAX_ROBOTS, World

LEVEL = 0.95
"""Of the interval of the multiplier."""


@dataclass(frozen=True, eq=False)
class Flight:
    """What a robot flew.

    Attributes:
        name: of the robot. start: its first cell.
        cells: int64 `[n]`, the cells that it entered, in order; a cell may be there several times.
        times: float64 `[n]`, seconds or steps. lost: whether it was lost.
        gaps: number of gaps in time whose way is not known. off: share of its places off the map or on obstacles.
        hazard: cumulative hazard of its visits by the map and its failure model, nats; None: not known.
    """

    name: str
    start: int
    cells: NDArray[np.int64]
    times: NDArray[np.float64]
    lost: bool
    gaps: int
    off: float
    hazard: float | None

    @property
    def survived(self) -> NDArray[np.int64]:
        """The cells that it entered and survived."""
        return self.cells[: len(self.cells) - self.lost]


@dataclass(frozen=True)
class Multiplier:
    """Posterior of one factor on the map's hazard: Gamma(lost + 1/2, hazard), by Jeffreys' prior.

    Robots are lost as by a Poisson process in their cumulative hazard, stopped at the loss or at the end of the flight.

    Attributes:
        lost: number of lost robots. hazard: the sum of the robots' cumulative hazards, above 0, nats.
    """

    lost: int
    hazard: float
    json_keys = "mean ci95=interval above_one=above"

    @property
    def mean(self) -> float:
        """Expected factor."""
        return (self.lost + 0.5) / self.hazard

    @property
    def interval(self) -> tuple[float, float]:
        """The central interval of probability LEVEL."""
        ends = gamma.ppf(((1 - LEVEL) / 2, (1 + LEVEL) / 2), self.lost + 0.5, scale=1 / self.hazard)
        return float(ends[0]), float(ends[1])

    @property
    def above(self) -> float:
        """Probability that the true hazard is larger than the map's."""
        return float(gamma.sf(1.0, self.lost + 0.5, scale=1 / self.hazard))


@dataclass(frozen=True)
class RobotRow:
    """A robot's flight.

    Attributes:
        robot: its name. visits: number of cells that it entered, with repetition. cells: without.
        of_its_path: share of its planned cells that it entered; None: no plan.
        hazard: cumulative hazard of its visits by the map, nats; None: not known.
        survives: chance to survive them by the map. lost: whether it was lost.
        gaps_in_time: number of gaps whose way is not known. off_the_map: share of its places off the map or on
            obstacles.
    """

    robot: str
    visits: int
    cells: int
    of_its_path: float | None
    hazard: float | None
    survives: float | None
    lost: bool
    gaps_in_time: int
    off_the_map: float


@dataclass(frozen=True)
class AreaRow:
    """An area of the plan.

    Attributes:
        area: its id. robot: to which it was assigned, or None. level: index of its threat level.
        cells: number of cells. visited: share of them that some robot entered.
    """

    area: int
    robot: int | None
    level: int
    cells: int
    visited: float


@dataclass(frozen=True)
class GapRow:
    """A connected area of cells, flown or left.

    Attributes:
        gap: its number, the largest first. cells: number of cells. area_m2: their size; None: cells have no size.
        cell: the cell nearest to the middle, [row, col]. threat: the largest p in it.
    """

    gap: int
    cells: int
    area_m2: float | None
    cell: list[int]
    threat: float


@dataclass(frozen=True, eq=False, repr=False)
class Debrief(Result):
    """A mission as flown.

    Attributes:
        world: the map. plan: the plan that was to be flown, or None. tracks: the file.
        flights: by robot.
        state: the state at the end, for `plan` and `drive`; None: all robots are lost, or nothing is left.
        rest: the plan of the rest from there, or None. notes: remarks for the user.
    """

    reported_by = "analysis.debrief:report"
    listed = "gaps"

    world: World
    plan: Plan | None
    tracks: str
    flights: tuple[Flight, ...]
    state: MissionState | None
    rest: Plan | None
    notes: tuple[str, ...] = ()
    partial: bool = False
    json_keys = """
        answer=summary input=world.source tracks coverage.accessible=cells coverage.visited=visited_share
        coverage.survived=survived_share coverage.planned=planned_share coverage.expected=expected lost
        hazard=multiplier.hazard hazard_multiplier=multiplier robots areas gaps=gap_rows rest=rest_ends notes?
    """

    @cached_property
    def accessible(self) -> NDArray[np.bool_]:
        """bool `[N]`: cells that some robot can reach from its start."""
        starts = np.array([flight.start for flight in self.flights])
        return self.world.accessible(np.stack(np.divmod(starts, self.world.shape[1]), axis=1)).ravel()

    @cached_property
    def visited(self) -> NDArray[np.bool_]:
        """bool `[N]`: accessible cells that some robot entered."""
        return self.accessible & _marked(self.world, [flight.cells for flight in self.flights])

    @cached_property
    def survived(self) -> NDArray[np.bool_]:
        """bool `[N]`: those that some robot entered and survived."""
        return self.accessible & _marked(self.world, [flight.survived for flight in self.flights])

    @cached_property
    def expected(self) -> float | None:
        """Expected share of the accessible cells that the plan visits in the open loop; None: no exact value."""
        exact = None if self.plan is None else open_loop_exact(self.plan, self.world)
        return exact.visited / self.cells if exact is not None and exact.is_known else None

    @property
    def cells(self) -> int:
        """Number of accessible cells."""
        return int(self.accessible.sum())

    @property
    def visited_share(self) -> float:
        """Share of the accessible cells that some robot entered."""
        return float(self.visited.sum() / self.cells)

    @property
    def survived_share(self) -> float:
        """Share of the accessible cells that some robot entered and survived."""
        return float(self.survived.sum() / self.cells)

    @property
    def planned_share(self) -> float | None:
        """Share of the accessible cells on the plan's paths; None: no plan."""
        if self.plan is None:
            return None
        return float(_marked(self.world, [robot.path for robot in self.plan.robots]).sum() / self.cells)

    @cached_property
    def gaps(self) -> tuple[NDArray[np.int64], ...]:
        """Connected areas of accessible cells that no robot entered, the largest first: int64 cells each."""
        return connected(self.accessible & ~self.visited, self.world)

    @property
    def lost(self) -> int:
        """Number of lost robots."""
        return sum(flight.lost for flight in self.flights)

    @property
    def multiplier(self) -> Multiplier | None:
        """Loss rate met against the map's; None: no visit was dangerous, or the map has no hazard of a visit."""
        hazards = [flight.hazard for flight in self.flights if flight.hazard is not None]
        total = sum(hazards)
        return Multiplier(self.lost, total) if total > 0 and len(hazards) == len(self.flights) else None

    @property
    def robots(self) -> list[RobotRow]:
        """The robots."""
        rows = []
        for number, flight in enumerate(self.flights):
            path = None if self.plan is None else np.unique(self.plan.robots[number].path)
            kept = None if path is None else float(np.isin(path, flight.cells).mean())
            survives = None if flight.hazard is None else float(np.exp(-flight.hazard))
            visits, cells = len(flight.cells), len(np.unique(flight.cells))
            rows.append(RobotRow(flight.name, visits, cells, kept, flight.hazard, survives, flight.lost, flight.gaps,
                                 flight.off))  # fmt: skip
        return rows

    @property
    def areas(self) -> list[AreaRow]:
        """The areas of the plan."""
        return [
            AreaRow(number, None if area.robot < 0 else area.robot, area.level, len(area.cells),
                    float(self.visited[area.cells].mean()))
            for number, area in enumerate(() if self.plan is None else self.plan.areas)
        ]  # fmt: skip

    @property
    def gap_rows(self) -> list[GapRow]:
        """The gaps."""
        return [self.row_of(number, cells) for number, cells in enumerate(self.gaps)]

    def row_of(self, number: int, cells: NDArray[np.int64]) -> GapRow:
        """The row of connected cells."""
        places = np.stack(np.divmod(cells, self.world.shape[1]), axis=1)
        middle = places[np.square(places - places.mean(axis=0)).sum(axis=1).argmin()].tolist()
        size = len(cells) * self.world.cell_size**2 if self.world.measured else None
        threat = float(np.nan_to_num(self.world.threat.ravel()[cells]).max())
        return GapRow(number, len(cells), size, middle, threat)

    @property
    def rest_ends(self) -> dict[str, Any] | None:
        """Outcome of the plan of the rest without losses, and the step at which it ends; None: no such plan."""
        return None if self.rest is None else {"outcome": self.rest.outcome, "time": self.rest.time}


def connected(marked: NDArray[np.bool_], world: World) -> tuple[NDArray[np.int64], ...]:
    """4-connected areas of marked cells, bool `[N]`, the largest first: int64 cells each."""
    return tuple(sorted(connected_parts(world.shape, np.flatnonzero(marked)), key=len, reverse=True))


def _marked(world: World, paths: Sequence[NDArray[np.int64]]) -> NDArray[np.bool_]:
    """bool `[N]`: the cells of paths."""
    marked = np.zeros(world.threat.size, dtype=bool)
    marked[np.concatenate(paths)] = True
    return marked


def make_debrief(world: World, path: Path, plan: Plan | None, settings: Settings, lost: Collection[str]) -> Debrief:
    """The debrief of the tracks in a file.

    Args:
        world: the map. path: the tracks. plan: that was to be flown, or None.
        settings: of the plan of the rest, and failure model without a plan. lost: names of lost robots.

    Raises:
        MapError: the tracks cannot be read on this map.
        UsageError: a robot that is not in the tracks or in the plan.
    """
    tracks, in_steps = read_tracks(path, world)
    known: dict[str, Track | None] = {track.name: track for track in tracks}
    if plan is not None:
        known = _of_plan(known, plan, path)
    elif len(known) > MAX_ROBOTS:
        raise UsageError(f"{len(known)} robots in {path}", expected=f"at most {MAX_ROBOTS}")
    for name in lost:
        if name not in known:
            raise UsageError(argument("lost", name), expected=f"robots of {path}: {', '.join(known)[:80]}")
    step = 1.0 if in_steps else world.pace.seconds
    model, flights = settings.failure_model() if plan is None else plan.failure_model, []
    for number, (name, track) in enumerate(known.items()):
        start = NO_CELL if plan is None else int(plan.robots[number].path[0])
        # A robot without a track has not left its start.
        found = Walk(np.array([start]), np.zeros(1), 0, 0.0) if track is None else walk(track, world, step)
        hazard = _hazard(found, world.of_robots(model.types, len(known))[number], model, number, step)
        is_lost = name in lost or (track is not None and track.status == "dead")
        begin = int(found.cells[0]) if plan is None else start
        flights.append(Flight(name, begin, *found[:2], is_lost, *found[2:], hazard))
    done = Debrief(world, plan, str(path), tuple(flights), None, None, _notes(flights, known, step))
    state = _state(done, step)
    if state is None:
        return done
    try:
        rest = plan_from_state(world, state, replace(settings, plan_for="closed_loop"), str(path))
    except InputError as error:
        return replace(done, state=state, notes=(*done.notes, f"the rest is not planned: {error}"))
    return replace(done, state=state, rest=rest)


def _notes(flights: Sequence[Flight], known: Mapping[str, Track | None], step: float | None) -> tuple[str, ...]:
    """Remarks on the tracks."""
    absent = [name for name, track in known.items() if track is None]
    gaps, off = sum(flight.gaps for flight in flights), max(flight.off for flight in flights)
    begins = [track.times[0] for track in known.values() if track is not None]
    apart = max(begins) - min(begins)
    return tuple(
        said
        for said, is_true in (
            (f"no track of robot {', '.join(absent)}: taken to be at its start", absent),
            (f"{counted(gaps, 'gap')} in time: the way across is not known, its cells are not counted", gaps),
            (f"up to {percent(off)} of a robot's places lie off the map or on obstacles: left out", off),
            (f"first times of robots are {apart:g} apart: each robot's own clock is used", apart),
            (f"places are not averaged: give {argument('speed')} or {argument('step_seconds')}", step is None),
            ("the loss rate is not compared: threats move, or change at times that the tracks lack",
             any(flight.hazard is None for flight in flights)),
        )
        if is_true
    )  # fmt: skip


def _of_plan(known: Mapping[str, Track | None], plan: Plan, path: Path) -> dict[str, Track | None]:
    """The track of each robot of the plan, by number; names that are no numbers count in the order of the file."""
    robots = len(plan.robots)
    if not all(name.isdecimal() for name in known):
        known = {str(number): track for number, track in enumerate(known.values())}
    for name in known:
        if int(name) >= robots:
            expected, fix = f"robots 0 to {robots - 1} in {path}", "give the plan that was flown"
            raise UsageError(f"robot {name} is none of the plan's {robots}", expected=expected, fix=fix)
    return {str(number): known.get(str(number)) for number in range(robots)}


def _hazard(found: Walk, own: World, model: FailureModel, number: int, step: float | None) -> float | None:
    """Cumulative hazard of visits in the robot's failure model; None for threats that move, or change unknown when.

    `own`: the world as the robot meets it.
    """
    if own.moving_threats is not None or (own.phases is not None and step is None):
        return None
    if own.phases is None:
        # The p that was assumed is that of the planned map, whatever is true.
        nats = -np.log1p(-np.nan_to_num(own.threat.ravel()[found.cells]).astype(np.float64))
    else:
        # A move that begins at step t enters its cell at step t + 1, and crosses the border in between.
        steps = np.ceil((found.times - found.times[0]) / (step or 1.0) - 1e-9).astype(np.int64)
        nats = own.exposures[0][own.visits(found.cells, steps)] / NAT
    return max(0.0, float(-np.log(model.survival(nats.sum(), number))))


def _state(done: Debrief, step: float | None) -> MissionState | None:
    """The state after the flights, areas to be allocated anew; None if no robot is left, or nothing to do."""
    moves = [min(len(flight.cells) - 1, MAX_STEP) for flight in done.flights]
    # The duration of each robot by its own clock: clocks of robots need not agree.
    spans = [float(np.ptp(flight.times)) / step for flight in done.flights] if step is not None else moves
    robots = tuple(
        RobotState(int(flight.cells[-1]), "dead" if flight.lost else "idle", moves=count, home=flight.start)
        for flight, count in zip(done.flights, moves, strict=True)
    )
    if done.visited.sum() == done.cells or done.lost == len(robots):
        return None
    survived = np.union1d(np.flatnonzero(done.survived), [robot.cell for robot in robots if robot.alive])
    visited = np.union1d(np.flatnonzero(done.visited), [robot.cell for robot in robots])
    last = min(round(max(spans)), MAX_STEP)
    world = done.world
    return MissionState(world.shape, world.sha256, last, visited, survived, robots)


# The report: planned against flown, gaps, the loss rate, the rest.

SHOWN = 12
"""Rows of a table on a terminal; a page and JSON have all."""
SECTIONS: dict[str, tuple[str, dict[str, Callable[[Any], str]]]] = {
    "robots": ("Robots", {
        "robot": str, "visits": str, "cells": str, "of_its_path": in_percent, "hazard": "{:.3f}".format,
        "survives": in_percent, "lost": lambda lost: "lost" if lost else "", "gaps_in_time": str,
        "off_the_map": in_percent,
    }),
    "areas": ("Areas with cells left", {"area": str, "robot": str, "level": str, "cells": str, "visited": in_percent}),
    "gaps": ("Gaps", {"gap": str, "cells": str, "area_m2": "{:,.0f}".format, "cell": str, "threat": in_percent}),
}  # fmt: skip
"""Sections by their key in the JSON object: title, and how values of a row are shown, unless all are None."""
NOTE = "hazard: sum of -ln(1 - p) over the visits; survives: chance of that by the map"


def report(done: Debrief) -> Report:
    """The report of a debrief."""
    left = [area for area in done.areas if area.visited < 1.0]
    rows: dict[str, Sequence[Any]] = {"robots": done.robots, "areas": left, "gaps": done.gap_rows}
    parts = []
    for name, (title, _) in SECTIONS.items():
        cut = [f"A terminal shows {SHOWN} of {len(rows[name])}."] * (len(rows[name]) > SHOWN)
        if rows[name]:
            tables = [_table(name, rows[name][:SHOWN])], [_table(name, rows[name])]
            parts.append(Section(title, tables[0], [NOTE] * (name == "robots") + cut, whole=tables[1]))
    saved: dict[str, Callable[[], str]] = {}
    for file, part in (("state.json", done.state), ("rest.json", done.rest)):
        if part is not None:
            saved[file] = partial(json_text, part.to_json(), compact=True)
    if done.world.georeference is not None:
        saved["flown.geojson"] = partial(flown_geojson, done)
    return Report(
        "debrief", "debrief", f"{done.world.name}: what was flown?", _summary(done), done,
        findings=_findings(done), figures=_key_figures(done),
        heading=[f"{map_text(done.world, done.cells, len(done.flights))}, tracks {done.tracks}"],
        picture=lambda: _map(done), parts=parts, notes=done.notes, pace=done.world.pace,
        pictures={"debrief.png": lambda: _map(done)}, files=saved,
    )  # fmt: skip


def _table(name: str, rows: Sequence[Any]) -> Table:
    def column(key: str, show: Callable[[Any], str]) -> Column:
        title = key.replace("_", " ") + ", %" * (show is in_percent)
        return Column(title, lambda row: None if getattr(row, key) is None else show(getattr(row, key)))

    shown = {key: show for key, show in SECTIONS[name][1].items() if any(getattr(row, key) is not None for row in rows)}
    return table_of(map(column, shown, shown.values()), rows)


def _summary(done: Debrief) -> str:
    """Coverage as flown, against the plan, in one sentence."""
    planned = "" if done.planned_share is None else f" (planned: {percent(done.planned_share, 2)})"
    if done.expected is not None:
        planned = f"{planned[:-1]}, expected with losses: {percent(done.expected, 2)})"
    left = f"{counted(len(done.gaps), 'gap')} of {counted(sum(map(len, done.gaps)), 'cell')} left"
    share = percent(done.visited_share, 2)
    said = f"{counted(len(done.flights), 'robot')} visited {share} of the accessible cells{planned}"
    return f"{said}; {left if done.gaps else 'nothing left'}."


def _findings(done: Debrief) -> list[str]:
    found, lost = done.multiplier, f"{done.lost} of {counted(len(done.flights), 'robot')} lost"
    if found is not None:
        low, high = found.interval
        lost += (
            f"; by the map's hazard {found.hazard:.2f} are expected here. The hazard met is {found.mean:.2f} "
            f"times that of the map ({low:.2f} .. {high:.2f}), larger with probability {percent(found.above)}"
        )
    said = [f"{lost}."]
    if any(flight.lost and flight.hazard == 0 for flight in done.flights):
        said.append("A robot was lost on a way without danger: the map is wrong there, or something else destroyed it.")
    return said if done.rest is None else [*said, f"The rest, planned from here: {done.rest.ends}."]


def _key_figures(done: Debrief) -> list[KeyFigure]:
    figures = [KeyFigure(percent(done.visited_share, 2), "visited"), KeyFigure(str(done.lost), "robots lost")]
    if done.planned_share is not None:
        figures.insert(1, KeyFigure(percent(done.planned_share, 2), "planned"))
    if (found := done.multiplier) is not None:
        low, high = found.interval
        figures.append(KeyFigure(f"{found.mean:.2f}", "hazard met / hazard of the map", f"{low:.2f} .. {high:.2f}"))
    return figures


def _map(done: Debrief) -> CellMaps:
    from matplotlib.colors import ListedColormap, Normalize

    layer = CellLayer(
        "Flown and left", "Green: some robot entered the cell; orange: none did.",
        done.visited.astype(np.float64).reshape(done.world.shape), ListedColormap(["#fc8d62", "#66c2a5"]),
        norm=Normalize(0, 1), labels=(0.0, 1.0), names=("left", "flown"), short="Flown",
    )  # fmt: skip
    starts = np.array([divmod(flight.start, done.world.shape[1]) for flight in done.flights])
    gaps = [(f"gap {number}", cells, False) for number, cells in enumerate(done.gaps[:SHOWN])]
    return CellMaps(done.world, starts, [layer], gaps)


def flown_geojson(done: Debrief) -> str:
    """A FeatureCollection of polygons: `kind` "flown", and "left" for each gap, with its cells, area and largest p."""
    from analysis.exporting.mission import polygons

    areas = [*connected(done.visited, done.world), *done.gaps]
    facts = [{"kind": "flown" if done.visited[cells[0]] else "left"} | as_json(done.row_of(number, cells))
             for number, cells in enumerate(areas)]  # fmt: skip
    features = [
        {"type": "Feature", "properties": of, "geometry": {"type": "MultiPolygon", "coordinates": parts}}
        for of, parts in zip(facts, polygons(done.world, areas), strict=True)
    ]
    lines = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    return f'{{"type": "FeatureCollection", "features": [\n{lines}\n]}}\n'
