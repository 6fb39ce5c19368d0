"""Compiled code is cached between runs: whatever happens to its files costs a compilation, never a crash.

What the compiled simulator asks of Numba: no reference counts, no floating point where whole numbers are meant; and
what it promises in return: no negative index, rows of known lengths.
"""

import ast
import errno
import importlib
import inspect
import logging
import os
import pkgutil
import random
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

import jax
import numba
import numpy as np
import pytest
from helpers import run_python
from jax._src import compilation_cache
from numba.core.dispatcher import Dispatcher

import analysis.theory
import planner
from mrac_jax.runtime import keep_jax_programs
from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.simulator.jit import (
    KEPT_SECONDS,
    KNOWN,
    NO_CACHE,
    PROGRAM,
    SUFFIX,
    UNCOUNTED,
    WITHIN,
    CacheFolder,
    _sources,
    cache_folder,
    is_cached,
    sources_hash,
    threaded,
)
from planner.simulator.state import State, Tables, first_state
from planner.simulator.struct_pointers import LENGTHS
from planner.world.world import World

ROOT = Path(__file__).parent.parent


def six_times(values: np.ndarray) -> float:
    """A kernel that costs little to compile."""
    return values[3] * 6


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The cache folder of a user of their own, not yet there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.delenv(NO_CACHE, raising=False)
    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    folder = cache_folder()
    yield folder / sources_hash()


def run_anew(monkeypatch: pytest.MonkeyPatch) -> tuple[float, int]:
    """The kernel's answer in a process that begins, and how often the cache had it."""
    monkeypatch.setattr("planner.simulator.jit.open_folder", CacheFolder)
    kernel: Any = threaded(six_times)
    return kernel(np.arange(4.0)), sum(kernel.stats.cache_hits.values())


def damage(content: bytes, way: int, rng: random.Random) -> bytes:
    """One of seven ways in which a file is spoiled."""
    place = rng.randrange(len(content))
    flipped = bytes([content[place] ^ 1 << rng.randrange(8)])
    return (
        content[:place] + flipped + content[place + 1 :],
        content[:place],
        b"",
        content[:-1],
        content + b"x",
        rng.randbytes(len(content)),
        content[:place] + bytes(64) + content[place + 64 :] + b"\0",
    )[way % 7]


def test_whether_code_is_cached_is_known_before_it_is_needed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_cached(threaded(six_times))
    run_anew(monkeypatch)
    assert is_cached(threaded(six_times))
    monkeypatch.setattr("planner.simulator.jit.sources_hash", lambda: "other sources")
    assert not is_cached(threaded(six_times))
    monkeypatch.setenv(NO_CACHE, "1")
    assert not is_cached(threaded(six_times))


