"""Recordings of small worlds, rewritten with something changed, and small logs with a known layout."""

import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Message
from mcap.stream_reader import StreamReader, breakup_chunk

from analysis.recording.container import Log, LogMessage, LogSchema, LogWriter, open_log
from analysis.recording.record import Request, record
from planner.make_plan import make_plan
from planner.plan.plan import Plan, RobotPlan
from planner.settings import Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# Shared by the tests of recordings: small worlds with their plans, and recordings rewritten with something changed.

SEED = 5


def small_task(robots: int = 3, shape: tuple[int, int] = (6, 9), seed: int = 2) -> tuple[World, Plan]:
    """A world that is not square, turned and moved, with robots that are often stopped."""
    made = random_world(*shape, ThreatPattern(areas=4, levels=(0.05, 0.1, 0.2), seed=seed))
    world = World.create(made.threat, cell_size=0.5, origin=(10.0, -20.0, 0.7))
    starts, _ = place_starts(world, robots)
    return world.with_starts(starts), make_plan(world, starts, Settings())


def foreign_plan(world: World, plan: Plan) -> Plan:
    """The same paths as another planner's plan."""
    robots = tuple(RobotPlan(robot.path) for robot in plan.robots)
    return Plan(world.shape, world.sha256, None, robots, outcome="end_of_paths", time=plan.makespan)


def small_recording(path: Path, **choices: Any) -> tuple[World, Plan]:
    """Rollouts 3 and 4 of `small_task` in a file."""
    world, plan = small_task()
    record(world, plan, Request(**{"ids": (3, 4), "seed": SEED} | choices), path)
    return world, plan


Change = Callable[[list[LogMessage]], None]
"""Changes the messages of a log in place."""


def rewrite(
    source: Path,
    target: Path,
    *,
    change: Change = lambda messages: None,
    attachments: dict[str, bytes | None] | None = None,
    metadata: Callable[[dict[str, str]], dict[str, str]] = lambda items: items,
    schema: Callable[[LogSchema], LogSchema] = lambda known: known,
) -> None:
    """A valid copy of a log with something changed: `attachments` by name (None: left out), the rest by functions."""
    log, replaced = open_log(source), attachments or {}
    change(messages := list(log.messages()))
    with LogWriter(target) as out:
        for attached in log.attachments:
            data = replaced.get(attached.name, attached.data)
            if data is not None:
                out.attach(attached.name, attached.media_type, bytes(data))
        for name, items in log.metadata:
            out.metadata(name, metadata(dict(items)))
        for one in messages:
            known = log.schemas[one.channel.schema_id]
            described = LogSchema(known.name, known.encoding, bytes(known.data), one.channel.message_encoding)
            out.write(out.channel(one.topic, schema(described)), one.log_time, bytes(one.data))


def places(messages: list[LogMessage], topic: str) -> list[int]:
    """Where the messages of a topic are."""
    return [place for place, one in enumerate(messages) if one.topic == topic]


def nth(topic: str, number: int, edit: Callable[[bytes], bytes | None]) -> Change:
    """Change message `number` of a topic, if there is one: its new data, or None to leave it out."""

    def change(messages: list[LogMessage]) -> None:
        for place in places(messages, topic)[number : number + 1]:
            data = edit(bytes(messages[place].data))
            messages[place : place + 1] = [] if data is None else [messages[place]._replace(data=data)]

    return change


def edited(kind: Any, edit: Callable[[Any], None]) -> Callable[[bytes], bytes]:
    """An edit of a protobuf message."""

    def change(data: bytes) -> bytes:
        message = kind.FromString(data)
        edit(message)
        return bytes(message.SerializeToString())

    return change


def world_with(world: World, **changes: Any) -> World:
    """The same world with something changed."""
    facts = {
        "threat": world.threat.copy(),
        **{name: getattr(world, name) for name in ("starts", "cell_size", "origin")},
    }
    return World.create(**(facts | changes))


