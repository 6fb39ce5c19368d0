"""What is intact in a damaged MCAP file: records found by their own checksums, wherever they stand.

A chunk, an attachment or a metadata record counts when its length, the lengths in it and its checksum all agree; one
without a checksum does not. The time is linear in the file's size: what a false start costs is counted, and limited.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from dataclasses import dataclass

from mcap import records
from mcap.opcode import Opcode

from planner import mcap as wire
from planner.mcap import HEAD, MAGIC, Damaged

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