def test_a_second_process_finds_the_code(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_anew(monkeypatch) == (18.0, 0)
    assert run_anew(monkeypatch) == (18.0, 1)
    [file] = home.iterdir()
    assert home.stat().st_mode & 0o777 == 0o700 and file.stat().st_mode & 0o777 == 0o600


def test_damaged_code_is_compiled_again(
    home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    [file] = home.iterdir()
    whole, rng = file.read_bytes(), random.Random(1)
    for way in range(14):
        caplog.clear()
        file.write_bytes(damage(whole, way, rng))
        assert run_anew(monkeypatch) == (18.0, 0)
        assert caplog.messages == [f"note: compiled code in {home} is compiled again: it was damaged"]
        assert run_anew(monkeypatch) == (18.0, 1)  # and kept


def test_code_that_numba_cannot_load_is_compiled_again(
    home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    [file] = home.iterdir()
    CacheFolder(home).write(file.name.removesuffix(SUFFIX), b"whole, but no code")
    assert run_anew(monkeypatch) == (18.0, 0) and "damaged" in caplog.text
    assert run_anew(monkeypatch) == (18.0, 1)


@pytest.mark.parametrize("internal", ["_reduce", "_rebuild"])
def test_a_numba_with_other_internals_compiles(
    internal: str, home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    monkeypatch.delattr(f"numba.core.compiler.CompileResult.{internal}")
    for file in home.iterdir() if internal == "_reduce" else ():
        file.unlink()
    assert [run_anew(monkeypatch) for _ in range(2)] == [(18.0, 0)] * 2
    assert len(caplog.messages) == 2


def test_a_damaged_program_of_jax_is_compiled_again(
    home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setattr(compilation_cache, "_cache", None)
    monkeypatch.setattr(compilation_cache, "_cache_initialized", False)
    try:
        jax.config.update(names[0], None)
        keep_jax_programs()
        jax.config.update(names[1], 0.0)
        program = compilation_cache._cache

        def run() -> float:
            def seven_times(value: Any) -> Any:
                return 7 * value + 1

            program._folder._reported = False
            return float(jax.jit(seven_times)(6.0))

        assert run() == 43.0
        folder = home.parent / "jax"
        [file] = [path for path in folder.iterdir() if "seven_times" in path.name]
        whole, rng = file.read_bytes(), random.Random(2)
        for way in range(14):
            caplog.clear()
            file.write_bytes(damage(whole, way, rng))
            assert run() == 43.0
            assert caplog.messages == [f"note: compiled code in {folder} is compiled again: it was damaged"]
            assert CacheFolder(folder).read(file.name.removesuffix(SUFFIX))
            caplog.clear()
            assert run() == 43.0 and not caplog.messages
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_content_under_another_name_is_not_used(tmp_path: Path) -> None:
    folder = CacheFolder(tmp_path)
    folder.write("a", b"one")
    (tmp_path / "a.sealed").rename(tmp_path / "b.sealed")
    assert folder.read("b") is None and folder.read("a") is None


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o702])
def test_a_folder_that_others_may_write_to_is_not_used(
    mode: int, home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    home.chmod(mode)
    assert run_anew(monkeypatch) == (18.0, 0)
    [line] = caplog.messages
    assert str(home) in line and "not used" in line and "chmod go-w" in line
    home.chmod(0o500)
    assert run_anew(monkeypatch) == (18.0, 1)


def test_a_file_of_others_is_not_used(
    home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    [file] = home.iterdir()
    file.chmod(0o666)
    assert run_anew(monkeypatch) == (18.0, 0) and "only you can write to" in caplog.text
    assert run_anew(monkeypatch) == (18.0, 1)  # replaced by one's own
    if os.geteuid() == 0:
        os.chown(file, 4321, -1)
    else:
        monkeypatch.setattr("os.geteuid", lambda: file.stat().st_uid + 1)
    assert run_anew(monkeypatch) == (18.0, 0)


def test_a_pipe_in_the_place_of_a_file(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run_anew(monkeypatch)
    [file] = home.iterdir()
    file.unlink()
    os.mkfifo(file, 0o600)
    assert run_anew(monkeypatch) == (18.0, 0)
    file.unlink()
    file.mkdir()
    assert run_anew(monkeypatch) == (18.0, 0)


@pytest.mark.parametrize("above", range(4))
def test_a_file_in_the_place_of_a_folder(
    above: int, home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    place = (home, *home.parents)[above]
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text("")
    assert run_anew(monkeypatch) == (18.0, 0)
    [line] = caplog.messages
    assert str(home) in line and "expected a folder" in line


def test_a_full_disk(home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
        ran = run_anew(monkeypatch)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert ran == (18.0, 0) and not [*home.iterdir()]
    [line] = caplog.messages
    assert str(home) in line and "is not kept (File too large)" in line


@pytest.mark.parametrize("made", [True, False], ids=["the folder", "above it"])
@pytest.mark.parametrize("reason", [errno.EROFS, errno.EACCES], ids=["read-only mount", "not one's own"])
def test_a_folder_that_cannot_be_written(
    reason: int, made: bool, home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As the system says it: permission bits would not keep root from writing."""
    if made:
        home.mkdir(mode=0o700, parents=True)

    def refuse(*place: object, **how: object) -> None:
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr("os.mkdir", refuse)
    monkeypatch.setattr("tempfile.mkstemp", refuse)
    assert [run_anew(monkeypatch) for _ in range(2)] == [(18.0, 0)] * 2
    assert home.exists() == made and not [*home.glob("*")]
    assert len(caplog.messages) == 2  # a folder's object says it once; here each stands for a process
    for line in caplog.messages:
        assert f"{home} is not kept ({os.strerror(reason)}): expected a folder to write to" in line


def test_no_home_at_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)

    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", nobody)
    assert cache_folder() is None
    assert threaded(six_times)(np.arange(4.0)) == 18.0


WRITES = """
import sys, numpy as np
from pathlib import Path
from planner.simulator.jit import CacheFolder
folder = CacheFolder(Path(sys.argv[1]))
for turn in range(150):
    folder.write("code", bytes([turn % 7]) * 200_000)
"""


def test_two_that_write_while_one_reads(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    command = [sys.executable, "-c", WRITES, str(tmp_path / "new" / "folder")]
    running = [subprocess.Popen(command, cwd=ROOT) for _ in range(2)]
    folder, seen = CacheFolder(tmp_path / "new" / "folder"), 0
    while any(process.poll() is None for process in running):
        content = folder.read("code")
        assert content is None or (len(content), len(set(content))) == (200_000, 1)
        seen += content is not None
    assert [process.returncode for process in running] == [0, 0] and seen > 10
    assert not caplog.messages and [path.name for path in folder.path.iterdir()] == ["code.sealed"]


def test_old_files_are_removed(tmp_path: Path) -> None:
    base = tmp_path / "mrac-jax" / "compiled"
    for name in ("old", "used"):
        CacheFolder(base / "one").write(name, b"content")
        CacheFolder(base / name).write(name, b"content")
    (base / "one" / "left.partial").write_bytes(b"half")
    (base / "one" / "somebody.txt").write_bytes(b"else")
    (base / "flat.sealed").write_bytes(b"of release 0.3")
    month_ago = time.time() - KEPT_SECONDS - 1
    for one in base.rglob("*.*"):
        os.utime(one, (month_ago, month_ago))
    for folder in ("one", "used"):
        assert CacheFolder(base / folder).read("used") == b"content"  # which makes it new
    CacheFolder(base / "new").write("new", b"content")
    left = {str(path.relative_to(base)) for path in base.rglob("*")}
    assert left == {"one", "one/used.sealed", "one/somebody.txt", "used", "used/used.sealed", "new", "new/new.sealed"}


def test_the_hash_is_that_of_the_sources(tmp_path: Path) -> None:
    hashes = []
    for name, text in (("one.py", ""), ("one.py", "1"), ("two.py", ""), ("three.txt", "")):
        (tmp_path / name).write_text(text)
        sources_hash.cache_clear()
        _sources.cache_clear()
        hashes.append(sources_hash(tmp_path))
    assert hashes[-1] == hashes[-2] and len(set(hashes)) == 3
    sources_hash.cache_clear()


def names_in(code: CodeType) -> set[str]:
    """Names that the code looks up, in inner functions too."""
    inner = [names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    return set(code.co_names).union(*inner)


@cache
def origins_in(file: str) -> dict[str, str | None]:
    """The modules of the names that a file imports."""
    return {
        alias.asname or alias.name: f"planner.simulator.{node.module}" if node.level else node.module
        for node in ast.walk(ast.parse(Path(file).read_text()))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def test_all_that_compiled_functions_use_is_in_the_hash() -> None:
    """Functions and constants of this project that they look up, and named tuples that may be their arguments.

    Each lies in the simulator, or in the package of the function that is compiled.
    """
    functions = set[Any]()
    for package in (planner, analysis.theory):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(found.name)
            functions |= {value.py_func for value in vars(module).values() if isinstance(value, Dispatcher)}
    todo, seen = [(function, function.__module__.rpartition(".")[0]) for function in functions], 0
    while todo:
        function, package = todo.pop()
        origins = origins_in(function.__code__.co_filename)
        modules = {function.__module__}
        for name in names_in(function.__code__) & function.__globals__.keys():
            value = inspect.unwrap(getattr(function.__globals__[name], "py_func", function.__globals__[name]))
            modules |= {origins.get(name), getattr(value, "__module__", None)}
            if inspect.isfunction(value) and value not in functions:
                functions.add(value)
                todo.append((value, package))
        tuples = {value for value in function.__globals__.values() if hasattr(value, "_fields")}
        for module in modules | {kind.__module__ for kind in tuples}:
            if module is not None and module.partition(".")[0] in ("planner", "mrac_jax", "analysis"):
                assert module.rpartition(".")[0] in (package, "planner.simulator"), (function, module)
                seen += 1
    assert seen > 400


def test_notes_reach_standard_error_once_and_without_a_traceback(tmp_path: Path) -> None:
    (tmp_path / "mrac-jax").write_text("")
    script = "from planner.simulator.jit import *\n"
    script += "f = CacheFolder(Path(sys.argv[1]))\nf.write('a', b'')\nf.write('b', b'')\n"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + script, str(tmp_path / "mrac-jax" / "compiled")],
        env=environment, capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    assert done.stderr.startswith(f"note: compiled code in {tmp_path}/mrac-jax/compiled is not kept")
    assert len(done.stderr.splitlines()) == 1 and logging.getLogger("mrac_jax").handlers == []


# What the compiled simulator asks of Numba, and what it promises.

IN_FLOATING_POINT = """
from numba.core import types
from numba.core.dispatcher import Dispatcher
import planner.simulator.areas, planner.simulator.failure_sampling, planner.simulator.paths, planner.simulator.rollouts
import planner.simulator.fixed_paths, planner.simulator.solo, planner.simulator.step, planner.simulator.visits
from planner.rollouts.closed_loop import compile_closed_loop, run_range
from planner.make_plan import make_plan
from planner.world.world import World

world = World.create([[0.0, 0.1, 0.0]])
run_range(compile_closed_loop(make_plan(world, [[0, 0]]), world), 1, 0, 2, threads=1)
seen = 0
for room in ("areas", "failure_sampling", "paths", "rollouts", "fixed_paths", "solo", "step", "visits"):
    for name, function in vars(getattr(planner.simulator, room)).items():
        if isinstance(function, Dispatcher) and name not in ("least_word", "mass_stopped"):  # which round
            for compiled in function.overloads.values():
                for variable, kind in compiled.type_annotation.typemap.items():
                    assert not isinstance(kind, types.Float), f"{name}: {variable} is {kind}"
                    seen += 1
print(seen)
"""

OF_ANOTHER_RELEASE = """
import sys
import numba
numba.__version__ = "99.0.0"
from planner.simulator.jit import kernel, program
part = kernel(lambda number: number + 3)
print(program(lambda number: part(number) * 1)(4), "planner.simulator.jit_parts" in sys.modules)
"""


def test_kernels_count_no_references() -> None:
    """Without the option the closed loop takes twice as long."""
    try:
        first = numba.njit(**UNCOUNTED)(lambda numbers: numbers[0])
        counted = numba.njit(lambda numbers: numbers[1:])
        assert (first(np.arange(3)), len(counted(np.arange(3)))) == (0, 2)
    except Exception as error:
        pytest.fail(f"Numba has changed ({error}): remove unknown options from UNCOUNTED in planner/simulator/jit.py")
    for function, expected in ((first, False), (counted, True)):
        (text,) = function.inspect_llvm().values()
        is_counted = "NRT_incref" in text or "NRT_decref" in text
        assert is_counted == expected, "Numba counts references where `_nrt` is False: see planner/simulator/jit.py"


def test_parts_of_kernels_are_called_without_wrappers() -> None:
    inner = numba.njit(**UNCOUNTED, **WITHIN, forceinline=True)(lambda numbers: numbers[0])
    outer = numba.njit(**UNCOUNTED)(lambda numbers: inner(numbers) + 1)
    assert outer(np.arange(3)) == 1


def test_a_branch_on_an_argument_that_may_be_left_out_stays() -> None:
    add = numba.njit(**UNCOUNTED, pipeline_class=PROGRAM)(lambda more=None: 1 if more is None else more + 1)
    assert (add(), add(4)) == (1, 5)


def run_uncached(code: str, **environment: str) -> str:
    """What a new process prints that keeps no compiled code."""
    return run_python(code, MRAC_JAX_NO_CACHE="1", **environment)


def test_a_release_of_numba_that_is_not_known_compiles_as_it_does() -> None:
    said = run_uncached(OF_ANOTHER_RELEASE)
    assert said.split() == ["7", "False"]
    assert numba.__version__.startswith(KNOWN) == ("planner.simulator.jit_parts" in sys.modules)


@pytest.mark.skipif(not numba.__version__.startswith(KNOWN), reason="that release compiles parts as it sees fit")
def test_no_index_is_asked_whether_it_is_negative() -> None:
    """It takes a tenth of the closed loop's time."""
    for options, expected in (({}, True), ({"pipeline_class": PROGRAM}, False)):
        at = numba.njit(**UNCOUNTED, **options)(lambda numbers, place: numbers[place, place + 1])
        assert at(np.arange(6).reshape(2, 3), 1) == 5
        (text,) = at.inspect_llvm().values()
        assert ("icmp slt i64 %arg.place, " in text) == expected


@pytest.mark.parametrize("worlds", [1, pytest.param(60, marks=pytest.mark.slow)])
def test_kernels_count_places_from_the_front(worlds: int) -> None:
    """What is compiled takes every index for one that is not negative."""
    code = f"import forward_indices; forward_indices.main({worlds})"
    assert int(run_uncached(code, NUMBA_DISABLE_JIT="1")) > 10**5 * worlds


def test_rows_are_as_long_as_kernels_take_them_for() -> None:
    world = World.create([[0.0, 0.1, 0.0]])
    tables = compile_closed_loop(make_plan(world, [[0, 0]]), world).tables
    made = {Tables: tables, State: first_state(tables, 8)}
    assert {(kind, name): getattr(made[kind], name).shape[-1] for kind, name in LENGTHS} == LENGTHS


@pytest.mark.slow
def test_kernels_compute_with_whole_numbers_alone() -> None:
    """Numba compares int64 and uint64 as float64: slow, and wrong above 2**53."""
    assert int(run_uncached(IN_FLOATING_POINT)) > 1000
