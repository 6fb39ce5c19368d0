"""Progress: in words on a terminal, and of the functions of the Python interface, which can be interrupted."""

import inspect
import io
import json
import math
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from helpers import after

import mrac_jax as mrac
from analysis import api
from analysis.cli.app import app, run
from analysis.cli.options import COMMANDS
from analysis.evaluation.evaluate import evaluate
from analysis.sampling import RolloutChoices
from analysis.utils import progress
from analysis.utils.notes import of_things
from analysis.utils.progress import Announcer, Interrupted, ask
from analysis.utils.tables import SafeConsole
from planner.make_plan import make_plan
from planner.settings import Settings
from planner.simulator import jit
from planner.simulator.jit import NO_CACHE
from planner.world.start_rule import place_starts
from planner.world.world import World

# What is going on is said in words, on a terminal and on a pipe; compiling is said when something is compiled.


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


def test_a_compilation_is_named_with_the_seconds_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of one code all compilations together, the inner ones once; of another code from the start again."""
    now = 0.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    announcer = Announcer()
    compiles, parts = announcer.line, ((announcer.begins, 0), (announcer.begins, 5), (announcer.ends, 0))
    announcer.what = "per_cell"
    for part, seconds in parts:
        part()
        now += seconds
    assert compiles() == "compiling per_cell, first such run, 5 s so far"
    now += 65.0
    announcer.ends()
    assert compiles() == ""
    announcer.begins()
    assert compiles() == "", "so short that nobody needs to know"
    now += 2.0
    assert compiles() == "compiling per_cell, first such run, 1 min 12 s so far"
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
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    monkeypatch.setattr(progress, "ANNOUNCER", announcer)
    world = World.create([[0, 0.1]])
    plan = make_plan(world, [[0, 0]], Settings(policy="per_cell"))
    with progress.show_progress(asked=False) as watch:
        watch.doing("alternatives")
        assert watch.line_after(8) == "alternatives ... (8 s)"
        for loop, name in (("closed", "per_cell"), ("open", "the open loop")):
            progress.announce_compilation(plan, loop)
            announcer.begins()
            now += 35.0
            assert watch.line_after(37) == f"compiling {name}, first such run, 35 s so far; alternatives"
            announcer.ends()
    screen = io.StringIO()
    monkeypatch.setattr(progress, "SafeConsole", lambda **_: SafeConsole(file=screen, force_terminal=True, width=120))
    with progress.show_progress() as watch:
        announcer.begins()
        now += 2.0
        watch._bar.refresh()
        assert "compiling the open loop, first such run, 37 s so far; rollouts" in screen.getvalue()
        with watch.paused():
            print("the answer")  # noqa: T201 - where the bar was
    assert capsys.readouterr().out == "the answer\n"


@pytest.mark.parametrize("cached", [True, False])
def test_a_compilation_in_other_processes_is_announced(cached: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[int] = []
    monkeypatch.setattr(progress.ANNOUNCER, "begins", lambda: begun.append(1))
    monkeypatch.setattr(jit, "is_cached", lambda program: cached)
    with progress.compiling_elsewhere(["mrac"]):
        assert len(begun) == (not cached)


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
        "from analysis.utils import progress as compiling\ncompiling.notice_compiling()\n"
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
        said.append(bool(re.search(r"compiling mrac, first such run, \d+ s so far", done.stderr)))
    assert said == [True, False]


# What a function of the door does while it works: it shows how far it is, and an interruption ends a user's loop.

SWEEP = "base: {kind: contiguous, size: 8x11, ratio: 0.2}\nmaps: 40\nrollouts: 30\n"


def small_world() -> mrac.World:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7], threat[0, 8] = 0.2, np.nan
    return mrac.load(threat)


def jobs(folder: Path) -> dict[str, tuple[int, Callable[..., Any]]]:
    """The calls after which something is done, and each function that can be interrupted."""
    world = small_world()
    plan = mrac.plan(world, 2)
    (folder / "a.yaml").write_text(SWEEP)
    return {
        "evaluate": (3, lambda **how: mrac.evaluate(world, plan, rollouts=100_000_000, **how)),
        "compare": (3, lambda **how: mrac.compare((world, plan), (world, mrac.plan(world, 3)), **how)),
        "size": (2, lambda **how: mrac.size(world, target=0.99, most=9, exact="never", **how)),
        "front": (3, lambda **how: mrac.front(world, 2, **how)),
        "starts": (2, lambda **how: mrac.starts(world, 1, **how)),
        "remove": (2, lambda **how: mrac.threats(world, 2, remove=1, **how)),
        "add": (2, lambda **how: mrac.threats(world, 2, add=1, **how)),
        "check": (2, lambda **how: mrac.check(world, plan, **how)),
        "record": (2, lambda **how: mrac.record(world, plan, folder / "a.mcap", ids=range(9), **how)),
        "sweep": (2, lambda **how: mrac.sweep(folder / "a.yaml", folder / "a.store", processes=1, **how)),
        "paper": (2, lambda **how: mrac.check(paper="fig4", maps=5, rollouts=8, processes=1, **how)),
    }


@pytest.mark.parametrize("name", ["evaluate", "compare", "size", "front", "sweep"])
def test_an_interruption_ends_a_loop_and_has_what_was_done(name: str, tmp_path: Path) -> None:
    calls, job = jobs(tmp_path)[name]
    done = []
    with pytest.raises(KeyboardInterrupt) as raised:
        for number in range(3):
            done.append(number)
            job(progress=after(calls))
    assert done == [0]
    assert isinstance(raised.value, Interrupted) and raised.value.partial is not None and raised.value.partial.partial
    if name != "sweep":  # what it did is in its store, which the second run goes on with
        answer = job(progress=after(calls), on_interrupt="return")
        assert answer.partial is True


def test_an_interruption_before_anything_is_done_is_raised_whatever_was_asked() -> None:
    world = small_world()
    for how in ("raise", "return"):
        with pytest.raises(Interrupted) as raised:
            mrac.evaluate(world, 2, progress=after(1), on_interrupt=how)  # type: ignore[arg-type]
        assert raised.value.partial is None


def test_every_function_that_shows_progress_says_how(tmp_path: Path) -> None:
    for name in jobs(tmp_path):
        function = getattr(mrac, {"remove": "threats", "add": "threats", "paper": "check"}.get(name, name))
        assert {"progress", "on_interrupt"} <= set(inspect.signature(function).parameters), name
        assert "progress" in function.__doc__ and "on_interrupt" in function.__doc__, name
    with pytest.raises(mrac.InputError, match="on_interrupt"):
        mrac.evaluate(small_world(), on_interrupt="ignore")  # type: ignore[arg-type]
    with pytest.raises(mrac.InputError, match="progress='yes'"):
        mrac.evaluate(small_world(), progress="yes")  # type: ignore[arg-type]


class Done:
    partial = False


def slowly(seconds: float) -> Callable[[Any, Any], Done]:
    """Work that is at its half after a moment."""

    def work(tell: Any, doing: Any) -> Done:
        tell(30, 60, 30.0)
        time.sleep(seconds)
        return Done()

    return work


def test_a_terminal_has_a_bar_a_pipe_lines_if_asked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert progress.FIRST + progress.EVERY <= 3, "nothing is said for longer"
    ask(slowly(0.2), True, "raise")
    monkeypatch.setattr(progress, "FIRST", 0.05)
    monkeypatch.setattr(progress, "EVERY", 0.05)
    ask(slowly(0.2), None, "raise")
    ask(slowly(0.2), False, "raise")
    assert capsys.readouterr().err == ""
    ask(slowly(0.2), True, "raise")
    assert "rollouts ... 30 of 60 rollouts, 30 s left (1 s)" in capsys.readouterr().err
    screen = io.StringIO()
    monkeypatch.setattr(progress, "SafeConsole", lambda **_: SafeConsole(file=screen, force_terminal=True, width=100))
    ask(slowly(0.2), None, "raise")
    assert "30 of 60 rollouts" in screen.getvalue()
    before = screen.tell()
    ask(slowly(0.2), False, "raise")
    assert screen.tell() == before


def test_a_notebook_has_a_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    class Handle:
        def update(self, data: dict[str, str], raw: bool) -> None:
            seen.append(data["text/plain"])

    def display(data: dict[str, str], raw: bool, display_id: bool) -> Handle:
        seen.append(data["text/plain"])
        return Handle()

    module = ModuleType("IPython.display")
    module.display = display  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", ModuleType("IPython"))
    monkeypatch.setitem(sys.modules, "IPython.display", module)
    monkeypatch.setattr(progress, "SafeConsole", lambda **_: SafeConsole(file=io.StringIO(), force_jupyter=True))
    monkeypatch.setattr(progress, "REFRESH", 0.05)
    ask(slowly(0.3), None, "raise")
    assert len(seen) > 2 and seen[0].startswith("rollouts ... 30 of 60 rollouts, 30 s left") and seen[-1] == ""
    seen.clear()
    ask(slowly(0.0), None, "raise")
    assert not seen


FILES = {"out", "json", "csv", "plot", "picture", "animation", "plan_out", "scenario_out", "waypoints", "altitude",
         "force", "state_at", "parquet", "merge", "figure", "store", "path"}  # fmt: skip
"""Options that name files, or what stands in them: in Python methods of answers, plans and stores."""
OF_THE_WORLD = set(inspect.signature(mrac.load).parameters) | {"sensor_range"}
"""Options that in Python are arguments of `load`, or methods of `World`."""
OF_THE_PLAN = set(inspect.signature(mrac.plan).parameters)
"""Options that in Python are arguments of `plan`, where a function takes a plan."""
TAKE_A_PLAN = {"evaluate", "compare", "check", "export", "record", "drive"}
OTHERWISE = {"evaluate": {"theory"}, "compare": {"plan"}, "drive": {"outlook"}, "inspect": {"events"}}
"""Other options that in Python are methods of the answer, or arguments of a side."""
OF_PYTHON = {
    "world", "plan", "a", "b", "spec", "store", "path", "progress", "on_interrupt", "starts", "out", "policy", "band",
    "options", "force", "step_seconds", "speed", "altitude", "file", "show", "made",
}  # fmt: skip
"""Arguments that a command has as INPUT, or that are about the call itself."""


def options_of(command: str) -> set[str]:
    """The options of a command, as arguments of Python are named."""
    names = {name for one in app[command].assemble_argument_collection() for name in one.names}
    names = {name for name in names if name.startswith("--") and not name.startswith(("--no-", "--empty-"))}
    names = {f"{name[4:]}_b" if name[:4] == "--b." else name[2:] for name in names}
    return {name.replace("-", "_") for name in names} - {"plan_b"}


def test_commands_and_functions_take_the_same_options() -> None:
    for command in (name for name in app if not name.startswith("-")):
        options, taken = options_of(command), set(inspect.signature(getattr(mrac, command)).parameters)
        elsewhere = FILES | OF_THE_WORLD | OTHERWISE.get(command, set())
        elsewhere |= OF_THE_PLAN if command in TAKE_A_PLAN else set()
        sides = {f"{name}_b" for name in elsewhere | OF_THE_PLAN}
        assert options - taken - elsewhere - sides == set(), f"mrac.{command} lacks options of `mrac-jax {command}`"
        assert taken - options - OF_PYTHON == set(), f"`mrac-jax {command}` lacks arguments of mrac.{command}"


def test_the_table_has_the_defaults_and_names_of_every_shared_option() -> None:
    """Options have one statement, in `OPTIONS`; the signatures of functions have no other defaults."""
    for command in COMMANDS:
        for name, option in command.options.items():
            assert option.help and option.help.endswith("."), (command.name, name)
            if command.name in mrac.__all__ and name in (
                found := inspect.signature(getattr(mrac, command.name)).parameters
            ):
                given = None if found[name].default is inspect.Parameter.empty else found[name].default
                assert option.default in (None, given) or given is None, (command.name, name)


def test_help_shows_fifteen_options_of_evaluate_and_all_of_them_on_demand(capsys: pytest.CaptureFixture[str]) -> None:
    shown = {}
    for flag in ("--help", "--help-all"):
        assert run(["evaluate", flag]) == 0
        said = capsys.readouterr().out
        shown[flag] = set(re.findall(r"│ (?:\* )? *(--[a-z-]+)", said))
        assert max(map(len, said.splitlines())) <= 110 and "[bold" not in said
    assert len(shown["--help"]) == 15
    assert {f"--{name.replace('_', '-')}" for name in options_of("evaluate")} == shown["--help-all"]


def test_searches_pass_every_option_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is given arrives: settings in Settings, rollouts in RolloutChoices; an unknown name is refused."""
    world = small_world()
    settings = {"levels": 3, "density": 5.0, "risk": "log", "max_steps": 900, "range": 700, "weibull_shape": 2.0,
                "recharge": 4, "hazard_multiplier": 0.5, "return_to": [[0, 0]], "radio": 30.0,
                "in_area": "rows"}  # fmt: skip
    policy = {"policy": "per_cell", "risk_cap": 0.5, "robot_value": 40.0}
    rolled = {
        "rollouts": 77, "seed": 5, "deadline": 300, "threat_checks": "every_visit", "engine": "numba",
        "exact": "never",
    }  # fmt: skip
    finders = {
        "starts": "start_positions.find_starts",
        "threats": "threats.find_attack",
        "front": "pareto.find_front",
        "size": "team_size.find_size",
    }
    for name, finder in finders.items():
        seen: list[Any] = []

        def find(*given: Any, seen: list[Any] = seen, **more: Any) -> Done:
            seen.extend(given)
            return Done()

        monkeypatch.setattr(f"analysis.search.{finder}", find)
        asked = settings | ({} if name == "front" else policy) | ({"target": 0.5} if name in ("size", "front") else {})
        asked |= {"add": 1} if name == "threats" else {}
        getattr(mrac, name)(world, **({} if name == "size" else {"robots": 2}), **asked, **rolled, progress=False)
        (made,) = [one for one in seen if isinstance(one, mrac.Settings)]
        (choices,) = [one for one in seen if isinstance(one, RolloutChoices)]
        for key, value in (settings | ({} if name == "front" else policy)).items():
            assert getattr(made, key) == (((0, 0),) if key == "return_to" else value), (name, key)
        for key in rolled.keys() - {"threat_checks"}:
            assert getattr(choices, key) == rolled[key], (name, key)
        with pytest.raises(mrac.InputError, match=f"^{name} has no argument 'rolouts'; .* did you mean 'rollouts'"):
            getattr(mrac, name)(world, rolouts=3)


