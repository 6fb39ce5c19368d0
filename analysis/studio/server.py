"""The studio: controls around an empty map, and the server that fills it, on the loopback alone, behind a token."""

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
from analysis.page.maps import STEPS, CellLayer, packed_layer, path_lines, thickness
from analysis.pictures import COVERED, FOG, LOSSES, OBSTACLE, SAFE, SHADES, THREAT, UNREACHABLE
from analysis.sampling import RolloutChoices, make_roll_out
from analysis.statistics.estimates import Estimate, losses_shown, lost_words
from analysis.statistics.estimates import exactly as exact_estimate
from analysis.statistics.variance_reduction import tally_mean
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.utils.tables import without_level
from planner.arguments import MAX_STEP, MOST_ROLLOUTS, exactly, whole
from planner.errors import InputError, MracError, UsageError, WorldError
from planner.files import Json, atomic_write
from planner.formatting import Pace, counted, percent
from planner.plan.plan import Plan, is_certain
from planner.plan_team import plan_team
from planner.policies import RULES
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.tally import Tally
from planner.world.features import with_truth
from planner.world.keys import PLACE, PROBABILITY, Key
from planner.world.levels import place_starts
from planner.world.map_knowledge import RANGE, Sense
from planner.world.scenario import said
from planner.world.world import MAX_ROBOTS, World

# The studio's page: controls around an empty map, which its script fills with what the server tells it.

PACKAGE = "analysis.studio"
SHARED = ("values.js", "choices.js", "cell_maps.js")
"""Of a report's script."""
SCRIPTS = ("board.js", "picture.js", "answer.js", "studio.js")
PAINTED = LinearSegmentedColormap.from_list("painted", [SAFE, *(to_hex(THREAT(x / 4)) for x in range(5))])
LAYERS = (("Threat", PAINTED, True), ("Coverage", COVERED, False), ("Losses", LOSSES, True))
"""Name, colours from the least to the largest, and whether small values are spread by a square root."""


@cache
def _script() -> Html:
    return whole_script([*map(asset, SHARED), *(asset(name, PACKAGE) for name in SCRIPTS)])


def security_headers() -> dict[str, str]:
    """Of every answer: the browser itself keeps this page apart from all others."""
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
    """The layers' colours and those of cells that have none."""
    places = np.linspace(0, 1, SHADES)
    layers = [{"name": n, "colours": [to_hex(c) for c in colours(places)], "root": root} for n, colours, root in LAYERS]
    return {"layers": layers, "obstacle": OBSTACLE, "unreachable": UNREACHABLE, "unknown": FOG}


@cache
def studio_page() -> str:
    """The page as HTML; nothing of a map is in it."""
    styles = "\n".join((asset("page.css"), asset("studio.css", PACKAGE)))
    return TEMPLATES.from_string(asset("studio.html", PACKAGE)).render(
        head=page_head("mrac-jax studio", styles, policy(_script(), "'self'")),
        rules=RULES.values(),
        most=MAX_ROBOTS,
        script=_script(),
    )


# What is on the page's board: cells, robots and settings, read strictly, and saved as a scenario.

PAGE = Path("the page")
"""What errors about a request name as their source."""
LIMITS, KNOWN = ("risk_cap", "robot_value"), ("unknown", "believed", "sensor_range")


USUAL = Sense(2.0)
"""What robots see where nobody has said it yet."""


