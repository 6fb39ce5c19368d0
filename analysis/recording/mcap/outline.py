"""What the end of a damaged log still tells about the rest: where records begin, how many messages there were."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.container import LIBRARY
from analysis.recording.mcap.descriptions import Descriptions
from analysis.recording.mcap.wire import HEAD, MAGIC, Cursor, Damaged

_DATA_END_SIZE = HEAD.size + 4


@dataclass
class Outline:
    """The summary of a log, as far as its checksum is right.

    Attributes:
        end: where the data section ends; the file's end where the summary does not stand.
        ours: whether the header says that we wrote it.
        stands: whether the summary stands and lists every chunk, attachment and metadata record.
        trusted: whether the data section's checksum is right.
        entries: offset -> (opcode, length, what it is) of those records; empty unless `stands`.
        messages: how many there were, None when unknown.
        described: the schemas and channels.
    """

    end: int
    ours: bool
    stands: bool = False
    trusted: bool = False
    entries: dict[int, tuple[int, int, str]] = field(default_factory=dict)
    messages: int | None = None
    described: Descriptions = field(default_factory=Descriptions)


def read_outline(data: memoryview) -> Outline:
    """The outline of a whole file that may be damaged anywhere; what its checksum does not vouch for is left out."""
    header = RecordBuilder()
    records.Header("", LIBRARY).write(header)
    head = header.end()
    outline = Outline(len(data), bytes(data[len(MAGIC) : len(MAGIC) + len(head)]) == head)
    try:
        start = _summary_start(data)
        found = Outline(_data_end(data, start), outline.ours, trusted=_is_trusted(data, start))
        _read_summary(data[start : len(data) - wire.FOOTER_SIZE], found)
    except Damaged:
        return outline
    return found


def _summary_start(data: memoryview) -> int:
    """Where a summary with the right checksum begins, by the footer; the closing magic is not asked for."""
    at = len(data) - wire.FOOTER_SIZE
    if at < len(MAGIC):
        raise Damaged("the end is missing")
    cursor = Cursor(data[at + HEAD.size :])
    start, _, checksum = cursor.number(8), cursor.number(8), cursor.number(4)
    if not len(MAGIC) <= start <= at:
        raise Damaged("the footer points outside the file")
    if checksum == 0 or zlib.crc32(data[start : len(data) - wire.AFTER_SUMMARY_CRC]) != checksum:
        raise Damaged("the summary has no right checksum")
    return start


def _data_end(data: memoryview, start: int) -> int:
    """Where the data section ends: at the summary if it closes there, else nobody knows."""
    at = start - _DATA_END_SIZE
    return start if at >= len(MAGIC) and HEAD.unpack_from(data, at) == (Opcode.DATA_END, 4) else len(data)


def _is_trusted(data: memoryview, end: int) -> bool:
    at = end - _DATA_END_SIZE
    if _data_end(data, end) != end:
        return False
    checksum = int.from_bytes(data[at + HEAD.size : end], "little")
    return checksum != 0 and zlib.crc32(data[:at]) == checksum


def _read_summary(summary: memoryview, outline: Outline) -> None:
    statistics = None
    for _, opcode, body in wire.records_in(summary):
        outline.described.add(opcode, body)
        cursor = Cursor(body)
        if opcode == Opcode.STATISTICS:
            statistics = wire.statistics(body)
            outline.messages = statistics.message_count
        elif opcode == Opcode.CHUNK_INDEX:
            first, last, at, length = (cursor.number(8) for _ in range(4))
            outline.entries[at] = (Opcode.CHUNK, length, f"chunk (log time {first / 1e9:g} to {last / 1e9:g} s)")
        elif opcode == Opcode.ATTACHMENT_INDEX:
            at, length = cursor.number(8), cursor.number(8)
            cursor.take(24)
            outline.entries[at] = (Opcode.ATTACHMENT, length, f"attachment {cursor.text()!r}")
        elif opcode == Opcode.METADATA_INDEX:
            at, length = cursor.number(8), cursor.number(8)
            outline.entries[at] = (Opcode.METADATA, length, f"metadata {cursor.text()!r}")
    told = statistics and (statistics.chunk_count + statistics.attachment_count + statistics.metadata_count)
    inside = all(len(MAGIC) <= at < outline.end for at in outline.entries)
    outline.stands = told == len(outline.entries) and inside
    if not outline.stands:
        outline.entries = {}
