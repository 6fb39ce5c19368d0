"""Hostile logs: a clear error in bounded memory and time, and nothing written outside the target."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Metadata,
    Schema,
    Statistics,
)
from recording_logs import POSE, Said, heard, parts_of, sample

from analysis.recording.log_reader import open_log, recover
from analysis.recording.log_writer import LogWriter
from analysis.recording.replay import recovered
from planner.errors import InputError
from planner.mcap import MAGIC, MAX_CHUNK


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.log_writer.os.fsync", lambda number: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("hostile")


@pytest.fixture(scope="module")
def whole(folder: Path) -> bytes:
    sample(folder / "whole.mcap", messages=30, chunk_size=400)
    return (folder / "whole.mcap").read_bytes()


def read(path: Path) -> list[Said] | None:
    """What the ordinary reader makes of a file: messages, or None after a clear error."""
    try:
        log = open_log(path)
        assert all(len(attached.data) <= path.stat().st_size for attached in log.attachments)
        return [(m.topic, m.log_time, m.sequence, m.data) for m in log.messages()]
    except InputError as error:
        assert str(error).startswith(str(path))
        return None


def saved(path: Path) -> list[Said] | None:
    """What recovery makes of a file: the messages of a valid log, or None after a clear error."""
    out = path.with_name("out.mcap")
    out.unlink(missing_ok=True)
    try:
        report = recover(path, out)
    except InputError as error:
        assert str(path) in str(error) and not out.exists()
        return None
    said = heard(out)
    assert len(said) == report.messages and sorted(read(out) or []) == sorted(said)
    assert all(line.isprintable() for line in recovered(report).findings)
    return said


def sealed(*records: McapRecord, summary: tuple[McapRecord, ...] = (), start: int | None = None) -> bytes:
    """A file of these records whose checksums are all right; `start`: what the footer says."""
    data, tail = RecordBuilder(), RecordBuilder()
    data.write(MAGIC)
    for record in (Header("", "x"), *records):
        record.write(data)
    body = data.end()
    DataEnd(zlib.crc32(body)).write(data)
    body += data.end()
    for record in summary:
        record.write(tail)
    described = tail.end()
    at = len(body) if start is None else start
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, at, 0)
    claimed = (body + described)[at:] if at <= len(body + described) else b""
    Footer(at, 0, zlib.crc32(head, zlib.crc32(claimed))).write(tail)
    return body + described + tail.end() + MAGIC


def chunk_of(*records: McapRecord, compression: str = "zstd", **changed: object) -> Chunk:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    plain = builder.end()
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(compression, bytes)(plain)
    chunk = Chunk(compression, packed, 0, 0, zlib.crc32(plain), len(plain))
    for name, value in changed.items():
        setattr(chunk, name, value)
    return chunk


SCHEMA = Schema(1, b"{}", "jsonschema", "a")
CHANNEL = Channel(1, "/x", "json", {}, 1)
SAYS = Message(1, 0, b"hello", 0, 0)
SAID: list[Said] = [("/x", 0, 0, b"hello")]


def test_a_plain_sealed_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(sealed(chunk_of(SCHEMA, CHANNEL, SAYS), summary=(SCHEMA, CHANNEL)))
    assert read(tmp_path / "a.mcap") == saved(tmp_path / "a.mcap") == heard(tmp_path / "a.mcap") == SAID


@pytest.mark.parametrize("size", [1, 7, 8, 9, 36, 37, 45, 1000, 100_000])
def test_random_bytes(tmp_path: Path, size: int) -> None:
    draws = np.random.default_rng(size)
    for data in (draws.bytes(size), MAGIC + draws.bytes(size), MAGIC + draws.bytes(size) + MAGIC, bytes(size)):
        (tmp_path / "a.mcap").write_bytes(data)
        assert read(tmp_path / "a.mcap") is None and saved(tmp_path / "a.mcap") is None


def test_what_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("", "empty", "pipe", "loop", "missing", "missing/a.mcap"):
        with pytest.raises(InputError, match="expected an MCAP file"):
            open_log(tmp_path / name)
        with pytest.raises(InputError, match="expected an MCAP file"):
            recover(tmp_path / name, tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


def claims(whole: bytes) -> Iterator[bytes]:
    """The file with each run of four or eight bytes at the places of length fields claiming a lot."""
    for part in parts_of(whole):
        for field, size in ((1, 8), (9, 4), (9, 8), (11, 4), (13, 4), (25, 4), (25, 8), (37, 4), (45, 8), (49, 8)):
            for value in (2 ** (8 * size) - 1, 2**31 - 1):
                if part.start + field + size <= part.end:
                    data = bytearray(whole)
                    at = part.start + field
                    data[at : at + size] = value.to_bytes(size, "little")
                    yield bytes(data)


def unsealed(data: bytes) -> bytes:
    """Without the checksums of the sections, so that the reader has to look at every record."""
    found = bytearray(data)
    end = next(part for part in parts_of(data) if part.opcode == Opcode.DATA_END)
    found[end.end - 4 : end.end] = bytes(4)
    found[-12:-8] = bytes(4)
    return bytes(found)


def test_huge_claimed_lengths(folder: Path, whole: bytes) -> None:
    path, full = folder / "claims.mcap", heard(folder / "whole.mcap")
    for i, data in enumerate(claims(unsealed(whole))):
        path.write_bytes(data)
        found = read(path)
        assert found is None or found == full
        if i % 25 == 0:
            rescued = saved(path)
            assert rescued is None or set(rescued) <= set(full)


@settings(max_examples=150)
@given(st.lists(st.tuples(st.integers(0, 10**9), st.binary(min_size=1, max_size=9)), min_size=1, max_size=4))
@example([(0, b"\0")])
def test_a_mutated_log_is_right_or_refused(folder: Path, whole: bytes, changes: list[tuple[int, bytes]]) -> None:
    path, full = folder / "mutated.mcap", heard(folder / "whole.mcap")
    data = bytearray(whole)
    for at, new in changes:
        data[at % len(data) : at % len(data) + len(new)] = new
    path.write_bytes(data)
    assert read(path) == (full if bytes(data) == whole else None)
    rescued = saved(path)
    assert rescued is None or [m for m in full if m in set(rescued)] == rescued


@settings(max_examples=150)
@given(st.integers(0, 10**9), st.integers(0, 40), st.binary(max_size=40), st.sampled_from(["replace", "cut", "repeat"]))
def test_without_checksums_still_only_clear_errors(
    folder: Path, whole: bytes, at: int, size: int, new: bytes, how: str
) -> None:
    path, full = folder / "fuzzed.mcap", heard(folder / "whole.mcap")
    data = unsealed(whole)
    at %= len(data)
    repeated = data[at : at + 20 * size]
    path.write_bytes(data[:at] + (repeated + repeated if how == "repeat" else new) + data[at + size :])
    if how == "cut":
        path.write_bytes(data[:at])
    read(path)
    rescued = saved(path)
    assert rescued is None or set(rescued) <= set(full)


def test_wrong_descriptions(tmp_path: Path) -> None:
    other = Channel(1, "/y", "json", {}, 1)
    cases = [
        (chunk_of(SAYS), "channel 1, which nothing describes"),
        (chunk_of(CHANNEL, SAYS), "schema 1, which nothing describes"),
        (chunk_of(SCHEMA, CHANNEL, other, SAYS), "channel 1 is described twice"),
        (chunk_of(SCHEMA, Schema(1, b"", "", ""), CHANNEL, SAYS), "schema 1 is described twice"),
        (chunk_of(Schema(0, b"", "", ""), SAYS), "a schema with id 0"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, compression="xz"), "unknown compression 'xz'"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, compression="\x1b[2J"), "unknown compression"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, data=b"no"), "broken|cut"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, uncompressed_size=5), "wrong checksum or size"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, uncompressed_size=500), "wrong checksum or size"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, uncompressed_size=2**62), "at most"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, uncompressed_crc=1), "wrong checksum"),
        (chunk_of(SCHEMA, CHANNEL, SAYS, compression="", uncompressed_size=2**27), "wrong checksum or size"),
    ]
    for chunk, problem in cases:
        (tmp_path / "a.mcap").write_bytes(sealed(chunk))
        with pytest.raises(InputError, match=problem) as caught:
            list(open_log(tmp_path / "a.mcap").messages())
        assert str(caught.value).isprintable()
        assert saved(tmp_path / "a.mcap") in (None, SAID, [])


def test_summaries_that_point_anywhere(tmp_path: Path) -> None:
    path, chunk = tmp_path / "a.mcap", chunk_of(SCHEMA, CHANNEL, SAYS)
    size = len(sealed(chunk, summary=(SCHEMA,)))
    for start in (0, 1, 8, 9, 27, 40, 100, size - 40, size - 37, size - 36, size - 1, size, 2**40, 2**63, 2**64 - 1):
        path.write_bytes(sealed(chunk, summary=(SCHEMA,), start=start))
        assert read(path) in (None, SAID)
        assert saved(path) == SAID


def test_chunk_indexes_that_overlap_or_go_round(tmp_path: Path) -> None:
    path, chunk = tmp_path / "a.mcap", chunk_of(SCHEMA, CHANNEL, SAYS)
    for offsets in ([27, 27, 28], [8, 8], [30, 29, 28, 27], [0], [2**63], [*range(8, 120)], [27, 60]):
        indexes = [ChunkIndex(2**63, at, "zstd", 1, 0, 0, {1: at}, 0, 1) for at in offsets]
        count = len(set(offsets))
        told = Statistics(0, 1, {1: 99}, count, 99, 0, 0, 0, 1)
        path.write_bytes(sealed(chunk, chunk, summary=(SCHEMA, CHANNEL, told, *indexes)))
        assert read(path) == SAID * 2
        assert saved(path) == SAID * 2
        broken = bytearray(path.read_bytes())
        broken[28] ^= 0xFF
        broken[90] ^= 1
        path.write_bytes(broken)
        assert read(path) is None and set(saved(path) or []) <= set(SAID)


def test_names_like_paths_are_only_names(tmp_path: Path) -> None:
    names = ["../../x", "/etc/passwd", "a\0b", "..", "", "C:\\x", "\x1b[31mred", "~/x", "a/b"]
    room = tmp_path / "room"
    room.mkdir()
    with LogWriter(room / "a.mcap") as log:
        for name in names:
            log.attach(name, name, b"data")
            log.metadata(name, {name: name})
        log.write(log.channel("/../x", POSE), 0, b"")
    assert [attached.name for attached in open_log(room / "a.mcap").attachments] == names
    data = bytearray((room / "a.mcap").read_bytes())
    for place in range(40, len(data), 211):
        data[place] ^= 1
        (room / "b.mcap").write_bytes(data)
        saved(room / "b.mcap")
        data[place] ^= 1
    assert {path.name for path in room.iterdir()} <= {"a.mcap", "b.mcap", "out.mcap"}
    assert [path.name for path in tmp_path.iterdir()] == ["room"]


def bomb(compression: str, size: int) -> bytes:
    """That many zero bytes, compressed piece by piece."""
    piece = bytes(2**26)
    if compression == "zstd":
        packer = zstandard.ZstdCompressor().compressobj()
        return b"".join([*(packer.compress(piece) for _ in range(size // len(piece))), packer.flush()])
    with lz4.frame.LZ4FrameCompressor() as lz4_packer:
        parts = [lz4_packer.begin(), *(lz4_packer.compress(piece) for _ in range(size // len(piece)))]
        return b"".join([*parts, lz4_packer.flush()])


LIMITED = """
import resource, sys
from pathlib import Path
from planner import mcap as wire
from analysis.recording.log_reader import open_log
from analysis.recording.log_reader import recover
from planner.errors import InputError
wire.MAX_CHUNK, room = map(int, sys.argv[2:])
used = int(next(line for line in open("/proc/self/status") if line.startswith("VmSize")).split()[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (used + room,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
    try:
        print(path.name, "read", sum(1 for _ in open_log(path).messages()))
    except InputError as error:
        print(path.name, "refused")
    try:
        report = recover(path, path.with_suffix(".out"))
        print(path.name, "saved", report.messages)
    except InputError as error:
        print(path.name, "lost")
"""


@pytest.mark.parametrize(("most", "room"), [(2**25, 200), pytest.param(MAX_CHUNK, 600, marks=pytest.mark.slow)])
def test_bombs_in_little_memory(tmp_path: Path, most: int, room: int) -> None:
    """600 MiB beyond what the program itself takes, and a minute, are enough for whatever files claim or unpack to.

    The quick one allows chunks of an eighth of the size, and has less room.
    """
    inside = chunk_of(SCHEMA, CHANNEL, SAYS)
    for compression, size in (("zstd", 2**29), ("lz4", 2**29)):
        packed = bomb(compression, size)
        for claimed in (size, most, 2**60):
            big = Chunk(compression, packed, 0, 0, 1, claimed)
            (tmp_path / f"{compression}-{claimed}.mcap").write_bytes(sealed(big, inside, summary=(SCHEMA, CHANNEL)))
    frame = bytearray(zstandard.compress(bytes(300)))
    huge = frame[:4] + bytes([0xE0]) + (2**62).to_bytes(8, "little") + frame[7:]
    (tmp_path / "frame.mcap").write_bytes(sealed(Chunk("zstd", bytes(huge), 0, 0, 1, 300), inside))
    tiny = sealed(*[Metadata("", {})] * 20_000, inside)
    (tmp_path / "many.mcap").write_bytes(tiny)
    keys = Metadata("m", {str(i): "v" * 100 for i in range(10_000)})
    (tmp_path / "keys.mcap").write_bytes(sealed(*[keys] * 20, inside))
    with (tmp_path / "sparse.mcap").open("wb") as sparse:
        sparse.write(MAGIC)
        sparse.truncate(most // 2)
    words = [sys.executable, "-c", LIMITED, str(tmp_path), str(most), str(room * 2**20)]
    run = subprocess.run(words, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    told = run.stdout.splitlines()
    assert not [line for line in told if "read" in line] and len(told) == 20
    bombs = [line for line in told if line.startswith(("zstd", "lz4", "frame"))]
    assert [line.split()[1:] for line in bombs] == [["refused"], ["saved", "1"]] * 7


def test_time_is_linear_in_what_a_hostile_file_holds(tmp_path: Path) -> None:
    """Patterns made to be mistaken for records at every place; ten times the bytes take about ten times as long."""
    nested = (
        struct.pack("<BQ", Opcode.CHUNK, 44) + bytes(28) + struct.pack("<I4sQ", 4, b"zstd", 4) + b"\x28\xb5\x2f\xfd"
    )
    patterns = [nested, b"\x28\xb5\x2f\xfd" + bytes(4), b"\x04\x22\x4d\x18", b"\x06" + bytes(8), b"\x09" + bytes(16)]
    patterns += [b"\x0c" + bytes(8), b"\x07\x06" + bytes(13), struct.pack("<BQ", 0x80, 0)]
    for pattern in patterns:
        seconds = []
        for size in (2**13, 2**16):
            (tmp_path / "a.mcap").write_bytes(MAGIC + pattern * (size // len(pattern)))
            began = time.process_time()
            assert read(tmp_path / "a.mcap") is None
            saved(tmp_path / "a.mcap")
            seconds.append(time.process_time() - began)
        assert seconds[1] < 30 * seconds[0] + 0.2, pattern
