"""MCAP logs, our own and others', read defensively: lengths are checked against the bytes that are there.

On invalid bytes everything here raises `Damaged`, and nothing else.
"""

from __future__ import annotations

import heapq
import itertools
import math
import mmap
import shlex
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lz4.frame
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode

from planner.errors import InputError
from planner.files import printable, why_no_file

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""Header of every record: opcode and length of the rest."""
AFTER_SUMMARY_CRC = 4 + len(MAGIC)
FOOTER_SIZE = HEAD.size + 16 + AFTER_SUMMARY_CRC
CHECK = "crc32"
"""Item with the checksum of our metadata records (MCAP has none for them)."""
MAX_CHUNK = 2**28
"""Largest chunk, before compression, that is written or read."""
MAX_DESCRIPTIONS = 2**24
"""Most bytes of schemas and channels, and of metadata, kept of one log."""
_MESSAGE = struct.Struct("<HIQQ")
_WINDOW = 2**27
_CHUNK_START, _CHUNK_CRC = struct.Struct("<Q"), slice(24, 28)
"""The first field of a chunk, its first log time, and the place of its checksum."""
UNCHECKED = "its messages are under no checksums: try `mcap recover` of the MCAP command line tools"
"""Fix for a damaged log from which `mrac-jax inspect --repair` saves nothing."""


class Damaged(ValueError):
    """Bytes that are no valid record; `work`: number of bytes read to find out."""

    def __init__(self, problem: str, work: int = 0) -> None:
        super().__init__(problem)
        self.work = work


def mapped(path: Path, error: type[InputError] = InputError) -> memoryview:
    """The file's bytes, read as they are used.

    Args:
        path: the file.
        error: exception if it is no regular file, or empty.
    """
    problem = why_no_file(path)
    if problem == "is a folder" and (inside := sorted(one.name for one in path.glob("*.mcap"))):
        problem, fix = f"is a folder with {', '.join(inside)[:200]}", "name the file in it"
        raise error(problem, source=printable(path), expected="an MCAP file", fix=fix)
    try:
        if not problem and not path.stat().st_size:
            problem = "is empty"
        if problem:
            raise error(problem, source=printable(path), expected="an MCAP file")
        with path.open("rb") as stream:
            return memoryview(mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    except InputError:
        raise
    except (OSError, ValueError) as wrong:
        raise error(f"cannot be read ({wrong})", source=printable(path), expected="an MCAP file") from wrong


def refusal(path: Path, problem: str, data: memoryview, error: type[InputError] = InputError) -> InputError:
    """The error of every reader for a truncated or damaged log, with a fix."""
    fix = UNCHECKED if unchecked(data) else f"try `mrac-jax inspect --repair OUT {shlex.quote(printable(path))}`"
    return error(f"truncated or damaged: {problem}", source=path, fix=fix)


def unchecked(data: memoryview) -> bool:
    """Whether a log has messages before its damage, and none of them in a chunk with a checksum."""
    found = False
    with suppress(Damaged):
        for _, opcode, body in records_in(data[len(MAGIC) :]):
            if opcode == Opcode.CHUNK and any(body[_CHUNK_CRC]):
                return False
            found |= opcode in (Opcode.CHUNK, Opcode.MESSAGE)
    return found


class _Body:
    """A record's bytes as a stream; `Damaged` if they end too early."""

    def __init__(self, data: memoryview) -> None:
        self._data, self.at = data, 0

    def read(self, count: int) -> bytes:
        left = len(self._data) - self.at
        if count > left:
            raise Damaged(f"a length of {count} where {left} bytes are left", self.at)
        self.at += count
        return bytes(self._data[self.at - count : self.at])


def parsed(kind: Any, body: memoryview) -> Any:
    """The record of a kind (a class of `mcap.records`) whose fields are exactly `body`."""
    stream = _Body(body)
    try:
        record = kind.read(ReadDataStream(stream))
    except UnicodeDecodeError as error:
        raise Damaged("text that is not UTF-8", stream.at) from error
    if stream.at != len(body):
        raise Damaged(f"{len(body) - stream.at} bytes too many", stream.at)
    return record


