"""What is going on is said in words, on a terminal and on a pipe; compiling is said when something is compiled."""

from __future__ import annotations

import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from analysis.evaluation.evaluate import evaluate
from analysis.sampling import RolloutChoices
from analysis.utils import compiling, progress
from analysis.utils.compiling import Announcer
from analysis.utils.notes import of_things
from analysis.utils.tables import SafeConsole
from planner import jit
from planner.jit import NO_CACHE
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.simulator.rollouts import run_set
from planner.world.levels import place_starts
from planner.world.world import World


def test_every_part_of_an_evaluation_is_announced_and_none_claims_to_be_over_early() -> None:
    """Between two announcements the counts rise to their total at most; the next part begins from nothing."""
    world = World.create([[0, 0.1, 0, 0.2], [0, 0, 0.1, 0]])
    plan = make_plan(world, place_starts(world, 1)[0])
    told: list[object] = []
    choices = RolloutChoices(loop="open", rollouts=200, deadline=3)
    evaluate(
        world,
        plan,
        choices,
        threat_scale=(0.5,),
        band=True,
        doing=told.append,
        progress=lambda done, total, seconds: told.append((done, total)),
    )
    parts = [place for place, said in enumerate(told) if isinstance(said, str)]
    assert [told[place] for place in parts] == [
        "exact values",
        "rollouts",
        "rollouts up to the deadline, step 3",
        "rollouts under 0.5 times the threats",
        "coverage over time",
    ]
    for first, last in zip(parts[1:], [*parts[2:], len(told)], strict=True):
        counts = told[first + 1 : last]
        assert counts, told[first]
        assert counts == sorted(counts)  # type: ignore[type-var]
        assert counts[-1] == ((100, 100) if told[first] == "coverage over time" else (200, 200))


def test_what_is_counted_may_be_other_things_than_rollouts() -> None:
    with progress.show_progress(asked=False) as watch:
        of_things(watch, "exact values")(3, 9, 1.0)
        assert watch.line() == "rollouts ... 3 of 9 exact values, 2 s left"
        watch(64, 128, 1.0)
        assert "64 of 128 rollouts" in watch.line()
    told: list[tuple[float, ...]] = []
    of_things(lambda *numbers: told.append(numbers), "exact values")(3, 9, 1.0)
    assert told == [(3, 9, 1.0)], "who asked for numbers gets no words"


def test_a_terminal_s_bar_is_empty_again_when_something_else_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(progress, "SafeConsole", lambda **_: SafeConsole(file=screen, force_terminal=True, width=100))
    with progress.show_progress() as watch:
        watch(100, 100, 1.0)
        watch._bar.refresh()
        assert "100 of 100 rollouts" in screen.getvalue()
        watch.doing("pictures and page")
        (task,) = watch._bar.tasks
        assert (task.total, task.completed, task.description) == (None, 0, "pictures and page")
        screen.truncate(0)
        watch._bar.refresh()
        assert "pictures and page" in screen.getvalue()
        assert "100 of 100" not in screen.getvalue()


def test_a_pipe_is_told_where_a_long_run_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "FIRST", 0.05)
    monkeypatch.setattr(progress, "EVERY", 0.05)
    with progress.show_progress() as watch:
        watch(30, 120, 1.0)
        deadline = time.monotonic() + 10
        err = ""
        while "30 of 120" not in err and time.monotonic() < deadline:
            time.sleep(0.02)
            err += capsys.readouterr().err
    assert "rollouts ... 30 of 120 rollouts, 3 s left" in err
    monkeypatch.undo()
    assert progress.FIRST + progress.EVERY <= 3, "nothing is said for longer"
    with progress.show_progress() as watch:
        watch.doing("coverage over time")
    assert capsys.readouterr().err == ""


