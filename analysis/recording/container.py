"""MCAP logs: a crash-safe writer, a reader with checks in bounded memory, and recovery of damaged files."""

from __future__ import annotations

import contextlib
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
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
from planner import mcap as wire
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.mcap import (
    CHECK,
    HEAD,
    MAGIC,
    MAX_CHUNK,
    MAX_DESCRIPTIONS,
    Damaged,
    Descriptions,
    LogMessage,
    bytes_of,
    check_of,
    message_bytes,
)

# Writer: the file survives a crash, and its bytes depend only on its content.
#
# Every chunk is self-contained: it repeats the schemas and channels of its messages, so that a chunk with a valid
# checksum can be read whatever was lost around it. All bytes are under a checksum: chunks and attachments have one
# each, metadata has one among its items, and so have the data and summary sections.

# The open chunk of a log: messages with their schemas and channels.


@dataclass
class OpenChunk:
    """Messages of the next chunk: (log time, the record's bytes, its channel, the channel's schema) of each.

    A message is added by a single `append`, so that an interrupt at any time leaves a consistent chunk.
    """

    messages: list[tuple[int, bytes, records.Channel, records.Schema | None]] = field(default_factory=list)

    def close(self, compressor: zstandard.ZstdCompressor) -> tuple[records.Chunk, list[records.MessageIndex]]:
        """The chunk, and the message indexes that follow it."""
        builder = RecordBuilder()
        schemas: set[int] = set()
        indexes: dict[int, records.MessageIndex] = {}
        for log_time, data, channel, schema in self.messages:
            # A chunk repeats the schema and channel of its first message of a channel.
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
    """A summary entry for a record of the data section; for a chunk, its number of messages by channel."""

    record: records.McapRecord
    counts: Mapping[int, int] = field(default_factory=dict)


def closing(
    start: int, schemas: Sequence[records.Schema], channels: Sequence[records.Channel], indexes: Sequence[Index]
) -> bytes:
    """All bytes after the data section, which ends at offset `start` of the file."""
    counted = statistics(len(schemas), len(channels), indexes)
    groups = sorted((bytes_of(one.record) for one in indexes), key=_opcode)
    summary = [*map(bytes_of, (*schemas, *channels, counted)), *groups]
    offsets, at = [], start
    for opcode, group in groupby(summary, _opcode):
        length = sum(map(len, group))
        offsets.append(bytes_of(records.SummaryOffset(opcode, at, length)))
        at += length
    data = b"".join((*summary, *offsets))
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
    return data + bytes_of(records.Footer(start, at, zlib.crc32(head, zlib.crc32(data)))) + MAGIC


def _opcode(record: bytes) -> Opcode:
    return Opcode(record[0])


def statistics(schemas: int, channels: int, indexes: Sequence[Index]) -> records.Statistics:
    """The counts of a complete log."""
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
"""Bytes before compression at which a chunk is closed: a crash loses at most one chunk, some 200 steps. Larger chunks
compress repeated grids better."""
MAX_IDS = 2**16 - 1
PARTIAL, RECOVERED = "mrac/partial", "mrac/recovered"
"""Names of the metadata records of an interrupted log, and of one that `recover` wrote."""
INTERRUPTED = "interrupted"
"""Reason of a log that Ctrl-C interrupted."""
_LEVEL = 3


@dataclass(frozen=True)
class LogSchema:
    """Type of a channel's messages: schema (name, encoding, text or bytes) and the encoding of the messages.

    Known pairs of encodings: `protobuf`/`protobuf`, `ros2msg`/`cdr`, `jsonschema`/`json`. No schema: the first three
    are empty.
    """

    name: str
    encoding: str
    data: bytes
    message_encoding: str


@dataclass(frozen=True)
class _Written:
    """State of the written file: bytes, their CRC-32, entries of the summary, and the next chunk."""

    offset: int
    crc: int
    indexes: int
    chunk: OpenChunk