def records_in(data: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """(offset, opcode, body) of each record of a chunk or a section."""
    at = 0
    while at < len(data):
        if len(data) - at < HEAD.size:
            raise Damaged("a record that is cut")
        opcode, length = HEAD.unpack_from(data, at)
        body = data[at + HEAD.size : at + HEAD.size + length]
        if len(body) != length or opcode == 0:
            raise Damaged("a record that is longer than what holds it")
        yield at, opcode, body
        at += HEAD.size + length


def bytes_of(record: records.McapRecord) -> bytes:
    """Bytes of a complete record."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def message_bytes(channel_id: int, sequence: int, log_time: int, publish_time: int, data: bytes) -> bytes:
    """Bytes of a complete message record; times in nanoseconds."""
    head = HEAD.pack(Opcode.MESSAGE, _MESSAGE.size + len(data))
    return head + _MESSAGE.pack(channel_id, sequence, log_time, publish_time) + data


def unpacked(chunk: records.Chunk) -> bytes:
    """A chunk's records, complete and with a valid checksum (0: none), in bounded memory."""
    size, data = chunk.uncompressed_size, chunk.data
    if size > MAX_CHUNK:
        raise Damaged(f"a chunk of {size} bytes; at most {MAX_CHUNK} are read")
    try:  # one byte more than claimed is enough to detect a wrong size
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor(max_window_size=_WINDOW).stream_reader(data).read(size + 1)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif chunk.compression:
            raise Damaged(f"a chunk with unknown compression {chunk.compression[:16]!r}")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise Damaged(f"a chunk whose {chunk.compression} data are broken", size + len(chunk.data)) from error
    if len(data) != size or chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise Damaged("a chunk with a wrong checksum or size", size + len(chunk.data))
    return data


def attachment(body: memoryview) -> records.Attachment:
    """A complete attachment with a valid checksum (0: none). Its name must never be used as a path."""
    found = parsed(records.Attachment, body)
    if int.from_bytes(body[-4:], "little") not in (0, zlib.crc32(body[:-4])):
        raise Damaged("an attachment with a wrong checksum", len(body))
    return found


def check_of(name: str, items: Mapping[str, str]) -> str:
    """Checksum of a metadata record: CRC-32 of its bytes without the checksum, as eight hexadecimal digits."""
    record = records.Metadata(name, {key: value for key, value in items.items() if key != CHECK})
    return f"{zlib.crc32(bytes_of(record)):08x}"


def metadata(body: memoryview) -> records.Metadata:
    """A metadata record as in the file; its checksum, if any, has to be valid."""
    record = parsed(records.Metadata, body)
    if record.metadata.get(CHECK, check := check_of(record.name, record.metadata)) != check:
        raise Damaged("a metadata record with a wrong checksum", len(body))
    return record


def all_records(data: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """`records_in` a section, with chunks replaced by their records."""
    for at, opcode, body in records_in(data):
        if opcode == Opcode.CHUNK:
            yield from records_in(memoryview(unpacked(parsed(records.Chunk, body))))
        else:
            yield at, opcode, body


def by_log_time(data: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """`all_records` of a section, messages in order of log time; equal ones in the file's order.

    Chunks may overlap in time: a message waits until every chunk that may hold an earlier one has been unpacked.
    Memory: the overlapping chunks, one if none overlap. Other records come before the messages around them.
    """
    parts: list[tuple[int, int, int, memoryview]] = []  # first log time, offset, opcode, body
    for at, opcode, body in records_in(data):
        if opcode == Opcode.CHUNK and len(body) >= _CHUNK_START.size:
            parts.append((_CHUNK_START.unpack_from(body)[0], at, opcode, body))
        elif opcode == Opcode.MESSAGE and len(body) >= _MESSAGE.size:
            parts.append((_MESSAGE.unpack_from(body)[2], at, opcode, body))
        else:
            yield at, opcode, body
    parts.sort(key=lambda part: part[:2])
    waiting: list[tuple[int, int, int, memoryview]] = []  # log time, offset of the part, of the record, body
    for (first, at, opcode, body), following in itertools.zip_longest(parts, parts[1:]):
        inside = [(0, opcode, body)]
        if opcode == Opcode.CHUNK:
            inside = list(records_in(memoryview(unpacked(parsed(records.Chunk, body)))))
        for within, kind, record in inside:
            if kind == Opcode.MESSAGE and len(record) >= _MESSAGE.size:
                time = _MESSAGE.unpack_from(record)[2]
                if time < first:
                    raise Damaged("a chunk with a message before its first log time", len(body))
                heapq.heappush(waiting, (time, at, within, record))
            else:
                yield within, kind, record
        until = math.inf if following is None else following[0]
        while waiting and waiting[0][0] < until:
            _, at, within, record = heapq.heappop(waiting)
            yield within, Opcode.MESSAGE, record


@dataclass(frozen=True)
class LogMessage:
    """One message: times in nanoseconds, `data` as encoded by its channel's schema (None: no schema)."""

    channel: records.Channel
    schema: records.Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes

    @property
    def topic(self) -> str:
        """The topic of its channel."""
        return self.channel.topic


class Descriptions:
    """The schemas and channels seen so far, by id; a repeated id has to have the same content."""

    def __init__(self) -> None:
        self.schemas: dict[int, records.Schema] = {}
        self.channels: dict[int, records.Channel] = {}
        self._held = 0

    def copy(self) -> Descriptions:
        """A copy that can be extended independently."""
        other = copy(self)
        other.schemas, other.channels = dict(self.schemas), dict(self.channels)
        return other

    def add(self, opcode: int, body: memoryview) -> None:
        """Store a record if it is a schema or a channel. Raises Damaged if it contradicts an earlier one."""
        kinds = {Opcode.SCHEMA: (records.Schema, self.schemas), Opcode.CHANNEL: (records.Channel, self.channels)}
        if opcode not in kinds:
            return
        kind, known = kinds[opcode]
        new = parsed(kind, body)
        if opcode == Opcode.SCHEMA and new.id == 0:
            raise Damaged("a schema with id 0")
        if new.id not in known:
            self._held += len(body)
            if self._held > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_DESCRIPTIONS} bytes of schemas and channels")
        if known.setdefault(new.id, new) != new:
            raise Damaged(f"{kind.__name__.lower()} {new.id} is described twice, differently")

    def messages(self, found: Iterable[tuple[int, int, memoryview]]) -> Iterator[LogMessage]:
        """The messages in the result of `records_in`. Raises Damaged if a channel or schema is missing.

        There are many, so they are not parsed by `parsed`.
        """
        for _, opcode, body in found:
            if opcode != Opcode.MESSAGE:
                self.add(opcode, body)
                continue
            if len(body) < _MESSAGE.size:
                raise Damaged("a message that is cut")
            number, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
            channel = self.channels.get(number)
            if channel is None:
                raise Damaged(f"a message of channel {number}, which is not described")
            schema = self.schemas.get(channel.schema_id)
            if schema is None and channel.schema_id:
                raise Damaged(f"channel {channel.id} has schema {channel.schema_id}, which is not described")
            yield LogMessage(channel, schema, log_time, publish_time, sequence, bytes(body[_MESSAGE.size :]))