SAVED = {
    "plan": lambda world, file, **how: mrac.plan(world, 2).save(file / "p.json", **how),
    "world": lambda world, file, **how: world.save(file / "w.npz", **how),
    "state": lambda world, file, **how: state_of(world).save(file / "s.json", **how),
    "mission": lambda world, file, **how: mrac.drive(world, 2).save(file / "m.json", **how),
    "answer": lambda world, file, **how: mrac.check(world, 1, rollouts=64, progress=False).save(file / "a", **how),
    "comparison": lambda world, file, **how: mrac.compare((world, 1), (world, 2), rollouts=64, progress=False).save(
        file / "c", **how
    ),
    "export": lambda world, file, **how: mrac.export(world, 2, file / "e.csv", **how),
    "folder": lambda world, file, **how: mrac.export(world, 2, file / "nav", to="nav2", **how),
    "record": lambda world, file, **how: mrac.record(world, 2, file / "r.mcap", ids=[0], progress=False, **how),
}


def state_of(world: mrac.World) -> Any:
    mission = mrac.drive(world, 2)
    mission.advance()
    return mission.state


@pytest.mark.parametrize("name", SAVED)
def test_nothing_is_replaced_unasked(name: str, tmp_path: Path) -> None:
    """The second call is refused, names a file and the fix, and changes no byte; `force=True` replaces."""
    world, save = small_world(), SAVED[name]
    save(world, tmp_path)
    files = sorted(file for file in tmp_path.rglob("*") if file.is_file())
    for file in files:
        file.write_text("mine")
    with pytest.raises(mrac.InputError, match=r"is there already; give force=True to replace it, or another name"):
        save(world, tmp_path)
    assert [file.read_text() for file in files] == ["mine"] * len(files)
    assert sorted(file for file in tmp_path.rglob("*") if file.is_file()) == files
    save(world, tmp_path, force=True)
    assert all(file.read_bytes() != b"mine" for file in files)


