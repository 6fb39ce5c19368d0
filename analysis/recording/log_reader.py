"""MCAP logs read with checks: a whole file or a clear error, in bounded memory, whatever the file claims."""

from __future__ import annotations

import contextlib
import re
import zlib
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.log_writer import PARTIAL, RECOVERED, LogSchema, LogWriter
from planner import mcap as wire
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.mcap import HEAD, MAGIC, MAX_DESCRIPTIONS, Damaged, Descriptions, LogMessage

MAX_EXTRAS = 10_000
"""Most attachments, and most metadata records, that a log may have."""


@dataclass(frozen=True)
class Summary:
    """The end of a log: where it begins, whether it has a checksum, the counts, schemas and channels."""

    start: int
    checked: bool
    statistics: records.Statistics | None
    described: Descriptions


def read_summary(data: memoryview) -> Summary:
    """The summary of a whole file, its checksum looked at. Raises Damaged."""
    end, size = data[-wire.FOOTER_SIZE :], len(data)
    if len(end) < wire.FOOTER_SIZE or end[-len(wire.MAGIC) :] != wire.MAGIC:
        raise Damaged("the end is missing")
    if wire.HEAD.unpack_from(end) != (Opcode.FOOTER, 20):
        raise Damaged("the footer is not where it should be")
    footer = wire.parsed(records.Footer, end[wire.HEAD.size : -len(wire.MAGIC)])
    start = footer.summary_start or size - wire.FOOTER_SIZE
    if not len(wire.MAGIC) <= start <= size - wire.FOOTER_SIZE:
        raise Damaged("the footer points outside the file")
    if footer.summary_crc not in (0, zlib.crc32(data[start : size - wire.AFTER_SUMMARY_CRC])):
        raise Damaged("the summary has a wrong checksum")
    statistics, described = None, Descriptions()
    for _, opcode, body in wire.records_in(data[start : size - wire.FOOTER_SIZE]):
        described.add(opcode, body)
        if opcode == Opcode.STATISTICS:
            statistics = wire.parsed(records.Statistics, body)
    return Summary(start, footer.summary_crc != 0, statistics, described)


class Log:
    """An open log, checked from end to end but for the insides of its chunks, which are checked as they are read.

    Attributes:
        path: the file.
        library: what wrote it.
        channels, schemas: by id, as the summary lists them.
        attachments: in the file's order.
        metadata: (name, items) in the file's order, without checksums.
        partial: why it is not the whole log ("" when it is).
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
        """The first attachment of that name. Raises InputError when there is none."""
        for attached in self.attachments:
            if attached.name == name:
                return attached.data
        raise InputError(f"has no attachment {name!r}", source=self.path)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """The messages in the order of their log times, and of the file where these are equal.

        `topics`: only these; None for all. Raises InputError at the first chunk that is damaged.
        """
        try:
            section = self._data[len(wire.MAGIC) : self._data_end]
            for message in self._described.copy().messages(wire.by_log_time(section)):
                if topics is None or message.topic in topics:
                    yield message
        except Damaged as error:
            raise wire.refusal(self.path, str(error), self._data) from error

    def _read_data_section(self) -> None:
        """Every record's length, attachments and metadata, and the checksum of all of it."""
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
    """Open an MCAP log and check it: sections' checksums, every record's length, attachments and metadata.

    Raises:
        InputError: no such file, not an MCAP file, or one that is truncated or damaged (then it names `recover`).
    """
    path = Path(path)
    data = wire.mapped(path)
    try:
        return Log(path, data)
    except Damaged as error:
        raise wire.refusal(path, str(error), data) from error


# What is intact in a damaged MCAP file: records found by their own checksums, wherever they stand.
#
# A chunk, an attachment or a metadata record counts when its length, the lengths in it and its checksum all agree; one
# without a checksum does not. The time is linear in the file's size: what a false start costs is counted, and limited.

VALUED = {Opcode.CHUNK: "chunk", Opcode.ATTACHMENT: "attachment", Opcode.METADATA: "metadata"}
_SIGNS = re.compile(
    rb"\x06(?=.{5}\x00{3}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4}))"
    rb"|\x09(?=.{5}\x00{3}.{18}\x00\x00)"
    rb"|\x0c(?=.{5}\x00{3}.{2}\x00\x00)",
    re.DOTALL,
)
"""Where such a record may begin: its opcode, a length below 2**40, a known compression or a name below 2**16 bytes."""
_LEAST_WORK, _WORK = 2**30, 32
"""Bytes of false starts that are gone through, and more of them for each byte of the file."""


@dataclass(frozen=True)
class Piece:
    """Bytes `[start, end)` of the file: a chunk's unpacked records, another record, or a word for what is lost."""

    start: int
    end: int
    found: bytes | records.Attachment | records.Metadata | str