class LogWriter:
    """Writes a log, as a context manager: `with LogWriter(path) as log: ...`.

    The file grows as `NAME.partial` next to the target and replaces it atomically at the end of the block. If the block
    raises (also Ctrl-C), the log is closed too: valid, with all messages so far, and marked by a metadata record
    `mrac/partial` {"reason"}; if the target exists, it is kept and the log becomes `NAME.interrupted.mcap`. A killed
    process leaves `NAME.partial`, complete up to the last closed chunk, for `recover`.

    Args:
        path: the target; an existing file is replaced at the end, but never by an interrupted log.
        chunk_size: bytes of messages in a chunk.
        ordered: whether log times must not decrease (ValueError if they do).
        suffix: of the growing file.
        discard: whether a block that raises leaves no file; can be changed meanwhile.

    Attributes:
        placed: the name of the finished log; None before.

    Raises:
        UsageError: on entry, if `NAME.partial` exists: from an earlier run, or of another process.
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
        with self._os_errors():
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
                except KeyboardInterrupt:  # the block is done: finish the file, then end the run
                    if not self._stream.closed:
                        self._take_back()
                    self._finish(self.path)
                    raise
            elif self.discard:
                self.partial.unlink(missing_ok=True)
            else:
                with contextlib.suppress(InputError):  # report the first error; NAME.partial stays
                    self._take_back()
                    reason = f"{kind.__name__}: {error}".rstrip(": ")
                    self.metadata(PARTIAL, {"reason": INTERRUPTED if kind is KeyboardInterrupt else reason})
                    self._finish(interrupted_name(self.path) if self.path.exists() else self.path)
        finally:
            with contextlib.suppress(OSError):
                self._stream.close()
        left = self.partial.exists()
        if isinstance(error, InputError) and self.placed is None and (left or kind is None):
            fix = f"{self.partial} holds the data written so far: {how_to_clear(self.partial)}" if left else ""
            raise InputError(error.problem, source=error.source, expected=error.expected, fix=fix) from error

    def channel(self, topic: str, schema: LogSchema, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a channel; equal arguments give the same id. Nothing is written until its first message."""
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
        """Write one message.

        Args:
            channel: id from `channel`.
            log_time: nanoseconds from 0.
            data: the encoded message.
            sequence: its number; by default the count of the channel's messages before it.
            publish_time: nanoseconds; `log_time` by default.
        """
        if self._ordered and log_time < self._last_time:
            raise ValueError(f"log time {log_time} after {self._last_time}: messages are written in order")
        if len(data) > MAX_CHUNK // 2:
            raise ValueError(f"a message of {len(data)} bytes; at most {MAX_CHUNK // 2} fit")
        # Readers limit the size of a chunk.
        if self._waiting + len(data) > MAX_CHUNK // 2:
            self.flush()
        # By default consumers can detect gaps.
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
        """Write an attachment at once. The name is only a label, never a path to write to."""
        record = bytes_of(records.Attachment(create_time, log_time, name, media_type, data))
        about = (len(record), log_time, create_time, len(data), name, media_type)
        self._put(record, Index(records.AttachmentIndex(self._written.offset, *about)))

    def metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record at once, with its checksum as an additional item."""
        record = bytes_of(records.Metadata(name, {**items, CHECK: check_of(name, items)}))
        index = records.MetadataIndex(self._written.offset, len(record), name)
        self._put(record, Index(index))

    def flush(self) -> None:
        """Close the open chunk, if it has messages, and pass it to the operating system."""
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
        # The chunk and its indexes are written together.
        self._put(b"".join(parts), Index(chunk_index, counts), OpenChunk())
        self._waiting = 0

    def _finish(self, target: Path) -> None:
        """Write the last chunk, the summary and the footer, and rename the file. Can be called again if interrupted."""
        with self._os_errors():
            if not self._stream.closed:
                self.flush()
                end = bytes_of(records.DataEnd(self._written.crc))
                schemas, channels = [*self._schemas.values()], [*self._channels.values()]
                self._stream.write(end + closing(self._written.offset + len(end), schemas, channels, self._indexes))
                self._stream.flush()
                # Data must be on disk before the rename makes them the target.
                os.fsync(self._stream.fileno())
                self._stream.close()
            # After an interrupt the file may already have its final name.
            if self.partial.exists():
                self.partial.replace(target)
            self.placed = target

    def _put(self, data: bytes, index: Index | None = None, chunk: OpenChunk | None = None) -> None:
        """Write bytes with their index; `chunk` replaces the open chunk, if given.

        Only the assignment at the end commits the write, so an interrupt at any time can be undone.
        """
        before = self._written
        with self._os_errors():
            self._stream.write(data)
            self._stream.flush()
        if index:
            self._indexes.append(index)
        checksum = zlib.crc32(data, before.crc)
        # A single assignment commits the write, so an interrupt cannot leave a mixed state.
        self._written = _Written(before.offset + len(data), checksum, len(self._indexes), chunk or before.chunk)

    def _take_back(self) -> None:
        """Undo the write that an interrupt stopped."""
        with self._os_errors():
            self._stream.seek(self._written.offset)
            self._stream.truncate()
        del self._indexes[self._written.indexes :]

    @contextlib.contextmanager
    def _os_errors(self) -> Iterator[None]:
        """Turn errors of the operating system into InputErrors that name the target."""
        try:
            yield
        except OSError as error:
            raise InputError(f"cannot be written ({error.strerror})", source=self.path) from error


# Reader: a complete file or a clear error, in bounded memory, whatever lengths the file claims.

MAX_EXTRAS = 10_000
"""Largest number of attachments, and of metadata records, in a log."""


@dataclass(frozen=True)
class Summary:
    """The end of a log: its offset, whether it has a checksum, the counts, schemas and channels."""

    start: int
    checked: bool
    statistics: records.Statistics | None
    described: Descriptions


def read_summary(data: memoryview) -> Summary:
    """The summary of a complete file, with its checksum verified. Raises Damaged."""
    end, size = data[-wire.FOOTER_SIZE :], len(data)
    if len(end) < wire.FOOTER_SIZE or end[-len(wire.MAGIC) :] != wire.MAGIC:
        raise Damaged("the end is missing")
    if wire.HEAD.unpack_from(end) != (Opcode.FOOTER, 20):
        raise Damaged("the footer is not where it should be")
    footer = wire.parsed(records.Footer, end[wire.HEAD.size : -len(wire.MAGIC)])
    start = footer.summary_start or size - wire.FOOTER_SIZE
    if not len(wire.MAGIC) <= start <= size - wire.FOOTER_SIZE:
        raise Damaged("the footer points outside the file")
    # A checksum of 0 means "not computed" in MCAP.
    if footer.summary_crc not in (0, zlib.crc32(data[start : size - wire.AFTER_SUMMARY_CRC])):
        raise Damaged("the summary has a wrong checksum")
    statistics, described = None, Descriptions()
    for _, opcode, body in wire.records_in(data[start : size - wire.FOOTER_SIZE]):
        described.add(opcode, body)
        if opcode == Opcode.STATISTICS:
            statistics = wire.parsed(records.Statistics, body)
    return Summary(start, footer.summary_crc != 0, statistics, described)


class Log:
    """An open log. All is checked except the content of its chunks, which is checked when it is read.

    Attributes:
        path: the file.
        library: the program that wrote it.
        channels, schemas: by id, from the summary.
        attachments: in the file's order.
        metadata: (name, items) in the file's order, without checksums.
        partial: why it is incomplete ("" if it is complete).
    """

    def __init__(self, path: Path, data: memoryview) -> None:
        self.path, self._data, self.library = path, data, ""
        self.attachments: list[records.Attachment] = []
        self.metadata: list[tuple[str, dict[str, str]]] = []
        if data[: len(wire.MAGIC)] != wire.MAGIC:
            raise InputError("is not an MCAP file", source=path, expected="a log that `mrac-jax record` wrote")
        summary = read_summary(data)
        self._described, self._data_end = summary.described, summary.start
        self.channels, self.schemas = summary.described.channels, summary.described.schemas
        self._read_data_section()
        reasons = [items.get("reason", "cut short") for name, items in self.metadata if name in (PARTIAL, RECOVERED)]
        self.partial = "; ".join(reasons)

    def attachment(self, name: str) -> bytes:
        """The first attachment of that name. Raises InputError if there is none."""
        for attached in self.attachments:
            if attached.name == name:
                return attached.data
        raise InputError(f"has no attachment {name!r}", source=self.path)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """The messages in order of log time, and in the file's order for equal times.

        `topics`: only these; None for all. Raises InputError at the first damaged chunk.
        """
        try:
            section = self._data[len(wire.MAGIC) : self._data_end]
            for message in self._described.copy().messages(wire.by_log_time(section)):
                if topics is None or message.topic in topics:
                    yield message
        except Damaged as error:
            raise wire.refusal(self.path, str(error), self._data) from error

    def _read_data_section(self) -> None:
        """Check the length of every record and the checksum of the section; read attachments and metadata."""
        finished, metadata_bytes, first = False, 0, len(wire.MAGIC)
        for at, opcode, body in wire.records_in(self._data[first : self._data_end]):
            if finished or (at == 0) != (opcode == Opcode.HEADER):
                raise Damaged("its records are out of order")
            if opcode == Opcode.HEADER:
                self.library = wire.parsed(records.Header, body).library
            elif opcode == Opcode.ATTACHMENT:
                self.attachments.append(wire.attachment(body))
            elif opcode == Opcode.METADATA:
                metadata_bytes += len(body)
                record = wire.metadata(body)
                record.metadata.pop(wire.CHECK, None)
                self.metadata.append((record.name, record.metadata))
            elif opcode == Opcode.DATA_END:
                finished, self._data_end = True, first + at
                checksum = wire.parsed(records.DataEnd, body).data_section_crc
                if checksum not in (0, zlib.crc32(self._data[: self._data_end])):
                    raise Damaged("its data have a wrong checksum")
            if max(len(self.attachments), len(self.metadata)) > MAX_EXTRAS or metadata_bytes > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_EXTRAS} attachments or {MAX_DESCRIPTIONS} bytes of metadata")
        if not finished:
            raise Damaged("its data section has no end")


def open_log(path: str | Path) -> Log:
    """Open an MCAP log and check it: checksums of sections, lengths of records, attachments and metadata.

    Raises:
        InputError: no such file, not an MCAP file, or a truncated or damaged one (the fix is `recover`).
    """
    path = Path(path)
    data = wire.mapped(path)
    try:
        return Log(path, data)
    except Damaged as error:
        raise wire.refusal(path, str(error), data) from error


# Recovery: intact records of a damaged MCAP file are found by their own checksums, at any offset.
#
# A chunk, attachment or metadata record is intact if its length, its inner lengths and its checksum agree; records
# without a checksum are not. The time is linear in the file's size: the cost of false starts is counted and limited.

VALUED = {Opcode.CHUNK: "chunk", Opcode.ATTACHMENT: "attachment", Opcode.METADATA: "metadata"}
_SIGNS = re.compile(
    rb"\x06(?=.{5}\x00{3}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4}))"
    rb"|\x09(?=.{5}\x00{3}.{18}\x00\x00)"
    rb"|\x0c(?=.{5}\x00{3}.{2}\x00\x00)",
    re.DOTALL,
)
"""Possible start of such a record: opcode, length below 2**40, known compression or a name below 2**16 bytes."""
_LEAST_WORK, _WORK = 2**30, 32
"""Limit of bytes in false starts: a constant, plus a multiple of the file's size."""


