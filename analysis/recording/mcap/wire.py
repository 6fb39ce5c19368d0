"""The bytes of MCAP records, read without trust: a length is never believed beyond what is there.

Everything here raises `Damaged` and nothing else on bytes that are not what they should be.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from analysis.recording.mcap.unpack import MAX_CHUNK, Damaged, unpack

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""What every record begins with: opcode and length of the rest."""
AFTER_SUMMARY_CRC = 4 + len(MAGIC)
FOOTER_SIZE = HEAD.size + 16 + AFTER_SUMMARY_CRC
CHECK = "crc32"
"""The item of our metadata records that holds their checksum (MCAP gives them none)."""
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")


def check_of(name: str, items: Mapping[str, str]) -> str:
    """Checksum of a metadata record: CRC-32 of its bytes without the checksum, as eight hexadecimal digits."""
    builder = RecordBuilder()
    records.Metadata(name, {key: value for key, value in items.items() if key != CHECK}).write(builder)
    return f"{zlib.crc32(builder.end()):08x}"


class Cursor:
    """Reads fields from bytes, in order; `Damaged` where they end too early."""

    def __init__(self, data: bytes | memoryview) -> None:
        self._data, self.at = memoryview(data), 0

    def take(self, count: int) -> memoryview:
        if count > len(self._data) - self.at:
            raise Damaged(f"a length of {count} where {len(self._data) - self.at} bytes are left")
        self.at += count
        return self._data[self.at - count : self.at]

    def number(self, size: int) -> int:
        return int.from_bytes(self.take(size), "little")

    def blob(self) -> memoryview:
        return self.take(self.number(4))

    def text(self) -> str:
        try:
            return str(self.blob(), "utf-8")
        except UnicodeDecodeError as error:
            raise Damaged("text that is not UTF-8") from error

    def items(self) -> dict[str, str]:
        inner, found = Cursor(self.blob()), {}
        while inner.at < len(inner._data):
            key = inner.text()
            if key in found:
                raise Damaged(f"the key {key!r} twice")
            found[key] = inner.text()
        return found

    def done(self) -> None:
        if self.at != len(self._data):
            raise Damaged(f"{len(self._data) - self.at} bytes too many")


