"""`mrac-jax record`: selected rollouts in full, and the results of all evaluated ones, as one MCAP file."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from analysis.inputs import input_path
from analysis.recording import contents
from analysis.recording.container import CHUNK_SIZE, LogWriter
from analysis.recording.frames import make_frames
from analysis.recording.viewers import topics
from analysis.recording.viewers.messages import rollout_messages
from analysis.recording.viewers.topics import Clock, Message, Stage, layout_json, type_of
from analysis.report.result import Result
from analysis.sampling import RolloutChoices, make_engine_for
from analysis.statistics.estimates import quantile
from analysis.theory.bounds import all_bounds
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.arguments import BLOCK, Numbers, argument
from planner.errors import UsageError
from planner.failure_model import key_of
from planner.files import why_no_file
from planner.formatting import UNPACED, Pace
from planner.plan.plan import Plan, is_certain
from planner.plan.state import MissionState
from planner.rollouts.single_run import PythonLoop
from planner.simulator.thresholds import threefry2x32
from planner.tally import RolloutResults, Tally, Trace
from planner.world.keys import read_yaml
from planner.world.map_files import YAML
from planner.world.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine

# Selection of rollouts from a stream, in memory that does not grow with the number of rollouts.

EXPECTED = "worst, median, best, random or quantile:Q with 0 < Q < 1"
_PURPOSE = 0x5049434B
"""Counter word of the random number of `random`: "PICK"."""


@dataclass(frozen=True)
class Pick:
    """One selection: its name as given, and the wanted quantile of visited coverage (None: any rollout)."""

    name: str
    q: float | None


def parse_picks(text: str) -> tuple[Pick, ...]:
    """`"worst,median,quantile:0.05"` as picks, each name once. Raises UsageError."""
    named = {"worst": 0.0, "median": 0.5, "best": 1.0, "random": None}
    picks: dict[str, Pick] = {}
    for name in text.split(","):
        if name in named:
            picks[name] = Pick(name, named[name])
            continue
        number = re.fullmatch(r"quantile:(0?\.[0-9]{1,15})", name, re.ASCII)
        if number is None or not 0 < float(number[1]) < 1:
            raise UsageError(f"{argument('pick')} {name!r}", expected=EXPECTED)
        picks[name] = Pick(name, float(number[1]))
    return tuple(picks.values())


def parse_ids(text: str, most: int) -> tuple[int, ...]:
    """`"0,5,7-9"` as distinct rollout ids in the given order; at most `most`. Raises UsageError."""
    ids: dict[int, None] = {}
    for part in text.split(","):
        bounds = re.fullmatch(r"([0-9]{1,1000})(?:-([0-9]{1,1000}))?", part, re.ASCII)
        if bounds is None:
            raise UsageError(f"{argument('ids')} {part[:60]!r}", expected='rollout ids, as "0,5,7-9"')
        first, last = int(bounds[1]), int(bounds[2] or bounds[1])
        if not first <= last < 2**32:
            expected = "ids below 2**32" if last >= 2**32 or "-" not in part else "the first id not above the last"
            raise UsageError(f"{argument('ids')} {part[:60]!r}", expected=expected)
        if last - first + 1 + len(ids) > most:
            raise UsageError(f"{argument('ids')} {text[:60]!r}: too many", expected=f"at most {most} rollouts in full")
        ids.update(dict.fromkeys(range(first, last + 1)))
    return tuple(ids)


class Picker:
    """Keeps, for every number of visited cells, the rollout to select.

    A quantile of visited coverage is a number of cells (`analysis.statistics.estimates.quantile`). Of the rollouts with
    that number, the one with the most survived cells is selected, then the shortest, then the lowest id; for `worst`,
    the one with the fewest survived cells, then the longest, then the lowest id. Memory: a few numbers for each
    accessible cell.
    """

    def __init__(self, accessible: int) -> None:
        self._counts = np.zeros(accessible + 1, dtype=np.int64)
        self._top = np.zeros((0, 4), dtype=np.int64)  # visited, -survived, time, id: the best of each number of cells
        self._worst: tuple[int, int, int, int] | None = None  # visited, survived, -time, id

    def add(self, results: RolloutResults) -> None:
        """Add the rollouts of the next ids."""
        visited, survived, time = (of.astype(np.int64) for of in (results.visited, results.survived, results.time))
        if not len(visited):
            return
        self._counts += np.bincount(visited, minlength=len(self._counts))
        new = np.stack([visited, -survived, time, results.start + np.arange(len(visited))], axis=1)
        rows = np.concatenate([self._top, new])
        # A stable sort keeps the earlier id first on ties.
        rows = rows[np.lexsort((rows[:, 2], rows[:, 1], rows[:, 0]))]
        self._top = rows[np.flatnonzero(np.diff(rows[:, 0], prepend=-1))]
        last = np.lexsort((-time, survived, visited))[0]
        worst = int(visited[last]), int(survived[last]), -int(time[last]), int(new[last, 3])
        self._worst = worst if self._worst is None else min(self._worst, worst)

    def choose(self, pick: Pick, seed: int) -> int:
        """The id of the selected rollout; `random`: any of those added (ids from 0), by the seed only."""
        if pick.q is None:
            total = int(self._counts.sum())
            high, low = threefry2x32(key_of(seed), np.uint32(_PURPOSE), np.uint32(0))
            return ((int(high) << 32 | int(low)) * total) >> 64
        if pick.q == 0.0:
            assert self._worst is not None
            return self._worst[3]
        return int(self._top[np.searchsorted(self._top[:, 0], quantile(self._counts, pick.q)), 3])


# The rollouts of a recording: evaluated as a stream, selected ones in full.


@dataclass(frozen=True)
class Request(RolloutChoices):
    """The arguments of a recording; its bytes do not depend on the engine.

    Attributes:
        ids: rollouts in full; empty: those selected by `picks`.
        picks: selections among the evaluated rollouts. evaluated: their number, ids from 0; 0: only those in `ids`.
        outcomes: store every evaluated rollout's outcome.
        step_seconds: time of a step.
        made: the plan comes from the planner, not from a file.
        scenario: the text of the scenario file, if there is one.
    """

    ids: tuple[int, ...] = ()
    picks: tuple[Pick, ...] = ()
    evaluated: int = 0
    outcomes: bool = False
    step_seconds: float = 1.0
    made: bool = True
    scenario: bytes | None = None

    def settings(self, ids: tuple[int, ...], picks: dict[str, int]) -> contents.Settings:
        """The settings for the file, once the recorded rollouts are known."""
        return contents.Settings(
            self.loop, "first_visit" if self.first_only else "every_visit", self.seed, ids, picks, self.evaluated,
            self.outcomes, self.step_seconds, "made" if self.made else "given", contents.own_version(),
        )  # fmt: skip

    def check(self) -> None:
        """Raise UsageError for arguments that cannot be recorded."""
        super().check()
        Numbers(*contents.STEP_SECONDS, "seconds").check("step_seconds", self.step_seconds)


def tally_of(engine: Engine, ids: Iterable[int]) -> Tally:
    """The tally of some rollouts."""
    # Engines roll out ranges of ids.
    known = np.sort(np.fromiter(ids, dtype=np.int64))
    spans = np.split(known, np.flatnonzero(np.diff(known) != 1) + 1)
    tallies = [engine.tally(int(span[0]), len(span)) for span in spans]
    return sum(tallies[1:], start=tallies[0])


def chunks(
    engine: Engine, count: int, progress: ProgressCallback | None, marks: Iterable[int] = ()
) -> Iterator[tuple[Tally, RolloutResults]]:
    """Rollouts 0 .. count - 1 in order: (tally so far, results of the next ids, which end at each of `marks`)."""
    from planner.rollouts.engine import run_chunks

    for chunk in run_chunks(engine, count, results=True, checkpoints=marks):
        assert chunk.results is not None
        yield chunk.tally, chunk.results
        if progress is not None:
            progress(chunk.tally.rollouts, count, chunk.seconds)


def evaluate(
    engine: Engine, request: Request, write: Callable[[Message], None], progress: ProgressCallback | None
) -> tuple[Tally, tuple[int, ...], dict[str, int]]:
    """(tally, ids to record, picks) of the evaluation; outcomes are written while it runs, in blocks of BLOCK ids."""
    if not request.evaluated:
        return tally_of(engine, request.ids), request.ids, {}
    picker, waiting, count = Picker(engine.accessible), list[RolloutResults](), request.evaluated
    for so_far, results in chunks(engine, count, progress, range(BLOCK, count, BLOCK) if request.outcomes else ()):
        tally = so_far
        if request.picks:
            picker.add(results)
        if request.outcomes:
            waiting.append(results)
            if tally.rollouts % BLOCK == 0 or tally.rollouts == count:
                write(_outcome_message(RolloutResults.join(waiting)))
                waiting = []
    picks = {pick.name: picker.choose(pick, request.seed) for pick in request.picks}
    return tally, request.ids or tuple(dict.fromkeys(picks.values())), picks


def _outcome_message(block: RolloutResults) -> Message:
    columns = {name: getattr(block, name).astype(np.int64).tolist() for name in contents.OUTCOME_COLUMNS}
    return Message("/outcomes", 0, topics.Outcomes(first=block.start, **columns).SerializeToString())


MOST_SECONDS = 2.0**31 - 1


@dataclass(frozen=True)
class Row:
    """Summary of a recorded rollout: its id, the picks that selected it, and its figures.

    Attributes:
        visited, survived: fractions of the accessible cells. time: steps. alive: robots. cells_visited: number.
    """

    rollout: int
    picks: tuple[str, ...]
    outcome: str
    visited: Fraction
    survived: Fraction
    time: int
    alive: int
    events: int
    cells_visited: int


@dataclass(eq=False, repr=False)
class Recorded(Result):
    """The result of `record`.

    Attributes:
        path: the file. settings: of the file. tally: of the evaluated rollouts.
        rows: the recorded rollouts. first: the trace of the first of them.
        partial: it was interrupted; `rows` are the finished rollouts, and the file is marked.
        files: all that were written. stage: shared data of the rollouts.
        bytes: the file's size. evaluate_seconds, record_seconds: run times of the evaluation and of the recording.
        pace: time of a step, if the world has it.
    """

    reported_by = "analysis.recording.replay:report"

    listed: ClassVar[str] = "rollouts"
    path: Path
    settings: contents.Settings = field(init=False)
    tally: Tally = field(init=False)
    rows: list[Row] = field(default_factory=list)
    first: Trace = field(init=False)
    stage: Stage = field(init=False)
    files: list[Path] = field(default_factory=list)
    partial: bool = False
    bytes: int = 0
    evaluate_seconds: float = 0.0
    record_seconds: float = 0.0
    pace: Pace = UNPACED
    json_keys = """
        file=path bytes steps rollouts=rows settings tally.accessible evaluate_seconds record_seconds
    """

    @property
    def steps(self) -> int:
        """Number of recorded steps, with t = 0."""
        return sum(row.time + 1 for row in self.rows)


def record(
    world: World,
    plan: Plan,
    request: Request,
    path: str | Path,
    *,
    progress: ProgressCallback | None = None,
    doing: Doing = quiet,
) -> Recorded:
    """Evaluate, select, and write the file at `path`. Memory: one rollout in full, and a few numbers for each cell.

    Returns:
        The result. After an interruption (KeyboardInterrupt): the finished rollouts, `partial`; the file is valid, and
        has the name NAME.interrupted.mcap if `path` existed before.

    Raises:
        InputError: the request cannot be recorded or the file cannot be written.
        UsageError: `path`.partial exists from an earlier run.
        KeyboardInterrupt: before the first rollout was finished; nothing is written.
    """
    if not request.outcomes and request.evaluated and is_certain(world, plan, request.loop):
        request = replace(request, evaluated=1)  # all rollouts are equal: every pick is rollout 0
    stage = Stage(world, plan, request.loop, request.seed, request.first_only)
    engine, done = make_engine_for(world, plan, request), Recorded(Path(path), pace=world.pace)
    began, log = time.perf_counter(), LogWriter(path, chunk_size=CHUNK_SIZE, discard=True)
    try:
        with log:
            _write(log, done, stage, request, engine, progress, doing)
    except KeyboardInterrupt:
        if log.placed is None:
            raise
        done.partial = True
    assert log.placed is not None
    done.path, done.bytes = log.placed, log.placed.stat().st_size
    done.record_seconds = time.perf_counter() - began - done.evaluate_seconds
    return done


def _write(
    log: LogWriter,
    done: Recorded,
    stage: Stage,
    request: Request,
    engine: Engine,
    progress: ProgressCallback | None,
    doing: Doing,
) -> None:
    """Write the log; it is kept once a rollout is complete. `doing`: called with the current rollout."""
    began, world, plan, done.stage = time.perf_counter(), stage.world, stage.plan, stage

    def write(message: Message) -> None:
        log.write(log.channel(message.topic, type_of(message.topic)), message.time, message.data)

    # World and plan come first, so that a recovered file has them.
    log.attach(contents.WORLD, "application/octet-stream", world.to_bytes())
    log.attach(contents.PLAN, "application/json", contents.plan_bytes(plan))
    if request.scenario is not None:
        log.attach(contents.SCENARIO, "application/yaml", request.scenario)
    log.attach(contents.BOUNDS, "application/json", contents.bounds_bytes(all_bounds(plan, world)))
    done.tally, ids, picks = evaluate(engine, request, write, progress)
    done.evaluate_seconds = time.perf_counter() - began
    done.settings = request.settings(ids, picks)
    _describe(log, done.settings, done.tally, world, plan)
    doing(f"writing rollout 1 of {len(ids)}")
    for trace, messages in recorded_messages(stage, engine.traces(ids), request.step_seconds):
        row = _row(trace, picks, stage, done.tally.accessible)
        for message in messages:
            write(message)
        if not done.rows:
            done.first = trace
        done.rows.append(row)
        # From the first complete rollout on, an interrupted file is worth keeping.
        log.discard, written = False, len(done.rows)
        doing(f"writing rollout {written + 1} of {len(ids)}" if written < len(ids) else "closing the file")


def _row(trace: Trace, picks: dict[str, int], stage: Stage, accessible: int) -> Row:
    frames = make_frames(trace, stage.plan.state)
    names = tuple(name for name, one in picks.items() if one == trace.rollout)
    visited, survived = int(frames.visited[-1]), int(frames.survived[-1])
    return Row(
        rollout=trace.rollout,
        picks=names,
        outcome=stage.plan.ending(trace.outcome).word,
        visited=Fraction(visited, accessible),
        survived=Fraction(survived, accessible),
        time=trace.time,
        alive=int(frames.alive_count[-1]),
        events=len(trace.events),
        cells_visited=visited,
    )


def _describe(log: LogWriter, settings: contents.Settings, tally: Tally, world: World, plan: Plan) -> None:
    """Write attachments and metadata that depend on the selected rollouts."""
    text, cells = contents.tally_bytes(tally, plan.ends_by_deadline)
    log.attach(contents.SETTINGS, "application/json", contents.json_bytes(settings.to_json()))
    log.attach(contents.TALLY, "application/json", text)
    log.attach(contents.TALLY_CELLS, "application/octet-stream", cells)
    log.attach(contents.LAYOUT, "application/json", layout_json(world, len(plan.robots)).encode())
    log.metadata(contents.METADATA, contents.metadata_of(settings, world, len(plan.robots)))


def recorded_messages(
    stage: Stage, traces: Iterable[Trace], step_seconds: float
) -> Iterator[tuple[Trace, Iterator[Message]]]:
    """Each rollout with its messages, one after the other in time. Raises UsageError beyond the clock of ROS."""
    clock = Clock(0, step_seconds)
    for trace in traces:
        # ROS times are int32 seconds.
        if clock.at(trace.time) > MOST_SECONDS * 1e9:
            raise UsageError(
                f"the rollouts take more than {MOST_SECONDS:.0f} s one after the other",
                fix=f"reduce {argument('step_seconds')}, or record fewer rollouts",
            )
        yield trace, rollout_messages(stage, trace, clock)
        clock = clock.after(trace.time)


def state_of_rollout(world: World, plan: Plan, request: Request, step: int) -> MissionState:
    """The mission state of the request's one rollout at the end of a step. Raises UsageError."""
    said = argument("state_at", step)
    if plan.is_external:
        raise UsageError(f"{said}: robots that follow fixed paths have no state to save", fix="omit it")
    if len(request.ids) != 1 or request.loop != "closed":
        raise UsageError(f"{said} without one closed-loop rollout", expected=f"{argument('ids')} with one number")
    if plan.state is not None and step <= plan.state.step:
        raise UsageError(said, expected=f"a step after the state's, {plan.state.step}")
    loop = PythonLoop(plan, world, first_only=request.first_only)
    found = loop.state_at(step, request.seed, request.ids[0])
    if found is None:
        raise UsageError(
            f"{said}: rollout {request.ids[0]} has ended before", expected="a step before its end, 0 or more"
        )
    return found


def scenario_text(source: str) -> bytes | None:
    """The text of the scenario file of an INPUT; None for any other input."""
    file = Path() if not source else input_path(source)
    if file.suffix.lower() not in YAML or why_no_file(file):
        return None
    keys = read_yaml(file).value
    return file.read_bytes() if isinstance(keys, dict) and "map" in keys else None