@dataclass(frozen=True)
class Piece:
    """Bytes `[start, end)` of the file: a chunk's unpacked records, another record, or a text for a lost part."""

    start: int
    end: int
    found: bytes | records.Attachment | records.Metadata | str


def pieces(data: memoryview) -> Iterator[Piece]:
    """All intact records after the header, in order, and the lost parts between them."""
    at, work = len(MAGIC), _LEAST_WORK + _WORK * len(data)
    for sign in _SIGNS.finditer(data, at):
        start = sign.start()
        if start < at:
            continue
        if work < 0:
            break
        opcode, length = HEAD.unpack_from(data, start)
        end = start + HEAD.size + length
        try:
            found = _intact(opcode, data[start + HEAD.size : end]) if end <= len(data) else None
        except Damaged as error:
            # Bound the cost of false starts, so that the time stays linear.
            work -= error.work
            continue
        if found is not None:
            yield from _lost(data, at, start)
            yield Piece(start, end, found)
            at = end
    yield from _lost(data, at, len(data))


def _intact(opcode: int, body: memoryview) -> bytes | records.Attachment | records.Metadata | None:
    """The content of a record; None if it has no checksum. Raises Damaged for a wrong checksum."""
    if opcode == Opcode.CHUNK:
        chunk = wire.parsed(records.Chunk, body)
        return wire.unpacked(chunk) if chunk.uncompressed_crc else None
    if opcode == Opcode.ATTACHMENT:
        return wire.attachment(body) if any(body[-4:]) else None
    record = wire.metadata(body)
    return record if wire.CHECK in record.metadata else None