@dataclass(frozen=True, eq=False)
class Sketch:
    """A board.

    Attributes:
        world: its cells; its `starts` are set where they were painted. robots: how many, else placed by the rule.
        settings: to plan with. deadline: a step at which coverage is reported too, or None.
        believed: the chance that robots believe where they do not know what is there; sense: what they see.
    """

    world: World
    robots: int
    settings: Settings
    deadline: int | None = None
    believed: float = 0.04
    sense: Sense = USUAL

    @classmethod
    def of(cls, world: World, robots: int, settings: Settings) -> Sketch:
        """The board of an input. Raises WorldError where it cannot be painted on."""
        known, sketch = world.knowledge, cls(world, robots, settings)
        if world.doubt is not None or world.types is not None:
            world.check_settled("painting")
        if known is None:
            return sketch
        believed = np.unique(world.threat[sketch.unknown])
        if len(believed) > 1 or np.isnan(believed).any():
            problem = "robots believe several things of what they do not know"
            raise WorldError(problem, source=world.source, expected="one chance everywhere, to paint on")
        chance = float(believed[0]) if len(believed) else cls.believed
        return replace(sketch, believed=chance, sense=known.sense)

    @property
    def unknown(self) -> NDArray[np.bool_]:
        """bool `[H, W]`: cells that are not as robots believe."""
        told, true = self.world.threat, self.world.met
        return (told != true) & ~(np.isnan(told) & np.isnan(true))

    def starts(self) -> tuple[NDArray[np.int64], tuple[str, ...]]:
        """Starts int64 `[K, 2]`, painted ones or placed by the rule, and notes."""
        if self.world.starts is not None:
            return self.world.starts, ()
        return place_starts(self.world, self.robots)

    def to_json(self) -> Json:
        """As `read_sketch` takes it."""
        starts = None if self.world.starts is None else self.world.starts.tolist()
        cells, unknown = (
            base64.b64encode(of.tobytes()).decode() for of in (self.world.met.astype("<f4"), self.unknown)
        )
        sees = None if self.sense.range == inf else self.sense.range
        knows = {"unknown": unknown, "believed": float(f"{self.believed:.7g}"), "sensor_range": sees}
        said = {name: getattr(self.settings, name) for name in ("policy", *LIMITS)}
        return {"cells": cells, "starts": starts, "robots": self.robots, "deadline": self.deadline} | said | knows

    def save(self, out: Path) -> tuple[Path, Path]:
        """Write the scenario `out` and the world file beside it that holds its cells; returns both."""
        raster = raster_of(out)
        starts = self.world.starts
        team: Json = {"count": self.robots} if starts is None else {"starts": starts.tolist()}
        keys = {"map": {"file": raster.name}} | said(team, self.settings, self.world.pace)
        text = yaml.safe_dump(keys, sort_keys=False)
        self.world.with_starts(None).save(raster, force=True)
        with atomic_write(out) as stream:
            stream.write(f"# Painted in mrac-jax studio.\n{text}")
        return out, raster


def raster_of(out: Path) -> Path:
    """The world file that goes with a saved scenario."""
    return out.with_suffix(".npz")


def read_sketch(body: bytes, first: Sketch) -> tuple[Sketch, Mapping[str, Key]]:
    """The board that a request's JSON holds, on the ground of the `first` one, and all keys of the request.

    `cells`: base64 of little-endian float32 `[H, W]`, NaN = obstacle. `starts`: `[[row, col], ...]`, or null for so
    many `robots` placed by the rule. `policy`, `risk_cap`, `robot_value`, `deadline` as the options of `evaluate`,
    null: none.
    `unknown`: base64 of a byte a cell, 1: robots do not know it, believe it free with the chance `believed`, and see
    `sensor_range` cells far, null: everything. Raises InputError.
    """
    try:
        top = Key(json.loads(body), "", PAGE, UsageError)
    except (ValueError, RecursionError):
        raise UsageError("no JSON", source=PAGE, expected="a board as JSON") from None
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
    sense = replace(first.sense, range=inf if sees.value is None else sees.number(RANGE))
    unknown = _cells(keys["unknown"], ground.shape, "u1").astype(np.bool_)
    if unknown.any():
        told = np.where(unknown, np.float32(believed), world.threat)
        with keys["sensor_range"].naming():
            world = with_truth(replace(world, threat=told), world, sense)
    return Sketch(world, robots if starts is None else len(starts), settings, deadline, believed, sense), keys


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


# What the studio says of an answer: a headline, and the few figures below it.

