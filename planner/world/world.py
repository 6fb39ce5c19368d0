"""The world: a grid of threat probabilities, its place on the ground, and the world file."""

from __future__ import annotations

import hashlib
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from planner.arguments import MAX_STEP, Numbers, argument, check_each, check_word, exactly, is_whole
from planner.errors import MapError, PlanError, WorldError
from planner.failure_model import exposure_of
from planner.files import (
    atomic_write,
    check_file,
    check_new,
    library_errors,
    npz_bytes,
    read_csv_grid,
    read_npy,
    read_npz,
)
from planner.formatting import TURNS, UNPACED, Pace, chance, html_of, pace_of, text_of
from planner.simulator.codes import NO_CELL
from planner.world.frame import HOW_TO_GIVE_ONE, LONGEST, Frame, Georeference, principal
from planner.world.keys import (
    CELL_SIZE,
    COORDINATE,
    DETECT,
    POSE,
    PROBABILITY,
    SCALE,
    VALUE,
    as_numbers,
    checked_layer,
    first_of,
)
from planner.world.levels import entry_costs, find_levels
from planner.world.map_knowledge import Knowledge, Sensor, make_detector, make_knowledge, make_sensor
from planner.world.moving_threats import (
    FORESIGHTS,
    MOST_PHASES,
    PATROLS,
    PLAN_ON,
    Foresight,
    MovingThreat,
    MovingThreats,
    Phases,
    PlannedOn,
    make_moving_threats,
    moving_threats_in,
)
from planner.world.robot_types import RobotTypes, Sources, types_in
from planner.world.uncertain_maps import (
    MOST_CHANCES,
    MOST_LEVELS,
    Draws,
    Hazard,
    Uncertain,
    make_hazard,
    maps_of,
    spread_of,
    uncertain_in,
)

if TYPE_CHECKING:
    import networkx as nx

MAX_CELLS = 2**26
"""Largest grid accepted, in cells; a file header that claims more is rejected before memory is allocated."""
MAX_ROBOTS = 1024
"""Most robots that the random-number counter can address (SPEC section 6)."""
WORLD_FILES = (".npz", ".npy", ".csv")
EXAMPLE = "example:"
"""Prefix of the names of shipped examples."""
Obstacles = Literal["unknown", "known"]
OBSTACLES: tuple[Obstacles, ...] = ("unknown", "known")
Uncertainty = Hazard | Uncertain | MovingThreats | Phases
SensorRange = float | Sensor | Mapping[str, Any]
"""A range in cells, or `{range, sight}`."""
PLANNED_QUANTILE = Numbers(0, 1, above=True, below=True, text="mean, or a number between 0 and 1")
FOUR_NEIGHBOURS = ndimage.generate_binary_structure(2, 1)