def _lost(data: memoryview, at: int, end: int) -> Iterator[Piece]:
    """The lost part `[at, end)`, if any; records without content of their own are skipped."""
    # Message indexes follow from their chunk, so their loss loses nothing.
    while length := _idle(data[at:end]):
        at += length
    finished = data[at : at + HEAD.size] == HEAD.pack(Opcode.DATA_END, 4)  # then the data section is complete
    if not (finished and at + HEAD.size + 4 <= end) and (at < end or end == len(data)):
        word = "the end of the file" if end == len(data) else "unreadable bytes"
        yield Piece(at, end, VALUED.get(data[at], word) if at < end else word)


def _idle(data: memoryview) -> int:
    """Length of the header or message index at the start of `data`; 0 if there is none with consistent lengths."""
    with contextlib.suppress(Damaged):
        _, opcode, body = next(wire.records_in(data), (0, 0, data))
        if opcode == Opcode.MESSAGE_INDEX and len(body) == 6 + int.from_bytes(body[2:6], "little"):
            return HEAD.size + len(body)
        if opcode == Opcode.HEADER and wire.parsed(records.Header, body):
            return HEAD.size + len(body)
    return 0


# Recovery of a log: all intact records in a valid file, and a list of the lost parts.


@dataclass(frozen=True)
class Lost:
    """A lost part: its kind, and its bytes `[start, end)` in the damaged file."""

    what: str
    start: int
    end: int

    def __str__(self) -> str:
        if self.start == self.end:
            return f"{self.what}, from byte {self.start:,} on"
        return f"{self.what}, bytes {self.start:,} to {self.end:,}"


