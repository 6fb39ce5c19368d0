"""`mrac-jax inspect`: what is in a recording, and each rollout with its events in words."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from analysis.recording import contents
from analysis.recording.events import end_text, event_line
from analysis.recording.mcap.reading import open_log
from analysis.recording.rollouts import RecordedRollout, rollouts_of
from planner.errors import InputError
from planner.files import Json
from planner.plans.plan import Plan
from planner.worlds.world import World


@dataclass(frozen=True)
class Inspection:
    """What is in a recording.

    Attributes:
        partial: why it is cut short. settings: None for a log that holds none of ours. shape: of the world.
        topics: schema and number of messages of each. attachments: bytes of each.
        rollouts: those in full, as the JSON object tells them: coverage as fractions of the accessible cells, how it
            ended (`text`), and the events in words.
    """

    path: Path
    bytes: int
    library: str
    seconds: float
    partial: str
    settings: contents.Settings | None
    shape: tuple[int, int] | None
    topics: dict[str, Json]
    attachments: dict[str, int]
    metadata: dict[str, dict[str, str]]
    rollouts: list[Json]


def inspect(path: str | Path) -> Inspection:
    """Look into a log. One that is not ours is listed by its topics. Raises InputError for one that cannot be read."""
    log = open_log(path)
    names = [attached.name for attached in log.attachments]
    ours = contents.SETTINGS in names and contents.WORLD in names
    settings, world, plan = None, None, None
    if ours:
        settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
        world = contents.read_world(log.attachment(contents.WORLD), str(path))
        plan = contents.read_plan(log.attachment(contents.PLAN), world, str(path)) if contents.PLAN in names else None
    topics: dict[str, Json] = {}
    last = 0
    for message in log.messages():
        schema = "" if message.schema is None else message.schema.name
        topics.setdefault(message.topic, {"schema": schema, "messages": 0})["messages"] += 1
        last = max(last, message.log_time)
    return Inspection(
        path=Path(path),
        bytes=Path(path).stat().st_size,
        library=log.library,
        seconds=last / 1e9,
        partial=log.partial,
        settings=settings,
        shape=None if world is None else world.shape,
        topics=dict(sorted(topics.items())),
        attachments={attached.name: len(attached.data) for attached in log.attachments},
        metadata=dict(log.metadata),
        rollouts=[] if world is None else [_rollout(one, world, plan, log.path) for one in rollouts_of(log)],
    )


def _rollout(one: RecordedRollout, world: World, plan: Plan | None, source: Path) -> Json:
    trace = one.trace
    try:
        lines = [event_line(row, world, plan) for row in trace.events]
    except (ValueError, IndexError) as error:
        raise InputError(f"rollout {trace.rollout}: an event that means nothing ({error})", source=source) from error
    cells = max(one.accessible, 1)
    visited, survived, alive = (int(values[-1]) for values in (one.visited, one.survived, one.alive))
    ended = trace.outcome if plan is None else plan.ending(trace.outcome)
    return {
        "rollout": trace.rollout,
        "begins_seconds": float(one.times[0]) / 1e9,
        "outcome": ended.word,
        "time": trace.time,
        "visited": visited / cells,
        "survived": survived / cells,
        "robots": trace.cells.shape[1],
        "alive": alive,
        "text": end_text(trace, ended, visited, survived, cells, alive),
        "events": [
            {"step": line.step, "kind": line.kind.name.lower(), "robot": line.robot, "text": line.text}
            for line in lines
        ],
    }
