"""MCAP logs by the `mcap` library: a crash-safe writer, a reader that checks every byte, and recovery."""

from __future__ import annotations

import io
import mmap
import os
import re
import signal
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NamedTuple

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import FOOTER_SIZE, NonSeekingReader, SeekingReader
from mcap.records import Attachment, Channel, Chunk, DataEnd, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.summary import Summary
from mcap.writer import ChunkBuilder, Writer

from analysis.recording.names import GROWING, how_to_clear, interrupted_name, left_over
from analysis.utils.progress import ENDING
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.files import MAGIC, damage_reported, mapped
from planner.json_objects import WithKeys

# Writer: the file survives a crash, and its bytes depend only on its content.
#
# Every chunk is self-contained: it repeats the schemas and channels of its messages, so that a chunk with a valid
# checksum can be read whatever was lost around it. All bytes are under a checksum: chunks and attachments have one
# each, metadata has one among its items, and so have the data and summary sections.

LIBRARY = "mrac-jax"
CHUNK_SIZE = 2**22
"""Bytes before compression at which a chunk is closed: a crash loses at most one chunk, some 200 steps. Larger chunks
compress repeated grids better."""
CHECK = "crc32"
"""Item with the checksum of our metadata records (MCAP has none for them)."""
PARTIAL, RECOVERED = "mrac/partial", "mrac/recovered"
"""Names of the metadata records of an interrupted log, and of one that `recover` wrote."""
INTERRUPTED = "interrupted"
"""Reason of a log that Ctrl-C interrupted."""


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


class SelfContainedChunks(ChunkBuilder):
    """Builds chunks that repeat the schemas and channels of their messages; the library writes each of them once."""

    def __init__(self) -> None:
        super().__init__()
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}

    def add_schema(self, schema: Schema) -> None:
        """Keep a schema for the chunks that need it."""
        self.schemas[schema.id] = schema

    def add_channel(self, channel: Channel) -> None:
        """Keep a channel for the chunks that need it."""
        self.channels[channel.id] = channel

    def add_message(self, message: Message) -> None:
        """Add a message, after its channel and schema if it is the chunk's first one of them."""
        if message.channel_id not in self.message_indices:
            channel = self.channels[message.channel_id]
            described = {self.channels[other].schema_id for other in self.message_indices}
            if channel.schema_id not in {0, *described}:
                super().add_schema(self.schemas[channel.schema_id])
            super().add_channel(channel)
        super().add_message(message)


