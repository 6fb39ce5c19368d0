"""MCAP logs: the writer under faults, hostile and damaged files, recovery."""

import io
import os
import re
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from types import FrameType

import lz4.frame
import mcap
import numpy as np
import pytest
import zstandard
from helpers import run_python
from hypothesis import example, given, settings
from hypothesis import strategies as st
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from recordings import GRID, POSE, TOPICS, Part, Said, heard, parts_of, said_in, sample

from analysis.recording import container
from analysis.recording.container import PARTIAL, RECOVERED, LogSchema, LogWriter, Lost, Recovered, open_log, recover
from analysis.recording.replay import recovered
from planner.errors import InputError, UsageError
from planner.files import MAGIC


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.container.os.fsync", lambda number: None)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with logs of one content: `whole.mcap`, and `small.mcap` of fewer messages in as many chunks."""
    path = tmp_path_factory.mktemp("logs")
    sample(path / "whole.mcap")
    sample(path / "small.mcap", messages=24, chunk_size=320)
    return path


@pytest.fixture(scope="module")
def whole(folder: Path) -> bytes:
    return (folder / "whole.mcap").read_bytes()


@pytest.fixture(scope="module")
def small(folder: Path) -> bytes:
    return (folder / "small.mcap").read_bytes()


# The writer: the same bytes for the same input, accepted by an independent reader, finished whatever happens.


def test_what_was_written_is_read_by_the_library_and_by_us(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    said = sample(path)
    sample(tmp_path / "b.mcap")
    assert path.read_bytes() == (tmp_path / "b.mcap").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "b.mcap"]
    log = open_log(path)
    assert heard(path) == said_in(log) == said
    with path.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    statistics = summary.statistics
    assert statistics.message_count == len(said)
    assert statistics.chunk_count == sum(bool(part.said) for part in parts_of(path.read_bytes())) > 3
    assert (statistics.message_start_time, statistics.message_end_time) == (said[0][1], said[-1][1])
    counts = {summary.channels[i].topic: number for i, number in statistics.channel_message_counts.items()}
    assert counts == {topic: sum(m[0] == topic for m in said) for topic in TOPICS}
    assert (statistics.attachment_count, statistics.metadata_count) == (3, 2)
    assert (statistics.schema_count, statistics.channel_count) == (2, 4)
    assert log.metadata == [("mrac-jax", {"version": "1", "seed": "7"}), ("end", {"outcome": "complete"})]
    kinds = [(attached.name, attached.media_type, len(attached.data)) for attached in log.attachments]
    assert kinds[1] == ("tally.json", "application/json", 14)
    assert [name for name, _, _ in kinds] == ["world.npz", "tally.json", "last.bin"]
    assert log.attachment("tally.json") == b'{"visited": 3}'
    assert {c.topic for c in log.channels.values()} == set(TOPICS) and (log.partial, log.library) == ("", "mrac-jax")
    chosen = [(m.topic, m.log_time, m.sequence, m.data) for m in log.messages(["/grid", "/raw"])]
    assert chosen == [m for m in said if m[0] in ("/grid", "/raw")]
    schemas = {m.topic: (m.schema.name, m.schema.data) if m.schema else None for m in log.messages()}
    assert (schemas["/poses"], schemas["/raw"]) == ((POSE.name, POSE.data), None)
    with pytest.raises(InputError, match="no attachment 'x'"):
        log.attachment("x")


def test_every_chunk_repeats_what_describes_its_messages(folder: Path, whole: bytes) -> None:
    for part in parts_of(whole):
        if part.opcode == Opcode.CHUNK:
            alone = whole[: parts_of(whole)[0].end] + whole[part.start : part.end]
            (folder / "alone.mcap").write_bytes(alone)
            assert saved(folder / "alone.mcap") == list(part.said)


