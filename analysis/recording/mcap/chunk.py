"""The chunk in progress of a log: messages, and before them whatever describes them, so that it can be read alone."""

from __future__ import annotations

import zlib
from dataclasses import dataclass, field

import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder


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