class LogWriter:
    """Writes a log, as a context manager: `with LogWriter(path) as log: ...`.

    The file grows as `NAME.partial` next to the target and replaces it atomically at the end of the block. If the block
    raises (also Ctrl-C), the log is closed too: valid, with all messages so far, and marked by a metadata record
    `mrac/partial` {"reason"}; if the target exists, it is kept and the log becomes `NAME.interrupted.mcap`. A killed
    process leaves `NAME.partial`, complete up to the last closed chunk, for `recover`.

    Args:
        path: the target; an existing file is replaced at the end, but never by an interrupted log.
        chunk_size: bytes of messages in a chunk.
        suffix: of the growing file.
        discard: whether a block that raises leaves no file; can be changed meanwhile.

    Attributes:
        placed: the name of the finished log; None before.

    Raises:
        UsageError: on entry, if `NAME.partial` exists: from an earlier run, or of another process.
        InputError: the target cannot be written, on entry and on every write.
    """

    def __init__(
        self, path: str | Path, *, chunk_size: int = CHUNK_SIZE, suffix: str = GROWING, discard: bool = False
    ) -> None:
        self.path = Path(path)
        self.partial = self.path.with_name(self.path.name + suffix)
        self.discard = discard
        self.placed: Path | None = None
        self._chunk_size = chunk_size
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {("", "", b""): 0}
        self._counts: Counter[int] = Counter()
        self._busy = self._broken = False
        self._held: int | None = None  # the signal that arrived during a write
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> LogWriter:
        if self.path.is_dir():
            raise InputError("is a folder", source=self.path, expected="the name of a file to write")
        try:
            self._stream = self.partial.open("xb")
        except FileExistsError:
            raise left_over(self.partial) from None
        except OSError as error:
            raise self._refused(error) from error
        self._writer = Writer(self._stream, chunk_size=self._chunk_size, enable_data_crcs=True)
        # The library has no public option for this; the attribute is the same from its release 1.2 on.
        self._writer._Writer__chunk_builder = SelfContainedChunks()
        with self._writing():
            self._writer.start(library=LIBRARY)
        ours = threading.current_thread() is threading.main_thread()
        held = [one for one in ENDING if ours and callable(signal.getsignal(one))]
        self._handlers = {one: signal.signal(one, self._interrupted) for one in held}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._busy, unfinished = True, error  # interrupts wait until the file has its name
        try:
            with self._writing():
                if kind is None:
                    self._finish(self.path)
                elif self.discard:
                    self.partial.unlink(missing_ok=True)
                elif not self._broken:
                    reason = f"{kind.__name__}: {error}".rstrip(": ")
                    self.metadata(PARTIAL, {"reason": INTERRUPTED if kind is KeyboardInterrupt else reason})
                    self._finish(interrupted_name(self.path) if self.path.exists() else self.path)
        except InputError as failed:
            unfinished = error or failed
        finally:
            with suppress(OSError):
                self._stream.close()
            for number, handler in self._handlers.items():
                signal.signal(number, handler)
        self._pass_on()
        left = self.partial.exists()
        if isinstance(unfinished, InputError) and self.placed is None and (left or kind is None):
            fix = f"{self.partial} holds the data written so far: {how_to_clear(self.partial)}" if left else ""
            raise InputError(
                unfinished.problem, source=unfinished.source, expected=unfinished.expected, fix=fix
            ) from unfinished

    def channel(self, topic: str, schema: LogSchema, metadata: Mapping[str, str] | None = None) -> int:
        """The id of a channel; equal arguments give the same id. Nothing is written until its first message."""
        items, known = dict(metadata or {}), (schema.name, schema.encoding, schema.data)
        key = (topic, schema, *sorted(items.items()))
        if key not in self._channels:
            if known not in self._schemas:
                self._schemas[known] = self._writer.register_schema(*known)
            self._channels[key] = self._writer.register_channel(
                topic, schema.message_encoding, self._schemas[known], items
            )
        return self._channels[key]

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
        # By default consumers can detect gaps.
        number = self._counts[channel] if sequence is None else sequence
        with self._writing():
            self._writer.add_message(
                channel, log_time, data, log_time if publish_time is None else publish_time, number
            )
            self._counts[channel] += 1

    def attach(self, name: str, media_type: str, data: bytes, log_time: int = 0, create_time: int = 0) -> None:
        """Write an attachment at once. The name is only a label, never a path to write to."""
        with self._writing():
            self._writer.add_attachment(create_time, log_time, name, media_type, data)

    def metadata(self, name: str, items: Mapping[str, str]) -> None:
        """Write a metadata record at once, with its checksum as an additional item."""
        with self._writing():
            self._writer.add_metadata(name, {**items, CHECK: check_of(name, items)})

    def _finish(self, target: Path) -> None:
        """Write the last chunk, the summary and the footer, and rename the file."""
        self._writer.finish()
        self._stream.flush()
        # Data must be on disk before the rename makes them the target.
        os.fsync(self._stream.fileno())
        self._stream.close()
        self.partial.replace(target)
        self.placed = target

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """Context of every write: interrupts wait for its end, and errors of the system name the target."""
        outer, self._busy = self._busy, True
        try:
            yield
            if not self._stream.closed:
                self._stream.flush()
        except BaseException as error:
            self._broken = True  # the writer's state is unknown: NAME.partial stays as it is
            if isinstance(error, OSError):
                raise self._refused(error) from error
            raise
        finally:
            self._busy = outer
        if not outer:
            self._pass_on()

    def _interrupted(self, number: int, frame: FrameType | None) -> None:
        if self._busy:
            self._held = number
        else:
            self._handlers[number](number, frame)

    def _pass_on(self) -> None:
        """Handle the signal that arrived during a write."""
        if self._held is not None:
            number, self._held = self._held, None
            self._handlers[number](number, None)

    def _refused(self, error: OSError) -> InputError:
        return InputError(f"cannot be written ({error.strerror})", source=self.path)


def check_of(name: str, items: Mapping[str, str]) -> str:
    """Checksum of a metadata record: CRC-32 of its bytes without the checksum, as eight hexadecimal digits."""
    return f"{zlib.crc32(bytes_of(Metadata(name, {key: value for key, value in items.items() if key != CHECK}))):08x}"


def bytes_of(record: McapRecord) -> bytes:
    """Bytes of a complete record."""
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


# Reader: a complete file or a clear error.


