"""Small logs with a known layout, for the tests of the container, of reading and of recovery."""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from analysis.recording.log_writer import LogSchema, LogWriter

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
        log.flush()
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
            record = next(StreamReader(stream_of(data[at:end]), skip_magic=True, emit_chunks=True).records)
            assert isinstance(record, Chunk)
            inner = [message for message in breakup_chunk(record, validate_crc=True) if isinstance(message, Message)]
            said = tuple((topics[m.channel_id], m.log_time, m.sequence, m.data) for m in inner)
        found.append(Part(opcode, at, end, said))
        at = end
    return found


def stream_of(data: bytes) -> io.BytesIO:
    return io.BytesIO(data)


def topics_of(data: bytes) -> dict[int, str]:
    summary = SeekingReader(stream_of(data)).get_summary()
    assert summary is not None
    return {number: channel.topic for number, channel in summary.channels.items()}


def heard(path: Path) -> list[Said]:
    """The messages by the library's two readers, which must agree, checksums looked at."""
    answers = []
    for reader in (SeekingReader, NonSeekingReader):
        with path.open("rb") as stream:
            found = reader(stream, validate_crcs=True).iter_messages()
            answers.append([(channel.topic, m.log_time, m.sequence, m.data) for _, channel, m in found])
    assert answers[0] == answers[1]
    return answers[0]
