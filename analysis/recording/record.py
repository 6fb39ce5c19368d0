"""`mrac-jax record`: chosen rollouts in full, and what all evaluated ones came to, as one MCAP file."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from analysis.inputs import input_path
from analysis.kit.notes import Doing, Progress, quiet
from analysis.recording import contents
from analysis.recording.frames import make_frames
from analysis.recording.mcap.container import CHUNK_SIZE, LogWriter
from analysis.recording.rolling import Request, engine_of, evaluate
from analysis.recording.viewers.layout import layout_json
from analysis.recording.viewers.messages import rollout_messages
from analysis.recording.viewers.topics import Clock, Message, Stage, type_of
from analysis.report.answer import Answer
from analysis.theory.bounds import all_bounds
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import why_no_file
from planner.mrac.reference import ReferenceLoop
from planner.pace import UNPACED, Pace
from planner.plans.plan import Plan, is_certain
from planner.plans.state import MissionState
from planner.tally import Tally
from planner.trace import Trace
from planner.worlds.keys import read_yaml
from planner.worlds.maps import YAML
from planner.worlds.world import World

if TYPE_CHECKING:
    from planner.rollouts.engine import Engine

MOST_SECONDS = 2.0**31 - 1


@dataclass(frozen=True)
class Row:
    """One rollout in full, in short: its id, the picks that chose it, and what it came to (cells, steps, robots)."""

    rollout: int
    picks: tuple[str, ...]
    outcome: str
    visited: int
    survived: int
    time: int
    alive: int
    events: int


@dataclass(eq=False, repr=False)
class Recorded(Answer):
    """What `record` did.

    Attributes:
        path: the file. settings: those in it. tally: of what was evaluated.
        rows: the rollouts in full. first: the trace of the first of them.
        partial: it was interrupted; `rows` are those that were done, and the file is marked.
        bytes: the file's size. evaluate_seconds, record_seconds: spent on evaluating, and on the rollouts in full.
        pace: how long a step takes, if the world knows.
    """

    reported_by = "analysis.recording.report:report"

    listed: ClassVar[str] = "rollouts"
    path: Path
    settings: contents.Settings = field(init=False)
    tally: Tally = field(init=False)
    rows: list[Row] = field(default_factory=list)
    first: Trace = field(init=False)
    partial: bool = False
    bytes: int = 0
    evaluate_seconds: float = 0.0
    record_seconds: float = 0.0
    pace: Pace = UNPACED

    @property
    def steps(self) -> int:
        """Steps recorded, t = 0 included."""
        return sum(row.time + 1 for row in self.rows)


def record(
    world: World,
    plan: Plan,
    request: Request,
    path: str | Path,
    *,
    progress: Progress | None = None,
    doing: Doing = quiet,
) -> Recorded:
    """Evaluate, choose, and write the file at `path`. Memory: one rollout in full, and a few numbers a cell.

    An interruption (KeyboardInterrupt) ends it with the rollouts that are done, `partial`; the file is then valid, and
    at NAME.interrupted.mcap where `path` was there before. If none is done, nothing is written and it is raised again.

    Raises:
        InputError: what cannot be recorded or written. UsageError: `path`.partial is left from an earlier run.
    """
    request.check()
    if not request.outcomes and request.evaluated and is_certain(world, plan, request.loop):
        request = replace(request, evaluated=1)  # every run is the same: whatever is picked is rollout 0
    engine, began, done = engine_of(world, plan, request), time.perf_counter(), Recorded(Path(path), pace=world.pace)
    log = LogWriter(path, chunk_size=CHUNK_SIZE, discard=True)
    try:
        with log:
            _write(log, done, world, plan, request, engine, progress, doing)
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
    world: World,
    plan: Plan,
    request: Request,
    engine: Engine,
    progress: Progress | None,
    doing: Doing,
) -> None:
    """The whole log; it is worth keeping once a rollout is complete. `doing`: told which rollout is written."""
    began = time.perf_counter()

    def write(message: Message) -> None:
        log.write(log.channel(message.topic, type_of(message.topic)), message.time, message.data)

    log.attach(contents.WORLD, "application/octet-stream", world.to_bytes())
    log.attach(contents.PLAN, "application/json", contents.plan_bytes(plan))
    if request.scenario is not None:
        log.attach(contents.SCENARIO, "application/yaml", request.scenario)
    log.attach(contents.BOUNDS, "application/json", contents.bounds_bytes(all_bounds(plan, world)))
    done.tally, ids, picks = evaluate(engine, request, write, progress)
    done.evaluate_seconds = time.perf_counter() - began
    done.settings = request.settings(ids, picks)
    _describe(log, done.settings, done.tally, world, plan)
    stage = Stage(world, plan, request.loop, request.seed, request.first_only, request.luck)
    doing(f"writing rollout 1 of {len(ids)}")
    for trace, messages in recorded_messages(stage, engine.traces(ids), request.step_seconds):
        row = _row(trace, picks, stage)
        for message in messages:
            write(message)
        log.flush()
        if not done.rows:
            done.first = trace
        done.rows.append(row)
        log.discard = False
        doing(
            f"writing rollout {len(done.rows) + 1} of {len(ids)}" if len(done.rows) < len(ids) else "closing the file"
        )


def _row(trace: Trace, picks: dict[str, int], stage: Stage) -> Row:
    frames = make_frames(trace, stage.plan.state)
    return Row(
        rollout=trace.rollout,
        picks=tuple(name for name, one in picks.items() if one == trace.rollout),
        outcome=stage.plan.ending(trace.outcome).word,
        visited=int(frames.visited[-1]),
        survived=int(frames.survived[-1]),
        time=trace.time,
        alive=int(frames.alive_count[-1]),
        events=len(trace.events),
    )


def _describe(log: LogWriter, settings: contents.Settings, tally: Tally, world: World, plan: Plan) -> None:
    """Attachments and metadata that are known once the rollouts are chosen."""
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
        if clock.at(trace.time) > MOST_SECONDS * 1e9:
            raise UsageError(
                f"the rollouts take more than {MOST_SECONDS:.0f} s one after the other",
                fix=f"make {argument('step_seconds')} less, or record fewer",
            )
        yield trace, rollout_messages(stage, trace, clock)
        clock = clock.after(trace.time)


def state_of_rollout(world: World, plan: Plan, request: Request, step: int) -> MissionState:
    """Where the one rollout of the request stands at the end of a step. Raises UsageError."""
    said = argument("state_at", step)
    if plan.is_foreign:
        raise UsageError(f"{said}: robots that follow given paths have no state to save", fix="leave it out")
    if len(request.ids) != 1 or request.loop != "closed":
        raise UsageError(f"{said} without one closed-loop rollout", expected=f"{argument('ids')} with one number")
    if plan.state is not None and step <= plan.state.step:
        raise UsageError(said, expected=f"a step after the state's, {plan.state.step}")
    loop = ReferenceLoop(plan, world, first_only=request.first_only, luck=request.luck)
    found = loop.state_at(step, request.seed, request.ids[0])
    if found is None:
        raise UsageError(
            f"{said}: rollout {request.ids[0]} has ended by then", expected="a step before its end, 0 or more"
        )
    return found


def scenario_text(source: str) -> bytes | None:
    """The text of the scenario file that an INPUT names; None for any other input."""
    file = input_path(source)
    if file.suffix.lower() not in YAML or why_no_file(file):
        return None
    keys = read_yaml(file).value
    return file.read_bytes() if isinstance(keys, dict) and "map" in keys else None