class LogMessage(NamedTuple):
    """One message: times in nanoseconds, `data` as encoded by its channel's schema (None: no schema)."""

    channel: Channel
    schema: Schema | None
    log_time: int
    publish_time: int
    sequence: int
    data: bytes

    @property
    def topic(self) -> str:
        """The topic of its channel."""
        return str(self.channel.topic)


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

    def __init__(self, path: Path) -> None:
        self.path, data = path, mapped(path)
        with damage_reported(path):
            start, _ = check_summary(data)
            check_data(data, start)
            reader = SeekingReader(data)
            summary = reader.get_summary() or Summary()
            self.channels, self.schemas = summary.channels, summary.schemas
            self.library = str(reader.get_header().library)
            self.attachments: list[Attachment] = [*reader.iter_attachments()]
            self.metadata = [
                (one.name, {key: value for key, value in one.metadata.items() if key != CHECK})
                for one in reader.iter_metadata()
            ]
        reasons = [items.get("reason", "cut short") for name, items in self.metadata if name in (PARTIAL, RECOVERED)]
        self.partial = "; ".join(reasons)

    def attachment(self, name: str) -> bytes:
        """The first attachment of that name. Raises InputError if there is none."""
        for attached in self.attachments:
            if attached.name == name:
                return bytes(attached.data)
        raise InputError(f"has no attachment {name!r}", source=self.path)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """The messages in the file's order, which is that of log times, in the memory of one chunk.

        `topics`: only these; None for all. Raises InputError at the first damaged chunk.
        """
        # A reader with a position of its own, so that two readings of one log do not disturb each other.
        reader = NonSeekingReader(mapped(self.path), validate_crcs=True)
        with damage_reported(self.path):
            for schema, channel, one in reader.iter_messages(topics, log_time_order=False):
                yield LogMessage(channel, schema, one.log_time, one.publish_time, one.sequence, one.data)


def open_log(path: str | Path) -> Log:
    """Open an MCAP log and check it: checksums of sections, lengths of records, attachments and metadata.

    Raises:
        InputError: no such file, not an MCAP file, or a truncated or damaged one (the fix is `recover`).
    """
    return Log(Path(path))


END = FOOTER_SIZE + len(MAGIC)
"""Bytes of the footer record and the closing magic."""


def check_summary(data: mmap.mmap) -> tuple[int, bool]:
    """(offset of the summary section, whether it has a checksum). Raises ValueError if the checksum is wrong."""
    opcode, length, start, _, checksum, magic = struct.unpack("<BQQQI8s", data[-END:])
    start = start or len(data) - END  # without a summary
    if magic != MAGIC or (opcode, length) != (Opcode.FOOTER, 20) or start > len(data) - END:
        raise ValueError("the end is missing")
    # A checksum of 0 means "not computed" in MCAP.
    if checksum not in (0, zlib.crc32(data[start : -len(MAGIC) - 4])):
        raise ValueError("the summary has a wrong checksum")
    return start, checksum != 0


def check_data(data: mmap.mmap, end: int) -> None:
    """Raise ValueError unless the data section ends at offset `end`, with a valid checksum."""
    at = end - len(bytes_of(DataEnd(0)))
    opcode, length, checksum = struct.unpack_from("<BQI", data, at)
    if (opcode, length) != (Opcode.DATA_END, 4):
        raise ValueError("its data section has no end")
    if checksum not in (0, zlib.crc32(memoryview(data)[:at])):
        raise ValueError("its data have a wrong checksum")


# Recovery: intact records of a damaged MCAP file are found by their own checksums, at any offset.
#
# A record is intact if the library writes the same bytes for it, and its checksum agrees: that of a chunk covers its
# messages, an attachment's all of it; metadata records have ours. The time is linear in the file's size: the cost of
# false starts is counted and limited.

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
class Recovered(WithKeys):
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
    json_keys = "source out chunks messages attachments metadata lost lost_messages losses complete"

    @property
    def losses(self) -> int:
        """Number of lost parts."""
        return len(self.lost)

    @property
    def complete(self) -> bool:
        """Whether the whole content of the file was saved."""
        return not self.lost and not self.lost_messages


class Piece(NamedTuple):
    """An intact record, bytes `[start, end)` of the file; a chunk also as the records in it."""

    start: int
    end: int
    record: McapRecord
    inside: list[McapRecord]


def pieces(data: mmap.mmap) -> Iterator[Piece | Lost]:
    """All intact records after the magic, in order, and the lost parts between them."""
    at, work = len(MAGIC), _LEAST_WORK + _WORK * len(data)
    while at < len(data):
        found, end = piece_at(data, at), len(data)
        if found is None:
            for sign in _SIGNS.finditer(data, at + 1):
                if work < 0 or (found := piece_at(data, sign.start())):
                    break
                # Bound the cost of false starts, so that the time stays linear.
                work -= end_of(data, sign.start()) - sign.start()
            end = found.start if found else len(data)
            yield Lost(VALUED.get(data[at], "unreadable bytes" if found else "the end of the file"), at, end)
            if found is None:
                return
        if isinstance(found.record, DataEnd):  # what follows has no content of its own
            return
        yield found
        at = found.end
    yield Lost("the end of the file", at, at)


