"""The comparison of the engines is worth something: it fails when a fault is planted in either of them.

A fault is one place of one source file, changed in a copy of the package; the comparison of
`test_mrac_jax_closed_loop` then runs in a process of its own that imports the copy.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
WORLDS = ("contiguous-8", "combs-8", "crossings-0")
"""Of the survey: of one compiled shape; robots lost, areas left in several parts, shares of both kinds, and ties."""
COMPARISON = """
import sys
from importlib import import_module
from pathlib import Path
from closed_loop_worlds import survey_worlds
from test_mrac_jax_closed_loop import compare

worlds, traced, *packages = sys.argv[1:]
for package in map(Path, packages):
    if Path(import_module(package.name).__file__).parent != package:
        raise ImportError(f"not the copy {package}")
chosen = [one for one in survey_worlds() if one.name in worlds.split()]
for one in chosen:
    compare(one, 60, traced=range(int(traced)))
print(f"{len(chosen)} worlds alike")
"""

HELD_WORLD = "contiguous-11"
"""Of the survey: with `reserve`, robots are held in some branches of a set and not in others."""
HELD_COMPARISON = """
import sys
from dataclasses import replace
from closed_loop_worlds import survey_worlds
from planner.kernels.closed_loop import compile_closed_loop, run_range
from planner.mrac.make_plan import make_plan
from planner.mrac.reference import ReferenceLoop

(one,) = [one for one in survey_worlds() if one.name == sys.argv[1]]
plan = make_plan(one.world, one.starts, replace(one.settings, policy="per_cell", reserve=0.5))
results = run_range(compile_closed_loop(plan, one.world), one.seed, 0, 150, singles=True, threads=1)[1]
readable = ReferenceLoop(plan, one.world)
if results.time.tolist() != [readable.run(one.seed, number).time for number in range(150)]:
    raise AssertionError(f"results differ: {one.name}")
print("1 worlds alike")
"""


@dataclass(frozen=True)
class Fault:
    """A change of an engine's source.

    Attributes:
        file: below the repository. old, new: text that stands there once, and what takes its place.
        seen_in: what differs first, a pattern.
    """

    file: str
    old: str
    new: str
    seen_in: str = "results|tallies"

    @property
    def package(self) -> str:
        """The package that it is planted in."""
        return self.file.split("/")[0]


TELLS_COMPLETION = (
    "        lanes = write_down("
    "lanes, completes, lanes.robot, EventKind.COMPLETED, read(lanes.ids, row + holder), move.cell)\n"
)
TELLS_HIT = """        mine = jnp.where(move.area == tables.none, NO_AREA, read(lanes.ids, row + move.area))
        lanes = write_down(lanes, move.hit, lanes.robot, EventKind.HIT, mine, move.cell)
