"""The end of an MCAP log: summary section, footer and closing magic."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from planner.mcap import MAGIC

_OPCODES = {
    records.Schema: Opcode.SCHEMA,
    records.Channel: Opcode.CHANNEL,
    records.Statistics: Opcode.STATISTICS,
    records.ChunkIndex: Opcode.CHUNK_INDEX,
    records.AttachmentIndex: Opcode.ATTACHMENT_INDEX,
    records.MetadataIndex: Opcode.METADATA_INDEX,
}
"""The groups of a summary, in their order."""


@dataclass(frozen=True)
class Index:
    """An entry of the summary about a record of the data section; for a chunk, its number of messages by channel."""

    record: records.McapRecord
    counts: Mapping[int, int] = field(default_factory=dict)


def closing(
    start: int, schemas: Sequence[records.Schema], channels: Sequence[records.Channel], indexes: Sequence[Index]
) -> bytes:
    """Everything after the data section, which ends at offset `start` of the file."""
    told = [*schemas, *channels, statistics(len(schemas), len(channels), indexes), *(one.record for one in indexes)]
    summary, spans = RecordBuilder(), []
    for kind, opcode in _OPCODES.items():
        group_start = summary.count
        for record in told:
            if isinstance(record, kind):
                record.write(summary)
        if summary.count > group_start:
            spans.append(records.SummaryOffset(opcode, start + group_start, summary.count - group_start))
    offsets_at = start + summary.count
    for span in spans:
        span.write(summary)
    data = summary.end()
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offsets_at)
    footer = RecordBuilder()
    records.Footer(start, offsets_at, zlib.crc32(head, zlib.crc32(data))).write(footer)
    return data + footer.end() + MAGIC


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
