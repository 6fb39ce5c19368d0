"""Decompression of chunks in bounded memory, whatever the data claim to become."""

from __future__ import annotations

import lz4.frame
import zstandard

MAX_CHUNK = 2**28
"""Largest chunk, before compression, that is written or read."""
_PIECE = 2**20
_BLOCK_WORK = 100
_WINDOW = 2**27


class Damaged(ValueError):
    """Bytes that are not the record that they should be. `work`: how many bytes were gone through to see it."""

    def __init__(self, problem: str, work: int = 0) -> None:
        super().__init__(problem)
        self.work = work


def unpack(compression: str, data: memoryview, limit: int) -> tuple[bytes | bytearray, int]:
    """Decompress one chunk, in bounded memory.

    Args:
        compression: "zstd", "lz4" or "".
        data: the compressed bytes; for zstd and lz4 what follows their end is left alone.
        limit: most bytes to make.

    Returns:
        The bytes, and how many bytes of `data` they were made of.

    Raises:
        Damaged: unknown compression, broken or endless data, or more than `limit`.
    """
    if compression == "":
        if len(data) > limit:
            raise Damaged(f"a chunk of more than {limit} bytes")
        return bytes(data), len(data)
    found = bytearray()
    try:
        if compression == "zstd":
            return found, _unpack_zstd(data, limit, found)
        if compression == "lz4":
            return found, _unpack_lz4(data, limit, found)
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise Damaged(f"a chunk whose {compression} data are broken", len(found)) from error
    raise Damaged(f"a chunk with unknown compression {compression[:16]!r}")


def _unpack_zstd(data: memoryview, limit: int, found: bytearray) -> int:
    end = _zstd_end(data)
    reader = zstandard.ZstdDecompressor(max_window_size=_WINDOW).stream_reader(data[:end])
    while piece := reader.read(_PIECE):
        _extend(found, piece, limit)
    return end


def _extend(found: bytearray, piece: bytes, limit: int) -> None:
    found += piece
    if len(found) > limit:
        raise Damaged(f"a chunk of more than {limit} bytes", len(found))


def _zstd_end(data: memoryview) -> int:
    """Where the zstd frame at the start of `data` ends, by its block headers (RFC 8878, section 3.1.1)."""
    parameters = zstandard.get_frame_parameters(data[:18])
    at, blocks, last = zstandard.frame_header_size(data[:18]), 0, False
    while not last and at <= len(data):
        block = int.from_bytes(data[at : at + 3], "little")
        last, kind, size = bool(block & 1), block >> 1 & 3, block >> 3
        at += 3 + (1 if kind == 1 else size)
        blocks += 1
    at += 4 * parameters.has_checksum
    if at > len(data):
        raise Damaged("zstd data that are cut", blocks * _BLOCK_WORK)
    return at


def _unpack_lz4(data: memoryview, limit: int, found: bytearray) -> int:
    reader = lz4.frame.LZ4FrameDecompressor()
    _extend(found, reader.decompress(data, max_length=4 * _PIECE), limit)
    while not reader.eof:
        piece = reader.decompress(b"", max_length=4 * _PIECE)
        if not piece and not reader.eof:
            raise Damaged("lz4 data that are cut", len(found))
        _extend(found, piece, limit)
    return len(data) - len(reader.unused_data or b"")
