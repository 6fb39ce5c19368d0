"""`mrac-jax record`: chosen rollouts in full, and what all evaluated ones came to, as one MCAP file."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from analysis.bounds import all_bounds
from analysis.inputs import input_path
from analysis.recording import contents
from analysis.recording.container import LogWriter
from analysis.recording.drawn import rollout_messages
from analysis.recording.frames import make_frames
from analysis.recording.layout import layout_json
from analysis.recording.rolling import Progress, Request, evaluate, make_runner
from analysis.recording.topics import Clock, Message, Stage, topic_types, type_of
from planner.errors import UsageError
from planner.files import why_no_file
from planner.keys import read_yaml
from planner.maps import YAML
from planner.plan import Plan
from planner.tally import Tally
from planner.trace import Trace
from planner.world import World

MOST_SECONDS = 2.0**31 - 1
CHUNK_SIZE = 2**22
"""Bytes before compression that a crash can lose, some 200 steps: with larger chunks repeated grids take less room."""


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


@dataclass(frozen=True, eq=False)
class Recorded:
    """What `record` did.

    Attributes:
        path: the file. settings: those in it. tally: of what was evaluated.
        rows: the rollouts in full. first: the trace of the first of them.
        evaluate_seconds, record_seconds: spent on evaluating, and on the rollouts in full.
    """

    path: Path
    settings: contents.Settings
    tally: Tally
    rows: tuple[Row, ...]
    first: Trace
    evaluate_seconds: float
    record_seconds: float

    @property
    def steps(self) -> int:
        """Steps recorded, t = 0 included."""
        return sum(row.time + 1 for row in self.rows)


def record(
    world: World, plan: Plan, request: Request, path: str | Path, *, progress: Progress | None = None
) -> Recorded:
    """Evaluate, choose, and write the file at `path`. Raises InputError. An interruption leaves a valid, partial file.

    Memory: one rollout in full, and a few numbers a cell, whatever is evaluated.
    """
    request.check()
    runner = make_runner(world, plan, request)
    types = topic_types()
    with LogWriter(path, chunk_size=CHUNK_SIZE) as log:
        log.attach(contents.WORLD, "application/octet-stream", contents.world_bytes(world))
        log.attach(contents.PLAN, "application/json", contents.plan_bytes(plan))
        if request.scenario is not None:
            log.attach(contents.SCENARIO, "application/yaml", request.scenario)
        log.attach(contents.BOUNDS, "application/json", contents.bounds_bytes(all_bounds(plan, world)))

        def write(message: Message) -> None:
            log.write(log.channel(message.topic, type_of(message.topic, types)), message.time, message.data)

        clock = time.perf_counter()
        tally, ids, picks = evaluate(runner, request, write, progress)
        evaluate_seconds = time.perf_counter() - clock
        settings = contents.Settings(
            loop=request.loop,
            threat_checks="first_visit" if request.first_only else "every_visit",
            seed=request.seed,
            ids=ids,
            picks=picks,
            evaluated=request.evaluated,
            outcomes=request.outcomes,
            step_seconds=request.step_seconds,
            plan="made" if request.made else "given",
            mrac_jax=contents.own_version(),
        )
        _describe(log, settings, tally, world, plan)
        clock = time.perf_counter()
        rows, first = [], None
        stage = Stage(world, plan, request.loop, request.seed)
        for trace, messages in recorded_messages(stage, runner.traces(ids), request.step_seconds):
            rows.append(_row(trace, picks, stage))
            first = first or trace
            for message in messages:
                write(message)
            log.flush()
    assert first is not None
    return Recorded(Path(path), settings, tally, tuple(rows), first, evaluate_seconds, time.perf_counter() - clock)


def _row(trace: Trace, picks: dict[str, int], stage: Stage) -> Row:
    frames = make_frames(trace, stage.areas)
    return Row(
        rollout=trace.rollout,
        picks=tuple(name for name, one in picks.items() if one == trace.rollout),
        outcome=trace.outcome.name.lower(),
        visited=int(frames.visited[-1]),
        survived=int(frames.survived[-1]),
        time=trace.time,
        alive=int(frames.alive_count[-1]),
        events=len(trace.events),
    )


def _describe(log: LogWriter, settings: contents.Settings, tally: Tally, world: World, plan: Plan) -> None:
    """Attachments and metadata that are known once the rollouts are chosen."""
    text, cells = contents.tally_bytes(tally)
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
                fix="make --step-seconds less, or record fewer",
            )
        yield trace, rollout_messages(stage, trace, clock)
        clock = clock.after(trace.time)


def scenario_text(source: str) -> bytes | None:
    """The text of the scenario file that an INPUT names; None for any other input."""
    file = input_path(source)
    if file.suffix.lower() not in YAML or why_no_file(file):
        return None
    keys = read_yaml(file).value
    return file.read_bytes() if isinstance(keys, dict) and "map" in keys else None
