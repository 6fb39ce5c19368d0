"""The studio: a page to paint maps on, and its server, which listens on the loopback address and requires a token."""

from __future__ import annotations

import asyncio
import base64
import binascii
import json
import logging
import secrets
import shlex
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, partial
from hmac import compare_digest
from math import inf
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple

import numpy as np
import yaml
from matplotlib.colors import LinearSegmentedColormap, to_hex
from numpy.typing import NDArray
from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler

from analysis.estimators.racing import with_eyes
from analysis.estimators.trial import Measured, alike, closed_truth
from analysis.page.document import TEMPLATES, Html, asset, page_head, policy, whole_script
from analysis.page.elements import CellLayer
from analysis.page.maps import STEPS, packed_layer, path_lines, thickness
from analysis.pictures import COVERED, FOG, LOSSES, OBSTACLE, SAFE, SHADES, THREAT, UNREACHABLE
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.statistics.estimates import Estimate, losses_shown, robots_text
from analysis.statistics.estimates import exactly as exact_estimate
from analysis.statistics.variance_reduction import tally_mean
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.utils.tables import without_level
from planner.arguments import MAX_STEP, MOST_ROLLOUTS, exactly, whole
from planner.errors import InputError, MracError, UsageError, WorldError
from planner.files import Json, atomic_write
from planner.formatting import Pace, counted, percent
from planner.open_loop import plan_team
from planner.plan.plan import Plan, is_certain
from planner.policies import RULES
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.tally import Tally
from planner.world.keys import PLACE, PROBABILITY, Key
from planner.world.map_knowledge import RANGE, Sensor
from planner.world.scenario import team_keys
from planner.world.start_rule import place_starts
from planner.world.world import MAX_ROBOTS, World

# The page: controls around an empty map, which its script fills with the server's data.

PACKAGE = "analysis.studio"
SHARED = ("values.js", "choices.js", "cell_maps.js")
"""Scripts that reports use too."""
SCRIPTS = ("board.js", "picture.js", "answer.js", "studio.js")
PAINTED = LinearSegmentedColormap.from_list("painted", [SAFE, *(to_hex(THREAT(x / 4)) for x in range(5))])
LAYERS = (("Threat", PAINTED, True), ("Coverage", COVERED, False), ("Losses", LOSSES, True))
"""Name, colour map, and whether small values are spread by a square root."""


@cache
def _script() -> Html:
    return whole_script([*map(asset, SHARED), *(asset(name, PACKAGE) for name in SCRIPTS)])


