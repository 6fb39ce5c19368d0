"""Compiled code is kept between runs: whatever happens to its files costs a compilation and a line, no answer."""

from __future__ import annotations

import ast
import errno
import logging
import os
import random
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from jax._src import compilation_cache
from numba import typeof

from mrac_jax.runtime import keep_jax_programs
from planner import jit
from planner import jit as sealed
from planner import jit as sources
from planner.jit import NO_CACHE, ROOMS, SealedFolder, cache_folder, is_kept, sources_hash, threaded
from planner.simulator.state import How
from planner.simulator.struct_pointers import Handed

ROOT = Path(__file__).parent.parent
WORN = re.compile(r"\n@(threaded|program|kernel|rare_kernel|spliced)\n")
KERNELS = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py") if WORN.search(path.read_text()))


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
    folder = cache_folder("compiled")
    assert folder is not None
    yield folder


def run_anew(monkeypatch: pytest.MonkeyPatch) -> tuple[float, int]:
    """The kernel's answer in a process that begins, and how often the cache had it."""
    monkeypatch.setattr("planner.jit.sealed_folder", SealedFolder)
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


def test_whether_code_is_kept_is_known_before_it_is_needed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_kept(threaded(six_times))
    run_anew(monkeypatch)
    assert is_kept(threaded(six_times))
    monkeypatch.setattr("planner.jit.sources_hash", lambda module, file: "other sources")
    assert not is_kept(threaded(six_times))
    monkeypatch.setenv(NO_CACHE, "1")
    assert not is_kept(threaded(six_times))


