"""What is intact in a damaged MCAP file: records found by their checksums, whatever the lengths around them claim.

A chunk or an attachment counts when its own checksum is right, a metadata record when it is well formed and the
checksum that ours carry is right. Every position is looked at a bounded number of times, so the time is linear in the
file's size; a false start costs what it makes us read, and there is a limit to that.
"""

from __future__ import annotations

import contextlib
import re
import zlib
from bisect import bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from mcap import records
from mcap.opcode import Opcode

from analysis.recording.mcap import wire
from analysis.recording.mcap.wire import HEAD, MAGIC, Attached, Cursor, Damaged

_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"
_SIGNS = re.compile(rb"[\x06\x09\x0c](?=.{5}\x00\x00\x00)|\x28(?=\xb5\x2f\xfd)|\x04(?=\x22\x4d\x18)", re.DOTALL)
"""What a record that is worth something looks like: its opcode and a length below 2**40, or its compressed data."""
_CHUNK_FIELDS = HEAD.size + 8 + 8 + 8 + 4 + 4
"""From a chunk's start to its compression's name; the data follow 8 bytes after that."""
_BEFORE_DATA = {_ZSTD[0]: _CHUNK_FIELDS + 4 + 8, _LZ4[0]: _CHUNK_FIELDS + 3 + 8}
_MOST_FALSE_STARTS = 2**19
_LEAST_WORK = 2**30
_MOST_METADATA = 2**24
_VALUED = {
    Opcode.CHUNK: "chunk",
    Opcode.ATTACHMENT: "attachment",
    Opcode.METADATA: "metadata",
    Opcode.MESSAGE: "message outside chunks",
}


@dataclass(frozen=True)
class Chunk:
    """An intact chunk: its records, unpacked."""

    start: int
    end: int
    data: bytes | bytearray


@dataclass(frozen=True)
class Extra:
    """An intact attachment, or a metadata record; `checked` when a checksum vouches for it."""

    start: int
    end: int
    record: Attached | records.Metadata
    checked: bool


@dataclass(frozen=True)
class Loose:
    """A schema, channel or message outside chunks, in a file whose data section's checksum is right."""

    start: int
    end: int
    opcode: int
    body: memoryview


@dataclass(frozen=True)
class Gap:
    """Bytes `[start, end)` that cannot be used."""

    start: int
    end: int
    what: str


Piece = Chunk | Extra | Loose | Gap