WAITING = "..."
"""In the place of a figure that is not known yet."""


class Figure(NamedTuple):
    """A figure to take away: its value, what it is, how sure."""

    value: str
    name: str
    note: str


def headline(robots: int, mean: Estimate, losses: Estimate, alone: bool = False) -> str:
    """The closed loop's answer in a sentence; `alone`: the open loop's, in which nobody takes over."""
    covers = f"{counted(robots, 'robot covers', 'robots cover')} {without_level(coverage(mean))} of what can be reached"
    if alone:
        covers = f"If nobody took over, {counted(robots, 'robot')} would cover {without_level(coverage(mean))}"
    lost = lost_words(losses.mean, robots, min(losses.digits(), 2))
    return f"{covers}; {lost} {'is' if robots == 1 else 'are'} lost."


def coverage(mean: Estimate) -> str:
    """A mean coverage in percent with its interval; an exact one says so."""
    return f"{percent(mean.mean, 2)} (exact)" if mean.half_width == 0 else mean.said(100.0, " %")


def page_figures(
    cells: int, robots: int, mean: Estimate | None, losses: Estimate | None, rollouts: int, exact: OpenLoopExact | None
) -> list[Figure]:
    """Covered, lost, and what the open loop comes to, if anybody drives it; None: not known yet."""
    runs = f"{counted(rollouts, 'rollout')}, {counted(cells, 'accessible cell')}" if rollouts else "rolling out"
    lost, sure = (WAITING, "") if losses is None else losses_shown(losses, robots)
    found = [
        Figure(WAITING if mean is None else coverage(mean), "covered on average", runs),
        Figure(lost, "robots lost", sure),
    ]
    if exact is not None:
        alone = f"exact; {lost_words(exact.expected_losses, robots)} lost"
        found.append(Figure(percent(exact.visited / cells, 2), "if nobody took over (open loop)", alone))
    return found


def knowledge_figures(found: Sequence[Measured]) -> list[Figure]:
    """What not to know the map costs, and what it is worth to look.

    `found`: the team told, as it is, and perhaps blind; empty: not known yet.
    """
    if not found:
        return [Figure(WAITING, "not knowing costs", "")]
    told, learning, *blind = found
    unit = 1.0 / told.largest("visited")

    def figure(more: Measured, less: Measured, names: tuple[str, str], known: str, team: Measured) -> Figure:
        alone, ahead = percent(team.mean("visited", unit).mean), more.ahead(less, "visited", unit)
        name, ahead = (names[0], ahead) if ahead.mean >= 0 else (names[1], ahead.negated)
        return Figure(ahead.said(100.0, " points"), name, f"{known}, they cover {alone}")

    costs = figure(told, learning, ("not knowing costs", "not knowing gains"), "told the map", told)
    looking = ("to look is worth", "to look costs")
    return [costs, *(figure(learning, one, looking, "blind", one) for one in blind)]


def deadline_figures(
    step: int | None, pace: Pace, mean: Estimate | None, exact: OpenLoopExact | None, cells: int
) -> list[Figure]:
    """Coverage by a deadline, if there is one."""
    if step is None:
        return []
    alone = "" if exact is None else f"open loop: {percent(exact.by_deadline(step)[0] / cells, 2)}, exact"
    return [Figure(WAITING if mean is None else coverage(mean), f"covered by {pace.step(step)}", alone)]


def command_words(out: Path, rollouts: int | None, precision: float, deadline: int | None, seed: int) -> str:
    """The command that repeats the answer to a saved board; without `rollouts` one that is as sure."""
    many = ("--precision", exactly(precision)) if rollouts is None else ("--rollouts", str(rollouts))
    more = (() if deadline is None else ("--deadline", str(deadline))) + (() if seed == 0 else ("--seed", str(seed)))
    return shlex.join(["mrac-jax", "evaluate", str(out), *many, *more])