def security_headers() -> dict[str, str]:
    """Headers of every response: the browser isolates this page from all others."""
    return {
        "Content-Security-Policy": f"{policy(_script(), chr(39) + 'self' + chr(39))}; frame-ancestors 'none'",
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "no-referrer",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


def palettes() -> Json:
    """Colours of the layers, and of cells without a value."""
    places = np.linspace(0, 1, SHADES)
    layers = [{"name": n, "colours": [to_hex(c) for c in colours(places)], "root": root} for n, colours, root in LAYERS]
    return {"layers": layers, "obstacle": OBSTACLE, "unreachable": UNREACHABLE, "unknown": FOG}


@cache
def studio_page() -> str:
    """The page as HTML, without any data of a map."""
    styles = "\n".join((asset("page.css"), asset("studio.css", PACKAGE)))
    return TEMPLATES.from_string(asset("studio.html", PACKAGE)).render(
        head=page_head("mrac-jax studio", styles, policy(_script(), "'self'")),
        rules=RULES.values(),
        most=MAX_ROBOTS,
        script=_script(),
    )


# The sketch on the page: cells, robots and settings. It is read with full checks, and saved as a scenario.

PAGE = Path("the page")
"""Source in errors about a request."""
LIMITS, KNOWN = ("risk_cap", "robot_value"), ("unknown", "believed", "sensor_range")


USUAL = Sensor(2.0)
"""Default sensor."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """A map, a team and settings, as painted on the page.

    Attributes:
        world: the map; its `starts` are the painted ones. robots: team size, for starts by rule.
        settings: for planning. deadline: a step at which coverage is also reported, or None.
        believed: threat of unknown cells on the prior map, a probability. sensor: the robots' sensor.
    """

    world: World
    robots: int
    settings: Settings
    deadline: int | None = None
    believed: float = 0.04
    sensor: Sensor = USUAL

    @classmethod
    def of(cls, world: World, robots: int, settings: Settings) -> Sketch:
        """The sketch of an input. Raises WorldError for an input that cannot be painted on."""
        known, sketch = world.knowledge, cls(world, robots, settings)
        if world.uncertainty is not None or world.types is not None:
            world.require_certain_map("painting")
        if known is None:
            return sketch
        believed = np.unique(world.threat[sketch.unknown])
        if len(believed) > 1 or np.isnan(believed).any():
            problem = "the prior map has several values in unknown cells"
            raise WorldError(problem, source=world.source, expected="one prior threat for all unknown cells")
        chance = float(believed[0]) if len(believed) else cls.believed
        return replace(sketch, believed=chance, sensor=known.sensor)

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells in which the prior map differs from the true map."""
        prior, true = self.world.threat, self.world.met
        return (prior != true) & ~(np.isnan(prior) & np.isnan(true))

    def starts(self) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """Starts int64 `[K, 2]`, painted or placed by the rule, and notes."""
        if self.world.starts is not None:
            return self.world.starts, ()
        return place_starts(self.world, self.robots)

    def to_json(self) -> Json:
        """The sketch in the format of `read_sketch`."""
        starts = None if self.world.starts is None else self.world.starts.tolist()
        cells, unknown = (
            base64.b64encode(of.tobytes()).decode() for of in (self.world.met.astype("<f4"), self.unknown)
        )
        sees = None if self.sensor.range == inf else self.sensor.range
        knows = {"unknown": unknown, "believed": float(f"{self.believed:.7g}"), "sensor_range": sees}
        said = {name: getattr(self.settings, name) for name in ("policy", *LIMITS)}
        return {"cells": cells, "starts": starts, "robots": self.robots, "deadline": self.deadline} | said | knows

    def save(self, out: Path) -> tuple[Path, Path]:
        """Write the scenario `out` and the world file with its cells in the same folder; return both paths."""
        raster = raster_of(out)
        starts = self.world.starts
        team: Json = {"count": self.robots} if starts is None else {"starts": starts.tolist()}
        keys = {"map": {"file": raster.name}} | team_keys(team, self.settings, self.world.pace)
        text = yaml.safe_dump(keys, sort_keys=False)
        self.world.with_starts(None).save(raster, force=True)
        with atomic_write(out) as stream:
            stream.write(f"# Painted in mrac-jax studio.\n{text}")
        return out, raster


def raster_of(out: Path) -> Path:
    """Path of the world file of a saved scenario."""
    return out.with_suffix(".npz")


def read_sketch(body: bytes, first: Sketch) -> tuple[Sketch, Mapping[str, Key]]:
    """The sketch of a request's JSON, for the map of the `first` one, and all keys of the request.

    Keys: `cells`, base64 of little-endian float32 `[H, W]`, NaN = obstacle. `starts`, `[[row, col], ...]`, or null for
    `robots` starts by the rule. `policy`, `risk_cap`, `robot_value`, `deadline`, as the options of `evaluate`; null:
    none. `unknown`, base64 of one byte for each cell; 1: unknown to the robots, with the prior threat `believed`.
    `sensor_range`, in cells; null: unlimited. Raises InputError.
    """
    try:
        top = Key(json.loads(body), "", PAGE, UsageError)
    except (ValueError, RecursionError):
        raise UsageError("not JSON", source=PAGE, expected="a board as JSON") from None
    keys = top.mapping(("cells", "starts", "robots", "policy", *LIMITS, "deadline", *KNOWN), ("rollouts",))
    given = {name: keys[name].number(expected="a number, or null") for name in LIMITS if keys[name].value is not None}
    settings = Settings(
        **vars(first.settings) | dict.fromkeys(LIMITS) | given | {"policy": keys["policy"].choice(tuple(RULES))}
    )
    settings.check()
    robots = keys["robots"].number(whole(1, MAX_ROBOTS))
    ground, starts = first.world, _starts(keys["starts"])
    world = World.create(
        _cells(keys["cells"], ground.shape, "<f4"), starts, ground.cell_size, ground.origin, ground.source,
        georeference=ground.georeference, value=ground.value, detect=ground.detect,
    )  # fmt: skip
    world, deadline = replace(world, pace=ground.pace, measured=ground.measured), None
    if keys["deadline"].value is not None:
        step = ground.pace.last_step("deadline", keys["deadline"].value, str(PAGE))
        deadline = replace(keys["deadline"], value=step).number(whole(1, MAX_STEP, "a step"))
    believed, sees = keys["believed"].number(PROBABILITY), keys["sensor_range"]
    sensor = replace(first.sensor, range=inf if sees.value is None else sees.number(RANGE))
    unknown = _cells(keys["unknown"], ground.shape, "u1").astype(np.bool_)
    if unknown.any():
        prior = np.where(unknown, np.float32(believed), world.threat)
        with keys["sensor_range"].naming():
            world = replace(world, threat=prior).with_true_map(world, sensor)
    return Sketch(world, robots if starts is None else len(starts), settings, deadline, believed, sensor), keys


def _cells(key: Key, shape: tuple[int, int], kind: str) -> NDArray:
    expected = f"{shape[0]} x {shape[1]} cells as base64 of {np.dtype(kind).name}"
    try:
        cells = np.frombuffer(base64.b64decode(key.text(expected), validate=True), dtype=kind)
    except (binascii.Error, ValueError):
        raise key.wrong(expected) from None
    if cells.size != shape[0] * shape[1]:
        raise key.wrong(expected)
    return cells.reshape(shape)


def _starts(key: Key) -> list[list[int]] | None:
    if key.value is None:
        return None
    items = key.items("a list of starts")
    if len(items) > MAX_ROBOTS:
        raise key.wrong(f"at most {MAX_ROBOTS} pairs [row, col]")
    return [item.numbers(PLACE, "[row, col], whole numbers", 2) for item in items]


# Texts of a result: the summary, and the figures below it.

WAITING = "..."
"""Placeholder of a figure that is not computed yet."""


class Figure(NamedTuple):
    """A figure of the result: value, name, note."""

    value: str
    name: str
    note: str


def summary(robots: int, mean: Estimate, losses: Estimate, alone: bool = False) -> str:
    """The summary of the closed loop; `alone`: of the open loop, in which no robot takes over another's work."""
    covers = f"{counted(robots, 'robot covers', 'robots cover')} {without_level(coverage(mean))} of accessible cells"
    if alone:
        covers = f"In the open loop, {counted(robots, 'robot')} would cover {without_level(coverage(mean))}"
    return f"{covers}; {robots_text(losses.mean, robots, min(losses.digits(), 2))} lost."


def coverage(mean: Estimate) -> str:
    """A mean coverage in percent with its interval, or marked as exact."""
    return f"{percent(mean.mean, 2)} (exact)" if mean.half_width == 0 else mean.describe(100.0, " %")


def page_figures(
    cells: int, robots: int, mean: Estimate | None, losses: Estimate | None, rollouts: int, exact: OpenLoopExact | None
) -> list[Figure]:
    """Coverage, losses, and the open loop's exact coverage if it applies; None: not computed yet."""
    runs = f"{counted(rollouts, 'rollout')}, {counted(cells, 'accessible cell')}" if rollouts else "simulating"
    lost, sure = (WAITING, "") if losses is None else losses_shown(losses, robots)
    found = [
        Figure(WAITING if mean is None else coverage(mean), "covered on average", runs),
        Figure(lost, "robots lost", sure),
    ]
    if exact is not None:
        alone = f"exact; {robots_text(exact.expected_losses, robots)} lost"
        found.append(Figure(percent(exact.visited / cells, 2), "covered in the open loop", alone))
    return found


def knowledge_figures(found: Sequence[Measured]) -> list[Figure]:
    """The cost of the unknown map, and the gain by the sensor.

    `found`: the team with the known map, as it is, and possibly without a sensor; empty: not computed yet.
    """
    if not found:
        return [Figure(WAITING, "cost of the unknown map", "")]
    known, online, *without = found
    unit = 1.0 / known.largest("visited")

    def figure(more: Measured, less: Measured, names: tuple[str, str], what: str, team: Measured) -> Figure:
        alone, ahead = percent(team.mean("visited", unit).mean), more.ahead(less, "visited", unit)
        name, ahead = (names[0], ahead) if ahead.mean >= 0 else (names[1], ahead.negated)
        return Figure(ahead.describe(100.0, " points"), name, f"{what}: {alone} covered")

    costs = figure(known, online, ("cost of the unknown map", "gain by the unknown map"), "known map", known)
    sensing = ("gain by the sensor", "cost of the sensor")
    return [costs, *(figure(online, one, sensing, "no sensor", one) for one in without)]


def deadline_figures(
    step: int | None, pace: Pace, mean: Estimate | None, exact: OpenLoopExact | None, cells: int
) -> list[Figure]:
    """Coverage by the deadline, if there is one."""
    if step is None:
        return []
    alone = "" if exact is None else f"open loop: {percent(exact.by_deadline(step)[0] / cells, 2)}, exact"
    return [Figure(WAITING if mean is None else coverage(mean), f"covered by {pace.step(step)}", alone)]


def command_words(out: Path, rollouts: int | None, precision: float, deadline: int | None, seed: int) -> str:
    """The command that repeats the result for a saved sketch; without `rollouts`, one of equal precision."""
    many = ("--precision", exactly(precision)) if rollouts is None else ("--rollouts", str(rollouts))
    more = (() if deadline is None else ("--deadline", str(deadline))) + (() if seed == 0 else ("--seed", str(seed)))
    return shlex.join(["mrac-jax", "evaluate", str(out), *many, *more])


# The server: on the loopback address only, with a token, for requests of its own page only.
#
# Tornado is maintained, needs no other package, limits the size of requests, and is a dependency of `dask` anyway.

# One result at a time, in a separate thread: a new sketch ends the work on older ones.

LOG = logging.getLogger("mrac_jax")
GRACE_SECONDS = 2.0
"""Time that a result may take to end at shutdown: compilation cannot be interrupted."""
SUPERSEDED = {"superseded": True}
"""Last line of a result that a newer sketch ended."""
Tell = Callable[[Json | None], None]
"""Takes a line of the result; None: the end."""
Work = Callable[[Any, Callable[[], None]], Iterator[Json]]
"""`work(board, go_on)` yields the lines; it calls `go_on`, which raises Superseded after a newer sketch."""


class Superseded(Exception):
    """No client waits for this result any more."""


class Job:
    """A sketch that waits for its result, or whose result is being computed."""

    def __init__(self, board: Any, tell: Tell) -> None:
        self.board, self.tell, self._over = board, tell, False

    def end(self) -> None:
        """Mark the job as superseded."""
        self._over = True

    def go_on(self) -> None:
        """Raise Superseded if the job is."""
        if self._over:
            raise Superseded


class Latest:
    """Computes results with `work`, one at a time. One more job waits; a newer one replaces it."""

    def __init__(self, work: Work) -> None:
        self._work, self._jobs = work, SimpleQueue[Job | None]()
        self._newest: Job | None = None
        self.begun = 0
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._thread.start()

    def submit(self, board: Any, tell: Tell) -> Job:
        """Compute this result next; `tell` is called from the worker thread. Call from one thread only."""
        job = Job(board, tell)
        old, self._newest = self._newest, job
        if old is not None:
            old.end()
        with suppress(Empty):
            # A waiting job is replaced, so at most one waits.
            waited = self._jobs.get_nowait()  # the thread that removes a job must end it
            if waited is not None:
                waited.tell(SUPERSEDED)
                waited.tell(None)
        self._jobs.put(job)
        return job

    def close(self) -> None:
        """End the thread at its next step; it is a daemon, so it never outlives the program."""
        if self._newest is not None:
            self._newest.end()
        self._jobs.put(None)
        self._thread.join(GRACE_SECONDS)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._answer(job)

    def _answer(self, job: Job) -> None:
        self.begun += 1
        try:
            job.go_on()
            for line in self._work(job.board, job.go_on):
                job.tell(line)
                job.go_on()
        except Superseded:
            job.tell(SUPERSEDED)
        except MracError as error:
            job.tell({"error": str(error)})
        except Exception as error:  # a bug: report it on the page, and go on with the next job
            LOG.exception("studio")
            job.tell({"error": f"a bug in mrac-jax ({type(error).__name__}): please report the terminal's output"})
        finally:
            job.tell(None)


# The result for a sketch, line by line: first the open loop's exact one, then the closed loop's with growing precision.

PRECISION = 0.005
"""Half-width of the 95 % interval of mean coverage at which the rollouts end, as `--precision`."""
MOST_PAIRS = 2048
"""Rollouts of each team with another sensor: with common random numbers, few are enough."""
SHOWN_SECONDS = 0.25
"""Seconds between two lines of running rollouts."""
GoOn = Callable[[], None]
"""Raises an exception that ends the work after a newer sketch."""


@dataclass(frozen=True, eq=False)
class Board:
    """A sketch with its plan.

    Attributes:
        accessible: bool `[H, W]`. exact: expectations of the open loop. certain: all rollouts are equal.
    """

    sketch: Sketch
    plan: Plan
    accessible: NDArray[np.bool_]
    exact: OpenLoopExact
    certain: bool
    notes: tuple[str, ...]

    def open_line(self) -> Json:
        """The open loop's line, the first, with the planned paths; null: too long to draw."""
        exact = self.exact
        mean, losses = exact_estimate(exact.visited / int(self.accessible.sum())), exact_estimate(exact.expected_losses)
        said = summary(len(self.plan.robots), mean, losses, alone=True)
        line = self._line("open", said, None, None, 0, [exact.visited_by_cell, exact.stops_by_cell])
        return line | {"paths": path_lines(self.plan), "thickness": thickness(self.plan)}

    def closed_line(
        self,
        stage: str,
        tally: Tally,
        known: Estimate | None = None,
        by_deadline: Estimate | None = None,
        knowing: Sequence[Measured] = (),
    ) -> Json:
        """A line of the closed loop; `known`: exact mean, if computed; `knowing`: result of `with_other_sensors`."""
        mean, losses = known or visited_mean(tally), tally_mean(tally, "lost", certain=self.certain)
        said = summary(tally.robots, mean, losses)
        maps = [tally.covered_visited / tally.rollouts, tally.stops / tally.rollouts]
        line = self._line(stage, said, mean, losses, tally.rollouts, maps, by_deadline)
        if self.sketch.world.knowledge is None:
            return line
        figures = [*line["figures"], *knowledge_figures(knowing)]
        # Robots replan, so the planned paths are not driven.
        return line | {"figures": figures, "paths": None, "thickness": 0}

    def _line(
        self,
        stage: str,
        summary: str,
        mean: Estimate | None,
        losses: Estimate | None,
        rollouts: int,
        maps: list[NDArray[np.float64]],
        by_deadline: Estimate | None = None,
    ) -> Json:
        """Data for the page; `maps`: probability of coverage and robots lost, `[N]` each."""
        world, cells = self.sketch.world, int(self.accessible.sum())
        alone = self.exact if world.knowledge is None else None
        figures = page_figures(cells, len(self.plan.robots), mean, losses, rollouts, alone)
        figures += deadline_figures(self.sketch.deadline, world.pace, by_deadline, alone, cells)
        covered, lost = (values.reshape(world.shape) for values in maps)
        layers = (
            CellLayer("Coverage", "", covered, COVERED, "%", digits=2),
            CellLayer("Losses", "", lost, LOSSES, root=True),
        )
        return {
            "stage": stage,
            "summary": summary,
            "figures": figures,
            "notes": self.notes,
            "rollouts": rollouts,
            "starts": self.plan.starts.tolist(),
            "steps": STEPS,
            "layers": [packed_layer(layer, ~np.isnan(world.met), self.accessible) for layer in layers],
        }


def visited_mean(tally: Tally) -> Estimate:
    """Mean visited coverage, a fraction of the accessible cells."""
    return tally_mean(tally, "visited", 1.0 / tally.accessible)


def with_other_sensors(board: Board, choices: RolloutChoices) -> list[Measured]:
    """The team with the known map, the team itself, and, if obstacles are known, the team without a sensor."""
    world = board.sketch.world
    assert world.knowledge is not None
    known, sees = world.knowledge, world.knowledge.sensor.range
    ranges = [inf, sees, *[0.0] * (sees > 0 and known.safe_without_sensor(world.free))]
    teams = [with_eyes(world, board.plan, far, replace(choices, exact="never")) for far in ranges]
    return list(alike(teams, 0, choices.rollouts))


def answers(sketch: Sketch, seed: int, kept: AllPairs, go_on: GoOn) -> Iterator[Json]:
    """Lines for the page, of growing precision. Raises InputError, and exceptions of `go_on`.

    The figures are those of `evaluate` for the same number of rollouts and seed; `kept`: cache of distance tables.
    """
    starts, notes = sketch.starts()
    plan = plan_team(sketch.world, starts, sketch.settings)
    go_on()
    exact, certain = open_loop_exact(plan, sketch.world), is_certain(sketch.world, plan)
    board = Board(sketch, plan, sketch.world.accessible(starts), exact, certain, (*notes, *plan.notes))
    if sketch.world.knowledge is None:
        yield board.open_line()
    choices = RolloutChoices(rollouts=1, precision=None if certain else PRECISION, seed=seed)
    roll_out = make_roll_out(sketch.world, plan, choices, kept=kept)
    looked, shown = 0, time.monotonic()
    for stage in roll_out(choices, None):
        go_on()
        tally = stage.tally
        if tally.rollouts >= 2 * looked:  # more frequent checks would stop too early by chance
            looked = tally.rollouts
            if certain or visited_mean(tally).half_width < PRECISION:
                break
        if time.monotonic() - shown > SHOWN_SECONDS:
            yield board.closed_line("closed", tally)
            shown = time.monotonic()
    yield board.closed_line("sure", tally)
    by_deadline = None
    if sketch.deadline is not None:
        for cut in roll_out(replace(choices, rollouts=tally.rollouts, precision=None), sketch.deadline):
            go_on()
            by_deadline = tally_mean(cut.tally, "visited", 1.0 / tally.accessible, certain=certain)
    knowing: list[Measured] = []
    if sketch.world.knowledge is not None:
        knowing = with_other_sensors(board, replace(choices, rollouts=min(tally.rollouts, MOST_PAIRS), precision=None))
        yield board.closed_line("sure", tally, None, by_deadline, knowing)
    go_on()
    truth = closed_truth(plan, sketch.world, exact, choices, kept)
    known = None if truth is None else exact_estimate(truth.visited.value / tally.accessible)
    yield board.closed_line("done", tally, known, by_deadline, knowing)


HOST = "127.0.0.1"
MOST_BYTES = 2 * 2**20
"""Limit of a request's body; a larger one is rejected before it is read."""
MOST_CELLS = 250_000
"""Limit of a map's cells, so that they fit into a request."""
PATIENCE = 20.0
"""Seconds in which a request's body must arrive."""
IDLE = 60.0
"""Seconds after which an idle connection is closed."""


@dataclass(eq=False)
class Studio:
    """State shared by the handlers.

    Attributes:
        first: the sketch of the input. name: of the input, for display. out: the scenario to save.
        seed: of the rollouts. token: required in requests. latest: computes results.
        board: the newest sketch, for a reloaded page.
    """

    first: Sketch
    name: str
    out: Path
    seed: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    latest: Latest = field(init=False)
    board: Sketch = field(init=False)

    def __post_init__(self) -> None:
        if self.first.settings.plan_for != "closed_loop":
            problem = f"plan_for is {self.first.settings.plan_for} in the studio"
            raise UsageError(problem, source=self.name, expected="closed_loop", fix="omit the setting")
        cells = self.first.world.threat.size
        if cells > MOST_CELLS:
            problem, fix = f"{cells:,} cells", "coarsen the map (--cell-size, or the scenario's cell_size)"
            raise UsageError(problem, source=self.name, expected=f"at most {MOST_CELLS:,} to paint on", fix=fix)
        kept = AllPairs()
        work = lambda board, go_on: answers(board, self.seed, kept, go_on)  # noqa: E731
        self.latest, self.board = Latest(work), self.first


class _Handler(RequestHandler):
    """Base handler: rejects foreign requests, and reports errors as one line of JSON."""

    def initialize(self, studio: Studio, hosts: tuple[str, ...]) -> None:
        self.studio, self.hosts = studio, hosts

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in security_headers().items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """Accept the page's origin only: other sites may send requests here, even by another name (DNS rebinding)."""
        headers = self.request.headers
        if self.request.host not in self.hosts:
            raise HTTPError(403, reason="Wrong host")
        if headers.get("Origin", f"http://{self.request.host}") != f"http://{self.request.host}":
            raise HTTPError(403, reason="Wrong origin")
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise HTTPError(403, reason="Wrong site")

    def write_error(self, status_code: int, **more: Any) -> None:
        """The reason as JSON, without a traceback; invalid input has status 400."""
        error = more.get("exc_info", (None, None))[1]
        if isinstance(error, InputError):
            self.set_status(400)
        # The body of a rejected request may be unread.
        self.set_header("Connection", "close")
        self.finish({"error": str(error) if isinstance(error, InputError) else self._reason})

    def log_exception(self, kind: Any, value: Any, trace: Any) -> None:
        """Keep rejected requests out of the terminal."""
        if not isinstance(value, HTTPError | InputError):
            super().log_exception(kind, value, trace)


class _Page(_Handler):
    """The page, without data of a map."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(studio_page())


class _Guarded(_Handler):
    """Base of handlers that require the token."""

    def prepare(self) -> None:
        super().prepare()
        given = self.request.headers.get("Authorization", "")
        # Constant time, so that timing does not reveal the token.
        if not compare_digest(given.encode(), f"Bearer {self.studio.token}".encode()):
            raise HTTPError(401, reason="No token")
        # A cross-site form cannot send this type without a preflight request.
        if self.request.method == "POST" and self.request.headers.get("Content-Type") != "application/json":
            raise HTTPError(415, reason="Not JSON")


class _Board(_Guarded):
    """The newest sketch, and the input's."""

    def get(self) -> None:
        studio, first = self.studio, self.studio.first
        about: Json = {"name": studio.name, "out": str(studio.out), "shape": first.world.shape, "palettes": palettes()}
        about |= {"paced": bool(first.world.pace)}
        self.finish(about | {"board": studio.board.to_json(), "first": first.to_json(), "notes": first.world.notes})


class _Answer(_Guarded):
    """Lines of JSON of growing precision, until the result is final or a newer sketch arrives."""

    async def post(self) -> None:
        board, _ = read_sketch(self.request.body, self.studio.first)
        self.studio.board = board
        lines: asyncio.Queue[Json | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        self.job = self.studio.latest.submit(board, partial(_hand_over, loop, lines))
        self.set_header("Content-Type", "application/x-ndjson")
        with suppress(StreamClosedError):
            while (line := await lines.get()) is not None:
                self.write(json.dumps(line, allow_nan=False) + "\n")
                await self.flush()

    def on_connection_close(self) -> None:
        """End the job: the client is gone."""
        if hasattr(self, "job"):
            self.job.end()


def _hand_over(loop: asyncio.AbstractEventLoop, lines: asyncio.Queue, line: Json | None) -> None:
    with suppress(RuntimeError):  # the server has ended
        loop.call_soon_threadsafe(lines.put_nowait, line)


class _Save(_Guarded):
    """Save the sketch as a scenario; return the command that repeats its result."""

    def post(self) -> None:
        board, keys = read_sketch(self.request.body, self.studio.first)
        rollouts = None
        if "rollouts" in keys and keys["rollouts"].value is not None:
            rollouts = keys["rollouts"].number(whole(1, MOST_ROLLOUTS, "a number of rollouts"))
        written = board.save(self.studio.out)
        command = command_words(self.studio.out, rollouts, PRECISION, board.deadline, self.studio.seed)
        self.finish({"written": list(map(str, written)), "command": command})


def make_application(studio: Studio, port: int) -> Application:
    """The handlers of a server on this port."""
    shared = {"studio": studio, "hosts": (f"{HOST}:{port}", f"localhost:{port}")}
    pages = {"/": _Page, "/board": _Board, "/answer": _Answer, "/save": _Save}
    return Application(
        [(path, handler, shared) for path, handler in pages.items()],
        default_handler_class=_Missing,
        default_handler_args=shared,
        log_function=lambda handler: None,
    )


class _Missing(_Guarded):
    """All other addresses."""

    def prepare(self) -> None:
        super().prepare()
        raise HTTPError(404)


async def serve(studio: Studio, port: int, ready: Callable[[str], None], over: asyncio.Event | None = None) -> None:
    """Serve until `over` is set, or forever; `ready` gets the address. Port 0: a free one. Raises UsageError."""
    logging.getLogger("tornado.general").setLevel(logging.ERROR)
    try:
        # Listen before the page is announced, so that its address works at once.
        with _listening(port) as listener:
            place = listener.getsockname()[1]
            server = HTTPServer(
                make_application(studio, place), max_body_size=MOST_BYTES, max_buffer_size=2 * MOST_BYTES,
                body_timeout=PATIENCE, idle_connection_timeout=IDLE, max_header_size=2**14,
            )  # fmt: skip
            server.add_socket(listener)
            ready(f"http://{HOST}:{place}/#{studio.token}")
            try:
                await (over or asyncio.Event()).wait()
            finally:
                server.stop()
                await server.close_all_connections()
    finally:
        studio.latest.close()


def _listening(port: int) -> socket.socket:
    try:
        listener = socket.create_server((HOST, port))
    except OSError as error:
        problem = f"--port {port} is not available ({error.strerror})"
        raise UsageError(problem, expected="a free port", fix="omit the option") from None
    listener.setblocking(False)
    return listener
