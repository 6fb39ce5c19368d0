"""A damaged or cut log made whole: everything that is intact, in a valid file, and a list of what is lost."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.container import RECOVERED, LogSchema, LogWriter
from analysis.recording.mcap.descriptions import MAX_DESCRIPTIONS, Descriptions
from analysis.recording.mcap.outline import Outline, read_outline
from analysis.recording.mcap.reading import MAX_EXTRAS, mapped
from analysis.recording.mcap.scan import Chunk, Extra, Gap, Loose, Scan
from analysis.recording.mcap.wire import Attached, Damaged
from planner.arguments import argument
from planner.errors import InputError, UsageError
from planner.shown import counted

_WORDS = {"": "bytes that make no sense", "end": "the end of the file, whatever stood there"}
_SLACK = 200
"""More than the bytes that writing a record anew can add to it, so that the log stays within what reading allows."""
MOST_LISTED = 1000
"""Losses beyond this many are counted, not listed."""


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
        unverified: names of saved metadata records that carry no checksum: well formed, perhaps altered.
        lost: what was not saved, as far as it can be told; at most MOST_LISTED.
        losses: how many such things there are.
        lost_messages: messages not saved; None when the summary, which tells their number, is damaged too.
    """

    source: Path
    out: Path
    chunks: int = 0
    messages: int = 0
    attachments: list[str] = field(default_factory=list)
    metadata: list[str] = field(default_factory=list)
    unverified: list[str] = field(default_factory=list)
    lost: list[Lost] = field(default_factory=list)
    losses: int = 0
    lost_messages: int | None = None

    @property
    def complete(self) -> bool:
        """Whether everything that the file held was saved."""
        return not self.lost and not self.lost_messages

    def lines(self) -> list[str]:
        """The report, a line each; names from the file are quoted."""
        saved = f"{counted(self.messages, 'message')} in {counted(self.chunks, 'chunk')}"
        others = counted(len(self.attachments), "attachment"), counted(len(self.metadata), "metadata record")
        found = [f"saved {saved}, {', '.join(others)}"]
        found += [f"saved without a checksum to vouch for it: metadata {name!r}" for name in self.unverified]
        found += [f"lost {lost}" for lost in self.lost]
        if self.losses > len(self.lost):
            found.append(f"lost {self.losses - len(self.lost):,} more")
        if self.lost_messages:
            found.append(f"lost {counted(self.lost_messages, 'message')} in all")
        if self.complete:
            found.append("nothing is lost")
        return [*found, f"written to {self.out}"]


def recover(path: str | Path, out: str | Path) -> Recovered:
    """Write everything that is intact in `path` to `out`, atomically; `path` itself is only read.

    Guarantee: every chunk, attachment and metadata record of our own logs whose checksum is right is saved, and nothing
    else. Cost: linear in the file's size (unpacked), memory of one chunk.

    Raises:
        UsageError: `out` is the damaged file itself.
        InputError: the file cannot be read, nothing in it can be saved, or `out` cannot be written.
    """
    path, out = Path(path), Path(out)
    data = mapped(path)
    writer = LogWriter(out, ordered=False, suffix=".recovering", discard=True)
    if any(other.exists() and other.samefile(path) for other in (writer.path, writer.partial)):
        raise UsageError(
            f"{out} is the damaged file itself", expected="another file to write", fix=f"see {argument('out')}"
        )
    outline = read_outline(data)
    report = Recovered(path, out)
    with writer:
        _Saver(writer, report, outline).save(data)
        if not (report.chunks or report.messages or report.attachments or report.metadata):
            raise InputError("holds nothing that can be saved", source=path, expected="an MCAP log")
        if not report.complete:
            writer.metadata(RECOVERED, {"reason": "recovered from a damaged log", "lost": str(report.losses)})
    return report