# The server behind the page: on the loopback alone, for whoever holds its token, and for no other page.
#
# Tornado, because it is kept, needs no other package, bounds what a request may hold, and comes with `dask` anyway.

# One board at a time, in a thread of its own: the newest wins, older ones end where they are.

LOG = logging.getLogger("mrac_jax")
GRACE_SECONDS = 2.0
"""How long an answer may take to end where the program ends: code that is being compiled cannot be stopped."""
SUPERSEDED = {"superseded": True}
"""The last line of a board in whose place another came."""
Tell = Callable[[Json | None], None]
"""Takes a line of the answer; None: it is over."""
Work = Callable[[Any, Callable[[], None]], Iterator[Json]]
"""`work(board, go_on)`: the lines; it calls `go_on`, which raises where another board has come."""


class Superseded(Exception):
    """Nobody waits for this answer any more."""


class Job:
    """A board that waits for its answer, or is being answered."""

    def __init__(self, board: Any, tell: Tell) -> None:
        self.board, self.tell, self._over = board, tell, False

    def end(self) -> None:
        """Nobody waits for it any more."""
        self._over = True

    def go_on(self) -> None:
        """Raise Superseded if that is so."""
        if self._over:
            raise Superseded


class Latest:
    """Answers boards with `work`, at most one at a time; one more waits, and a newer one takes its place."""

    def __init__(self, work: Work) -> None:
        self._work, self._jobs = work, SimpleQueue[Job | None]()
        self._newest: Job | None = None
        self.begun = 0
        self._thread = threading.Thread(target=self._run, name="studio", daemon=True)
        self._thread.start()

    def submit(self, board: Any, tell: Tell) -> Job:
        """Answer this board next; `tell` is called from the thread. To be called from one thread alone."""
        job = Job(board, tell)
        old, self._newest = self._newest, job
        if old is not None:
            old.end()
        with suppress(Empty):
            waited = self._jobs.get_nowait()  # whoever takes it out answers it
            if waited is not None:
                waited.tell(SUPERSEDED)
                waited.tell(None)
        self._jobs.put(job)
        return job

    def close(self) -> None:
        """End the thread, at its next step; a daemon, it ends with the program in any case."""
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
        except Exception as error:  # a fault of ours: the page hears of it, and the next stroke is answered
            LOG.exception("studio")
            job.tell({"error": f"a fault of mrac-jax ({type(error).__name__}): please report what the terminal says"})
        finally:
            job.tell(None)


# The answer to a board, line after line: the open loop's exact one, then the closed loop's until it is sure.

PRECISION = 0.005
"""Half the width of the 95 % interval of mean coverage at which the rollouts end, as `--precision` takes it."""
MOST_PAIRS = 2048
"""Rollouts of teams with other eyes, each: on the same luck they tell as much as several times as many."""
SHOWN_SECONDS = 0.25
"""Between two lines of rollouts that go on."""
GoOn = Callable[[], None]
"""Raises what ends the work if nobody waits for it any more."""


@dataclass(frozen=True, eq=False)
class Board:
    """A board with its plan.

    Attributes:
        accessible: bool `[H, W]`. exact: the open loop's values. certain: every run is the same.
    """

    sketch: Sketch
    plan: Plan
    accessible: NDArray[np.bool_]
    exact: OpenLoopExact
    certain: bool
    notes: tuple[str, ...]

    def open_line(self) -> Json:
        """The open loop's line, which comes first and holds the planned paths too; null: too long to draw."""
        exact = self.exact
        mean, losses = exact_estimate(exact.visited / int(self.accessible.sum())), exact_estimate(exact.expected_losses)
        said = headline(len(self.plan.robots), mean, losses, alone=True)
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
        """The closed loop's line; `known`: its mean where that is exact; `knowing`: of `with_other_eyes`."""
        mean, losses = known or visited_mean(tally), tally_mean(tally, "lost", certain=self.certain)
        said = headline(tally.robots, mean, losses)
        maps = [tally.covered_visited / tally.rollouts, tally.stops / tally.rollouts]
        line = self._line(stage, said, mean, losses, tally.rollouts, maps, by_deadline)
        if self.sketch.world.knowledge is None:
            return line
        figures = [*line["figures"], *knowledge_figures(knowing)]
        return line | {"figures": figures, "paths": None, "thickness": 0}  # nobody drives what is planned

    def _line(
        self,
        stage: str,
        headline: str,
        mean: Estimate | None,
        losses: Estimate | None,
        rollouts: int,
        maps: list[NDArray[np.float64]],
        by_deadline: Estimate | None = None,
    ) -> Json:
        """What the page is told; `maps`: chance covered and robots lost, `[N]` each."""
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
            "headline": headline,
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


