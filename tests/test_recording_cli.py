"""The commands `record` and `inspect` as a user meets them."""

import io
import json
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import FOLDER
from foxglove_schemas_protobuf.Log_pb2 import Log
from helpers import answer_of, assert_same_trace, load_plan
from page_reader import refused
from recordings import nth, rewrite, small_task

import analysis.recording.record
from analysis.cli.app import run
from analysis.recording.container import open_log
from analysis.recording.contents import read_outcomes, read_rollouts
from planner.rollouts.closed_loop import compile_closed_loop, trace_rollouts
from planner.world.world import load_world_file

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
TINY = str(FOLDER / "tiny-3x7-01.npz")
FEW = ("--rollouts", "64")


def recorded(folder: Path, *words: str, source: str = WORLD) -> Path:
    out = folder / "run.mcap"
    assert run(["record", source, "--out", str(out), *words]) == 0
    return out


def inspected(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    """What `inspect` prints, without breaks of lines."""
    capsys.readouterr()
    assert run(["inspect", *words]) == status
    return " ".join(capsys.readouterr().out.split())


TYPED = "threats: [{raster: p.npy, type: x}]\nrobots: {count: 2, matrix: {a: {x: 0.1}, b: {x: 2}}, types: [a, b]}"


STOPPED_BY = [
    ("robots: {count: 2}", {"threat 10 %"}),
    ("robots: {count: 2, hazard_multiplier: [1, 2]}", {"threat 10 %", "threat 19 %"}),
    (TYPED, {"threat 1 %", "threat 20 %"}),
    (
        "moving_threats: [{walk: 0.5, h: 0.3, count: 4}]\nrobots: {count: 2}",
        {"threat 10 %, or a moving threat", "by a moving threat"},
    ),
]


@pytest.mark.parametrize(("keys", "said"), STOPPED_BY)
def test_what_is_said_to_stop_a_robot_is_what_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, keys: str, said: set[str]
) -> None:
    """Half the cells have p = 0.1; `/events` and `inspect` say the same."""
    monkeypatch.chdir(tmp_path)
    p = np.zeros((5, 8))
    p[:, 4:] = 0.1
    np.save("p.npy", p)
    np.save("free.npy", np.zeros((5, 8)))
    Path("s.yaml").write_text(f"map: {{file: {'free' if keys == TYPED else 'p'}.npy}}\n{keys}\n")
    out = recorded(tmp_path, "--ids", "0-31", source="s.yaml")
    capsys.readouterr()
    found = answer_of(capsys, "inspect", str(out))["rollouts"]
    lost = [event["text"] for one in found for event in one["events"] if event["kind"] == "hit"]
    assert {text.split("], ")[1].split(";")[0] for text in lost} == said
    logged = [Log.FromString(bytes(one.data)) for one in open_log(out).messages() if one.topic == "/events"]
    assert [one.message for one in logged if "is lost at" in one.message] == lost