"""
QUICK = {
    "classical tie order": Fault(
        "planner/kernels/areas.py",
        "            if cost >= 0 and (level < best_level or cost < best_cost):\n",
        "            if cost >= 0 and (level < best_level or cost <= best_cost):\n",
    ),
    "classical survivors find the state that the others left": Fault(
        "planner/kernels/rollouts.py",
        "        hit = hand(level_of(stack, level + 1))\n",
        "        hit = s._replace(marks=stack.marks[level + 1])\n",
    ),
    "classical set parted, and the order of the hit ones lost": Fault(
        "planner/kernels/luck.py",
        "        ids[kept + index] = words[index]\n",
        "        ids[kept + index] = words[0]\n",
    ),
    "classical set counted once": Fault(
        "planner/kernels/runs.py", "    c.new[step] += size\n", "    c.new[step] += 1\n"
    ),
    "classical bits of another branch": Fault(
        "planner/kernels/rollouts.py",
        "    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)\n",
        "    stale = to.open[0] & np.uint64(0xFF)\n"
        "    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)\n"
        "    to.open[0] |= stale\n",
    ),
    "jax snapshot of another step": Fault(
        "mrac_jax/closed_loop/nominal.py",
        '(np.searchsorted(begins, step[danger], side="right") - 1)',
        'np.searchsorted(begins[1:], step[danger], side="right").clip(1, len(begins) - 1)',
    ),
    "jax component lost": Fault(
        "mrac_jax/closed_loop/areas.py", "            rest & ~part,\n", "            jnp.zeros_like(rest),\n"
    ),
}
HELD = Fault(
    "planner/kernels/rollouts.py",
    "            to.robots[robot, word] = of.robots[robot, word]\n",
    "            if word != ROBOT_WORDS - 1:\n                to.robots[robot, word] = of.robots[robot, word]\n",
)
"""The held flag of another branch is kept."""
SLOW = {
    "classical hit before the cell is marked": Fault(
        "planner/kernels/runs.py",
        "    s.marks[ALIVE] -= 1\n",
        "    s.marks[ALIVE] -= 1\n    s.home[cell] = np.int64(s.home[cell]) >> 1 << 1\n",
    ),
    "classical component lost": Fault(
        "planner/kernels/areas.py",
        "        reopen(s, new)\n",
        "        if split or new == first_new:\n            reopen(s, new)\n",
    ),
    "jax prefix a step short": Fault(
        "mrac_jax/closed_loop/nominal.py",
        "            on_it[:step] += leaving\n",
        "            on_it[: max(step - 1, 0)] += leaving\n",
        seen_in="tallies",
    ),
    "jax snapshot taken a step late": Fault(
        "mrac_jax/closed_loop/steps.py",
        "    halts = ends & (lanes.step + 1 == lanes.halt)\n",
        "    halts = ends & (lanes.step == lanes.halt)\n",
    ),
    "jax tie order": Fault(
        "mrac_jax/closed_loop/steps.py",
        "    for side in reversed(range(SIDES)):\n        near = read(tables.near, cell * SIDES + side)",
        "    for side in range(SIDES):\n        near = read(tables.near, cell * SIDES + side)",
    ),
    "jax tie order of areas": Fault(
        "mrac_jax/closed_loop/search.py",
        "        number = jnp.where(fits, jnp.take_along_axis(rows, label, axis=1), FAR)\n",
        "        number = jnp.where(fits, -jnp.take_along_axis(rows, label, axis=1), FAR)\n",
    ),
    "jax hit before completion": Fault(
        "mrac_jax/closed_loop/steps.py",
        "    after = (move.word & ~jnp.uint32(PENDING)) | jnp.uint32(VISITED)\n",
        "    after = jnp.where(move.hit, move.word, (move.word & ~jnp.uint32(PENDING)) | jnp.uint32(VISITED))\n",
    ),
    "jax completion told after the hit": Fault(
        "mrac_jax/closed_loop/steps.py", TELLS_COMPLETION + TELLS_HIT, TELLS_HIT + TELLS_COMPLETION, seen_in="traces"
    ),
}


def copy_of(package: str, folder: Path) -> Path:
    """The package's sources in the folder."""
    return Path(shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__")))


def plant(fault: Fault, folder: Path) -> Path:
    """A copy of the package, with the fault; where it is."""
    package = copy_of(fault.package, folder)
    source = folder / fault.file
    text = source.read_text()
    assert text.count(fault.old) == 1, f"{fault.file} has changed: plant the fault anew"
    source.write_text(text.replace(fault.old, fault.new))
    return package


def compare_in_a_process(
    packages: list[Path], *, interpreted: bool, traced: int = 0, worlds: str = " ".join(WORLDS), by: str = COMPARISON
) -> subprocess.CompletedProcess[str]:
    """The comparison with these copies in the place of the repository's packages.

    JAX's programs may come from the cache folder: they are kept by their content, so that a fault makes its own.
    `interpreted`: the compiled simulator runs uncompiled, which costs less than to compile it for a few rollouts.
    """
    folder = packages[0].parent
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "PYTHONDONTWRITEBYTECODE": "1",
        "PYTHONPATH": os.pathsep.join(str(path) for path in (folder, ROOT, Path(__file__).parent)),
    }
    if "planner" in {path.name for path in packages}:
        environment |= {"NUMBA_DISABLE_JIT": "1"} if interpreted else {"NUMBA_CACHE_DIR": str(folder / "numba")}
    command = [sys.executable, "-c", by, worlds, str(traced), *map(str, packages)]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


def assert_found(fault: Fault, folder: Path, *, interpreted: bool) -> None:
    """The comparison fails, and by what differs."""
    traced = 20 if fault.seen_in == "traces" else 0
    done = compare_in_a_process([plant(fault, folder)], interpreted=interpreted, traced=traced)
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(rf"^AssertionError: ({fault.seen_in}) differ: [a-z-]+-\d+$", done.stderr, re.MULTILINE), (
        done.stderr
    )


@pytest.mark.slow
def test_a_flag_of_another_branch_is_found(tmp_path: Path) -> None:
    ends = []
    for name, make in (("honest", copy_of), ("faulty", lambda _, folder: plant(HELD, folder))):
        (tmp_path / name).mkdir()
        package = make("planner", tmp_path / name)
        done = compare_in_a_process([package], interpreted=True, worlds=HELD_WORLD, by=HELD_COMPARISON)
        ends.append((done.returncode, done.stdout, f"results differ: {HELD_WORLD}" in done.stderr))
    assert ends == [(0, "1 worlds alike\n", False), (1, "", True)]


def test_no_fault_no_difference(tmp_path: Path) -> None:
    packages = [copy_of(package, tmp_path) for package in ("planner", "mrac_jax")]
    done = compare_in_a_process(packages, interpreted=True)
    assert (done.returncode, done.stdout) == (0, f"{len(WORLDS)} worlds alike\n"), done.stderr


@pytest.mark.slow
def test_no_fault_no_difference_in_traces_nor_compiled(tmp_path: Path) -> None:
    packages = [copy_of(package, tmp_path) for package in ("planner", "mrac_jax")]
    done = compare_in_a_process(packages, interpreted=False, traced=20)
    assert (done.returncode, done.stdout) == (0, f"{len(WORLDS)} worlds alike\n"), done.stderr


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_is_found(name: str, tmp_path: Path) -> None:
    assert_found(QUICK[name], tmp_path, interpreted=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_every_fault_is_found(name: str, tmp_path: Path) -> None:
    assert_found(SLOW[name], tmp_path, interpreted=False)
