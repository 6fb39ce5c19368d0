"""Recovery: every intact chunk of a damaged log, nothing invented, whatever byte is wrong and wherever it is cut."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.writer import CompressionType, Writer
from recording_logs import Part, Said, heard, parts_of, sample, stream_of

from analysis.recording.log_reader import Lost, Recovered, open_log, recover
from analysis.recording.log_writer import RECOVERED
from analysis.recording.replay import recovered as in_words
from planner.errors import InputError, UsageError

ATTACHED = {"world.npz", "tally.json", "last.bin"}
METADATA = {"mrac-jax", "end"}


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.log_writer.os.fsync", lambda number: None)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
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


def recovered(data: bytes, folder: Path) -> tuple[Recovered, list[Said]]:
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
    with pytest.raises(InputError, match=r"(truncated.*try `mrac-jax recover .*in\.mcap`|not an MCAP file)"):
        list(open_log(folder / "in.mcap").messages())


def test_an_undamaged_log_comes_out_the_same(whole: bytes, tmp_path: Path) -> None:
    report, _ = recovered(whole, tmp_path)
    assert report.complete and report.lost_messages == 0 and said_of(report)[-1] == "nothing is lost"
    assert (tmp_path / "out.mcap").read_bytes() == whole


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

    That is a chunk's times, which no checksum covers, a bit of compressed data that says nothing, and the length of all
    items of a metadata record, which their own lengths tell too.
    """
    data = bytearray(whole)
    data[at] ^= 1 << bit
    refused(bytes(data), folder)
    report, said = recovered(bytes(data), folder)
    opcode, field = (part.opcode, at - part.start) if part else (0, 0)
    chunks = [p for p in parts_of(whole) if p.opcode == Opcode.CHUNK]
    full = [m for p in chunks for m in p.said]
    hurt = opcode == Opcode.CHUNK and not 9 <= field < 25 and not (field >= 53 and said == full)
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
            recovered(whole[:size], folder)
        return
    report, said = recovered(whole[:size], folder)
    assert said == kept
    assert len(report.attachments) == sum(part.opcode == Opcode.ATTACHMENT for part in parts)
    assert len(report.metadata) == sum(part.opcode == Opcode.METADATA for part in parts)
    finished = any(part.opcode == Opcode.DATA_END for part in parts)
    assert report.complete == finished and report.lost_messages is None


def test_cut_at_80_random_places_and_after_every_record(whole: bytes, tmp_path: Path) -> None:
    cuts = np.random.default_rng(5).choice(len(whole), 80, replace=False).tolist()
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
    _, said = recovered(bytes(data), tmp_path)
    assert said == [m for part in chunks if part is not victim for m in part.said]


@pytest.mark.parametrize("seed", range(10))
def test_bytes_taken_out_or_put_in(whole: bytes, tmp_path: Path, seed: int) -> None:
    """Everything after is moved, so that no offset in the summary is right any more."""
    draws = np.random.default_rng(seed)
    chunks = [part for part in parts_of(whole) if part.opcode == Opcode.CHUNK]
    victim = chunks[int(draws.integers(len(chunks)))]
    at = victim.start + 55 + int(draws.integers(20))
    moved = whole[: at + 7] + draws.bytes(5) + whole[at:] if seed % 2 else whole[:at] + whole[at + 9 :]
    _, said = recovered(moved, tmp_path)
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
    report, found = recovered(data, tmp_path)
    assert found == said and report.lost_messages == 0
    assert report.metadata == [] and [lost.what for lost in report.lost] == ["metadata"]
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    for place in (9, 30, 37, 60):
        broken = bytearray(data)
        broken[chunks[2].start + place] ^= 1
        report, found = recovered(bytes(broken), tmp_path)
        rest = [m for part in chunks if part is not chunks[2] for m in part.said]
        assert found in (rest, said) and report.attachments == ["../../x\0"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "in.mcap", "out.mcap"]


def test_what_only_a_lost_chunk_describes_comes_from_the_summary(tmp_path: Path) -> None:
    data, _ = foreign(CompressionType.ZSTD)
    chunks = [part for part in parts_of(data) if part.opcode == Opcode.CHUNK]
    broken = bytearray(data)
    broken[chunks[0].end - 1] ^= 1
    rest = [m for part in chunks[1:] for m in part.said]
    assert recovered(bytes(broken), tmp_path)[1] == rest
    report, said = recovered(bytes(broken[:-40]), tmp_path)
    assert said == [] and any("nothing describes" in str(lost) for lost in report.lost)


def test_messages_outside_chunks_have_no_checksum_and_are_lost(tmp_path: Path) -> None:
    data, said = foreign(CompressionType.NONE, chunked=False)
    report, found = recovered(data, tmp_path)
    assert found == [] and report.attachments and report.lost_messages == len(said)


def test_a_message_index_that_lies_does_not_hide_a_chunk(whole: bytes, tmp_path: Path) -> None:
    parts = parts_of(whole)
    data = bytearray(whole[: data_end(whole) - 13])
    indexes = [part for part in parts if part.opcode == Opcode.MESSAGE_INDEX]
    for part in indexes:
        struct.pack_into("<Q", data, part.start + 1, 2**40)
    assert recovered(bytes(data), tmp_path)[1] == [m for part in parts for m in part.said]


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
        patched.setattr("analysis.recording.log_reader._save_chunk", interrupted)
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
    once, said = recovered(whole[:3000], tmp_path)
    (tmp_path / "once.mcap").write_bytes((tmp_path / "out.mcap").read_bytes())
    again = recover(tmp_path / "once.mcap", tmp_path / "twice.mcap")
    assert again.complete and again.messages == once.messages and heard(tmp_path / "twice.mcap") == said
    assert open_log(tmp_path / "twice.mcap").partial


def test_the_report_counts_in_english(whole: bytes, tmp_path: Path) -> None:
    one = Recovered(tmp_path / "a", tmp_path / "b", 1, 1, ["x"], ["y"], lost=[Lost("the end", 9, 9)], lost_messages=1)
    lines = said_of(one)
    assert lines[0] == "saved 1 message in 1 chunk, 1 attachment, 1 metadata record"
    assert lines[1:3] == ["lost the end, from byte 9 on", "lost 1 message in all"]
    report, _ = recovered(whole[:3000], tmp_path)
    for line in said_of(report):
        assert not re.search(r"bytes ([0-9,]+) to \1(?![0-9,])", line)
