"""`mrac-jax inspect`: what is in a recording, and a timeline of its events, in the terminal."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.kit.tables import make_table
from analysis.recording import contents
from analysis.recording.events import end_text, event_line
from analysis.recording.mcap.reading import Log, open_log
from analysis.recording.rollouts import RecordedRollout, rollouts_of
from planner.arguments import argument
from planner.errors import InputError
from planner.files import Json
from planner.shown import counted
from planner.trace import EventKind
from planner.worlds.world import World

if TYPE_CHECKING:
    from rich.console import Console

MOST_LINES = 40
"""Events shown of a rollout: losses, reallocations and shares first."""
FIRST = (EventKind.HIT, EventKind.REALLOCATED, EventKind.SHARED)


@dataclass(frozen=True)
class Event:
    """An event in words."""

    step: int
    kind: str
    robot: int
    text: str


@dataclass(frozen=True)
class Rollout:
    """A rollout in full, in short: coverage as fractions of the accessible cells; `text`: how it ended."""

    rollout: int
    begins_seconds: float
    outcome: str
    time: int
    visited: float
    survived: float
    robots: int
    alive: int
    text: str
    events: tuple[Event, ...]


@dataclass(frozen=True)
class Inspection:
    """What is in a recording. `settings` is None for a log that holds none of ours; `partial`: why it is cut short."""

    path: Path
    bytes: int
    library: str
    seconds: float
    partial: str
    settings: contents.Settings | None
    shape: tuple[int, int] | None
    topics: dict[str, tuple[str, int]]
    attachments: dict[str, int]
    metadata: dict[str, dict[str, str]]
    rollouts: tuple[Rollout, ...]


def inspect(path: str | Path) -> Inspection:
    """Look into a log. One that is not ours is listed by its topics. Raises InputError for one that cannot be read."""
    log = open_log(path)
    names = [attached.name for attached in log.attachments]
    ours = contents.SETTINGS in names and contents.WORLD in names
    settings, world = None, None
    if ours:
        settings = contents.read_settings(log.attachment(contents.SETTINGS), str(path))
        world = contents.read_world(log.attachment(contents.WORLD), str(path))
    counts: Counter[str] = Counter()
    kinds = {}
    last = 0
    for message in log.messages():
        counts[message.topic] += 1
        last = max(last, message.log_time)
        kinds[message.topic] = "" if message.schema is None else message.schema.name
    return Inspection(
        path=Path(path),
        bytes=Path(path).stat().st_size,
        library=log.library,
        seconds=last / 1e9,
        partial=log.partial,
        settings=settings,
        shape=None if world is None else world.shape,
        topics={topic: (kinds[topic], counts[topic]) for topic in sorted(counts)},
        attachments={attached.name: len(attached.data) for attached in log.attachments},
        metadata=dict(log.metadata),
        rollouts=tuple(_rollouts(log, world)) if world is not None else (),
    )


def _rollouts(log: Log, world: World) -> list[Rollout]:
    return [_rollout(one, world, log.path) for one in rollouts_of(log)]


def _rollout(one: RecordedRollout, world: World, source: Path) -> Rollout:
    trace = one.trace
    try:
        lines = [event_line(row, world) for row in trace.events]
    except (ValueError, IndexError) as error:
        raise InputError(f"rollout {trace.rollout}: an event that means nothing ({error})", source=source) from error
    cells = max(one.accessible, 1)
    visited, survived, alive = (int(values[-1]) for values in (one.visited, one.survived, one.alive))
    return Rollout(
        rollout=trace.rollout,
        begins_seconds=float(one.times[0]) / 1e9,
        outcome=trace.outcome.name.lower(),
        time=trace.time,
        visited=visited / cells,
        survived=survived / cells,
        robots=trace.cells.shape[1],
        alive=alive,
        text=end_text(trace, visited, survived, cells, alive),
        events=tuple(Event(line.step, line.kind.name.lower(), line.robot, line.text) for line in lines),
    )


def inspection_json(found: Inspection) -> Json:
    """The JSON object of `--json`."""
    out = asdict(found)
    out["path"] = str(found.path)
    out["topics"] = {topic: {"schema": kind, "messages": count} for topic, (kind, count) in found.topics.items()}
    out["settings"] = None if found.settings is None else found.settings.to_json()
    return out


def print_inspection(found: Inspection, console: Console, most_events: int | None) -> None:
    """The same in words: contents, then each rollout with at most so many events of its timeline (None: all)."""

    def tell(text: str) -> None:
        console.print(text, highlight=False, markup=False)

    tell(f"{found.path}: {found.bytes / 1e6:.2f} MB, {found.seconds:g} s, written by {found.library}")
    if found.partial:
        tell(f"not the whole log: {found.partial}")
    if found.settings is None:
        tell("no recording of mrac-jax: no settings and no world in it")
    else:
        tell(_settings_line(found))
    table = make_table(("topic", "schema", "messages"), left=("topic", "schema"))
    for topic, (kind, count) in found.topics.items():
        if not _is_later_robot(topic):
            table.add_row(topic, kind, f"{count:,}")
    console.print(table)
    later = sum(_is_later_robot(topic) for topic in found.topics)
    if later:
        tell(f"and {counted(later, 'topic')} like those of robot 0 for the other robots")
    tell("attachments: " + ", ".join(f"{name} ({counted(size, 'byte')})" for name, size in found.attachments.items()))
    for rollout in found.rollouts:
        tell("")
        _print_rollout(rollout, tell, most_events)


def _settings_line(found: Inspection) -> str:
    settings, shape = found.settings, found.shape
    assert settings is not None and shape is not None
    evaluated = (
        f"{counted(settings.evaluated, 'rollout')} evaluated"
        if settings.evaluated
        else "these rollouts alone evaluated"
    )
    kept = ", their outcomes kept" if settings.outcomes else ""
    checks = "" if settings.threat_checks == "every_visit" else ", threats at first visits alone"
    return (
        f"{settings.loop} loop{checks} on {shape[0]} x {shape[1]} cells, seed {settings.seed}, {evaluated}{kept}, "
        f"{settings.step_seconds:g} s a step, mrac-jax {settings.mrac_jax}"
    )


def _print_rollout(rollout: Rollout, tell: Any, most: int | None) -> None:
    tell(f"{rollout.text} (from {rollout.begins_seconds:g} s of the file)")
    shown = set(range(len(rollout.events)))
    if most is not None and len(shown) > most:
        weight = {kind.name.lower() for kind in FIRST}
        order = sorted(shown, key=lambda i: (rollout.events[i].kind not in weight, i))
        shown = set(order[:most])
    step = None
    for number, event in enumerate(rollout.events):
        if number in shown:
            label = "" if event.step == step else f"step {event.step}"
            tell(f"  {label:>12}  {event.text}")
            step = event.step
    hidden = len(rollout.events) - len(shown)
    if hidden and shown:
        tell(f"  {'':>12}  and {counted(hidden, 'event')} more: {argument('events', 'all')}")


def _is_later_robot(topic: str) -> bool:
    parts = topic.split("/")
    return len(parts) == 4 and parts[1] == "robots" and parts[2] != "0"