@dataclass(frozen=True)
class Team:
    """Requests of an input about the team.

    `route`: int64 `[R, 2]`, (row, col) of the cells of the route that is to be safe, in order, or None.
    """

    robots: int | None = None
    start: str = "upper-left"
    settings: Mapping[str, Any] = field(default_factory=dict)
    route: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class World:
    """A grid world `[H, W]`, row 0 at the top (largest y). Build it with `World.create`, which checks it.

    Attributes:
        threat: float32 `[H, W]`; NaN = obstacle, else the probability `0 <= p < 1` that one visit destroys the robot.
        starts: int64 `[K, 2]`, (row, col) of each robot, or None if the input names none.
        cell_size: side of a cell in metres.
        origin: (x, y, yaw) in metres and radians: the pose of the grid's lower-left corner in the map's frame.
        source: origin of the world, for messages and plan files: a file, `example:NAME`, or a word.
        notes: effects of loading that a user should know (cells dropped, values clipped, ...).
        team: requests of the input about the team.
        georeference: position of the map's frame on the Earth, or None if not given.
        value: float64 `[H, W]`, value of each cell (0 on obstacles), or None: 1 each.
        detect: float64 `[H, W]`, probability that a survived visit detects what is in the cell, or None: 1 each.
        uncertainty: latent hazards, candidates of the true map, moving threats, or phases; robots plan on `threat`, and
            losses are drawn from these. None: every visit is an independent draw from `threat`.
        sources: the threats that `threat` was combined from, if a scenario names polygons, points or sites.
        knowledge: the true map, if it differs from the prior map `threat`. None: the map is known.
        types: threats of each robot type, if there are types; `threat` is then the map's own p, all factors 1.
        measured: whether `cell_size` was given; else it is assumed. pace: duration of a step, if given.
    """

    threat: NDArray[np.float32]
    starts: NDArray[np.int64] | None = None
    cell_size: float = 1.0
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    source: str = "world"
    notes: tuple[str, ...] = field(default=())
    team: Team = Team()
    georeference: Georeference | None = None
    value: NDArray[np.float64] | None = None
    detect: NDArray[np.float64] | None = None
    uncertainty: Uncertainty | None = None
    sources: Sources | None = None
    knowledge: Knowledge | None = None
    measured: bool = True
    pace: Pace = UNPACED
    types: RobotTypes | None = None

    @staticmethod
    def create(
        threat: ArrayLike,
        starts: ArrayLike | None = None,
        cell_size: ArrayLike = 1.0,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        source: str = "world",
        notes: tuple[str, ...] = (),
        georeference: Georeference | None = None,
        value: ArrayLike | None = None,
        detect: ArrayLike | None = None,
    ) -> World:
        """Make a checked world.

        Args:
            threat: `[H, W]`, probabilities; NaN or masked (`numpy.ma`): obstacle. Threats that are 0 as float32 count
                as safe, with a note.
            starts: `[K, 2]`, (row, col).
            cell_size: metres.
            origin: (x, y, yaw), see `World`.
            source: for messages.
            notes: kept in the world.
            georeference: of the map's frame.
            value, detect: `[H, W]`, or one number for all cells; ignored on obstacles.

        Raises:
            WorldError: names the first invalid cell, start or number.
        """
        array, vanished = _checked_threat(threat, source)
        (size,) = _reals("cell_size", cell_size, 1, CELL_SIZE, CELL_SIZE.expected, source)
        x, y, yaw = _reals("origin", origin, 3, COORDINATE, POSE, source)
        checked = None if starts is None else check_starts(starts, array, source)
        if vanished:
            notes = (*notes, f"{vanished} cells have a threat too small for 32-bit numbers: they count as safe (p = 0)")
        world = World(array, checked, size, (x, y, yaw), source, tuple(notes), georeference=georeference)
        return world.with_values(value, detect)

    @property
    def name(self) -> str:
        """File name without its folder: reports are passed on, and folder names may be private."""
        return Path(self.source).name or self.source

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return (int(self.threat.shape[0]), int(self.threat.shape[1]))

    @property
    def frame(self) -> Frame:
        """Position of the cells on the ground."""
        return Frame(self.shape, self.cell_size, self.origin)

    @property
    def free(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are not obstacles."""
        return ~np.isnan(self.threat)

    @property
    def met(self) -> NDArray[np.float32]:
        """float32 `[H, W]`, like `threat`: the true threats of the first step, whatever robots plan on."""
        if self.moving_threats is not None:
            return self.moving_threats.own
        if self.phases is not None:
            return self.phases.threats[0]
        return self.threat if self.knowledge is None else self.knowledge.truth

    @property
    def sha256(self) -> str:
        """Hash of the threat array as little-endian float32 in C order (SPEC section 9): the identity of the map."""
        return hashlib.sha256(np.ascontiguousarray(self.threat, dtype="<f4").tobytes()).hexdigest()

    @property
    def moving_threats(self) -> MovingThreats | None:
        """Moving threats, or None."""
        return self.uncertainty if isinstance(self.uncertainty, MovingThreats) else None

    @property
    def phases(self) -> Phases | None:
        """Threats that change by phases, or None."""
        return self.uncertainty if isinstance(self.uncertainty, Phases) else None

    @property
    def by_phase(self) -> NDArray[np.float32]:
        """float32 `[P, N]`: `met` in each phase; one phase if threats do not change."""
        return (self.met if self.phases is None else self.phases.threats).reshape(-1, self.threat.size)

    def visits(self, cells: NDArray[np.integer], steps: ArrayLike) -> NDArray[np.int64]:
        """Indices of visits in `by_phase` and `exposures`, flattened.

        Args:
            cells: int `[n]`, cell indices.
            steps: int `[n]`, or one step.
        """
        phase = 0 if self.phases is None else self.phases.number_at(steps)
        return np.asarray(cells + phase * self.threat.size, dtype=np.int64)

    @cached_property
    def draws(self) -> Draws | None:
        """Draws of an uncertain map, or None if every visit is an independent draw from `threat`."""
        return None if self.uncertainty is None else self.uncertainty.draws()

    @cached_property
    def exposures(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(hazards, table): hazard of a visit to each cell, int64 `[N]` or by phase `[P N]`, the largest one if maps
        differ; and the table of all, int64 `[M, C]` (`Draws`).
        """
        if self.uncertainty is None or isinstance(self.uncertainty, MovingThreats | Phases):
            return exposure_of(self.by_phase).ravel(), np.zeros((0, 0), dtype=np.int64)
        return self.uncertainty.exposures()

    @property
    def randomness_sha256(self) -> str:
        """Hash of the true threats: map, uncertainty, movement, robot types, and the true map if it is not known."""
        of = self.draws or self.moving_threats or self.phases
        drawn = "" if of is None else f"?{of.sha256}"
        # Estimates change decisions, so they are part of the identity.
        drawn += self.uncertainty.taught if isinstance(self.uncertainty, Hazard) else ""
        drawn += "" if self.types is None else f"&{self.types.sha256}"
        return self.sha256 + drawn + ("" if self.knowledge is None else f"!{self.knowledge.sha256}")

    @cached_property
    def _of_no_type(self) -> World:
        return replace(self, types=None)

    @cached_property
    def _of_types(self) -> tuple[World, ...]:
        """The world as robots of each type meet it."""
        assert self.types is not None
        return tuple(replace(self, threat=threat, types=None) for threat in self.types.threat)

    def of_robots(self, types: str | tuple[str, ...] | None, robots: int) -> tuple[World, ...]:
        """The world as each robot of a team meets it.

        Args:
            types: one type for all, one for each robot, or None.
            robots: K.

        Raises:
            PlanError: the world has no types, or not these.
            WorldError: types together with an uncertain or unknown map.
        """
        if types is None:
            return (self if self.types is None else self._of_no_type,) * robots
        if self.types is None:
            problem = f"{argument('types')} for a world without robot types"
            raise PlanError(problem, source=self.source, fix="give the scenario `robots: {matrix: ...}`")
        if self.uncertainty is not None or self.knowledge is not None:
            problem = "robot types require one known map"
            raise WorldError(problem, source=self.source, fix=f"leave {argument('types')} out")
        # One name stands for the whole team.
        names = (types,) * robots if isinstance(types, str) else types
        check_each("types", names, robots, self.source, "type")
        return tuple(self._of_types[self.types.number(name, self.source)] for name in names)

    @property
    def enterable(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are free on the true map or on the prior map."""
        return self.free | ~np.isnan(self.met)

    @property
    def learned_hazard(self) -> Hazard | None:
        """The latent hazard that robots estimate, or None."""
        return self.uncertainty if isinstance(self.uncertainty, Hazard) and self.uncertainty.learn else None

    @property
    def is_learned(self) -> bool:
        """Whether the robots' map may change during a mission: by sensors or by hazard estimates."""
        looks = self.knowledge is not None and self.knowledge.sensor.range > 0
        return looks or self.learned_hazard is not None

    def require_certain_map(self, what: str, or_else: str = "", hazards: bool = False) -> None:
        """Check that the map is known, certain and the same for all robots.

        Args:
            what: subject of the message: the function that requires it.
            or_else: further text of the fix.
            hazards: persistent latent hazards are supported.

        Raises:
            WorldError: it is not.
        """
        key = "" if self.uncertainty is None else self.uncertainty.key
        if not (hazards and isinstance(self.uncertainty, Hazard) and self.uncertainty.kind == "persistent"):
            self._refuse(what, self.uncertainty, "requires one known map", f"leave `{key}` out{or_else}")
        self.require_known_map(what, or_else)
        fix = f"leave `matrix` and `types` out{or_else}"
        self._refuse(what, self.types, "requires the same p for every robot", fix)

    def require_known_map(self, what: str, or_else: str = "") -> None:
        """Check that the map is known: robots neither update nor estimate it. Args and errors as in
        `require_certain_map`."""
        announced = self.phases if self.phases is not None and self.phases.are_announced else None
        for found, requires, fix in (
            (self.learned_hazard, "does not support hazard estimates", "leave `learn` out"),
            (announced, "requires threats known in advance", "use `plan_on: first` or `worst`"),
            (self.knowledge, "requires a known map", "leave `true_map`, `prior_map` and `sensor_range` out"),
        ):
            self._refuse(what, found, requires, fix + or_else)

    def _refuse(self, what: str, found: Uncertainty | Knowledge | RobotTypes | None, requires: str, fix: str) -> None:
        """Raise WorldError if the world has `found`, with which `what` does not work."""
        if found is not None:
            raise WorldError(f"{what} {requires}; here: {found.description}", source=self.source, fix=fix)

    def require_uniform(self, what: str) -> None:
        """Check that all cells count the same: no values and no detection probabilities.

        Args:
            what: subject of the message.

        Raises:
            WorldError: they differ.
        """
        named = [of.name for of in (VALUE, DETECT) if getattr(self, of.name) is not None]
        if named:
            said = " and ".join(f"`{name}`" for name in named)
            problem = f"{what} counts all cells alike; here: {said}"
            fix = f"leave {said} out; evaluate, size and front report value"
            raise WorldError(problem, source=self.source, fix=fix)

    @cached_property
    def components(self) -> NDArray[np.int32]:
        """int32 `[H, W]`: 4-connected components of the free cells of the true map, from 1; 0 = obstacle."""
        labels, _ = ndimage.label(~np.isnan(self.met), structure=FOUR_NEIGHBOURS)
        return labels.astype(np.int32)

    def accessible(self, starts: ArrayLike) -> NDArray[np.bool_]:
        """bool `[H, W]`: free cells of the true map that some robot can reach from its start `[K, 2]`."""
        rows, cols = check_starts(starts, self.met, self.source).T
        # By component: one lookup per cell instead of a search per robot.
        # Component 0 are the obstacles, which no start can be in.
        reached = np.zeros(self.components.max() + 1, dtype=np.bool_)
        reached[self.components[rows, cols]] = True
        return reached[self.components]

    def with_starts(self, starts: ArrayLike | None) -> World:
        """A copy with other starts `[K, 2]`, checked."""
        checked = None if starts is None else check_starts(starts, self.met, self.source)
        return replace(self, starts=checked)

    def to_xy(self, cells: ArrayLike) -> NDArray[np.float64]:
        """Centres of cells (indices `row * W + col`) in metres, map frame, float64 `[..., 2]`."""
        rows, cols = np.divmod(np.asarray(cells, dtype=np.int64), self.shape[1])
        return self.at(rows + 0.5, cols + 0.5)

    def at(self, rows: ArrayLike, cols: ArrayLike) -> NDArray[np.float64]:
        """(x, y) in metres, map frame, of positions in cells from the upper-left corner; centres are at .5.

        Args:
            rows, cols: `[...]`, down and to the right.

        Returns:
            float64 `[..., 2]`.
        """
        return self.frame.at(rows, cols)

    def to_lonlat(self, points: ArrayLike) -> NDArray[np.float64]:
        """(longitude, latitude) in degrees, WGS 84, of points (x, y) `[..., 2]` of the map's frame.

        Longitudes are in -180..180.

        Raises:
            MapError: the map has no georeference.
        """
        if self.georeference is None:
            problem = "the map has no georeference"
            raise MapError(problem, source=self.source, expected="a georeferenced map", fix=HOW_TO_GIVE_ONE)
        return principal(self.georeference.to_lonlat(points))

    def places(self, points: ArrayLike) -> NDArray[np.float64]:
        """Positions in cells (down, right) `[..., 2]` from the upper-left corner, of points (x, y) in metres."""
        local = self.frame.local(points) / self.cell_size
        return np.stack([self.shape[0] - local[..., 1], local[..., 0]], axis=-1)

    def with_values(self, value: ArrayLike | None = None, detect: ArrayLike | None = None) -> World:
        """A copy with other values and detection probabilities, checked.

        Args:
            value, detect: `[H, W]` or one number; None: 1 each.
        """
        free = self.free
        values = checked_layer(value, VALUE, free, self.source)
        return replace(self, value=values, detect=checked_layer(detect, DETECT, free, self.source))

    def with_pace(
        self, step_seconds: float | None = None, speed: float | None = None, turn: float | None = None
    ) -> World:
        """A copy with another duration of a step. Arguments not given keep their value.

        Args:
            step_seconds: seconds per step.
            speed: metres per second: a step lasts as long as a cell takes.
            turn: steps that a quarter turn costs.

        Raises:
            UsageError: a number out of range, or a speed without a given cell size.
        """
        found = pace_of(step_seconds, speed, self.cell_size if self.measured else None)
        TURNS.check("turn", turn, optional=True)
        pace = found if found else self.pace
        return replace(self, pace=replace(pace, turn=self.pace.turn if turn is None else float(turn)))

    def with_phases(self, phases: Sequence[tuple[Any, World | ArrayLike]], plan_on: Foresight = FORESIGHTS[0]) -> World:
        """The world with threats that change with time.

        Args:
            phases: pairs `(begin, threats)` in order of time: from step `begin` on, p of a visit is that of `threats`,
                an array `[H, W]` (NaN = obstacle, as in the world) or a world. A phase of step 0 replaces the map's p.
            plan_on: "now": robots learn of a change when it comes; "first": they plan on the first map only; "worst":
                on the cell-wise maximum.

        Raises WorldError for invalid phases, a world without a known map, or robot types.
        """
        self._require_single_uncertainty("phases")
        check_word("plan_on", plan_on, FORESIGHTS, WorldError, self.source)
        begins: list[int] = []
        maps: list[NDArray[np.float32]] = []
        for number, pair in enumerate(phases):
            name, least = f"phases[{number}]", begins[-1] + 1 if begins else 0
            if not (isinstance(pair, tuple | list) and len(pair) == 2):
                expected = "pairs (step, threats), e.g. (40, numpy.zeros((20, 20)))"
                raise WorldError(f"{name} is {type(pair).__name__}", source=self.source, expected=expected)
            if not is_whole(pair[0], least, MAX_STEP):
                expected = f"a step, {least} to {MAX_STEP}" + ": phases are in order of time" * (number > 0)
                raise WorldError(f"{name}.from is {pair[0]!r:.40}", source=self.source, expected=expected)
            begins.append(pair[0])
            maps.append(self._on_same_cells(pair[1], name))
        if not 0 < len(begins) <= MOST_PHASES:
            raise WorldError(f"{len(begins)} phases", source=self.source, expected=f"1 to {MOST_PHASES}")
        # The world's own threats hold until the first phase.
        if begins[0] != 0:
            begins, maps = [0, *begins], [self.threat, *maps]
        if len(begins) == 1:
            return replace(self, threat=maps[0])
        found = Phases(np.array(begins, dtype=np.int64), np.stack(maps), plan_on)
        return replace(self, threat=found.planned, uncertainty=found)

    def with_moving_threats(
        self, threats: Iterable[MovingThreat | Mapping[str, Any]], plan_on: PlannedOn | None = None
    ) -> World:
        """The world with moving threats in addition to its own.

        Args:
            threats: each with the keys of a scenario: `{"walk": 0.2, "h": 0.3, "count": 6}`, or
                `{"patrol": [[0, 0], [0, 1]], "h": 1}`; `{"walk": 0.5, "h": "threats"}`: each dangerous cell becomes a
                walker with its p.
            plan_on: "patrols": robots plan on p joined with the long-run cells of the threats with a route; "joined":
                of all of them; "own": on p alone. None: "patrols" ("joined" before release 0.4).

        Raises WorldError for invalid threats, a world without a known map, or robot types.
        """
        chosen = PATROLS if plan_on is None else plan_on
        check_word("plan_on", chosen, PLAN_ON, WorldError, self.source)
        self._require_single_uncertainty("moving_threats")
        found = make_moving_threats(threats, self.threat, plan_on is None, self.source)
        return replace(self, threat=found.planned(chosen, self.source), uncertainty=found)

    def with_latent_hazard(self, kind: str, q: ArrayLike, h: ArrayLike = 1.0, learn: bool = False) -> World:
        """The world with hazards that exist or not for a whole run, instead of its threats; robots plan on q * h.

        Args:
            kind: "persistent"; "consumed": the first hit removes it; "independent": every visit is drawn, from q * h.
            q: probability that the hazard exists. h: probability that a visit destroys the robot if it does. Numbers,
                or arrays `[H, W]`.
            learn: robots learn from their visits; `with_sensor_range` also gives them detectors.

        Raises WorldError for invalid probabilities, or together with other uncertainty or robot types.
        """
        self._require_single_uncertainty("latent_hazard", over=Hazard)
        if learn and kind == "independent":
            problem = "hazards drawn independently for every visit cannot be estimated"
            raise WorldError(
                problem, source=self.source, expected="persistent or consumed ones", fix="leave `learn` out"
            )
        hazard = make_hazard("persistent" if kind == "independent" else kind, q, h, self.free, self.source)
        hazard = replace(hazard, learn=bool(learn))
        return self._planning_on(hazard.threat, None if kind == "independent" else hazard)

    def with_maps(self, maps: Sequence[ArrayLike] | NDArray, plan_on: float | None = None) -> World:
        """The world with equally likely maps `[M, H, W]` of p, one of which is true in each run.

        Args:
            maps: float `[M, H, W]`, p; NaN = obstacle, as in the world.
            plan_on: None: robots plan on the mean, cell by cell; 0.9: on the 90 % quantile.

        Raises WorldError for maps with other obstacles or another shape, invalid probabilities, or together with other
        uncertainty or robot types.
        """
        self._require_single_uncertainty("maps", Uncertain, "; a prior is given after the maps")
        if len(maps) == 0:
            raise WorldError("uncertain maps is empty", source=self.source, expected="a map or more")
        checked = [self._on_same_cells(one, f"maps[{place}]") for place, one in enumerate(maps)]
        if len(checked) * self.threat.size > MOST_CHANCES:
            problem = f"{len(checked)} maps of {self.threat.size} cells"
            raise WorldError(problem, source=self.source, expected=f"at most {MOST_CHANCES} cells in all")
        uncertain = maps_of(np.stack(checked), f"one of {len(checked)} equally likely maps")
        PLANNED_QUANTILE.check("plan_on", plan_on, WorldError, self.source, optional=True)
        return self._planning_on(uncertain.plan_on(plan_on), uncertain)

    def with_spread(self, kind: str, amount: float, by: str = "common", plan_on: float | None = None) -> World:
        """The world with uncertain threats: the true p of each run is drawn around them.

        Args:
            kind: "lognormal", `amount` the standard deviation of log p; or "beta", `amount` an effective sample size.
            by: "common": one number for the whole map; "level": one for each of its threat levels, at most 16.
            plan_on: as in `with_maps`; the mean is the world's own threat.

        Raises WorldError for invalid arguments, or together with other uncertainty or robot types.
        """
        self._require_single_uncertainty("spread", or_else="; a prior is given after the maps")
        levels = find_levels(self.threat, self.free, MOST_LEVELS).of_cell.reshape(self.shape)
        uncertain, cut = spread_of(self.threat, levels, kind, amount, by, self.source)
        PLANNED_QUANTILE.check("plan_on", plan_on, WorldError, self.source, optional=True)
        note = f"the spread on p is cut off below 1 in {cut} cells: their mean is lower than the map's"
        # The mean of the spread is p up to rounding: the map's own values keep its levels exact.
        found = self._planning_on(self.threat if plan_on is None else uncertain.plan_on(plan_on), uncertain)
        return replace(found, notes=(*self.notes, *[note] * (cut > 0)))

    def with_true_map(self, true_map: World | ArrayLike, sensor_range: SensorRange = 0) -> World:
        """The world as the robots' prior map, together with the true map, which destroys robots.

        Args:
            true_map: p `[H, W]`, NaN = obstacle, or a world.
            sensor_range: in cells, or `{range, sight}`; 0: robots learn nothing, and the obstacles must be the same.

        Raises WorldError for other obstacles than a sensor can find, or together with another uncertainty.
        """
        for one in (self, true_map):
            other = (one.uncertainty or one.knowledge) if isinstance(one, World) else None
            if isinstance(one, World) and other is not None:
                problem = f"a true map together with another uncertainty: {other.description}"
                raise WorldError(problem, source=one.source)
        return self._with_knowledge(self.threat, self._threat_of(true_map, "truth"), sensor_range)

    def with_prior_map(self, p: float, obstacles: Obstacles = "unknown", sensor_range: SensorRange = 0) -> World:
        """The world as the true map of robots whose prior map has every cell free, with threat p.

        With `with_maps` the true map is the drawn one.

        Args:
            p: probability that a visit destroys the robot, as robots assume until they see a cell.
            obstacles: "known": the prior map has the obstacles; "unknown": robots find them.
            sensor_range: as in `with_true_map`.

        Raises WorldError for an invalid p, or together with another uncertainty.
        """
        check_word("obstacles", obstacles, OBSTACLES, WorldError, self.source)
        PROBABILITY.check("prior_map", p, WorldError, self.source)
        known = ~self.free if obstacles == "known" else np.zeros(self.shape, dtype=np.bool_)
        return self._with_knowledge(np.where(known, np.nan, p).astype(np.float32), self.met, sensor_range)

    def with_sensor_range(self, sensor_range: SensorRange) -> World:
        """The world with other sensors, of robots without a known map.

        Args:
            sensor_range: in cells, or `{range, sight}`; with learned hazards a detector, `{range, sight, detect,
                false_alarm}`.

        Raises WorldError for a known map.
        """
        if self.learned_hazard is not None:
            detector = make_detector(sensor_range, self.source)
            return replace(self, uncertainty=replace(self.learned_hazard, detector=detector))
        if self.knowledge is None and not isinstance(self.uncertainty, Uncertain):
            problem = "the map is known: a sensor range has no effect"
            hazard = "give `latent_hazard` the key `learn: true`" if isinstance(self.uncertainty, Hazard) else ""
            fix = hazard or "give a `true_map`, a `prior_map`, or `map_uncertainty`"
            raise WorldError(problem, source=self.source, fix=fix)
        return self._with_knowledge(self.threat, self.met, sensor_range)

    def with_range(self, cells: float) -> World:
        """A copy with another sensor range in cells; obstacles block the view as before. Raises WorldError."""
        sight = self.knowledge is not None and self.knowledge.sensor.sight and cells < inf
        return self.with_sensor_range(Sensor(cells, sight))

    def to_networkx(self) -> nx.DiGraph:
        """The free cells as a `networkx.DiGraph`: nodes (row, col) with `threat` and `pos` (metres).

        An edge into a cell has `cost` after eq. (3), in the integers of SPEC section 3 (no quantisation), and
        `hazard = -log(1 - p)`, the additive form of the survival probability.
        """
        import networkx as nx

        # Imported here: no other method needs the searches, and NetworkX is slow to load.
        from planner.simulator.searches import neighbour_table

        levels = find_levels(self.threat, self.free, most=self.threat.size + 1)
        costs, threat = entry_costs(levels, "paper"), self.threat.ravel()
        free = np.flatnonzero(self.free.ravel())
        name = {int(cell): divmod(int(cell), self.shape[1]) for cell in free}
        graph = nx.DiGraph(shape=self.shape, cell_size=self.cell_size, origin=self.origin)
        for cell, (x, y) in zip(free.tolist(), self.to_xy(free).tolist(), strict=True):
            graph.add_node(name[cell], threat=float(threat[cell]), pos=(x, y))
        for side in neighbour_table(self.shape, self.free.ravel()).T:
            for cell in free[side[free] != NO_CELL].tolist():
                entered = int(side[cell])
                hazard = float(-np.log1p(-np.float64(threat[entered])))
                graph.add_edge(name[cell], name[entered], cost=int(costs[entered]), hazard=hazard)
        return graph

    def _threat_of(self, given: World | ArrayLike, name: str) -> NDArray[np.float32]:
        """p `[H, W]` of a world or of an array, checked."""
        return (given if isinstance(given, World) else World.create(given, source=f"{self.source}: {name}")).threat

    def _on_same_cells(self, given: World | ArrayLike, name: str) -> NDArray[np.float32]:
        """p `[H, W]` of a world or of an array, checked to have this world's obstacles."""
        threat = self._threat_of(given, name)
        if threat.shape != self.shape:
            problem = f"{name} has shape {list(threat.shape)}"
            raise WorldError(problem, source=self.source, expected=f"that of the map, {list(self.shape)}")
        differ = np.isnan(threat) == self.free
        if differ.any():
            problem = f"{name} has other obstacles {first_of(differ)[1]}"
            raise WorldError(problem, source=self.source, expected="those of the map: only threats change")
        return threat

    def _planning_on(self, threat: NDArray[np.float32], uncertainty: Uncertainty | None) -> World:
        threat.setflags(write=False)
        return replace(self, threat=threat, uncertainty=uncertainty)

    def _with_knowledge(
        self, belief: NDArray[np.float32], truth: NDArray[np.float32], sensor_range: SensorRange
    ) -> World:
        """The world with the prior map `belief` and the true map `truth`, float32 `[H, W]`."""
        if self.uncertainty is not None and not isinstance(self.uncertainty, Uncertain):
            problem = f"map updates do not support this uncertainty: {self.uncertainty.description}"
            fix = f"leave out `{self.uncertainty.key}`, or `true_map`, `prior_map` and `sensor_range`"
            raise WorldError(problem, source=self.source, fix=fix)
        sensor = make_sensor(sensor_range, self.source)
        # Sensors compare whole maps: with a quantile per level there would be one map for each combination.
        if isinstance(self.uncertainty, Uncertain) and not self.uncertainty.whole and sensor.range > 0:
            problem = "sensors need whole maps to choose from; this uncertainty draws one quantile for each level"
            raise WorldError(problem, source=self.source, fix="draw one for the whole map: `by: common`")
        belief.setflags(write=False)
        knowledge = make_knowledge(belief, truth, sensor, self.source)
        starts = None if self.starts is None else check_starts(self.starts, truth, self.source)
        return replace(self, threat=belief, knowledge=knowledge, starts=starts)

    def _require_single_uncertainty(
        self, what: str, over: type[Hazard | Uncertain] | None = None, or_else: str = ""
    ) -> None:
        """Raise WorldError unless `what` may be the only uncertainty; it may replace one of kind `over`."""
        replaced = over is not None and isinstance(self.uncertainty, over)
        for other, expected in (
            (None if replaced else self.uncertainty, "one known map"),
            (self.knowledge, "one known map"),
            (self.types, "one known map for all robots"),
        ):
            if other is not None:
                another = "" if other is self.types else "another uncertainty: "
                more = "" if other is self.types else or_else
                problem, fix = f"`{what}` together with {another}{other.description}", f"leave one of the two out{more}"
                raise WorldError(problem, source=self.source, expected=expected, fix=fix)

    def to_cells(self, points: ArrayLike) -> NDArray[np.int64]:
        """(row, col) int64 `[..., 2]` of the cells that hold points (x, y) in metres; possibly off the map."""
        return self.frame.pixels(points)

    def _rows(self) -> list[tuple[str, str]]:
        free, dangerous = self.free, self.threat > 0
        worst = f", the worst {chance(float(self.threat[dangerous].max()))}" if dangerous.any() else ""
        team = "" if self.team.robots is None else f"{self.team.robots}, placed by the rule {self.team.start!r}"
        rows = [
            ("cells", f"{self.shape[0]} x {self.shape[1]} of {self.cell_size:g} m, {int(free.sum()):,} of them free"),
            ("threats", f"{int(dangerous.sum()):,} dangerous cells{worst}"),
            (
                "value",
                "" if self.value is None else f"{self.value.sum():g} in all, at most {self.value.max():g} a cell",
            ),
            ("detect", "" if self.detect is None else f"{self.detect[free].mean():.3g} a visit, on average"),
            ("place", "" if self.georeference is None else f"in {self.georeference.crs[:60]}"),
            ("step", f"{self.pace.seconds:g} s" if self.pace.seconds else ""),
            ("uncertainty", "" if self.uncertainty is None else self.uncertainty.description),
            ("types", "" if self.types is None else ", ".join(self.types.names)),
            ("knowledge", "" if self.knowledge is None else self.knowledge.description),
            ("robots", team if self.starts is None else f"{len(self.starts)}, starts {self.starts[:8].tolist()}"),
            *(("note", note) for note in self.notes[:4]),
        ]
        return [(name, what) for name, what in rows if what]

    def __repr__(self) -> str:
        return text_of(f"World {self.source}", self._rows())

    def _repr_html_(self) -> str:
        return html_of(f"World {self.source}", self._rows())

    def save(self, path: str | Path, *, force: bool = False) -> None:
        """Write the world file (`.npz`) of SPEC section 9 atomically.

        Args:
            path: of the file.
            force: replace an existing file.

        Raises UsageError if the file exists and `force` is not given.
        """
        check_new(path, force=force)
        with atomic_write(Path(path), "wb") as out:
            out.write(self.to_bytes())

    def to_bytes(self) -> bytes:
        """Content of the world file; equal for equal worlds."""
        return npz_bytes(**self.arrays())

    def arrays(self) -> dict[str, Any]:
        """Arrays of the world file, by name."""
        starts = {} if self.starts is None else {"starts": self.starts}
        origin = np.array(self.origin, dtype=np.float64)
        place = {} if self.georeference is None else {f"crs{end}": np.array(v) for end, v in _place(self.georeference)}
        uncertainty = {} if self.uncertainty is None else self.uncertainty.arrays()
        uncertainty |= {} if self.knowledge is None else self.knowledge.arrays()
        if self.types is not None:
            uncertainty |= replace(self.types, team=self.team.settings.get("types") or self.types.team).arrays()
        layers = {of.name: layer for of in (VALUE, DETECT) if (layer := getattr(self, of.name)) is not None}
        threat = {"threat": self.threat, "cell_size": np.float64(self.cell_size), "origin": origin}
        return threat | starts | place | uncertainty | layers


def check_starts(starts: ArrayLike, threat: NDArray[np.float32], source: str) -> NDArray[np.int64]:
    """Check starts.

    Args:
        starts: `[K, 2]`, (row, col).
        threat: float32 `[H, W]`, NaN = obstacle.
        source: for messages.

    Returns:
        int64 `[K, 2]`.

    Raises:
        WorldError: names the first robot that does not start on a free cell.
    """
    given = np.asarray(starts)
    is_whole_numbers = given.dtype.kind in "iu" or (given.dtype.kind == "f" and (given == np.round(given)).all())
    pairs = given.ndim == 2 and given.shape[1] == 2 and 0 < len(given) <= MAX_ROBOTS
    if not (pairs and is_whole_numbers) or np.ma.is_masked(starts):
        problem = f"starts are {_as_text(starts)}, of shape {given.shape}"
        expected = f"[row, col] as whole numbers, one a robot, of at most {MAX_ROBOTS}: [K, 2]"
        raise WorldError(problem, source=source, expected=expected)
    height, width = threat.shape
    for robot, (row, col) in enumerate(given.tolist()):
        inside = 0 <= row < height and 0 <= col < width
        if not inside or np.isnan(threat[int(row), int(col)]):
            what = "an obstacle" if inside else "outside the map"
            problem = f"robot {robot} starts at [{row:.15g}, {col:.15g}], {what}"
            expected = f"a free cell, row 0..{height - 1} and col 0..{width - 1}"
            fix = f"move the start, or use {argument('robots')} instead of {argument('starts')}"
            raise WorldError(problem, source=source, expected=expected, fix=fix)
    return given.astype(np.int64)


def _reals(name: str, value: ArrayLike, count: int, of: Numbers, expected: str, source: str) -> list[float]:
    """`count` real numbers (no strings, booleans or complex ones) as floats, else a WorldError."""
    try:
        given = np.asarray(value)
    except ValueError:  # lists of unequal length
        given = np.empty(0)
    found = [float(n) for n in given.reshape(-1)] if given.dtype.kind in "fiu" and given.size == count else []
    if not found or not all(map(of.accepts, found)):
        raise WorldError(f"{name} is {_as_text(value)}", source=source, expected=expected)
    return found


def _as_text(value: ArrayLike) -> str:
    return reprlib.repr(value.tolist() if isinstance(value, np.ndarray | np.generic) and value.size < 10 else value)


def _checked_threat(threat: ArrayLike, source: str) -> tuple[NDArray[np.float32], int]:
    """The threat array, and the number of its threats that are too small for float32."""
    array = as_numbers(threat, "threat", source, "fiub")
    if isinstance(threat, np.ma.MaskedArray):
        array = np.where(np.ma.getmaskarray(threat), np.nan, array)
    if array.ndim != 2 or not 0 < array.size <= MAX_CELLS:
        expected = f"a grid [H, W] of 1 to {MAX_CELLS} cells"
        raise WorldError(f"threat has shape {array.shape}", source=source, expected=expected)
    with np.errstate(over="ignore", under="ignore"):
        values = array.astype(np.float32)
    # Checked as float32, in which 0.99999999 is 1: engines compare float32 values.
    wrong = ~np.isnan(values) & ~((values >= 0) & (values < 1))
    if wrong.any():
        at, where = first_of(wrong)
        p, expected = float(array[at]), "a probability 0 <= p < 1 as float32, or NaN for an obstacle"
        fix = "write NaN for an obstacle, at most 0.9999999 for a threat" if p == -1 or 0.9 < p <= 1 else ""
        raise WorldError(f"threat is {exactly(p)} {where}", source=source, expected=expected, fix=fix)
    if np.isnan(values).all():
        raise WorldError("every cell is an obstacle", source=source, expected="at least one free cell")
    # One bit pattern for NaN and no negative zero: equal maps have equal hashes.
    canonical = np.where(np.isnan(values), np.float32(np.nan), values + np.float32(0.0)).astype(np.float32)
    canonical.setflags(write=False)
    return canonical, int(((canonical == 0) & (array != 0)).sum())


def load_world_file(path: str | Path) -> World:
    """Read a world file: `.npz` (SPEC section 9), a bare `.npy` threat array, or a `.csv` of it (-1 or nan = obstacle).

    Raises:
        MapError: the file cannot be read.
        WorldError: its content is no world.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in WORLD_FILES:
        raise MapError(f"unknown world format {path.suffix!r}", source=path, expected=" ".join(WORLD_FILES))
    check_file(path, "a world file")
    if suffix == ".npz":
        return world_of(read_npz(path, 8 * MAX_CELLS), str(path))
    if suffix == ".npy":
        return replace(World.create(read_npy(path, MAX_CELLS), source=str(path)), measured=False)
    values, notes = read_csv_grid(path, MAX_CELLS)
    values = np.where(values == -1, np.nan, values)
    return replace(World.create(values, source=str(path), notes=notes), measured=False)


def world_of(arrays: Mapping[str, NDArray], source: str) -> World:
    """The world in the arrays of a world file.

    Raises:
        MapError, WorldError: as in `load_world_file`.
    """
    if "threat" not in arrays:
        raise MapError(f"holds {sorted(arrays)}", source=source, expected="an array named 'threat'")
    size, origin = arrays.get("cell_size", 1.0), arrays.get("origin", np.zeros(3))
    place = _georeference(arrays, source) if "crs" in arrays else None
    world = World.create(arrays["threat"], None, size, origin, source, georeference=place)
    # The builders that users call check what a file holds: a file has no rules of its own.
    with library_errors("its arrays do not fit each other", source, "arrays as World.save writes them"):
        # The true map first: starts, phases and uncertainty are checked against it.
        if "truth" in arrays:
            far, sight = arrays.get("sense", np.zeros(2)).tolist()
            world = world.with_true_map(arrays["truth"], {"range": far, "sight": bool(sight)})
        if "starts" in arrays:
            world = world.with_starts(arrays["starts"])
        types = types_in(arrays, world.free, source) if "types" in arrays else None
        world = replace(world, uncertainty=_uncertainty_in(arrays, world), measured="cell_size" in arrays, types=types)
        return world.with_values(arrays.get("value"), arrays.get("detect"))


def _uncertainty_in(arrays: Mapping[str, NDArray], world: World) -> Uncertainty | None:
    """The uncertainty or change of a world's threats in the arrays of its file."""
    true = World(world.met, source=world.source)
    if "movers_own" in arrays:
        own = true._on_same_cells(arrays["movers_own"], "movers_own")
        return replace(true, threat=own).with_moving_threats(moving_threats_in(arrays), "own").uncertainty
    if "phases_threat" in arrays:
        begins, plan_on = arrays["phases_from"].tolist(), str(arrays["phases_plan_on"])
        pairs = list(zip(begins, arrays["phases_threat"], strict=True))
        found = true.with_phases(pairs, plan_on)  # type: ignore[arg-type]
        # The stored map of the plan has to follow from the phases: else plans and rollouts would disagree.
        if begins[0] or not np.array_equal(found.threat, world.threat, equal_nan=True):
            raise ValueError("threat does not follow from phases_*")
        return found.uncertainty
    if "hazard_kind" in arrays:
        learns = bool(np.any(arrays.get("hazard_learn", False)))
        true = true.with_latent_hazard(str(arrays["hazard_kind"]), arrays["hazard_q"], arrays["hazard_h"], learns)
        if learns and "hazard_detector" in arrays:
            far, sight, detect, false_alarm = arrays["hazard_detector"].tolist()
            sensor = {"range": far, "sight": bool(sight), "detect": detect, "false_alarm": false_alarm}
            true = true.with_sensor_range(sensor)
        return true.uncertainty
    return uncertain_in(arrays, true.free, world.source) if "uncertain_chances" in arrays else None


def _place(georeference: Georeference) -> tuple[tuple[str, Any], ...]:
    """World-file entries of a georeference: suffixes of the names `crs`, `crs_origin`, `crs_scale`, and values."""
    return ("", georeference.crs), ("_origin", georeference.origin), ("_scale", georeference.scale)


def _georeference(arrays: Mapping[str, NDArray], source: str) -> Georeference:
    crs = arrays["crs"]
    if crs.dtype.kind != "U" or crs.size != 1 or not 0 < len(str(crs.item())) <= LONGEST:
        raise WorldError(f"crs is {_as_text(crs)[:60]}", source=source, expected="the text of a CRS, as 'EPSG:32633'")
    pairs = []
    for name, default, of in (("crs_origin", (0.0, 0.0), COORDINATE), ("crs_scale", (1.0, 1.0), SCALE)):
        x, y = _reals(name, arrays.get(name, default), 2, of, "two numbers, x and y", source)
        pairs.append((x, y))
    return Georeference(str(crs.item()), *pairs)