def test_record_replay_inspect(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recorded(tmp_path, *FEW, "--pick", "worst,best", "--outcomes", source=TINY)
    said = capsys.readouterr()
    assert "picked as" in said.out
    assert "worst" in said.out and "all robots lost" in said.out and "stopped" not in said.out
    wrote = [line for line in said.err.splitlines() if line.startswith("wrote ")]
    assert wrote == [f"wrote {out}", f"wrote {tmp_path / 'run.layout.json'}"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.layout.json", "run.mcap"]
    assert json.loads((tmp_path / "run.layout.json").read_text())
    assert "identical" in inspected(capsys, str(out), "--replay", "--all")
    text = inspected(capsys, str(out))
    assert "/map/threat" in text and "is lost at [" in text
    rollouts = list(read_rollouts(out))
    assert f"rollout {rollouts[0].trace.rollout} ends: " in text
    outcomes = read_outcomes(out)
    assert rollouts[0].visited[-1] == outcomes.visited.min()
    assert rollouts[1].visited[-1] == outcomes.visited.max()


def test_json_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recorded(tmp_path, "--robots", "3", "--ids", "0,5,7-9", "--seed", "11", "--json", source=TINY)
    made = json.loads(capsys.readouterr().out)
    assert [row["rollout"] for row in made["rollouts"]] == [0, 5, 7, 8, 9]
    assert (made["settings"]["seed"], made["settings"]["evaluated"], made["bytes"]) == (11, 0, out.stat().st_size)
    replayed = answer_of(capsys, "inspect", str(out), "--replay")
    assert (replayed["identical"], replayed["rollouts"], replayed["difference"]) == (True, 5, "")
    found = answer_of(capsys, "inspect", str(out))
    assert found["topics"]["/rollout/end"] == {"schema": "mrac.End", "messages": 5}
    assert [one["rollout"] for one in found["rollouts"]] == [0, 5, 7, 8, 9]
    assert found["rollouts"][1]["visited"] == pytest.approx(made["rollouts"][1]["visited"])
    assert len(found["rollouts"][0]["events"]) == made["rollouts"][0]["events"]


def test_replay_of_a_changed_file_exits_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recorded(tmp_path, "--robots", "3", "--ids", "2", source=TINY)
    bad = tmp_path / "bad.mcap"
    rewrite(out, bad, change=nth("/rollout/event", 0, lambda data: None))
    assert "NOT identical" in inspected(capsys, str(bad), "--replay", status=1)
    assert answer_of(capsys, "inspect", str(bad), "--replay", status=1)["identical"] is False


def test_recover_tells_what_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("analysis.recording.record.CHUNK_SIZE", 3_000)
    out = recorded(tmp_path, "--ids", "0-3", source=TINY)
    assert run(["inspect", str(out), "--repair", str(tmp_path / "again.mcap")]) == 0
    data = out.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 2 // 3])
    capsys.readouterr()
    assert "try `mrac-jax inspect --repair OUT" in refused(capsys, "inspect", str(cut))
    assert run(["inspect", str(cut), "--repair", str(tmp_path / "cut.recovered.mcap")]) == 1
    told = capsys.readouterr()
    assert "lost" in told.out
    saved = tmp_path / "cut.recovered.mcap"
    assert f"wrote {saved}" in told.err
    whole = [one.trace for one in read_rollouts(out)]
    kept = [one.trace for one in read_rollouts(saved)]
    assert 1 <= len(kept) < 4
    assert kept == whole[: len(kept)]
    assert "incomplete log" in inspected(capsys, str(saved))
    said = f"identical as far as it goes: {len(kept)} of 4 rollouts; the file is recovered"
    assert said in inspected(capsys, str(saved), "--replay")
    found = answer_of(capsys, "inspect", str(saved), "--replay")
    assert (found["identical"], found["partial"], found["rollouts"], found["asked"]) == (True, True, len(kept), 4)
    assert answer_of(capsys, "inspect", str(cut), "--repair", str(saved), status=1)["complete"] is False


def test_another_planners_plan_is_recorded_open_loop(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world, plan = small_task()
    world.save(tmp_path / "world.npz")
    paths = [np.stack(np.divmod(robot.path, world.shape[1]), axis=1).tolist() for robot in plan.robots]
    (tmp_path / "other.json").write_text(json.dumps({"paths": paths}))
    given = ("--plan", str(tmp_path / "other.json"))
    out = recorded(tmp_path, *given, "--ids", "0", source=str(tmp_path / "world.npz"))
    assert next(read_rollouts(out)).loop == "open"
    assert run(["inspect", str(out), "--replay"]) == 0
    capsys.readouterr()
    (tmp_path / "closed").mkdir()
    words = (*given, "--ids", "0,1,2", "--loop", "closed")
    out = recorded(tmp_path / "closed", *words, source=str(tmp_path / "world.npz"))
    loop = compile_closed_loop(load_plan(tmp_path / "other.json", world), world)
    for mine, trace in zip(read_rollouts(out), trace_rollouts(loop, 0, [0, 1, 2]), strict=True):
        assert_same_trace(mine.trace, trace)
    assert run(["inspect", str(out), "--replay"]) == 0


def test_a_saved_plan_is_recorded_too(tmp_path: Path) -> None:
    plan = tmp_path / "plan.json"
    assert run(["plan", TINY, "--robots", "3", "--out", str(plan)]) == 0
    out = recorded(tmp_path, "--plan", str(plan), "--ids", "1", source=TINY)
    assert run(["inspect", str(out), "--replay"]) == 0


def test_pictures_go_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("analysis.recording.pictures.animation_gif", lambda *given, **named: b"GIF89a")  # seconds
    world, _ = small_task()
    world.save(tmp_path / "w.npz")
    picture, animation = tmp_path / "end.png", tmp_path / "run.gif"
    recorded(
        tmp_path, "--ids", "3", "--picture", str(picture), "--animation", str(animation), source=str(tmp_path / "w.npz")
    )
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert animation.read_bytes().startswith(b"GIF8")


WRONG_OPTIONS = [
    (("--out", "run.txt"), "run.txt does not end in .mcap"), (("--out", "no-such-folder/run.mcap"), "no-such-folder"),
    (("--out", "."), ". does not end in .mcap"), (("--out", ""), "--out ''"),
    (("--out", ".mcap"), ".mcap has no name before .mcap"), (("--out", "a.mcap", "--pick", ""), "--pick ''"),
    (("--out", "a.mcap", "--ids", "18446744073709551616"), "ids below 2**32"),
    (("--out", "a.mcap", "--step-seconds", "nan"), "--step-seconds 'nan'"),
    (("--out", "a.mcap", "--picture", "a.jpg"), "does not end in .png"),
    (("--out", "a.mcap", "--animation", "a.mp4"), "does not end in .gif"),
    (("--out", "a.mcap", "--ids", "1", "--pick", "best"), "both --ids and --pick"),
    (("--out", "a.mcap", "--ids", "x"), "--ids 'x'"), (("--out", "a.mcap", "--pick", "middle"), "--pick 'middle'"),
    (("--out", "a.mcap", "--rollouts", "0"), "--rollouts 0"), (("--out", "a.mcap", "--seed", "-1"), "--seed -1"),
    (("--out", "a.mcap", "--step-seconds", "0"), "--step-seconds 0; expected seconds, 1e-06 to 1e+06"),
    (("--out", "a.mcap", "--step-seconds", "501"), "--step-seconds 501; expected seconds, 1e-06 to 500"),
    (("--out", "a.mcap", "--loop", "open", "--threat-checks", "first_visit"), "first_visit needs the closed loop"),
    (("--out", "a.mcap", "--robots", "0"), "--robots 0"), (("--ids", "1"), "out"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "said"), WRONG_OPTIONS)
def test_wrong_options_are_one_line_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: tuple, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert said in refused(capsys, "record", WORLD, *words)
    assert list(tmp_path.iterdir()) == []


def test_inputs_are_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recorded(tmp_path, "--ids", "0", source=TINY)
    before = out.read_bytes()
    capsys.readouterr()
    assert "is an input" in refused(capsys, "inspect", str(out), "--repair", str(out))
    plan = tmp_path / "plan.mcap"
    plan.write_text("{}")
    assert "is an input" in refused(capsys, "record", TINY, "--plan", str(plan), "--out", str(plan))
    state = tmp_path / "run.state.json"
    state.write_text("{}")
    words = f"record {TINY} --state {state} --ids 0 --state-at 1 --out {tmp_path / 'run.mcap'} --force"
    assert "is an input" in refused(capsys, *words.split())
    assert out.read_bytes() == before
    assert plan.read_text() == state.read_text() == "{}"


@pytest.mark.parametrize("option", [[], ["--replay"], ["--repair", "new.mcap"]])
def test_files_that_are_none(option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert "nothing.mcap" in refused(capsys, "inspect", str(tmp_path / "nothing.mcap"), *option)
    (tmp_path / "text.mcap").write_text("hello")
    assert "text.mcap" in refused(capsys, "inspect", str(tmp_path / "text.mcap"), *option)
    (tmp_path / "empty.mcap").touch()
    assert "empty.mcap" in refused(capsys, "inspect", str(tmp_path / "empty.mcap"), *option)
    assert str(tmp_path) in refused(capsys, "inspect", str(tmp_path), *option)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.mcap", "text.mcap"]


def test_a_log_of_somebody_else_is_listed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from analysis.recording.container import LogSchema, LogWriter

    with LogWriter(tmp_path / "other.mcap") as log:
        log.write(log.channel("/speed", LogSchema("", "", b"", "json")), 5 * 10**9, b"{}")
    text = inspected(capsys, str(tmp_path / "other.mcap"))
    assert "/speed" in text
    assert "not a recording of mrac-jax" in text
    assert "settings.json" in refused(capsys, "inspect", str(tmp_path / "other.mcap"), "--replay")


def test_the_timeline_can_be_had_in_full(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = recorded(tmp_path, "--robots", "8", "--ids", "0")
    short, full, none = (inspected(capsys, str(out), "--events", how) for how in ("main", "all", "none"))
    assert short == inspected(capsys, str(out))
    events = len(next(read_rollouts(out)).trace.events)
    assert events > 40
    assert f"and {events - 40} events more" in short
    assert len(full) > len(short)
    assert "rollout 0 ends: " in none
    assert " more: " not in none
    assert "is lost at" not in none


def test_the_default_is_the_median(tmp_path: Path) -> None:
    out = recorded(tmp_path, "--robots", "2", "--rollouts", "101", "--outcomes")
    (one,) = read_rollouts(out)
    assert one.visited[-1] == np.sort(read_outcomes(out).visited)[50]
    assert load_world_file(WORLD).shape == one.shape


THREE = ("record", WORLD, "--robots", "3", "--ids", "0-2", "--force", "--out")


@pytest.fixture
def interrupted(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[str, str]]:
    """What `record` of rollouts 0 to 2 with Ctrl-C in the middle of one says on standard output and error."""
    make = analysis.recording.record.rollout_messages

    def record(out: Path, rollout: int, *words: str) -> tuple[str, str]:
        def messages(stage: Any, trace: Any, clock: Any) -> Iterator[Any]:
            for number, message in enumerate(make(stage, trace, clock)):
                if number == 500 and trace.rollout == rollout:
                    signal.raise_signal(signal.SIGINT)
                yield message

        monkeypatch.setattr(analysis.recording.record, "rollout_messages", messages)
        assert run([*THREE, str(out), *words]) == 130
        monkeypatch.undo()
        return capsys.readouterr()

    return record


def test_ctrl_c_while_recording_leaves_what_is_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], interrupted: Callable[..., tuple[str, str]]
) -> None:
    out = tmp_path / "run.mcap"
    told, err = interrupted(out, 1)
    assert f"interrupted: {out} holds 1 of 3 rollouts" in err and "survived, %" in told
    assert [one.trace.rollout for one in read_rollouts(out)] == [0] and open_log(out).partial == "interrupted"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.layout.json", "run.mcap"]
    assert "incomplete log: interrupted" in inspected(capsys, str(out))
    said = "identical as far as it goes: 1 of 3 rollouts; the file is partial"
    assert said in inspected(capsys, str(out), "--replay")
    before = out.read_bytes()
    told, err = interrupted(out, 2, "--json")
    made = json.loads(told)
    beside = tmp_path / "run.interrupted.mcap"
    assert (made["partial"], made["file"], [row["rollout"] for row in made["rollouts"]]) == (True, str(beside), [0, 1])
    assert made["settings"]["ids"] == [0, 1, 2]
    assert f"{out} existed before and is kept" in err
    assert (tmp_path / "run.interrupted.layout.json").exists()
    assert out.read_bytes() == before


def test_ctrl_c_before_anything_is_done(tmp_path: Path, interrupted: Callable[..., tuple[str, str]]) -> None:
    out = tmp_path / "run.mcap"
    out.write_bytes(b"older")
    said, err = interrupted(out, 0, "--json")
    assert (said, err.splitlines()[-1]) == ("", "interrupted: nothing was recorded")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("run.mcap", b"older")]


def test_a_recording_is_replaced_only_if_somebody_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a pipe by --force alone; at a terminal a person is asked."""
    out = tmp_path / "run.mcap"
    out.write_bytes(b"older")
    words = ["record", TINY, "--ids", "3", "--out", str(out)]
    assert f"{out} is there already; give --force to replace it, or another name" in refused(capsys, *words)
    for answer, replaced in (("\n", False), ("no\n", False), ("y\n", True)):
        out.write_bytes(b"older")
        typed = io.StringIO(answer)
        monkeypatch.setattr(typed, "isatty", lambda: True)
        monkeypatch.setattr(sys, "stdin", typed)
        monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
        assert run(words) == 0
        assert "is there already. Replace it? [y/N]" in capsys.readouterr().err
        assert (out.read_bytes() != b"older") == replaced
    out.write_bytes(b"older")
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    assert run([*words, "--force"]) == 0 and out.read_bytes() != b"older"


def test_ctrl_c_while_drawing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(*given: object, **named: object) -> bytes:
        said.append(capsys.readouterr())
        raise KeyboardInterrupt

    said: list[Any] = []
    monkeypatch.setattr("analysis.recording.pictures.animation_gif", interrupt)
    world, _ = small_task()
    world.save(tmp_path / "w.npz")
    out, gif = tmp_path / "run.mcap", tmp_path / "run.gif"
    words = ["record", str(tmp_path / "w.npz"), "--ids", "3", "--animation", str(gif), "--out", str(out)]
    assert run(words) == 130
    assert "survived, %" in said[0].out
    assert said[0].err.splitlines()[-1] == f"drawing {gif} ..."
    assert capsys.readouterr().err == f"interrupted while drawing; {out} is whole\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.layout.json", "run.mcap", "w.npz"]
    assert run(["inspect", str(out), "--replay"]) == 0


def test_a_file_left_by_a_killed_run_is_not_lost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    left = tmp_path / "run.mcap.partial"
    left.write_bytes(b"precious")
    said = refused(capsys, "record", WORLD, "--ids", "0", "--out", str(tmp_path / "run.mcap"))
    fix = f"recover it with `mrac-jax inspect --repair OUT {left}` or remove it"
    assert f"{left} is left from an earlier run; {fix}" in said
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [(left.name, b"precious")]
