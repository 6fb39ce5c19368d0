"""The end of an MCAP log: summary section, footer and closing magic."""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby

from mcap import records
from mcap.opcode import Opcode

from planner.mcap import MAGIC, bytes_of


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
