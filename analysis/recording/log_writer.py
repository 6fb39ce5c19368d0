"""The MCAP container, writing side: a log that survives a crash and whose bytes depend on its content alone.

Every chunk stands alone: the schemas and channels that its messages use are written again in it, so that a chunk whose
checksum is right can be read whatever was lost around it. Everything in the file is under a checksum: chunks and
attachments have their own, metadata carries one among its items, and the data and summary sections have one each.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from analysis.recording.names import GROWING, how_to_clear, interrupted_name, left_over
from planner.errors import InputError
from planner.mcap import CHECK, MAGIC, MAX_CHUNK, bytes_of, check_of, message_bytes

# The chunk in progress of a log: messages, and before them whatever describes them, so that it can be read alone.


@dataclass
class OpenChunk:
    """Messages waiting to be packed: (log time, the record's bytes, its channel, that one's schema) of each.

    A message comes in by one `append`, so that an interrupt at any time leaves a whole chunk.
    """

    messages: list[tuple[int, bytes, records.Channel, records.Schema | None]] = field(default_factory=list)

    def close(self, compressor: zstandard.ZstdCompressor) -> tuple[records.Chunk, list[records.MessageIndex]]:
        """The chunk, and the message indexes that follow it."""
        builder = RecordBuilder()
        schemas: set[int] = set()
        indexes: dict[int, records.MessageIndex] = {}
        for log_time, data, channel, schema in self.messages:
            if channel.id not in indexes:
                if schema and schema.id not in schemas:
                    schema.write(builder)
                    schemas.add(schema.id)
                channel.write(builder)
                indexes[channel.id] = records.MessageIndex(channel.id, [])
            indexes[channel.id].records.append((log_time, builder.count))
            builder.write(data)
        times = [message[0] for message in self.messages]
        plain = builder.end()
        packed = compressor.compress(plain)
        return records.Chunk("zstd", packed, max(times), min(times), zlib.crc32(plain), len(plain)), [*indexes.values()]


# The end of an MCAP log: summary section, footer and closing magic.


@dataclass(frozen=True)
class Index:
    """An entry of the summary about a record of the data section; for a chunk, its number of messages by channel."""

    record: records.McapRecord
    counts: Mapping[int, int] = field(default_factory=dict)


def closing(
    start: int, schemas: Sequence[records.Schema], channels: Sequence[records.Channel], indexes: Sequence[Index]
) -> bytes:
    """Everything after the data section, which ends at offset `start` of the file."""
    counted = statistics(len(schemas), len(channels), indexes)
    groups = sorted((bytes_of(one.record) for one in indexes), key=_opcode)
    told = [*map(bytes_of, (*schemas, *channels, counted)), *groups]
    offsets, at = [], start
    for opcode, group in groupby(told, _opcode):
        length = sum(map(len, group))
        offsets.append(bytes_of(records.SummaryOffset(opcode, at, length)))
        at += length
    data = b"".join((*told, *offsets))
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
    return data + bytes_of(records.Footer(start, at, zlib.crc32(head, zlib.crc32(data)))) + MAGIC


def _opcode(record: bytes) -> Opcode:
    return Opcode(record[0])


def statistics(schemas: int, channels: int, indexes: Sequence[Index]) -> records.Statistics:
    """The counts of a whole log."""
    chunks = [index.record for index in indexes if isinstance(index.record, records.ChunkIndex)]
    kinds = Counter(type(index.record) for index in indexes)
    counts: Counter[int] = Counter()
    for index in indexes:
        counts.update(index.counts)
    return records.Statistics(
        attachment_count=kinds[records.AttachmentIndex],
        channel_count=channels,
        channel_message_counts=dict(sorted(counts.items())),
        chunk_count=len(chunks),
        message_count=counts.total(),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        metadata_count=kinds[records.MetadataIndex],
        schema_count=schemas,
    )


LIBRARY = "mrac-jax"
CHUNK_SIZE = 2**22
"""A chunk is closed once it holds this many bytes before compression: what a crash can lose, some 200 steps. In larger
ones repeated grids take less room."""
MAX_IDS = 2**16 - 1
PARTIAL, RECOVERED = "mrac/partial", "mrac/recovered"
"""Names of the metadata records of a log that was cut short, and of one that `recover` wrote."""
INTERRUPTED = "interrupted"
"""Reason of a log that Ctrl-C cut short."""
_LEVEL = 3


@dataclass(frozen=True)
class LogSchema:
    """What a channel's messages are: schema (name, encoding, its text or bytes) and the encoding of the messages.

    Known pairs of encodings: `protobuf`/`protobuf`, `ros2msg`/`cdr`, `jsonschema`/`json`. No schema: all of the first
    three empty.
    """

    name: str
    encoding: str
    data: bytes
    message_encoding: str


@dataclass(frozen=True)
class _Written:
    """How far the file has come: bytes, their CRC-32, entries of the summary, and the chunk that is next."""

    offset: int
    crc: int
    indexes: int
    chunk: OpenChunk


class LogWriter:
    """Writes a log, as a context manager: `with LogWriter(path) as log: ...`.

    The file grows as `NAME.partial` beside the target and takes its place, atomically, at the end of the block. When
    the block raises (Ctrl-C too), the log is finished as well: valid, holding all that was written, and marked by a
    metadata record `mrac/partial` {"reason"}; where a file of the target's name exists, that one stays and the log
    becomes `NAME.interrupted.mcap`. A killed process leaves `NAME.partial`, complete up to the last closed chunk, for
    `recover`.

    Args:
        path: the target; an older file there is replaced at the end, but never by a log that is cut short.
        chunk_size: bytes of messages a chunk.
        ordered: whether log times must not decrease (ValueError if they do).
        suffix: what the growing file's name ends with.
        discard: whether a block that raises leaves nothing, instead of a log that is cut short; can be set on the way.

    Attributes:
        placed: the name that the finished log got; None before.

    Raises:
        UsageError: on entry, `NAME.partial` is there: left from an earlier run, or written by another one.
        InputError: the target cannot be written, on entry and on every write.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        chunk_size: int = CHUNK_SIZE,
        ordered: bool = True,
        suffix: str = GROWING,
        discard: bool = False,
    ) -> None:
        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + suffix)
        self.discard = discard
        self.placed: Path | None = None
        self._chunk_size, self._ordered = chunk_size, ordered
        self._schemas: dict[tuple[str, str, bytes], records.Schema] = {}
        self._channels: dict[tuple[object, ...], records.Channel] = {}
        self._described: list[tuple[records.Channel, records.Schema | None]] = []  # by the channel's id, from 1
        self._counts: Counter[int] = Counter()
        self._waiting = self._last_time = 0
        self._indexes: list[Index] = []
        self._written = _Written(0, 0, 0, OpenChunk())
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)

    def __enter__(self) -> LogWriter:
        if self.path.is_dir():
            raise InputError("is a folder", source=self.path, expected="the name of a file to write")
        with self._told():
            try:
                self._stream: BinaryIO = self.partial.open("xb")
            except FileExistsError:
                raise left_over(self.partial) from None
        self._put(MAGIC + bytes_of(records.Header("", LIBRARY)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                try:
                    self._finish(self.path)
                except InputError as unfinished:
                    error = unfinished
                except KeyboardInterrupt:  # all is there: it ends the run once the file is whole
                    if not self._stream.closed:
                        self._take_back()
                    self._finish(self.path)
                    raise
            elif self.discard:
                self.partial.unlink(missing_ok=True)
            else:
                with contextlib.suppress(InputError):  # the first error is the one to tell; NAME.partial stays
                    self._take_back()
                    reason = f"{kind.__name__}: {error}".rstrip(": ")
                    self.metadata(PARTIAL, {"reason": INTERRUPTED if kind is KeyboardInterrupt else reason})
                    self._finish(interrupted_name(self.path) if self.path.exists() else self.path)
        finally:
            with contextlib.suppress(OSError):
                self._stream.close()
        left = self.partial.exists()
        if isinstance(error, InputError) and self.placed is None and (left or kind is None):
            fix = f"{self.partial} holds what was written so far: {how_to_clear(self.partial)}" if left else ""
            raise InputError(error.problem, source=error.source, expected=error.expected, fix=fix) from error

    def channel(self, topic: str, schema: LogSchema, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a channel; the same arguments give the same id. Nothing is written until its first message."""
        items, known = dict(metadata or {}), None
        if schema.name or schema.encoding or schema.data:
            new_schema = records.Schema(len(self._schemas) + 1, schema.data, schema.encoding, schema.name)
            known = self._schemas.setdefault((schema.name, schema.encoding, schema.data), new_schema)
        schema_id = 0 if known is None else known.id
        new = records.Channel(len(self._channels) + 1, topic, schema.message_encoding, items, schema_id)
        key = (topic, schema_id, schema.message_encoding, *sorted(items.items()))
        channel = self._channels.setdefault(key, new)
        if channel.id > MAX_IDS or schema_id > MAX_IDS:
            raise ValueError(f"more than {MAX_IDS} channels or schemas in one log")
        if channel is new:
            self._described.append((channel, known))
        return int(channel.id)

    def write(
        self, channel: int, log_time: int, data: bytes, sequence: int | None = None, publish_time: int | None = None
    ) -> None:
        """One message.

        Args:
            channel: id that `channel` gave.
            log_time: nanoseconds from 0.
            data: the encoded message.
            sequence: its number; by default the count of the channel's messages before it.
            publish_time: nanoseconds; `log_time` by default.
        """
        if self._ordered and log_time < self._last_time:
            raise ValueError(f"log time {log_time} after {self._last_time}: messages are written in order")
        if len(data) > MAX_CHUNK // 2:
            raise ValueError(f"a message of {len(data)} bytes; at most {MAX_CHUNK // 2} fit")
        if self._waiting + len(data) > MAX_CHUNK // 2:
            self.flush()
        number = self._counts[channel] if sequence is None else sequence
        published = log_time if publish_time is None else publish_time
        record = message_bytes(channel, number, log_time, published, data)
        self._written.chunk.messages.append((log_time, record, *self._described[channel - 1]))
        self._counts[channel] += 1
        self._last_time = max(self._last_time, log_time)
        self._waiting += len(record)
        if self._waiting >= self._chunk_size:
            self.flush()

    def attach(self, name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0) -> None:
        """An attachment, written at once. A name is a name, never a path that somebody should write to."""
        record = bytes_of(records.Attachment(create_time, log_time, name, media_type, data))
        about = (len(record), log_time, create_time, len(data), name, media_type)
        self._put(record, Index(records.AttachmentIndex(self._written.offset, *about)))

    def metadata(self, name: str, items: Mapping[str, str]) -> None:
        """A metadata record, written at once, with its checksum as one more item."""
        record = bytes_of(records.Metadata(name, {**items, CHECK: check_of(name, items)}))
        index = records.MetadataIndex(self._written.offset, len(record), name)
        self._put(record, Index(index))

    def flush(self) -> None:
        """Close the chunk in progress, if it holds messages, and hand it to the operating system."""
        if not self._written.chunk.messages:
            return
        chunk, message_indexes = self._written.chunk.close(self._compressor)
        at, record = self._written.offset, bytes_of(chunk)
        parts, offsets = [record], {}
        for index in message_indexes:
            offsets[index.channel_id] = at + sum(map(len, parts))
            parts.append(bytes_of(index))
        chunk_index = records.ChunkIndex(
            message_start_time=chunk.message_start_time,
            message_end_time=chunk.message_end_time,
            chunk_start_offset=at,
            chunk_length=len(record),
            message_index_offsets=offsets,
            message_index_length=sum(map(len, parts[1:])),
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
        )
        counts = {index.channel_id: len(index.records) for index in message_indexes}
        self._put(b"".join(parts), Index(chunk_index, counts), OpenChunk())
        self._waiting = 0

    def _finish(self, target: Path) -> None:
        """The last chunk, the summary and the footer; then the file takes its place. Goes on if interrupted."""
        with self._told():
            if not self._stream.closed:
                self.flush()
                end = bytes_of(records.DataEnd(self._written.crc))
                schemas, channels = [*self._schemas.values()], [*self._channels.values()]
                self._stream.write(end + closing(self._written.offset + len(end), schemas, channels, self._indexes))
                self._stream.flush()
                os.fsync(self._stream.fileno())
                self._stream.close()
            if self.partial.exists():
                self.partial.replace(target)
            self.placed = target

    def _put(self, data: bytes, index: Index | None = None, chunk: OpenChunk | None = None) -> None:
        """Write bytes with their index; `chunk` is the one that grows from then on, if that changes.

        Only the assignment at the end makes it count, so an interrupt at any time can be taken back.
        """
        before = self._written
        with self._told():
            self._stream.write(data)
            self._stream.flush()
        if index:
            self._indexes.append(index)
        checksum = zlib.crc32(data, before.crc)
        self._written = _Written(before.offset + len(data), checksum, len(self._indexes), chunk or before.chunk)

    def _take_back(self) -> None:
        """Forget what was being written when an interrupt came."""
        with self._told():
            self._stream.seek(self._written.offset)
            self._stream.truncate()
        del self._indexes[self._written.indexes :]

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """An operating system's refusal as an InputError that names the target."""
        try:
            yield
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", source=self.path) from error