def pieces(data: memoryview) -> Iterator[Piece]:
    """All that is intact from the header on, in order, and between it what is lost."""
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
            work -= error.work
            continue
        if found is not None:
            yield from _lost(data, at, start)
            yield Piece(start, end, found)
            at = end
    yield from _lost(data, at, len(data))


def _intact(opcode: int, body: memoryview) -> bytes | records.Attachment | records.Metadata | None:
    """What a record holds; None where no checksum vouches for it. Raises Damaged where that is wrong."""
    if opcode == Opcode.CHUNK:
        chunk = wire.parsed(records.Chunk, body)
        return wire.unpacked(chunk) if chunk.uncompressed_crc else None
    if opcode == Opcode.ATTACHMENT:
        return wire.attachment(body) if any(body[-4:]) else None
    record = wire.metadata(body)
    return record if wire.CHECK in record.metadata else None


def _lost(data: memoryview, at: int, end: int) -> Iterator[Piece]:
    """What stood in `[at, end)`, where nothing is intact; nothing if it is records that hold nothing of their own."""
    while length := _idle(data[at:end]):
        at += length
    finished = data[at : at + HEAD.size] == HEAD.pack(Opcode.DATA_END, 4)  # then the data section is all there
    if not (finished and at + HEAD.size + 4 <= end) and (at < end or end == len(data)):
        word = "the end of the file, whatever stood there" if end == len(data) else "bytes that make no sense"
        yield Piece(at, end, VALUED.get(data[at], word) if at < end else word)


def _idle(data: memoryview) -> int:
    """How long the header or message index at the start of `data` is; 0 if there is none whose lengths agree."""
    with contextlib.suppress(Damaged):
        _, opcode, body = next(wire.records_in(data), (0, 0, data))
        if opcode == Opcode.MESSAGE_INDEX and len(body) == 6 + int.from_bytes(body[2:6], "little"):
            return HEAD.size + len(body)
        if opcode == Opcode.HEADER and wire.parsed(records.Header, body):
            return HEAD.size + len(body)
    return 0


# A damaged or cut log made whole: everything that is intact, in a valid file, and a list of what is lost.


@dataclass(frozen=True)
class Lost:
    """Something that could not be saved: what it was, and the bytes `[start, end)` of the damaged file it stood in."""

    what: str
    start: int
    end: int

    def __str__(self) -> str:
        if self.start == self.end:
            return f"{self.what}, from byte {self.start:,} on"
        return f"{self.what}, bytes {self.start:,} to {self.end:,}"


@dataclass
class Recovered:
    """What `recover` saved and lost.

    Attributes:
        source, out: the damaged file and the one that was written.
        chunks, messages: how many were saved.
        attachments, metadata: names of those that were saved, in the file's order.
        lost: what was not saved, as far as it can be told.
        lost_messages: messages not saved; None when the summary, which tells their number, is damaged too.
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
        """Whether everything that the file held was saved."""
        return not self.lost and not self.lost_messages


def recover(path: str | Path, out: str | Path) -> Recovered:
    """Write everything that is intact in `path` to `out`, atomically; `path` itself is only read.

    Guarantee: every chunk, attachment and metadata record that is as it was written, by its checksum, is saved, and
    nothing else. Cost: linear in the file's size (unpacked), memory of one chunk.

    Raises:
        UsageError: `out` is the damaged file itself.
        InputError: the file cannot be read, nothing in it can be saved, or `out` cannot be written.
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
    """Write what is intact, and keep the account."""
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
        except ValueError as error:  # Damaged, or more than a log may have
            report.lost.append(Lost(str(error), piece.start, piece.end))
    counts = summary.statistics
    if counts is not None:
        report.lost_messages = max(0, counts.message_count - report.messages)
        told = (counts.message_count, counts.chunk_count, counts.attachment_count, counts.metadata_count)
        if told == (report.messages, report.chunks, len(report.attachments), len(report.metadata)):
            report.lost = []  # what makes no sense held nothing


def _summary(data: memoryview) -> Summary:
    """The summary, if a checksum vouches for it; else an empty one."""
    try:
        found = read_summary(data)
    except Damaged:
        found = None
    return found if found is not None and found.checked else Summary(len(data), False, None, Descriptions())


def _save_chunk(data: memoryview, writer: LogWriter, described: Descriptions) -> int:
    """Write the messages of a chunk; returns how many. Before that all are looked at, and nothing is on Damaged."""
    count = sum(1 for _ in described.messages(wire.records_in(data)))
    for message in described.messages(wire.records_in(data)):
        channel = _channel(writer, message.channel, described)
        writer.write(channel, message.log_time, message.data, message.sequence, message.publish_time)
    writer.flush()
    return count


def _channel(writer: LogWriter, channel: records.Channel, described: Descriptions) -> int:
    """The id to write a channel's messages under."""
    schema = described.schemas.get(channel.schema_id)
    name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
    return writer.channel(channel.topic, LogSchema(name, encoding, data, channel.message_encoding), channel.metadata)