def test_a_second_process_finds_the_code(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run_anew(monkeypatch) == (18.0, 0)
    assert run_anew(monkeypatch) == (18.0, 1)
    [file] = home.iterdir()
    assert home.stat().st_mode & 0o777 == 0o700 and file.stat().st_mode & 0o777 == 0o600


def seed_of(how: How) -> int:
    """A kernel that does not import what it is handed."""
    return int(how.key0)


def test_code_is_stale_when_a_tuple_that_it_is_handed_has_changed(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    how, changed = How(*map(np.uint32, (5, 6, 7, 8)), 9, True, False, 0, *map(np.uint32, range(6))), set[str]()
    monkeypatch.setattr("planner.jit.sources_hash", lambda module, file: f"{module} {module in changed}")

    def hits() -> int:
        kernel: Any = threaded(seed_of)
        assert kernel(how) == 5
        return sum(kernel.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    changed.add("planner.simulator.state")
    assert [hits(), hits()] == [0, 1]
    handed = jit._sources_of([Handed(typeof(how))])
    assert handed == {"planner.simulator.struct_pointers False", "planner.simulator.state True"}


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
        assert caplog.messages == [f"note: compiled code in {home} is made again: it was damaged"]
        assert run_anew(monkeypatch) == (18.0, 1)  # and kept


def test_code_that_numba_cannot_load_is_compiled_again(
    home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    run_anew(monkeypatch)
    [file] = home.iterdir()
    SealedFolder(home).write(file.name.removesuffix(sealed.SUFFIX), b"whole, but no code")
    assert run_anew(monkeypatch) == (18.0, 0) and "damaged" in caplog.text
    assert run_anew(monkeypatch) == (18.0, 1)


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

            program._folder._told = False
            return float(jax.jit(seven_times)(6.0))

        assert run() == 43.0
        [file] = [path for path in home.iterdir() if "seven_times" in path.name]
        whole, rng = file.read_bytes(), random.Random(2)
        for way in range(14):
            caplog.clear()
            file.write_bytes(damage(whole, way, rng))
            assert run() == 43.0
            assert caplog.messages == [f"note: compiled code in {home} is made again: it was damaged"]
            assert SealedFolder(home).read(file.name.removesuffix(sealed.SUFFIX))
            caplog.clear()
            assert run() == 43.0 and not caplog.messages
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_content_under_another_name_is_not_used(tmp_path: Path) -> None:
    folder = SealedFolder(tmp_path)
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
    assert run_anew(monkeypatch) == (18.0, 0) and "others may have written it" in caplog.text
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


@pytest.mark.parametrize("place", ["home", "home/mrac-jax", "home/mrac-jax/compiled"])
def test_a_file_in_the_place_of_a_folder(
    place: str, tmp_path: Path, home: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / place).write_text("")
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
    assert cache_folder("compiled") is None
    assert threaded(six_times)(np.arange(4.0)) == 18.0


WRITES = """
import sys, numpy as np
from pathlib import Path
from planner.jit import SealedFolder
folder = SealedFolder(Path(sys.argv[1]))
for turn in range(150):
    folder.write("code", bytes([turn % 7]) * 200_000)
"""


def test_two_that_write_while_one_reads(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    command = [sys.executable, "-c", WRITES, str(tmp_path / "new" / "folder")]
    running = [subprocess.Popen(command, cwd=ROOT) for _ in range(2)]
    folder, seen = SealedFolder(tmp_path / "new" / "folder"), 0
    while any(process.poll() is None for process in running):
        content = folder.read("code")
        assert content is None or (len(content), len(set(content))) == (200_000, 1)
        seen += content is not None
    assert [process.returncode for process in running] == [0, 0] and seen > 10
    assert not caplog.messages and [path.name for path in folder.path.iterdir()] == ["code.sealed"]


def test_old_files_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "mrac-jax" / "compiled"
    SealedFolder(path).write("old", b"old")
    SealedFolder(path).write("used", b"used")
    (path / "left.partial").write_bytes(b"half")
    (path / "somebody.txt").write_bytes(b"else")
    month_ago = time.time() - 31 * sealed.DAY
    for one in path.iterdir():
        os.utime(one, (month_ago, month_ago))
    assert SealedFolder(path).read("used") == b"used"  # which makes it new
    SealedFolder(path).write("new", b"new")
    assert {one.name for one in path.iterdir()} == {"used.sealed", "new.sealed", "somebody.txt"}
    monkeypatch.setattr(sealed, "MOST_BYTES", 120)
    day_ago = time.time() - sealed.DAY / 2
    os.utime(path / "used.sealed", (day_ago, day_ago))
    SealedFolder(path).write("more", b"more" * 10)
    SealedFolder(path).write("most", b"most" * 10)
    assert {one.name for one in path.iterdir()} == {"more.sealed", "most.sealed", "somebody.txt"}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two packages in which `planner.kernel` imports some modules and not `planner.world.scenario`."""
    texts = {
        "planner/__init__.py": "",
        "planner/kernel.py": "from planner.mrac.paths import (\n    search,  # (best)\n)\nfrom . import near\n",
        "planner/mrac/paths.py": "def search():\n    from mrac_jax.sub import deep\n",
        "planner/near.py": "import mrac_jax.plain as plain\n",
        "planner/world/scenario.py": "import yaml\nfrom planner import kernel\n",
        "mrac_jax/__init__.py": "",
        "mrac_jax/plain.py": "",
        "mrac_jax/sub/__init__.py": "from .wide import everything\n",
        "mrac_jax/sub/deep.py": "from ..leaf import one\n",
        "mrac_jax/sub/wide.py": "everything = 1\n",
        "mrac_jax/leaf.py": "one = 1\n",
    }
    for name, text in texts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(sources, "_folders", lambda room: (str(tmp_path / room),))
    return tmp_path


def kernel_hash(project: Path) -> str:
    for function in (sources_hash, sources._read, sources.file_of):
        function.cache_clear()
    try:
        return sources_hash("planner.kernel", str(project / "planner/kernel.py"))
    finally:
        for function in (sources_hash, sources._read, sources.file_of):
            function.cache_clear()


def test_code_is_stale_when_what_it_imports_has_changed_and_only_then(project: Path) -> None:
    for path in sorted(project.rglob("*.py")):
        before = kernel_hash(project)
        path.write_text(path.read_text() + "# changed\n")
        of_no_use = path.name == "scenario.py" or path == project / "mrac_jax/__init__.py"
        assert (kernel_hash(project) != before) != of_no_use, path


def test_the_imports_that_the_parser_sees() -> None:
    """Every import of this project's modules is seen without the parser, which would take too long at every start."""
    for room in ("planner", "mrac_jax"):
        for path in (ROOT / room).rglob("*.py"):
            seen = {
                name for name, _ in sources._read(".".join(path.relative_to(ROOT).with_suffix("").parts), str(path))[1]
            }
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    names = {alias.name for alias in node.names}
                elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                    names = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
                else:
                    assert not isinstance(node, ast.ImportFrom), f"{path}: a relative import"
                    continue
                ours = {name for name in names if name.split(".")[0] in ROOMS and sources.file_of(name)}
                assert ours <= seen, path


def test_a_reader_of_files_throws_no_compiled_code_away() -> None:
    assert len(KERNELS) > 8
    readers = {
        "planner.world.scenario",
        "planner.world.raster_files",
        "planner.world.threats",
        "planner.plan.plan_file",
        "planner.plan.state_file",
    }
    for path in KERNELS:
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        seen, todo = set[str](), [(name, str(path))]
        while todo:
            one = todo.pop()
            if one[0] not in seen:
                seen.add(one[0])
                todo += sources._read(*one)[1]
        assert "planner.jit" in seen and not seen & readers, path


def test_notes_reach_standard_error_once_and_without_a_traceback(tmp_path: Path) -> None:
    (tmp_path / "mrac-jax").write_text("")
    script = "from planner.jit import *\n"
    script += "f = SealedFolder(Path(sys.argv[1]))\nf.write('a', b'')\nf.write('b', b'')\n"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "import sys\n" + script, str(tmp_path / "mrac-jax" / "compiled")],
        env=environment, capture_output=True, text=True, check=True, cwd=ROOT,
    )  # fmt: skip
    assert done.stderr.startswith(f"note: compiled code in {tmp_path}/mrac-jax/compiled is not kept")
    assert len(done.stderr.splitlines()) == 1 and logging.getLogger("mrac_jax").handlers == []