class Scan:
    """Walks the file from record to record, and searches for the next where the walk breaks.

    Args:
        data: the whole file.
        hints: opcodes by the offsets at which records are known to begin (from an intact summary).
        end: where the data section ends, as far as is known.
        trusted: whether the data section's own checksum is right.
        ours: whether every metadata record carries a checksum.
    """

    def __init__(self, data: memoryview, hints: Mapping[int, int], end: int, trusted: bool, ours: bool) -> None:
        self._data, self._hints, self._end = data, hints, end
        self._hinted = sorted(hints)
        self._trusted, self._ours = trusted, ours
        self._budget = _LEAST_WORK + 32 * len(data)
        self._false_starts = 0
        self._next: Chunk | Extra | None = None

    def pieces(self) -> Iterator[Piece]:
        """Everything from the header to the end of the data section, in order."""
        at = len(MAGIC)
        while at < self._end and self._data[at:] != MAGIC:
            found = self._intact(at)
            if found:
                yield found
                at = found.end
                continue
            opcode, end = self._head(at)
            if end:
                if opcode == Opcode.DATA_END:
                    return
                if self._trusted and opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    yield Loose(at, end, opcode, self._data[at + HEAD.size : end])
                elif opcode in _VALUED:
                    yield Gap(at, end, _VALUED[opcode])
                at = end
                continue
            resume = self._end if self._cut(at) or self._spent() else self._resume(at)
            yield Gap(at, resume, _VALUED.get(opcode, "end" if resume == self._end else ""))
            if resume == self._end:
                return
            at = resume
        if self._data[at:] != MAGIC:
            yield Gap(at, at, "end")

    def _intact(self, at: int) -> Chunk | Extra | None:
        """The record at `at`, whatever its opcode and length say, if its checksum is right."""
        if self._next and self._next.start == at:
            return self._next
        if at + HEAD.size <= self._end and self._agrees(at, *HEAD.unpack_from(self._data, at)):
            return None
        try:
            return self._chunk(at) or self._attachment(at) or self._metadata(at)
        except Damaged as error:
            self._budget -= error.work
            return None

    def _chunk(self, at: int) -> Chunk | None:
        data = self._data
        for compression, magic in (("zstd", _ZSTD), ("lz4", _LZ4)):
            start = at + _CHUNK_FIELDS + len(compression) + 8
            if data[start : start + len(magic)] == magic:
                return self._checked_chunk(at, compression, start, self._end)
        start = at + _CHUNK_FIELDS + 8
        end = start + int.from_bytes(data[start - 8 : start], "little")
        if end > self._end or data[at] != Opcode.CHUNK or any(data[start - 12 : start - 8]):
            return None
        return self._checked_chunk(at, "", start, end)

    def _checked_chunk(self, at: int, compression: str, start: int, end: int) -> Chunk | None:
        crc = int.from_bytes(self._data[at + _CHUNK_FIELDS - 8 : at + _CHUNK_FIELDS - 4], "little")
        found, used = wire.unpack(compression, self._data[start:end], wire.MAX_CHUNK)
        if (crc and zlib.crc32(found) == crc) or (crc == 0 and self._trusted):
            return Chunk(at, start + used, found)
        self._budget -= len(found) + used
        return None

    def _attachment(self, at: int) -> Extra | None:
        try:
            found, used = wire.attachment_at(self._data[at + HEAD.size : self._end])
        except Damaged:
            return None
        if (found.right and found.checksum) or (self._trusted and found.checksum == 0 and self._is(at, 0x09, used)):
            return Extra(at, at + HEAD.size + used, found, True)
        self._budget -= used
        return None

    def _metadata(self, at: int) -> Extra | None:
        cursor = Cursor(self._data[at + HEAD.size : min(self._end, at + HEAD.size + _MOST_METADATA)])
        record = records.Metadata(cursor.text(), cursor.items())
        end = at + HEAD.size + cursor.at
        if wire.CHECK in record.metadata:
            right = record.metadata[wire.CHECK] == wire.check_of(record.name, record.metadata)
            return Extra(at, end, record, True) if right else None
        if (self._trusted or not self._ours) and self._is(at, Opcode.METADATA, cursor.at):
            return Extra(at, end, record, self._trusted)
        return None

    def _is(self, at: int, opcode: int, length: int) -> bool:
        return bool(HEAD.unpack_from(self._data, at) == (opcode, length))

    def _head(self, at: int) -> tuple[int, int]:
        """(opcode, end) that the record's first nine bytes claim; end 0 unless that makes sense."""
        if at + HEAD.size > self._end:
            return 0, 0
        opcode, length = HEAD.unpack_from(self._data, at)
        end, following = at + HEAD.size + length, bisect_right(self._hinted, at)
        passed = following < len(self._hinted) and self._hinted[following] < end
        if opcode == 0 or end > self._end or passed:
            return opcode, 0
        agrees = self._agrees(at, opcode, length)
        if agrees is not None:
            return opcode, end if agrees else 0
        if end == self._end or self._data[end:] == MAGIC:
            return opcode, end
        if end + HEAD.size > self._end:
            return opcode, 0
        next_opcode, length = HEAD.unpack_from(self._data, end)
        known = 0 < next_opcode <= Opcode.DATA_END
        return opcode, end if known and end + HEAD.size + length <= len(self._data) else 0

    def _agrees(self, at: int, opcode: int, length: int) -> bool | None:
        """Whether a record's length is what its own fields say, for kinds that have no checksum; None for others."""
        if opcode == Opcode.DATA_END:
            return length == 4 and not (self._hinted and self._hinted[-1] > at)
        if opcode == Opcode.MESSAGE_INDEX:
            listed = int.from_bytes(self._data[at + HEAD.size + 2 : at + HEAD.size + 6], "little")
            return length == 6 + listed and listed % 16 == 0
        if opcode == Opcode.HEADER:
            cursor = Cursor(self._data[at + HEAD.size : self._end])
            with contextlib.suppress(Damaged):
                cursor.blob()
                cursor.blob()
            return cursor.at == length
        return None

    def _cut(self, at: int) -> bool:
        """Whether a chunk or an attachment begins here whose lengths agree that it ends beyond the file."""
        cursor = Cursor(self._data[at : at + 2 * HEAD.size + _MOST_METADATA])
        try:
            opcode, length = cursor.number(1), cursor.number(8)
            if opcode == Opcode.CHUNK:
                inner = wire.chunk_head(cursor).packed
            elif opcode == Opcode.ATTACHMENT:
                cursor.take(16)
                cursor.blob()
                cursor.blob()
                inner = cursor.number(8) + 4
            else:
                return False
        except Damaged:
            return False
        return cursor.at + inner == HEAD.size + length and at + HEAD.size + length > self._end

    def _spent(self) -> bool:
        """Whether false starts have cost more than a damaged file's would."""
        return self._budget < 0 or self._false_starts > _MOST_FALSE_STARTS

    def _resume(self, at: int) -> int:
        """Where to go on after `at`: the next hint if a record stands there, else the next intact record."""
        following = bisect_right(self._hinted, at)
        if following < len(self._hinted):
            hint = self._hinted[following]
            if self._data[hint] == self._hints[hint] or self._intact(hint):
                return hint
        elif self._hinted:
            return self._end
        for sign in _SIGNS.finditer(self._data, at + 1, self._end):
            start = sign.start() - _BEFORE_DATA.get(self._data[sign.start()], 0)
            if start <= at:
                continue
            self._next = self._intact(start)
            if self._next:
                return start
            self._false_starts += 1
            if self._spent():
                break
        return self._end
