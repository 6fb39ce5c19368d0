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

from analysis.recording.mcap.wire import MAGIC


@dataclass(frozen=True)
class Index:
    """An entry of the summary about a record of the data section; for a chunk, its number of messages by channel."""

    opcode: Opcode
    record: records.McapRecord
    counts: Mapping[int, int] = field(default_factory=dict)


def closing(
    start: int,
    schemas: Mapping[int, records.Schema],
    channels: Mapping[int, records.Channel],
    indexes: Sequence[Index],
) -> bytes:
    """Everything after the data section, which ends at offset `start` of the file."""
    groups: dict[Opcode, list[records.McapRecord]] = {
        Opcode.SCHEMA: [*schemas.values()],
        Opcode.CHANNEL: [*channels.values()],
        Opcode.STATISTICS: [statistics(len(schemas), len(channels), indexes)],
    }
    for opcode in (Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX, Opcode.METADATA_INDEX):
        groups[opcode] = [index.record for index in indexes if index.opcode == opcode]
    summary, spans = RecordBuilder(), []
    for opcode, group in groups.items():
        group_start = summary.count
        for record in group:
            record.write(summary)
        if group:
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
    kinds = Counter(index.opcode for index in indexes)
    counts: Counter[int] = Counter()
    for index in indexes:
        counts.update(index.counts)
    return records.Statistics(
        attachment_count=kinds[Opcode.ATTACHMENT_INDEX],
        channel_count=channels,
        channel_message_counts=dict(sorted(counts.items())),
        chunk_count=len(chunks),
        message_count=counts.total(),
        message_end_time=max((chunk.message_end_time for chunk in chunks), default=0),
        message_start_time=min((chunk.message_start_time for chunk in chunks), default=0),
        metadata_count=kinds[Opcode.METADATA_INDEX],
        schema_count=schemas,
    )
