"""A damaged or cut log made whole: everything that is intact, in a valid file, and a list of what is lost."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mcap import records

from analysis.recording.mcap.container import RECOVERED, LogSchema, LogWriter
from analysis.recording.mcap.reading import Summary, read_summary
from analysis.recording.mcap.scan import pieces
from planner import mcap as wire
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.mcap import Damaged, Descriptions


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