def test_an_empty_log_is_valid(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.channel("/never", POSE)
    assert heard(tmp_path / "a.mcap") == [] == said_in(open_log(tmp_path / "a.mcap"))


def test_a_channel_is_one_by_what_it_says(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        one = log.channel("/x", POSE, {"a": "1", "b": "2"})
        assert log.channel("/x", POSE, {"b": "2", "a": "1"}) == one
        others = {log.channel("/x", GRID), log.channel("/x", POSE), log.channel("/y", POSE)}
        assert len(others | {one}) == 4


@pytest.mark.parametrize("error", [KeyboardInterrupt(), ValueError("no such robot")])
def test_an_exception_leaves_a_valid_log_marked_partial(tmp_path: Path, error: BaseException) -> None:
    path = tmp_path / "a.mcap"
    said = "interrupted" if isinstance(error, KeyboardInterrupt) else "ValueError: no such robot"
    for name in ("a.mcap", "a.interrupted.mcap"):  # what is there is kept
        with pytest.raises(type(error)), LogWriter(path, chunk_size=200) as log:
            channel = log.channel("/x", POSE)
            for i in range(30):
                log.write(channel, i, b"%d" % i * 10)
            raise error
        assert log.placed == tmp_path / name and [m[1] for m in heard(log.placed)] == list(range(30))
        assert open_log(log.placed).partial == said
        assert [found for found, _ in open_log(log.placed).metadata] == [PARTIAL]
    with pytest.raises(type(error)), LogWriter(path, discard=True):
        raise error
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.interrupted.mcap", "a.mcap"]


def test_a_partial_file_that_is_there_is_neither_followed_nor_replaced(tmp_path: Path) -> None:
    path, left = tmp_path / "a.mcap", r"a\.mcap\.partial is left .*`mrac-jax inspect --repair OUT .*` or remove it"
    with LogWriter(path) as first:
        with pytest.raises(UsageError, match=left), LogWriter(path):
            pass
        first.write(first.channel("/x", POSE), 0, b"1")
    assert len(heard(path)) == 1 and not first.partial.exists()
    (tmp_path / "other").write_bytes(b"precious")
    first.partial.symlink_to(tmp_path / "other")
    with pytest.raises(UsageError, match=left), LogWriter(path):
        pass
    assert (tmp_path / "other").read_bytes() == b"precious"
    for target, said in ((tmp_path, "is a folder"), (tmp_path / "no" / "a.mcap", "cannot be written")):
        with pytest.raises(InputError, match=said), LogWriter(target):
            pass


def interrupting(at: int) -> Callable[[FrameType, str, object], object]:
    """A tracer that sends Ctrl-C before the given line, counted from 0, of the writers, ours and the library's."""
    left, files = [at], (container.__file__, str(Path(mcap.__file__).parent))

    def trace(frame: FrameType, event: str, _: object) -> object:
        if not frame.f_code.co_filename.startswith(files) or frame.f_code.co_name == "__exit__":
            return None
        if event == "line":
            left[0] -= 1
            if left[0] == -1:
                signal.raise_signal(signal.SIGINT)
        return trace

    return trace


def test_an_interrupt_at_any_moment_leaves_a_valid_log(tmp_path: Path) -> None:
    """Before any step of the writers, also while the log is finished: then it is whole."""
    lengths = set()
    for step in count():
        path, before = tmp_path / f"{step}.mcap", sys.gettrace()
        try:
            with LogWriter(path, chunk_size=150) as log:
                sys.settrace(interrupting(17 * step))
                for i in range(6):
                    log.write(log.channel("/x", POSE), i, b"%d" % i)
        except KeyboardInterrupt:
            ended = False
        else:
            ended = True
        finally:
            sys.settrace(before)
        said, found = heard(path), open_log(path)
        assert [m[1:] for m in said] == [(i, i, b"%d" % i) for i in range(len(said))]
        assert said_in(found) == said and found.partial in ("", "interrupted")
        assert (len(said) == 6 or found.partial == "interrupted") and log.placed == path
        lengths.add((len(said), found.partial))
        if ended:
            break
    assert len(list(tmp_path.iterdir())) == step + 1 and lengths >= {(0, "interrupted"), (3, "interrupted"), (6, "")}


WRITES_UNTIL_KILLED = """
import sys
from analysis.recording.container import LogSchema, LogWriter
with LogWriter(sys.argv[1], chunk_size=2000) as log:
    log.attach("world.npz", "x/y", b"world")
    log.metadata("mrac-jax", {"seed": "7"})
    channel, i = log.channel("/x", LogSchema("a", "jsonschema", b"{}", "json")), 0
    while True:
        log.write(channel, i, b"%d" % i)
        i += 1
        if i % 100 == 0:
            print(i, flush=True)
"""


def test_kill_9_loses_at_most_the_chunk_in_flight(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen([sys.executable, "-c", WRITES_UNTIL_KILLED, str(path)], stdout=subprocess.PIPE)
    with process.stdout as told:
        while int(told.readline()) < 1000:
            pass
        time.sleep(0.05)
        process.kill()
        written = [int(line) for line in told.read().split()]
    process.wait()
    partial = tmp_path / "a.mcap.partial"
    assert partial.exists() and not path.exists()
    with pytest.raises(InputError, match="inspect --repair"):
        open_log(partial)
    report = recover(partial, path)
    assert partial.exists() and report.attachments == ["world.npz"] and report.metadata == ["mrac-jax"]
    said = heard(path)
    assert [m[1:] for m in said] == [(i, i, b"%d" % i) for i in range(len(said))]
    most_in_flight = 2000 // (9 + 22 + 4)
    assert len(said) >= max(written, default=1000) - most_in_flight
    assert "the end of the file" in str(report.lost[-1]) and open_log(path).partial


@pytest.mark.parametrize("chunk_size", [10, 10**6])
def test_a_full_disk_is_told(tmp_path: Path, chunk_size: int) -> None:
    """Whether a message meets it or the summary at the end: with what is left, and how to have it back."""
    resource = pytest.importorskip("resource")
    before, log = resource.getrlimit(resource.RLIMIT_FSIZE), LogWriter(tmp_path / "a.mcap", chunk_size=chunk_size)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        with pytest.raises(InputError, match=r"a\.mcap: cannot be written \(File too large") as caught, log:
            log.write(log.channel("/x", POSE), 0, os.urandom(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    left = tmp_path / "a.mcap.partial"
    fix = f"{left} holds the data written so far: recover it with `mrac-jax inspect --repair OUT {left}`"
    assert fix in str(caught.value) and [path.name for path in tmp_path.iterdir()] == [left.name]


def test_repeating_the_descriptions_costs_little(tmp_path: Path) -> None:
    """Five channels with schemas of 2 kB each: some percent of a log of full chunks."""
    schemas = [LogSchema(f"s{i}", "protobuf", os.urandom(700) * 3, "protobuf") for i in range(5)]
    sizes = []
    for chunk_size in (2**19, 2**24):
        with LogWriter(tmp_path / "a.mcap", chunk_size=chunk_size) as log:
            ids = [log.channel(f"/{schema.name}", schema) for schema in schemas]
            for i in range(3000):
                log.write(ids[i % 5], i, i.to_bytes(4, "little") * 200)
        sizes.append((tmp_path / "a.mcap").stat().st_size)
        assert len(heard(tmp_path / "a.mcap")) == 3000
    assert sizes[0] < sizes[1] * 1.3


# Hostile logs: a clear error, and nothing written outside the target.


def read(path: Path) -> list[Said] | None:
    """What the ordinary reader makes of a file: messages, or None after a clear error."""
    try:
        log = open_log(path)
        assert all(len(attached.data) <= path.stat().st_size for attached in log.attachments)
        return said_in(log)
    except InputError as error:
        assert str(error).startswith(str(path)) and str(error).isprintable()
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
    assert len(said) == report.messages and read(out) == said
    assert all(line.isprintable() for line in recovered(report).findings)
    return said


def sealed(*parts: records.McapRecord, summary: tuple[records.McapRecord, ...] = (), start: int | None = None) -> bytes:
    """A file of these records whose checksums are all right; `start`: what the footer says."""
    data, tail = RecordBuilder(), RecordBuilder()
    data.write(MAGIC)
    for record in (records.Header("", "x"), *parts):
        record.write(data)
    body = data.end()
    records.DataEnd(zlib.crc32(body)).write(data)
    body += data.end()
    for record in summary:
        record.write(tail)
    described = tail.end()
    at = len(body) if start is None else start
    head = struct.pack("<BQQQ", Opcode.FOOTER, 20, at, 0)
    claimed = (body + described)[at:] if at <= len(body + described) else b""
    records.Footer(at, 0, zlib.crc32(head, zlib.crc32(claimed))).write(tail)
    return body + described + tail.end() + MAGIC


def chunk_of(*parts: records.McapRecord, compression: str = "zstd", **changed: object) -> records.Chunk:
    builder = RecordBuilder()
    for record in parts:
        record.write(builder)
    plain = builder.end()
    packed = {"zstd": zstandard.compress, "lz4": lz4.frame.compress}.get(compression, bytes)(plain)
    chunk = records.Chunk(compression, packed, 0, 0, zlib.crc32(plain), len(plain))
    for name, value in changed.items():
        setattr(chunk, name, value)
    return chunk


SCHEMA = records.Schema(1, b"{}", "jsonschema", "a")
CHANNEL = records.Channel(1, "/x", "json", {}, 1)
SAYS = records.Message(1, 0, b"hello", 0, 0)
SAID: list[Said] = [("/x", 0, 0, b"hello")]
INSIDE = chunk_of(SCHEMA, CHANNEL, SAYS)


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
        for reader in (open_log, lambda path: recover(path, tmp_path / "out.mcap")):
            with pytest.raises(InputError, match="expected an MCAP file"):
                reader(tmp_path / name)
    assert not (tmp_path / "out.mcap").exists()


def claims(data: bytes) -> Iterator[bytes]:
    """The file with each run of four or eight bytes at the places of length fields claiming a lot."""
    for part in parts_of(data):
        for field, size in ((1, 8), (9, 4), (9, 8), (11, 4), (13, 4), (25, 4), (25, 8), (37, 4), (45, 8), (49, 8)):
            for value in (2 ** (8 * size) - 1, 2**31 - 1):
                if part.start + field + size <= part.end:
                    changed, at = bytearray(data), part.start + field
                    changed[at : at + size] = value.to_bytes(size, "little")
                    yield bytes(changed)


def unsealed(data: bytes) -> bytes:
    """Without the checksums of the sections, so that the reader has to look at every record."""
    found = bytearray(data)
    end = next(part for part in parts_of(data) if part.opcode == Opcode.DATA_END)
    found[end.end - 4 : end.end] = bytes(4)
    found[-12:-8] = bytes(4)
    return bytes(found)


def test_huge_claimed_lengths(folder: Path, small: bytes) -> None:
    path, full = folder / "claims.mcap", heard(folder / "small.mcap")
    for i, data in enumerate(list(claims(unsealed(small)))[::3]):
        path.write_bytes(data)
        assert read(path) in (None, full)
        if i % 25 == 0:
            assert set(saved(path) or []) <= set(full)


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 10**9), st.binary(min_size=1, max_size=9)), min_size=1, max_size=4))
@example([(0, b"\0")])
def test_a_mutated_log_is_right_or_refused(folder: Path, small: bytes, changes: list[tuple[int, bytes]]) -> None:
    path, full, data = folder / "mutated.mcap", heard(folder / "small.mcap"), bytearray(small)
    for at, new in changes:
        data[at % len(data) : at % len(data) + len(new)] = new
    path.write_bytes(data)
    assert read(path) == (full if bytes(data) == small else None)
    rescued = saved(path)
    assert rescued is None or [m for m in full if m in set(rescued)] == rescued


@settings(max_examples=30)
@given(st.integers(0, 10**9), st.integers(0, 40), st.binary(max_size=40), st.sampled_from(["replace", "cut", "repeat"]))
def test_without_checksums_still_only_clear_errors(
    folder: Path, small: bytes, at: int, size: int, new: bytes, how: str
) -> None:
    path, full, data = folder / "fuzzed.mcap", heard(folder / "small.mcap"), unsealed(small)
    at %= len(data)
    repeated = data[at : at + 20 * size]
    path.write_bytes(data[:at] + (repeated + repeated if how == "repeat" else new) + data[at + size :])
    if how == "cut":
        path.write_bytes(data[:at])
    read(path)
    assert set(saved(path) or []) <= set(full)


WRONG_CHUNKS = [
    (chunk_of(SAYS), "no channel record found with id 1"),
    (chunk_of(CHANNEL, SAYS), "no schema record found with id 1"),
    (chunk_of(SCHEMA, CHANNEL, SAYS, compression="\x1b[2J", data=b"no"), "crc validation failed"),
    (chunk_of(SCHEMA, CHANNEL, SAYS, data=b"no"), "frame header"),
    (chunk_of(SCHEMA, CHANNEL, SAYS, uncompressed_crc=1), "crc validation failed"),
    (chunk_of(SCHEMA, CHANNEL, SAYS, compression="", data=b"\x05" + bytes(40)), "crc validation failed"),
]


@pytest.mark.parametrize(("chunk", "problem"), WRONG_CHUNKS)
def test_chunks_that_are_wrong(tmp_path: Path, chunk: records.Chunk, problem: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(sealed(chunk))
    with pytest.raises(InputError, match=f"truncated or damaged: .*({problem})"):
        said_in(open_log(path))
    assert read(path) is None and saved(path) is None
    path.write_bytes(sealed(chunk, INSIDE))
    assert saved(path) == SAID


def test_summaries_that_point_anywhere(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    size = len(sealed(INSIDE, summary=(SCHEMA,)))
    for start in (0, 1, 8, 9, 27, 40, 100, size - 40, size - 37, size - 36, size - 1, size, 2**40, 2**63, 2**64 - 1):
        path.write_bytes(sealed(INSIDE, summary=(SCHEMA,), start=start))
        assert read(path) in (None, SAID) and saved(path) == SAID
    for offsets in ([27, 27, 28], [8, 8], [30, 29, 28, 27], [0], [2**63], [*range(8, 120)], [27, 60]):
        indexes = [records.ChunkIndex(2**63, at, "zstd", 1, 0, 0, {1: at}, 0, 1) for at in offsets]
        told = records.Statistics(0, 1, {1: 99}, len(set(offsets)), 99, 0, 0, 0, 1)
        path.write_bytes(sealed(INSIDE, INSIDE, summary=(SCHEMA, CHANNEL, told, *indexes)))
        assert read(path) == saved(path) == SAID * 2


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
from analysis.recording.container import open_log, recover
from planner.errors import InputError
used = int(next(line for line in open("/proc/self/status") if line.startswith("VmSize")).split()[1]) * 1024
resource.setrlimit(resource.RLIMIT_AS, (used + 200 * 2**20,) * 2)
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
for path in sorted(Path(sys.argv[1]).glob("*.mcap")):
    try:
        print(path.name, "read", sum(1 for _ in open_log(path).messages()))
    except InputError as error:
        print(path.name, "refused", recover(path, path.with_suffix(".out")).messages)
"""


def test_bombs_end_in_a_clear_error_where_memory_is_limited(tmp_path: Path) -> None:
    size = 2**29
    for compression in ("zstd", "lz4"):
        packed = bomb(compression, size)
        for claimed in (size, 2**25, 2**60):
            big = records.Chunk(compression, packed, 0, 0, 1, claimed)
            (tmp_path / f"{compression}-{claimed}.mcap").write_bytes(sealed(big, INSIDE, summary=(SCHEMA, CHANNEL)))
    frame = bytearray(zstandard.compress(bytes(300)))
    huge = frame[:4] + bytes([0xE0]) + (2**62).to_bytes(8, "little") + frame[7:]
    (tmp_path / "frame.mcap").write_bytes(sealed(records.Chunk("zstd", bytes(huge), 0, 0, 1, 300), INSIDE))
    told = run_python(LIMITED, str(tmp_path)).splitlines()
    assert len(told) == 7 and {line.split(maxsplit=1)[1] for line in told} == {"refused 1"}


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


def put(data: bytes, folder: Path) -> None:
    """The damaged log, in new files: on some disks to write over others takes 10 ms, thousands of times."""
    for name in ("in.mcap", "out.mcap"):
        (folder / name).unlink(missing_ok=True)
    (folder / "in.mcap").write_bytes(data)


def recovered_from(data: bytes, folder: Path) -> tuple[Recovered, list[Said]]:
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
    told = recovered(report)
    return [told.summary, *told.findings]


def refused(data: bytes, folder: Path) -> None:
    """The ordinary reader tells what to do about a damaged log."""
    put(data, folder)
    said = r"(truncated.*try `mrac-jax inspect --repair OUT .*in\.mcap`|not an MCAP file)"
    with pytest.raises(InputError, match=said):
        list(open_log(folder / "in.mcap").messages())


def test_an_undamaged_log_comes_out_the_same(whole: bytes, tmp_path: Path) -> None:
    report, said = recovered_from(whole, tmp_path)
    assert report.complete and report.lost_messages == 0 and said_of(report)[-1] == "nothing is lost"
    old, new = open_log(tmp_path / "in.mcap"), open_log(tmp_path / "out.mcap")
    assert said == said_in(old) and new.attachments == old.attachments and new.metadata == old.metadata


def flips(whole: bytes, every: bool = False) -> Iterator[tuple[int, Part | None]]:
    """Offsets of every region of the file: of each record its opcode, length, and first, middle and last bytes."""
    yield from ((at, None) for at in (0, 4, 7, len(whole) - 8, len(whole) - 1))
    parts = parts_of(whole)
    ends = {part.opcode: part for part in parts} | {-part.opcode: part for part in reversed(parts)}
    for part in parts if every else dict.fromkeys(ends.values()):
        middle = (part.start + 9 + part.end) // 2
        fields = [0, 1, 8, 9, 25, 33, 41, 53]
        chosen = {part.start + field for field in fields} | {middle, part.end - 4, part.end - 1}
        chosen = set(range(part.start, part.end)) if every else {at for at in chosen if at < part.end}
        yield from ((at, part) for at in sorted(chosen))


def check_flip(whole: bytes, at: int, bit: int, part: Part | None, folder: Path) -> None:
    """All but the damaged record is saved; that one too where nothing that counts is damaged.

    That is a chunk's times and size, which no checksum covers, a bit of compressed data that says nothing, and the
    length of all items of a metadata record, which their own lengths tell too.
    """
    data = bytearray(whole)
    data[at] ^= 1 << bit
    refused(bytes(data), folder)
    report, said = recovered_from(bytes(data), folder)
    opcode, field = (part.opcode, at - part.start) if part else (0, 0)
    chunks = [p for p in parts_of(whole) if p.opcode == Opcode.CHUNK]
    full = [m for p in chunks for m in p.said]
    hurt = opcode == Opcode.CHUNK and not 9 <= field < 33 and not (field >= 53 and said == full)
    assert said == [m for p in chunks if p is not part or not hurt for m in p.said]
    attached, metadata = set(report.attachments), set(report.metadata)
    assert attached <= ATTACHED and len(ATTACHED - attached) == (opcode == Opcode.ATTACHMENT)
    assert metadata <= METADATA and len(METADATA - metadata) <= (opcode == Opcode.METADATA)
    lost = hurt + (attached != ATTACHED) + (metadata != METADATA)
    summary_stands = part is not None and part.start < data_end(whole)
    assert len(report.lost) == lost if summary_stands or not part else len(report.lost) >= lost
    if summary_stands:
        assert report.lost_messages == len(full) - len(said)


def data_end(whole: bytes) -> int:
    return next(part.end for part in parts_of(whole) if part.opcode == Opcode.DATA_END)


def test_one_flipped_bit_in_each_region(whole: bytes, tmp_path: Path) -> None:
    places = list(flips(whole))
    assert {part.opcode for _, part in places if part} >= {1, 2, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}
    for at, part in places:
        check_flip(whole, at, at % 8, part, tmp_path)


@pytest.mark.slow
def test_every_byte_flipped(small: bytes, tmp_path: Path) -> None:
    for at, part in flips(small, every=True):
        check_flip(small, at, (at * 5) % 8, part, tmp_path)


def check_cut(whole: bytes, size: int, folder: Path) -> None:
    """Exactly the records that end before the cut are saved."""
    refused(whole[:size], folder) if size else None
    parts = [part for part in parts_of(whole) if part.end <= size]
    kept = [m for part in parts for m in part.said]
    if not any(part.opcode in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA) for part in parts):
        with pytest.raises(InputError):
            recovered_from(whole[:size], folder)
        return
    report, said = recovered_from(whole[:size], folder)
    assert said == kept
    assert len(report.attachments) == sum(part.opcode == Opcode.ATTACHMENT for part in parts)
    assert len(report.metadata) == sum(part.opcode == Opcode.METADATA for part in parts)
    finished = any(part.opcode == Opcode.DATA_END for part in parts)
    assert report.complete == finished and report.lost_messages is None


def test_cut_at_30_random_places_and_after_every_record(whole: bytes, tmp_path: Path) -> None:
    cuts = np.random.default_rng(5).choice(len(whole), 30, replace=False).tolist()
    for size in [*cuts, *(part.end for part in parts_of(whole))]:
        check_cut(whole, size, tmp_path)


@pytest.mark.slow
def test_cut_at_every_place(small: bytes, tmp_path: Path) -> None:
    for size in range(len(small)):
        check_cut(small, size, tmp_path)


@pytest.mark.parametrize("seed", range(20))
def test_cut_and_flipped_the_rest_is_saved(whole: bytes, tmp_path: Path, seed: int) -> None:
    """Without the summary, and with a broken length in the middle: the scan finds what follows."""
    draws = np.random.default_rng(seed)
    chunks = [part for part in parts_of(whole) if part.opcode == Opcode.CHUNK]
    size = data_end(whole) - 5
    victim = chunks[int(draws.integers(len(chunks) - 1))]
    data = bytearray(whole[:size])
    data[victim.start + 1 : victim.start + 9] = draws.bytes(8)
    data[victim.start + 60 : victim.start + 64] = draws.bytes(4)
    _, said = recovered_from(bytes(data), tmp_path)
    assert said == [m for part in chunks if part is not victim for m in part.said]


@pytest.mark.parametrize("seed", range(10))
def test_bytes_taken_out_or_put_in(whole: bytes, tmp_path: Path, seed: int) -> None:
    """Everything after is moved, so that no offset in the summary is right any more."""
    draws = np.random.default_rng(seed)
    chunks = [part for part in parts_of(whole) if part.opcode == Opcode.CHUNK]
    victim = chunks[int(draws.integers(len(chunks)))]
    at = victim.start + 55 + int(draws.integers(20))
    moved = whole[: at + 7] + draws.bytes(5) + whole[at:] if seed % 2 else whole[:at] + whole[at + 9 :]
    _, said = recovered_from(moved, tmp_path)
    assert said == [m for part in chunks if part is not victim for m in part.said]


def foreign(compression: CompressionType, chunked: bool = True) -> tuple[bytes, list[Said]]:
    """A log by the library's own writer: channels described once, metadata without a checksum."""
    out = io.BytesIO()
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
    report, found = recovered_from(data, tmp_path)
    assert found == said and report.lost_messages == 0
    assert report.metadata == [] and [lost.what for lost in report.lost] == ["metadata"]
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    for place in (9, 30, 37, 60):
        broken = bytearray(data)
        broken[chunks[2].start + place] ^= 1
        report, found = recovered_from(bytes(broken), tmp_path)
        rest = [m for part in chunks if part is not chunks[2] for m in part.said]
        assert found in (rest, said) and report.attachments == ["../../x\0"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "in.mcap", "out.mcap"]


def test_what_only_a_lost_chunk_describes_comes_from_the_summary(tmp_path: Path) -> None:
    data, _ = foreign(CompressionType.ZSTD)
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    broken = bytearray(data)
    broken[chunks[0].end - 1] ^= 1
    rest = [m for part in chunks[1:] for m in part.said]
    assert recovered_from(bytes(broken), tmp_path)[1] == rest
    report, said = recovered_from(bytes(broken[:-40]), tmp_path)
    assert said == [] and any("not described" in str(lost) for lost in report.lost)


def test_messages_outside_chunks_have_no_checksum_and_are_lost(tmp_path: Path) -> None:
    data, said = foreign(CompressionType.NONE, chunked=False)
    report, found = recovered_from(data, tmp_path)
    assert found == [] and report.attachments and report.lost_messages == len(said)


def test_a_message_index_that_lies_does_not_hide_a_chunk(whole: bytes, tmp_path: Path) -> None:
    parts = parts_of(whole)
    data = bytearray(whole[: data_end(whole) - 13])
    indexes = [part for part in parts if part.opcode == Opcode.MESSAGE_INDEX]
    for part in indexes:
        struct.pack_into("<Q", data, part.start + 1, 2**40)
    assert recovered_from(bytes(data), tmp_path)[1] == [m for part in parts for m in part.said]


def test_the_input_is_never_written(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(whole[:2000])
    (tmp_path / "link").symlink_to(path)
    (tmp_path / "hard").hardlink_to(path)
    for out in (path, tmp_path / "link", tmp_path / "hard", tmp_path / ".." / tmp_path.name / "a.mcap"):
        with pytest.raises(UsageError, match="the damaged file itself"):
            recover(path, out)
    path.rename(tmp_path / "b.mcap.recovering")
    with pytest.raises(UsageError, match="the damaged file itself"):
        recover(tmp_path / "b.mcap.recovering", tmp_path / "b.mcap")
    assert (tmp_path / "b.mcap.recovering").read_bytes() == whole[:2000]


def test_what_is_there_is_replaced_only_at_the_end(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "in.mcap").write_bytes(whole[:3000])
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


def test_a_recovered_log_is_recovered_again(whole: bytes, tmp_path: Path) -> None:
    once, said = recovered_from(whole[:3000], tmp_path)
    (tmp_path / "once.mcap").write_bytes((tmp_path / "out.mcap").read_bytes())
    again = recover(tmp_path / "once.mcap", tmp_path / "twice.mcap")
    assert again.complete and again.messages == once.messages and heard(tmp_path / "twice.mcap") == said
    assert open_log(tmp_path / "twice.mcap").partial


def test_the_report_counts_in_english(whole: bytes, tmp_path: Path) -> None:
    one = Recovered(tmp_path / "a", tmp_path / "b", 1, 1, ["x"], ["y"], lost=[Lost("the end", 9, 9)], lost_messages=1)
    lines = said_of(one)
    assert lines[0] == "saved 1 message in 1 chunk, 1 attachment, 1 metadata record"
    assert lines[1:3] == ["lost the end, from byte 9 on", "lost 1 message in all"]
    report, _ = recovered_from(whole[:3000], tmp_path)
    for line in said_of(report):
        assert not re.search(r"bytes ([0-9,]+) to \1(?![0-9,])", line)