def end_of(data: mmap.mmap, start: int) -> int:
    """The end of the record that starts at an offset, by its length; `start` if the file ends before."""
    end = start + 9 + int.from_bytes(data[start + 1 : start + 9], "little")
    return end if end <= len(data) else start


def piece_at(data: mmap.mmap, start: int) -> Piece | None:
    """The intact record that starts at an offset, if there is one."""
    # Invalid bytes make the library and the decompressors raise errors of many kinds.
    with suppress(Exception):
        end = end_of(data, start)
        body, inside = data[start:end], []
        record = next(StreamReader(io.BytesIO(body), skip_magic=True, emit_chunks=True).records)
        if isinstance(record, Chunk):
            inside = breakup_chunk(record, validate_crc=True)
        elif isinstance(record, Metadata) and record.metadata[CHECK] != check_of(record.name, record.metadata):
            return None
        if bytes_of(record) == body:
            return Piece(start, end, record, inside)
    return None


def recover(path: str | Path, out: str | Path) -> Recovered:
    """Write all intact records of `path` to `out`, atomically; `path` is only read.

    Guarantee: all chunks, attachments and metadata records with a valid checksum are saved, and chunks without a
    checksum whose records are complete. Cost: linear in the file's (unpacked) size; memory of one chunk.

    Raises:
        UsageError: `out` is the damaged file.
        InputError: the file cannot be read, has no intact record, or `out` cannot be written.
    """
    path, out = Path(path), Path(out)
    data = mapped(path, magic=False)
    writer = LogWriter(out, suffix=".recovering", discard=True)
    if any(other.exists() and other.samefile(path) for other in (writer.path, writer.partial)):
        raise UsageError(
            f"{out} is the damaged file itself", expected="another file to write", fix=f"see {argument('out')}"
        )
    report = Recovered(path, out)
    with writer:
        _save(data, writer, report)
        if not (report.chunks or report.attachments or report.metadata):
            raise InputError("holds nothing that can be saved", source=path, expected="an MCAP log")
        if not report.complete:
            writer.metadata(RECOVERED, {"reason": "recovered from a damaged log", "lost": str(len(report.lost))})
    return report


def _save(data: mmap.mmap, writer: LogWriter, report: Recovered) -> None:
    """Write the intact records, and update the report."""
    summary = Summary()
    with suppress(Exception):  # as in `piece_at`
        if check_summary(data)[1]:  # else it may be damaged
            summary = SeekingReader(data).get_summary() or summary
    for piece in pieces(data):
        if isinstance(piece, Lost):
            report.lost.append(piece)
        elif isinstance(kept := piece.record, Attachment):
            writer.attach(kept.name, kept.media_type, kept.data, kept.log_time, kept.create_time)
            report.attachments.append(kept.name)
        elif isinstance(kept, Metadata):
            writer.metadata(kept.name, kept.metadata)
            report.metadata.append(kept.name)
        elif isinstance(kept, Chunk):
            _save_chunk(piece, writer, summary, report)
    counts = summary.statistics
    if counts is not None:
        report.lost_messages = max(0, counts.message_count - report.messages)
        counted = (counts.message_count, counts.chunk_count, counts.attachment_count, counts.metadata_count)
        if counted == (report.messages, report.chunks, len(report.attachments), len(report.metadata)):
            report.lost = []  # unreadable bytes had no content


def _save_chunk(piece: Piece, writer: LogWriter, described: Summary, report: Recovered) -> None:
    """Write the messages of a chunk, and add its descriptions to those known."""
    described.schemas |= {one.id: one for one in piece.inside if isinstance(one, Schema)}
    described.channels |= {one.id: one for one in piece.inside if isinstance(one, Channel)}
    messages = [one for one in piece.inside if isinstance(one, Message)]
    # Check all messages before any is written.
    for number in sorted({one.channel_id for one in messages}):
        channel = described.channels.get(number)
        if channel is None or channel.schema_id not in {0, *described.schemas}:
            report.lost.append(Lost(f"chunk with channel {number}, which is not described", piece.start, piece.end))
            return
    for one in messages:
        channel = described.channels[one.channel_id]
        schema = described.schemas.get(channel.schema_id, Schema(0, b"", "", ""))
        kind = LogSchema(schema.name, schema.encoding, schema.data, channel.message_encoding)
        number = writer.channel(channel.topic, kind, channel.metadata)
        writer.write(number, one.log_time, one.data, one.sequence, one.publish_time)
    report.chunks += 1
    report.messages += len(messages)