def test_a_mission_replaces_its_own_file(tmp_path: Path) -> None:
    world, file = small_world(), tmp_path / "now.json"
    mission = mrac.drive(world, 2)
    for _ in range(2):
        mission.save(file)
        mission.advance()
    again = mrac.drive(world, 2, state=file)
    again.save(file)
    with pytest.raises(mrac.InputError, match="is there already"):
        mrac.drive(world, 2).save(file)


@pytest.mark.parametrize(
    "words", ["plan {world} --out {out}", "front {world} --losses 1 --rollouts 64 --plan-out {out}"]
)
def test_commands_replace_no_plan_unasked(words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world, out = tmp_path / "w.npz", tmp_path / "go.json"
    small_world().save(world)
    out.write_text("mine")
    given = words.format(world=world, out=out).split()
    assert run(given) == 2
    assert capsys.readouterr().err.endswith(
        f"error: {out} is there already; give --force to replace it, or another name\n"
    )
    assert out.read_text() == "mine"
    if given[0] == "plan":
        assert run([*given, "--force"]) == 0
        assert mrac.read_plan(out, small_world()).robots


def test_an_input_error_is_a_value_error_that_nothing_swallows(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where a library's ValueError is told otherwise, an InputError stays what it was; so it does between processes."""
    with pytest.raises(ValueError, match="robots=0"):
        mrac.plan(small_world(), 0)
    with pytest.raises(mrac.InputError) as raised:
        mrac.load(tmp_path / "none.yaml")
    assert str(raised.value).endswith("none.yaml: no such file; expected a map") or "no such file" in str(raised.value)
    error = pickle.loads(pickle.dumps(raised.value))
    assert (type(error), str(error), error.problem) == (type(raised.value), str(raised.value), raised.value.problem)
    assert str(type(error)(error)) == str(error)  # as libraries raise again what another process raised
    for call in (mrac.size, api.size, mrac.evaluate, api.evaluate):  # with hints, and without
        with pytest.raises(mrac.InputError, match="has no argument 'rolouts'") as raised:
            call(small_world(), rolouts=lambda: 3)
        error = pickle.loads(pickle.dumps(raised.value))
        assert (str(error), error.expected, error.fix) == (str(raised.value), raised.value.expected, raised.value.fix)
        assert str(type(error)(error)) == str(error)
        assert ("did you mean 'rollouts'" in error.fix) == (call in (mrac.size, mrac.evaluate))
    plan = mrac.plan(small_world(), 2)
    plan.save(tmp_path / "p.json")
    state = json.loads(json.dumps(state_of(small_world()).to_json())) | {"checksum": 1}
    (tmp_path / "s.json").write_text(json.dumps(state))
    (tmp_path / "large.yaml").write_text("#" * 2**24)
    (tmp_path / "empty.mcap").write_bytes(b"")
    small_world().save(tmp_path / "w.npz")
    said = {
        f"evaluate {tmp_path}/w.npz --levels 2.5": "error: --levels '2.5'; expected a whole number, as 100000",
        f"evaluate {tmp_path}/w.npz --state {tmp_path}/s.json": "is damaged, or was changed: its checksum is of other",
        f"evaluate {tmp_path}/large.yaml": "large.yaml: more than ",
        f"inspect {tmp_path}/empty.mcap": "empty.mcap: is empty; expected an MCAP file",
    }
    for words, line in said.items():
        assert run(words.split()) == 2
        err = capsys.readouterr().err
        assert line in err and "cannot be read" not in err, words


def test_bounds_say_what_they_are() -> None:
    answer = mrac.evaluate(small_world(), 2, rollouts=64, advice=False, band=False, progress=False)
    bounds = answer.bounds
    title, *lines = repr(bounds).splitlines()
    assert title.startswith("Limits: upper bounds of the mean coverage")
    assert [line.split()[0] for line in lines] == ["least", "any_strategy", "ideal", "ideal_one"]
    for line, bound in zip(lines, (bounds.least, bounds.any_strategy, bounds.ideal, bounds.ideal_one), strict=True):
        shown = float(line.split()[1])
        assert 100 * bound.mean <= shown < 100 * bound.mean + 0.0101  # never less than the bound
        assert f"% ({math.ceil(100 * bound.cells - 1e-9) / 100:,.2f} cells): " in line and len(line) < 140
    assert len({line.partition(": ")[2] for line in lines}) == 4
    unknown = mrac.evaluate(small_world(), 2, rollouts=64, bound=False, advice=False, band=False, progress=False).bounds
    if unknown.any_strategy is None:
        assert "not computed (bound=True" in repr(unknown) and "<table>" in unknown._repr_html_()