def with_other_eyes(board: Board, choices: RolloutChoices) -> list[Measured]:
    """The team that is told the map, the team itself, and where the obstacles are known one that is blind."""
    world = board.sketch.world
    assert world.knowledge is not None
    known, sees = world.knowledge, world.knowledge.sense.range
    ranges = [inf, sees, *[0.0] * (sees > 0 and known.may_be_blind(world.free))]
    teams = [with_eyes(world, board.plan, far, replace(choices, exact="never")) for far in ranges]
    return list(alike(teams, 0, choices.rollouts))


def answers(sketch: Sketch, seed: int, kept: AllPairs, go_on: GoOn) -> Iterator[Json]:
    """Lines for the page, each surer than the one before. Raises InputError, and what `go_on` raises.

    The figures are those of `evaluate` for so many rollouts of this seed; `kept` holds tables from board to board.
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
        if tally.rollouts >= 2 * looked:  # who looks more often than that stops too early
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
        knowing = with_other_eyes(board, replace(choices, rollouts=min(tally.rollouts, MOST_PAIRS), precision=None))
        yield board.closed_line("sure", tally, None, by_deadline, knowing)
    go_on()
    truth = closed_truth(plan, sketch.world, exact, choices, kept)
    known = None if truth is None else exact_estimate(truth.visited.value / tally.accessible)
    yield board.closed_line("done", tally, known, by_deadline, knowing)


HOST = "127.0.0.1"
MOST_BYTES = 2 * 2**20
"""Of a request's body; a larger one is refused before it is read."""
MOST_CELLS = 250_000
"""Of a map, so that its cells have room in a request."""
PATIENCE = 20.0
"""Seconds that a request's body may take to come."""
IDLE = 60.0
"""Seconds that a connection is kept without a request."""


@dataclass(eq=False)
class Studio:
    """What the handlers share.

    Attributes:
        first: the board as the input has it. name: of the input, as shown. out: the scenario to save.
        seed: of the rollouts. token: what a request must name. latest: answers boards.
        board: the newest one, which a page that is loaded again goes on with.
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
            raise UsageError(problem, source=self.name, expected="closed", fix="leave it out")
        cells = self.first.world.threat.size
        if cells > MOST_CELLS:
            problem, fix = f"{cells:,} cells", "coarsen the map (--cell-size, or the scenario's cell_size)"
            raise UsageError(problem, source=self.name, expected=f"at most {MOST_CELLS:,} to paint on", fix=fix)
        kept = AllPairs()
        work = lambda board, go_on: answers(board, self.seed, kept, go_on)  # noqa: E731
        self.latest, self.board = Latest(work), self.first


class _Handler(RequestHandler):
    """Refuses who has no business here, and says what is wrong in one line of JSON."""

    def initialize(self, studio: Studio, hosts: tuple[str, ...]) -> None:
        self.studio, self.hosts = studio, hosts

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in security_headers().items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """The page's own origin alone: other sites may send requests here, even under another name (DNS rebinding)."""
        headers = self.request.headers
        if self.request.host not in self.hosts:
            raise HTTPError(403, reason="Wrong host")
        if headers.get("Origin", f"http://{self.request.host}") != f"http://{self.request.host}":
            raise HTTPError(403, reason="Wrong origin")
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise HTTPError(403, reason="Wrong site")

    def write_error(self, status_code: int, **more: Any) -> None:
        """No traceback: the reason, or what is wrong with the board."""
        error = more.get("exc_info", (None, None))[1]
        said = str(error) if isinstance(error, InputError) else self._reason
        self.set_header("Connection", "close")
        self.finish({"error": said})

    def log_exception(self, kind: Any, value: Any, trace: Any) -> None:
        """Refusals are no news for the terminal."""
        if not isinstance(value, HTTPError | InputError):
            super().log_exception(kind, value, trace)

    def send_error(self, status_code: int = 500, **more: Any) -> None:
        """Bad input is the request's fault."""
        bad = isinstance(more.get("exc_info", (None, None))[1], InputError)
        super().send_error(400 if bad else status_code, **more)