@dataclass
class Recovered:
    """The result of `recover`.

    Attributes:
        source, out: the damaged and the new file.
        chunks, messages: numbers saved.
        attachments, metadata: names of those saved, in the file's order.
        lost: known losses.
        lost_messages: number of lost messages; None if the summary, which has the total, is damaged too.
    """

    source: Path
    out: Path
    chunks: int = 0
    messages: int = 0
    attachments: list[str] = field(default_factory=list)
    metadata: list[str] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    lost_messages: int | None = None

    @property
    def complete(self) -> bool:
        """Whether the whole content of the file was saved."""
        return not self.lost and not self.lost_messages


def recover(path: str | Path, out: str | Path) -> Recovered:
    """Write all intact records of `path` to `out`, atomically; `path` is only read.

    Guarantee: all chunks, attachments and metadata records with a valid checksum are saved, and nothing else. Cost:
    linear in the file's (unpacked) size; memory of one chunk.

    Raises:
        UsageError: `out` is the damaged file.
        InputError: the file cannot be read, has no intact record, or `out` cannot be written.
    """
    path, out = Path(path), Path(out)
    data = wire.mapped(path)
    writer = LogWriter(out, ordered=False, suffix=".recovering", discard=True)
    if any(other.exists() and other.samefile(path) for other in (writer.path, writer.partial)):
        raise UsageError(
            f"{out} is the damaged file itself", expected="another file to write", fix=f"see {argument('out')}"
        )
    report = Recovered(path, out)
    with writer:
        _save(data, writer, report)
        if not (report.chunks or report.attachments or report.metadata):
            fix = wire.UNCHECKED if wire.unchecked(data) else ""
            raise InputError("holds nothing that can be saved", source=path, expected="an MCAP log", fix=fix)
        if not report.complete:
            writer.metadata(RECOVERED, {"reason": "recovered from a damaged log", "lost": str(len(report.lost))})
    return report