def records_in(data: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """(offset, opcode, body) of each record of a chunk or a summary section."""
    at = 0
    while at < len(data):
        if len(data) - at < HEAD.size:
            raise Damaged("a record that is cut")
        opcode, length = HEAD.unpack_from(data, at)
        body = data[at + HEAD.size : at + HEAD.size + length]
        if len(body) != length or opcode == 0:
            raise Damaged("a record that is longer than what holds it")
        yield at, opcode, body
        at += HEAD.size + length


def header(body: memoryview) -> records.Header:
    cursor = Cursor(body)
    return records.Header(cursor.text(), cursor.text())


def footer(data: memoryview) -> records.Footer:
    """The footer of a whole file."""
    end = bytes(data[-FOOTER_SIZE:])
    if len(data) < FOOTER_SIZE or end[-len(MAGIC) :] != MAGIC:
        raise Damaged("the end is missing")
    if HEAD.unpack_from(end) != (Opcode.FOOTER, 20):
        raise Damaged("the footer is not where it should be")
    cursor = Cursor(memoryview(end)[HEAD.size :])
    return records.Footer(cursor.number(8), cursor.number(8), cursor.number(4))


def schema(body: memoryview) -> records.Schema:
    cursor = Cursor(body)
    number, name, encoding = cursor.number(2), cursor.text(), cursor.text()
    if number == 0:
        raise Damaged("a schema with id 0")
    return records.Schema(number, bytes(cursor.blob()), encoding, name)


def channel(body: memoryview) -> records.Channel:
    cursor = Cursor(body)
    number, schema_id, topic, encoding = cursor.number(2), cursor.number(2), cursor.text(), cursor.text()
    return records.Channel(number, topic, encoding, cursor.items(), schema_id)


def message_bytes(channel_id: int, sequence: int, log_time: int, publish_time: int, data: bytes) -> bytes:
    """A whole message record."""
    head = HEAD.pack(Opcode.MESSAGE, _MESSAGE.size + len(data))
    return head + _MESSAGE.pack(channel_id, sequence, log_time, publish_time) + data


def message(body: memoryview) -> records.Message:
    found = message_head(body)
    found.data = bytes(body[_MESSAGE.size :])
    return found


def message_head(body: memoryview) -> records.Message:
    """The message without its data."""
    if len(body) < _MESSAGE.size:
        raise Damaged("a message that is cut")
    number, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
    return records.Message(number, log_time, b"", publish_time, sequence)


@dataclass(frozen=True)
class ChunkHead:
    """The fields of a chunk record before its data, whose length is `packed`."""

    start: int
    end: int
    size: int
    crc: int
    compression: str
    packed: int


def chunk_head(cursor: Cursor) -> ChunkHead:
    """Leaves the cursor at the chunk's data."""
    start, end, size, crc = _CHUNK.unpack(cursor.take(_CHUNK.size))
    return ChunkHead(start, end, size, crc, cursor.text(), cursor.number(8))


def chunk_data(head: ChunkHead, cursor: Cursor) -> bytes | bytearray:
    """A chunk's records, whole and with the right checksum (0 stands for none); the cursor is at its packed data."""
    packed = cursor.take(head.packed)
    cursor.done()
    if head.size > MAX_CHUNK:
        raise Damaged(f"a chunk of {head.size} bytes; at most {MAX_CHUNK} are read")
    data, used = unpack(head.compression, packed, head.size)
    if len(data) != head.size or used != len(packed) or head.crc not in (0, zlib.crc32(data)):
        raise Damaged("a chunk with a wrong checksum or size")
    return data


@dataclass(frozen=True)
class Attached:
    """An attachment. Its name is whatever the writer chose: never to be used as a path."""

    name: str
    media_type: str
    log_time: int
    create_time: int
    checksum: int
    right: bool
    view: memoryview = field(repr=False)

    @property
    def data(self) -> bytes:
        return bytes(self.view)


def attachment(body: memoryview) -> Attached:
    """A whole attachment whose checksum is right (0 stands for none)."""
    found, end = attachment_at(body)
    if end != len(body) or not (found.right or found.checksum == 0):
        raise Damaged("an attachment with a wrong checksum or size")
    return found


def attachment_at(body: memoryview) -> tuple[Attached, int]:
    """The attachment whose fields begin `body`, however long that is, and where it ends."""
    cursor = Cursor(body)
    log_time, create_time, name, media_type = cursor.number(8), cursor.number(8), cursor.text(), cursor.text()
    data = cursor.take(cursor.number(8))
    end, checksum = cursor.at, cursor.number(4)
    right = checksum == zlib.crc32(body[:end])
    return Attached(name, media_type, log_time, create_time, checksum, right, data), cursor.at


def metadata(body: memoryview) -> records.Metadata:
    """A metadata record as it stands in the file; its checksum, where it has one, must be right."""
    cursor = Cursor(body)
    record = records.Metadata(cursor.text(), cursor.items())
    if record.metadata.get(CHECK, check := check_of(record.name, record.metadata)) != check:
        raise Damaged("a metadata record with a wrong checksum")
    return record


def statistics(body: memoryview) -> records.Statistics:
    cursor = Cursor(body)
    messages, schemas = cursor.number(8), cursor.number(2)
    channels, attachments, metadatas, chunks = (cursor.number(4) for _ in range(4))
    start, end, counts = cursor.number(8), cursor.number(8), Cursor(cursor.blob())
    per_channel = {}
    while counts.at < len(counts._data):
        number = counts.number(2)
        per_channel[number] = counts.number(8)
    return records.Statistics(attachments, channels, per_channel, chunks, messages, end, start, metadatas, schemas)