class _Page(_Handler):
    """The page itself: nothing of the map is in it."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(studio_page())


class _Guarded(_Handler):
    """What needs the token."""

    def prepare(self) -> None:
        super().prepare()
        given = self.request.headers.get("Authorization", "")
        if not compare_digest(given.encode(), f"Bearer {self.studio.token}".encode()):
            raise HTTPError(401, reason="No token")
        if self.request.method == "POST" and self.request.headers.get("Content-Type") != "application/json":
            raise HTTPError(415, reason="Not JSON")


class _Board(_Guarded):
    """The board to go on with, and the input's."""

    def get(self) -> None:
        studio, first = self.studio, self.studio.first
        about: Json = {"name": studio.name, "out": str(studio.out), "shape": first.world.shape, "palettes": palettes()}
        about |= {"paced": bool(first.world.pace)}
        self.finish(about | {"board": studio.board.to_json(), "first": first.to_json(), "notes": first.world.notes})


class _Answer(_Guarded):
    """Lines of JSON, each surer than the one before, until it is sure or another board has come."""

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
        """Nobody reads on."""
        if hasattr(self, "job"):
            self.job.end()


def _hand_over(loop: asyncio.AbstractEventLoop, lines: asyncio.Queue, line: Json | None) -> None:
    with suppress(RuntimeError):  # the server has ended
        loop.call_soon_threadsafe(lines.put_nowait, line)


class _Save(_Guarded):
    """The board as a scenario, and the command that repeats its answer."""

    def post(self) -> None:
        board, keys = read_sketch(self.request.body, self.studio.first)
        rollouts = None
        if "rollouts" in keys and keys["rollouts"].value is not None:
            rollouts = keys["rollouts"].number(whole(1, MOST_ROLLOUTS, "a number of rollouts"))
        written = board.save(self.studio.out)
        command = command_words(self.studio.out, rollouts, PRECISION, board.deadline, self.studio.seed)
        self.finish({"written": list(map(str, written)), "command": command})


def make_application(studio: Studio, port: int) -> Application:
    """The addresses of a server that listens at this port."""
    shared = {"studio": studio, "hosts": (f"{HOST}:{port}", f"localhost:{port}")}
    pages = {"/": _Page, "/board": _Board, "/answer": _Answer, "/save": _Save}
    return Application(
        [(path, handler, shared) for path, handler in pages.items()],
        default_handler_class=_Missing,
        default_handler_args=shared,
        log_function=lambda handler: None,
    )


class _Missing(_Guarded):
    """Every other address."""

    def prepare(self) -> None:
        super().prepare()
        raise HTTPError(404)


async def serve(studio: Studio, port: int, ready: Callable[[str], None], over: asyncio.Event | None = None) -> None:
    """Serve until `over` is set, or for ever; `ready` is told the address. Port 0: a free one. Raises UsageError."""
    logging.getLogger("tornado.general").setLevel(logging.ERROR)
    try:
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
        problem = f"--port {port} cannot be listened at ({error.strerror})"
        raise UsageError(problem, expected="a free port", fix="leave it out") from None
    listener.setblocking(False)
    return listener
