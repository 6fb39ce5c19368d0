"""Hostile and damaged logs."""

from __future__ import annotations

import os
import re
import struct
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from helpers import run_python
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
from mcap.writer import CompressionType, Writer
from recordings import POSE, Part, Said, heard, parts_of, sample, stream_of

from analysis.recording.container import RECOVERED, LogWriter, Lost, Recovered, open_log, recover
from analysis.recording.replay import recovered
from analysis.recording.replay import recovered as in_words
from planner.errors import InputError, UsageError
from planner.mcap import MAGIC, MAX_CHUNK

# Hostile logs: a clear error in bounded memory and time, and nothing written outside the target.


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.container.os.fsync", lambda number: None)


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


@settings(max_examples=30)
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


@settings(max_examples=30)
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
        (chunk_of(SAYS), "channel 1, which is not described"),
        (chunk_of(CHANNEL, SAYS), "schema 1, which is not described"),
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
from analysis.recording.container import open_log
from analysis.recording.container import recover
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
    for compression, size in (("zstd", 16 * most), ("lz4", 16 * most)):
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
    told = run_python(LIMITED, str(tmp_path), str(most), str(room * 2**20)).splitlines()
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


# Recovery: every intact chunk of a damaged log, nothing invented, whatever byte is wrong and wherever it is cut.

ATTACHED = {"world.npz", "tally.json", "last.bin"}
METADATA = {"mrac-jax", "end"}