def _save(data: memoryview, writer: LogWriter, report: Recovered) -> None:
    """Write the intact records, and update the report."""
    summary = _summary(data)
    described = summary.described
    for number in sorted(described.channels):
        _channel(writer, described.channels[number], described)
    for piece in pieces(data):
        try:
            if isinstance(piece.found, records.Attachment):
                kept = piece.found
                writer.attach(kept.name, kept.media_type, kept.data, kept.log_time, kept.create_time)
                report.attachments.append(kept.name)
            elif isinstance(piece.found, records.Metadata):
                writer.metadata(piece.found.name, piece.found.metadata)
                report.metadata.append(piece.found.name)
            elif isinstance(piece.found, bytes):
                report.messages += _save_chunk(memoryview(piece.found), writer, described)
                report.chunks += 1
            else:
                report.lost.append(Lost(piece.found, piece.start, piece.end))
        except InputError:  # the copy cannot be written
            raise
        except ValueError as error:  # Damaged, or above a limit of logs
            report.lost.append(Lost(str(error), piece.start, piece.end))
    counts = summary.statistics
    if counts is not None:
        report.lost_messages = max(0, counts.message_count - report.messages)
        counted = (counts.message_count, counts.chunk_count, counts.attachment_count, counts.metadata_count)
        if counted == (report.messages, report.chunks, len(report.attachments), len(report.metadata)):
            report.lost = []  # unreadable bytes had no content


def _summary(data: memoryview) -> Summary:
    """The summary if its checksum is valid, else an empty one."""
    try:
        found = read_summary(data)
    except Damaged:
        found = None
    return found if found is not None and found.checked else Summary(len(data), False, None, Descriptions())


def _save_chunk(data: memoryview, writer: LogWriter, described: Descriptions) -> int:
    """Write the messages of a chunk and return their number. All are checked first: nothing is written on Damaged."""
    # A first pass checks all messages before any is written.
    count = sum(1 for _ in described.messages(wire.records_in(data)))
    for message in described.messages(wire.records_in(data)):
        channel = _channel(writer, message.channel, described)
        writer.write(channel, message.log_time, message.data, message.sequence, message.publish_time)
    writer.flush()
    return count


def _channel(writer: LogWriter, channel: records.Channel, described: Descriptions) -> int:
    """The id in the new file for a channel."""
    schema = described.schemas.get(channel.schema_id)
    name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
    return writer.channel(channel.topic, LogSchema(name, encoding, data, channel.message_encoding), channel.metadata)