def test_a_compilation_is_named_with_the_seconds_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one code all compilations together, the inner ones once; of another code from the start again."""
    now = 0.0
    monkeypatch.setattr(compiling.time, "monotonic", lambda: now)
    announcer = Announcer()
    compiles, parts = announcer.line, ((announcer.begins, 0), (announcer.begins, 5), (announcer.ends, 0))
    announcer.what = "per_cell"
    for part, seconds in parts:
        part()
        now += seconds
    assert compiles() == "compiling per_cell, first run only, 5 s so far"
    now += 65.0
    announcer.ends()
    assert compiles() == ""
    announcer.begins()
    assert compiles() == "", "so short that nobody needs to know"
    now += 2.0
    assert compiles() == "compiling per_cell, first run only, 1 min 12 s so far"
    announcer.ends()
    announcer.what = "mrac"
    announcer.begins()
    now += 3.0
    monkeypatch.setenv(NO_CACHE, "1")
    assert compiles() == "compiling mrac, in every run, as compiled code is not kept, 3 s so far"


def test_a_progress_line_says_what_is_compiled_for_what(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a pipe and on a terminal; what is compiled is the simulator of the plan that was made ready last."""
    announcer, now = Announcer(), 0.0
    monkeypatch.setattr(compiling.time, "monotonic", lambda: now)
    for module in (compiling, progress):
        monkeypatch.setattr(module, "ANNOUNCER", announcer)
    world = World.create([[0, 0.1]])
    plan = make_plan(world, [[0, 0]], Settings(policy="per_cell"))
    with progress.show_progress(asked=False) as watch:
        watch.doing("alternatives")
        assert watch.line_after(8) == "alternatives ... (8 s)"
        for loop, name in (("closed", "per_cell"), ("open", "the open loop")):
            compiling.compiles_for(plan, loop)
            announcer.begins()
            now += 35.0
            assert watch.line_after(37) == f"compiling {name}, first run only, 35 s so far; alternatives"
            announcer.ends()
    screen = io.StringIO()
    monkeypatch.setattr(progress, "SafeConsole", lambda **_: SafeConsole(file=screen, force_terminal=True, width=120))
    with progress.show_progress() as watch:
        announcer.begins()
        now += 2.0
        watch._bar.refresh()
        assert "compiling the open loop, first run only, 37 s so far; rollouts" in screen.getvalue()
        with watch.paused():
            print("the answer")  # noqa: T201 - where the bar was
    assert capsys.readouterr().out == "the answer\n"


def test_processes_that_will_compile_are_known_by_their_policies(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    monkeypatch.setattr(compiling.ANNOUNCER, "begins", lambda: begun.append(1))
    monkeypatch.setattr(jit, "is_cached", lambda program: program is run_set)
    for policies, said in ((["mrac"], 0), (["per_cell"], 1), (["mrac", "per_cell"], 2)):
        with compiling.compiling_elsewhere(policies):
            assert len(begun) == said


@pytest.mark.parametrize("jax", [False, True], ids=["numba", "jax"])
def test_both_compilers_report_to_the_announcer_and_a_cache_does_not(tmp_path: Path, jax: bool) -> None:
    """A process of its own, for Numba twice: the second finds all in the cache."""
    numba_code = (
        "import numba\nfrom pathlib import Path\nnumba.config.CACHE_DIR = {folder!r}\n"
        "from tests_small import double\n"
        "double(3)\n"
    )
    jax_code = (
        "import jax, os\nos.environ['XDG_CACHE_HOME'] = {folder!r}\n"
        "import mrac_jax.runtime\nmrac_jax.runtime.keep_jax_programs()\n"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0.0)\n"
        "for axis in (0, 1):\n"
        "    jax.jit(lambda x: jax.numpy.sort(x, axis))(jax.numpy.zeros((9, 9))).block_until_ready()\n"
    )
    (tmp_path / "tests_small.py").write_text(
        "import numba\n@numba.njit(cache=True)\ndef double(x):\n    return 2 * x\n"
    )
    code = (
        "from analysis.utils import compiling\ncompiling.notice_compiling()\n"
        "compiling.PATIENCE, seen, ends = 0.0, [], compiling.ANNOUNCER.ends\n"
        "compiling.ANNOUNCER.ends = lambda: (seen.append(compiling.ANNOUNCER.line()), ends())\n"
        + (jax_code if jax else numba_code).format(folder=str(tmp_path / "cache"))
        + "assert all('so far' in line for line in seen)\nprint(len(seen))\n"
    )
    paths = os.pathsep.join([str(tmp_path), str(Path(__file__).parent.parent)])
    environment = os.environ | {"PYTHONPATH": paths}
    counts = []
    for _ in range(1 if jax else 2):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=False, timeout=300
        )
        assert done.returncode == 0, done.stderr
        counts.append(int(done.stdout))
        assert done.stderr == ""
    assert counts[0] > jax  # several programs
    if not jax:  # JAX says that it begins before it looks into the cache; what it finds there is there in no time
        assert counts[1] == 0
    else:
        assert list((tmp_path / "cache").rglob("jax/*.sealed"))


@pytest.mark.slow
def test_a_first_run_says_that_it_compiles_and_prints_one_json_object(tmp_path: Path) -> None:
    np_world = tmp_path / "world.npz"
    World.create([[0, 0.1, 0, 0.2], [0, 0, 0.1, 0]]).save(np_world)
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    words = [sys.executable, "-m", "analysis.cli.app", "evaluate", str(np_world), "--rollouts", "50", "--json"]
    said = []
    for _ in range(2):
        done = subprocess.run(words, capture_output=True, text=True, env=environment, check=True, timeout=600)
        assert json.loads(done.stdout)["rollouts"] == 50
        said.append(bool(re.search(r"compiling mrac, first run only, \d+ s so far", done.stderr)))
    assert said == [True, False]