@pytest.fixture(scope="module")
def whole_recover(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    sample(path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """As many chunks and other records, fewer messages: a test at every byte takes the square of the length."""
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    sample(path, messages=24, chunk_size=320)
    return path.read_bytes()


def put(data: bytes, folder: Path) -> None:
    """The damaged log, in new files: on some disks to write over others takes 10 ms, thousands of times."""
    for name in ("in.mcap", "out.mcap"):
        (folder / name).unlink(missing_ok=True)
    (folder / "in.mcap").write_bytes(data)


def recovered_recover(data: bytes, folder: Path) -> tuple[Recovered, list[Said]]:
    """Recover damaged bytes; the result is valid for the library's readers and ours, which must agree."""
    put(data, folder)
    report = recover(folder / "in.mcap", folder / "out.mcap")
    said, log = heard(folder / "out.mcap"), open_log(folder / "out.mcap")
    assert [(m.topic, m.log_time, m.sequence, m.data) for m in log.messages()] == said
    assert report.messages == len(said) and (folder / "in.mcap").read_bytes() == data
    assert [attached.name for attached in log.attachments] == report.attachments
    assert [name for name, _ in log.metadata if name != RECOVERED] == report.metadata
    assert bool(log.partial) == (not report.complete)
    return report, said


def said_of(report: Recovered) -> list[str]:
    """What the command prints."""
    told = in_words(report)
    return [told.headline, *told.findings]


def refused(data: bytes, folder: Path) -> None:
    """The ordinary reader tells what to do about a damaged log."""
    put(data, folder)
    with pytest.raises(
        InputError, match=r"(truncated.*try `mrac-jax inspect --repair OUT .*in\.mcap`|not an MCAP file)"
    ):
        list(open_log(folder / "in.mcap").messages())


def test_an_undamaged_log_comes_out_the_same(whole_recover: bytes, tmp_path: Path) -> None:
    report, _ = recovered_recover(whole_recover, tmp_path)
    assert report.complete and report.lost_messages == 0 and said_of(report)[-1] == "nothing is lost"
    assert (tmp_path / "out.mcap").read_bytes() == whole_recover


def flips(whole_recover: bytes, every: bool = False) -> Iterator[tuple[int, Part | None]]:
    """Offsets of every region of the file: of each record its opcode, length, and first, middle and last bytes."""
    yield from ((at, None) for at in (0, 4, 7, len(whole_recover) - 8, len(whole_recover) - 1))
    parts = parts_of(whole_recover)
    ends = {part.opcode: part for part in parts} | {-part.opcode: part for part in reversed(parts)}
    for part in parts if every else dict.fromkeys(ends.values()):
        middle = (part.start + 9 + part.end) // 2
        fields = [0, 1, 8, 9, 25, 33, 41, 53]
        chosen = {part.start + field for field in fields} | {middle, part.end - 4, part.end - 1}
        chosen = set(range(part.start, part.end)) if every else {at for at in chosen if at < part.end}
        yield from ((at, part) for at in sorted(chosen))


def check_flip(whole_recover: bytes, at: int, bit: int, part: Part | None, folder: Path) -> None:
    """All but the damaged record is saved; that one too where nothing that counts is damaged.

    That is a chunk's times, which no checksum covers, a bit of compressed data that says nothing, and the length of all
    items of a metadata record, which their own lengths tell too.
    """
    data = bytearray(whole_recover)
    data[at] ^= 1 << bit
    refused(bytes(data), folder)
    report, said = recovered_recover(bytes(data), folder)
    opcode, field = (part.opcode, at - part.start) if part else (0, 0)
    chunks = [p for p in parts_of(whole_recover) if p.opcode == Opcode.CHUNK]
    full = [m for p in chunks for m in p.said]
    hurt = opcode == Opcode.CHUNK and not 9 <= field < 25 and not (field >= 53 and said == full)
    assert said == [m for p in chunks if p is not part or not hurt for m in p.said]
    attached, metadata = set(report.attachments), set(report.metadata)
    assert attached <= ATTACHED and len(ATTACHED - attached) == (opcode == Opcode.ATTACHMENT)
    assert metadata <= METADATA and len(METADATA - metadata) <= (opcode == Opcode.METADATA)
    lost = hurt + (attached != ATTACHED) + (metadata != METADATA)
    summary_stands = part is not None and part.start < data_end(whole_recover)
    assert len(report.lost) == lost if summary_stands or not part else len(report.lost) >= lost
    if summary_stands:
        assert report.lost_messages == len(full) - len(said)


def data_end(whole_recover: bytes) -> int:
    return next(part.end for part in parts_of(whole_recover) if part.opcode == Opcode.DATA_END)


def test_one_flipped_bit_in_each_region(whole_recover: bytes, tmp_path: Path) -> None:
    places = list(flips(whole_recover))
    assert {part.opcode for _, part in places if part} >= {1, 2, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
    for at, part in places:
        check_flip(whole_recover, at, at % 8, part, tmp_path)


@pytest.mark.slow
def test_every_byte_flipped(small: bytes, tmp_path: Path) -> None:
    for at, part in flips(small, every=True):
        check_flip(small, at, (at * 5) % 8, part, tmp_path)


def check_cut(whole_recover: bytes, size: int, folder: Path) -> None:
    """Exactly the records that end before the cut are saved."""
    refused(whole_recover[:size], folder) if size else None
    parts = [part for part in parts_of(whole_recover) if part.end <= size]
    kept = [m for part in parts for m in part.said]
    if not any(part.opcode in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA) for part in parts):
        with pytest.raises(InputError):
            recovered_recover(whole_recover[:size], folder)
        return
    report, said = recovered_recover(whole_recover[:size], folder)
    assert said == kept
    assert len(report.attachments) == sum(part.opcode == Opcode.ATTACHMENT for part in parts)
    assert len(report.metadata) == sum(part.opcode == Opcode.METADATA for part in parts)
    finished = any(part.opcode == Opcode.DATA_END for part in parts)
    assert report.complete == finished and report.lost_messages is None


def test_cut_at_30_random_places_and_after_every_record(whole_recover: bytes, tmp_path: Path) -> None:
    cuts = np.random.default_rng(5).choice(len(whole_recover), 30, replace=False).tolist()
    for size in [*cuts, *(part.end for part in parts_of(whole_recover))]:
        check_cut(whole_recover, size, tmp_path)


@pytest.mark.slow
def test_cut_at_every_place(small: bytes, tmp_path: Path) -> None:
    for size in range(len(small)):
        check_cut(small, size, tmp_path)


@pytest.mark.parametrize("seed", range(20))
def test_cut_and_flipped_the_rest_is_saved(whole_recover: bytes, tmp_path: Path, seed: int) -> None:
    """Without the summary, and with a broken length in the middle: the scan finds what follows."""
    draws = np.random.default_rng(seed)
    chunks = [part for part in parts_of(whole_recover) if part.opcode == Opcode.CHUNK]
    size = data_end(whole_recover) - 5
    victim = chunks[int(draws.integers(len(chunks) - 1))]
    data = bytearray(whole_recover[:size])
    data[victim.start + 1 : victim.start + 9] = draws.bytes(8)
    data[victim.start + 60 : victim.start + 64] = draws.bytes(4)
    _, said = recovered_recover(bytes(data), tmp_path)
    assert said == [m for part in chunks if part is not victim for m in part.said]


@pytest.mark.parametrize("seed", range(10))
def test_bytes_taken_out_or_put_in(whole_recover: bytes, tmp_path: Path, seed: int) -> None:
    """Everything after is moved, so that no offset in the summary is right any more."""
    draws = np.random.default_rng(seed)
    chunks = [part for part in parts_of(whole_recover) if part.opcode == Opcode.CHUNK]
    victim = chunks[int(draws.integers(len(chunks)))]
    at = victim.start + 55 + int(draws.integers(20))
    moved = (
        whole_recover[: at + 7] + draws.bytes(5) + whole_recover[at:]
        if seed % 2
        else whole_recover[:at] + whole_recover[at + 9 :]
    )
    _, said = recovered_recover(moved, tmp_path)
    assert said == [m for part in chunks if part is not victim for m in part.said]


def foreign(compression: CompressionType, chunked: bool = True) -> tuple[bytes, list[Said]]:
    """A log by the library's own writer: channels described once, metadata without a checksum."""
    out = stream_of(b"")
    writer = Writer(out, chunk_size=500, compression=compression, use_chunking=chunked, enable_data_crcs=True)
    writer.start()
    schema = writer.register_schema("a", "jsonschema", b"{}")
    channels = [writer.register_channel(f"/{name}", "json", schema) for name in "ab"]
    said = []
    for i in range(60):
        data = bytes([i]) * (i % 7 * 10)
        writer.add_message(channels[i % 2], i, data, i, sequence=i)
        said.append((f"/{'ab'[i % 2]}", i, i, data))
    writer.add_attachment(0, 0, "../../x\0", "x/y", b"123")
    writer.add_metadata("m", {"a": "b"})
    writer.finish()
    return out.getvalue(), said


@pytest.mark.parametrize("compression", CompressionType)
def test_logs_of_other_writers(tmp_path: Path, compression: CompressionType) -> None:
    data, said = foreign(compression)
    (tmp_path / "a.mcap").write_bytes(data)
    assert [(m.topic, m.log_time, m.sequence, m.data) for m in open_log(tmp_path / "a.mcap").messages()] == said
    report, found = recovered_recover(data, tmp_path)
    assert found == said and report.lost_messages == 0
    assert report.metadata == [] and [lost.what for lost in report.lost] == ["metadata"]
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    for place in (9, 30, 37, 60):
        broken = bytearray(data)
        broken[chunks[2].start + place] ^= 1
        report, found = recovered_recover(bytes(broken), tmp_path)
        rest = [m for part in chunks if part is not chunks[2] for m in part.said]
        assert found in (rest, said) and report.attachments == ["../../x\0"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "in.mcap", "out.mcap"]


def test_what_only_a_lost_chunk_describes_comes_from_the_summary(tmp_path: Path) -> None:
    data, _ = foreign(CompressionType.ZSTD)
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    broken = bytearray(data)
    broken[chunks[0].end - 1] ^= 1
    rest = [m for part in chunks[1:] for m in part.said]
    assert recovered_recover(bytes(broken), tmp_path)[1] == rest
    report, said = recovered_recover(bytes(broken[:-40]), tmp_path)
    assert said == [] and any("not described" in str(lost) for lost in report.lost)


def test_messages_outside_chunks_have_no_checksum_and_are_lost(tmp_path: Path) -> None:
    data, said = foreign(CompressionType.NONE, chunked=False)
    report, found = recovered_recover(data, tmp_path)
    assert found == [] and report.attachments and report.lost_messages == len(said)


def test_a_message_index_that_lies_does_not_hide_a_chunk(whole_recover: bytes, tmp_path: Path) -> None:
    parts = parts_of(whole_recover)
    data = bytearray(whole_recover[: data_end(whole_recover) - 13])
    indexes = [part for part in parts if part.opcode == Opcode.MESSAGE_INDEX]
    for part in indexes:
        struct.pack_into("<Q", data, part.start + 1, 2**40)
    assert recovered_recover(bytes(data), tmp_path)[1] == [m for part in parts for m in part.said]


def test_the_input_is_never_written(whole_recover: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(whole_recover[:2000])
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "hard").hardlink_to(path)
    for out in (path, tmp_path / "link", tmp_path / "hard", tmp_path / ".." / tmp_path.name / "a.mcap"):
        with pytest.raises(UsageError, match="the damaged file itself"):
            recover(path, out)
    path.rename(tmp_path / "b.mcap.recovering")
    with pytest.raises(UsageError, match="the damaged file itself"):
        recover(tmp_path / "b.mcap.recovering", tmp_path / "b.mcap")
    assert (tmp_path / "b.mcap.recovering").read_bytes() == whole_recover[:2000]


def test_what_is_there_is_replaced_only_at_the_end(
    whole_recover: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in.mcap").write_bytes(whole_recover[:3000])
    (tmp_path / "out.mcap").write_bytes(b"older")

    def interrupted(*args: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("analysis.recording.container._save_chunk", interrupted)
        with pytest.raises(KeyboardInterrupt):
            recover(tmp_path / "in.mcap", tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == b"older"
    (tmp_path / "junk").write_bytes(b"junk" * 100)
    with pytest.raises(InputError, match="nothing that can be saved"):
        recover(tmp_path / "junk", tmp_path / "out.mcap")
    assert (tmp_path / "out.mcap").read_bytes() == b"older"
    recover(tmp_path / "in.mcap", tmp_path / "out.mcap")
    assert heard(tmp_path / "out.mcap")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in.mcap", "junk", "out.mcap"]


def test_a_recovered_log_is_recovered_again(whole_recover: bytes, tmp_path: Path) -> None:
    once, said = recovered_recover(whole_recover[:3000], tmp_path)
    (tmp_path / "once.mcap").write_bytes((tmp_path / "out.mcap").read_bytes())
    again = recover(tmp_path / "once.mcap", tmp_path / "twice.mcap")
    assert again.complete and again.messages == once.messages and heard(tmp_path / "twice.mcap") == said
    assert open_log(tmp_path / "twice.mcap").partial


def test_the_report_counts_in_english(whole_recover: bytes, tmp_path: Path) -> None:
    one = Recovered(tmp_path / "a", tmp_path / "b", 1, 1, ["x"], ["y"], lost=[Lost("the end", 9, 9)], lost_messages=1)
    lines = said_of(one)
    assert lines[0] == "saved 1 message in 1 chunk, 1 attachment, 1 metadata record"
    assert lines[1:3] == ["lost the end, from byte 9 on", "lost 1 message in all"]
    report, _ = recovered_recover(whole_recover[:3000], tmp_path)
    for line in said_of(report):
        assert not re.search(r"bytes ([0-9,]+) to \1(?![0-9,])", line)