class _Saver:
    """Writes what a scan finds, and keeps the account."""

    def __init__(self, writer: LogWriter, report: Recovered, outline: Outline) -> None:
        self._writer, self._report, self._outline = writer, report, outline
        self._known = outline.described
        self._missing = dict(outline.entries)
        self._newest, self._held, self._metadata_bytes = 0, 0, _SLACK
        for number in sorted(self._known.channels):
            channel = self._known.channels[number]
            with contextlib.suppress(Damaged):
                self._channel(channel, self._known.schemas.get(channel.schema_id))

    def save(self, data: memoryview) -> None:
        outline = self._outline
        hints = {at: opcode for at, (opcode, _, _) in outline.entries.items()}
        for piece in Scan(data, hints, outline.end, outline.trusted, outline.ours).pieces():
            if isinstance(piece, Gap):
                if not outline.stands:
                    self._lose(Lost(_WORDS.get(piece.what, piece.what), piece.start, piece.end))
                continue
            try:
                if isinstance(piece, Extra):
                    self._extra(piece)
                elif isinstance(piece, Chunk):
                    self._messages(memoryview(piece.data), piece)
                    self._writer.flush()
                    self._report.chunks += 1
                else:
                    self._messages(data[piece.start : piece.end], piece)
            except Damaged as error:
                self._lose(Lost(str(error), piece.start, piece.end))
            self._missing.pop(piece.start, None)
        for at, (_, length, what) in sorted(self._missing.items()):
            self._lose(Lost(what, at, at + length))
        if outline.messages is not None:
            self._report.lost_messages = max(0, outline.messages - self._report.messages)

    def _messages(self, found: memoryview, piece: Chunk | Loose) -> None:
        """Write the messages of intact records; first all of these are looked at, so that Damaged comes before."""
        described, channels, orphans = Descriptions(self._known), {}, 0
        for _, opcode, body in wire.records_in(found):
            if opcode != Opcode.MESSAGE:
                described.add(opcode, body)
                continue
            message = wire.message_head(body)
            if len(body) > wire.MAX_CHUNK // 2:
                raise Damaged("a message that is too long to write")
            if message.channel_id not in channels:
                channels[message.channel_id] = self._channel_of(described, message)
            orphans += channels[message.channel_id] == 0
        self._known.merge(described)
        for _, opcode, body in wire.records_in(found):
            if opcode == Opcode.MESSAGE and channels[wire.message_head(body).channel_id]:
                message = wire.message(body)
                channel, times = channels[message.channel_id], (message.log_time, message.publish_time)
                self._writer.write(channel, times[0], message.data, message.sequence, times[1])
                self._report.messages += 1
        if orphans:
            self._lose(
                Lost(f"{counted(orphans, 'message')} of channels that nothing describes", piece.start, piece.end)
            )

    def _channel_of(self, described: Descriptions, message: records.Message) -> int:
        """The id to write a message under; 0 where nothing describes its channel."""
        try:
            found = described.resolve(message)
        except Damaged:
            return 0
        return self._channel(found.channel, found.schema)

    def _channel(self, channel: records.Channel, schema: records.Schema | None) -> int:
        name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        kind = LogSchema(name, encoding, data, channel.message_encoding)
        try:
            number = self._writer.channel(channel.topic, kind, channel.metadata)
        except ValueError as error:
            raise Damaged(str(error)) from error
        if number > self._newest:
            self._newest = number
            texts = (name, encoding, channel.topic, *channel.metadata, *channel.metadata.values())
            self._held += len(data) + sum(len(text.encode()) + 8 for text in texts) + _SLACK
            if self._held > MAX_DESCRIPTIONS:
                raise Damaged(f"more than {MAX_DESCRIPTIONS} bytes of schemas and channels")
        return number

    def _extra(self, piece: Extra) -> None:
        record, names = piece.record, self._report.metadata
        if isinstance(record, Attached):
            names = self._report.attachments
        else:
            self._metadata_bytes += piece.end - piece.start + _SLACK
        if len(names) >= MAX_EXTRAS - 1 or self._metadata_bytes > MAX_DESCRIPTIONS:
            raise Damaged("more attachments or metadata than a log may have")
        if isinstance(record, Attached):
            self._writer.attach(record.name, record.media_type, record.data, record.log_time, record.create_time)
            self._report.attachments.append(record.name)
            return
        self._writer.metadata(record.name, record.metadata)
        self._report.metadata.append(record.name)
        if not piece.checked:
            self._report.unverified.append(record.name)

    def _lose(self, lost: Lost) -> None:
        self._report.losses += 1
        if len(self._report.lost) < MOST_LISTED:
            self._report.lost.append(lost)