def positions(world: World, cells: np.ndarray) -> np.ndarray:
    """Centres of cells in metres, told plainly: float64 `[..., 2]`."""
    x, y, yaw = world.origin
    out = np.zeros((*cells.shape, 2))
    for place, cell in np.ndenumerate(cells):
        row, col = divmod(int(cell), world.shape[1])
        across, up = (col + 0.5) * world.cell_size, (world.shape[0] - row - 0.5) * world.cell_size
        out[place] = x + np.cos(yaw) * across - np.sin(yaw) * up, y + np.sin(yaw) * across + np.cos(yaw) * up
    return out


# Small logs with a known layout, for the tests of the container, of reading and of recovery.

POSE = LogSchema("mrac.Pose", "jsonschema", b'{"type": "object"}', "json")
GRID = LogSchema("mrac.Grid", "protobuf", bytes(range(200)), "protobuf")
BARE = LogSchema("", "", b"", "raw")
TOPICS = {"/poses": POSE, "/grid": GRID, "/raw": BARE, "/more": POSE}

Said = tuple[str, int, int, bytes]
"""(topic, log time, sequence, data) of a message."""


@dataclass(frozen=True)
class Part:
    """A record of the data section, bytes [start, end), and what a chunk says."""

    opcode: int
    start: int
    end: int
    said: tuple[Said, ...] = ()


def sample(path: Path, messages: int = 60, chunk_size: int = 700, seed: int = 1) -> list[Said]:
    """Write a log with attachments and metadata before, between and after its chunks; returns its messages."""
    said, draws = [], np.random.default_rng(seed)
    with LogWriter(path, chunk_size=chunk_size) as log:
        log.attach("world.npz", "application/octet-stream", draws.bytes(60))
        log.metadata("mrac-jax", {"version": "1", "seed": "7"})
        ids = {topic: log.channel(topic, schema, {"unit": "m"}) for topic, schema in TOPICS.items()}
        for i in range(messages):
            topic = [*TOPICS][int(draws.integers(len(TOPICS)))]
            data = draws.bytes(int(draws.integers(0, 60)))
            said.append((topic, i * 10, sum(topic == known[0] for known in said), data))
            log.write(ids[topic], i * 10, data)
            if i == messages // 2:
                log.attach("tally.json", "application/json", b'{"visited": 3}')
        log.attach("last.bin", "application/octet-stream", draws.bytes(30))
        log.metadata("end", {"outcome": "complete"})
    return said


@lru_cache
def parts_of(data: bytes) -> list[Part]:
    """The records of an undamaged log, by its lengths."""
    found, at, topics = [], 8, topics_of(data)
    while at < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, at)
        end, said = at + 9 + length, ()
        if opcode == Opcode.CHUNK:
            record = next(StreamReader(io.BytesIO(data[at:end]), skip_magic=True, emit_chunks=True).records)
            inner = [message for message in breakup_chunk(record, validate_crc=True) if isinstance(message, Message)]
            said = tuple((topics[m.channel_id], m.log_time, m.sequence, m.data) for m in inner)
        found.append(Part(opcode, at, end, said))
        at = end
    return found


def topics_of(data: bytes) -> dict[int, str]:
    summary = SeekingReader(io.BytesIO(data)).get_summary()
    return {number: channel.topic for number, channel in summary.channels.items()}


def said_in(log: Log) -> list[Said]:
    """The messages by our own reader."""
    return [(m.topic, m.log_time, m.sequence, m.data) for m in log.messages()]


def heard(path: Path) -> list[Said]:
    """The messages by the library's two readers, which must agree, checksums looked at."""
    answers = []
    for reader in (SeekingReader, NonSeekingReader):
        with path.open("rb") as stream:
            found = reader(stream, validate_crcs=True).iter_messages()
            answers.append([(channel.topic, m.log_time, m.sequence, m.data) for _, channel, m in found])
    assert answers[0] == answers[1]
    return answers[0]
