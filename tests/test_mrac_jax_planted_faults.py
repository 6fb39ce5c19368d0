"""The comparison of the engines is worth something: it fails when a fault is planted in either of them.

A fault is one place of one source file, changed in a copy of the package. A process of its own imports the copy, runs
that one engine, and compares it with what the other engine, which has no fault, came to here.
"""

import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from closed_loop_worlds import SurveyWorld, survey_world
from helpers import assert_same_results, assert_same_tally, assert_same_trace

from planner.make_plan import make_plan
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.single_run import PythonLoop

ROOT = Path(__file__).parent.parent
WORLDS = ("contiguous-8", "combs-8", "crossings-0")
"""Of the survey: of one compiled shape; robots lost, areas left in several parts, shares of both kinds, and ties."""
ROLLOUTS, TRACED = 60, 20
PACKAGES = ("planner", "mrac_jax")
"""Where the two engines are; a copy of one is in the place of the repository's."""
COMPARISON = "import test_mrac_jax_planted_faults as faults; faults.{}()"
HELD, HELD_RUNS = "contiguous-11", 150
"""Of the survey: with `reserve`, robots are held in some branches of a set and not in others."""


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

    def planted(self, root: Path) -> str:
        """The source below here, with the fault."""
        text = (root / self.file).read_text()
        assert text.count(self.old) == 1, f"{self.file} has changed: plant the fault anew"
        return text.replace(self.old, self.new)


AREAS, ROLL, VISITS = (f"planner/simulator/{name}.py" for name in ("areas", "rollouts", "visits"))
BOOK, COUNTING, ENGINE, EVENTS, DECISIONS = (
    f"mrac_jax/closed_loop/{name}.py" for name in ("book", "counting", "engine", "events", "decisions")
)
INTERPRETED = {
    "classical tie order": Fault(AREAS, "or cost < best_cost):", "or cost <= best_cost):"),
    "classical survivors find the state that the others left": Fault(
        ROLL, "lost = hand(level_of(stack, top))", "lost = hand(level_of(stack, top))._replace(moving=s.moving)"
    ),
    "classical set parted, and the order of the hit ones lost": Fault(
        "planner/simulator/failure_sampling.py", "ids[kept + index] = words[index]", "ids[kept + index] = words[0]"
    ),
    "classical set counted once": Fault(VISITS, "c.new[step] += size", "c.new[step] += 1"),
    "classical bits of another branch": Fault(
        ROLL,
        "    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)\n",
        "    stale = to.open[0] & np.uint64(0xFF)\n"
        "    copy_row(of.open, to.open, (areas + WORD - 1) // WORD)\n    to.open[0] |= stale\n",
    ),
    "jax snapshot after the loss": Fault(ENGINE, "= ENDLESS - left[: last + 1] + ", "= "),
    "jax component lost": Fault(BOOK, "if bisected else parts:", "if bisected else parts[:2]:"),
}
QUICK = "classical bits of another branch", "jax snapshot after the loss"
STALE_FLAG = Fault(
    ROLL,
    "    copy_row(of.robots, to.robots, len(of.robots))\n",
    "    for robot in range(len(of.robots)):\n        held = to.robots[robot].held\n"
    "        to.robots[robot] = of.robots[robot]\n        to.robots[robot].held = held\n",
)
COMPILED = {
    "classical hit before the cell is marked": Fault(
        VISITS,
        "    s.marks.alive -= 1\n",
        "    s.marks.alive -= 1\n    s.marks.covered -= s.home[cell] & VISITED\n"
        "    s.home[cell] = np.int64(s.home[cell]) >> 1 << 1\n",
    ),
    "classical component lost": Fault(
        AREAS, "        reopen(s, new)\n", "        if split or new == first_new:\n            reopen(s, new)\n"
    ),
    "classical path remembered goes on in an area that was shared": Fault(
        "planner/simulator/paths.py",
        "    robots[robot].ahead, robots[robot].path = ahead, 0\n",
        "    if searched:\n        robots[robot].ahead, robots[robot].path = ahead, 0\n",
    ),
    "jax walks counted a step short": Fault(COUNTING, "(1, moves + 1):", "(1, max(moves, 2)):", seen_in="tallies"),
    "jax tie order": Fault(BOOK, "if target < 0 and cell < len(todo)", "if cell < len(todo)"),
    "jax tie order of areas": Fault(EVENTS, "jnp.argmin(costs, axis=1)", "G - 1 - jnp.argmin(costs[:, ::-1], axis=1)"),
    "jax loss before the cell is marked": Fault(EVENTS, "walked, walked - dies)", "walked - dies, walked - dies)"),
    "jax robots that act later have moved": Fault(EVENTS, "& ~(late | due)[:, None]", "& (late | due)[:, None]"),
    "jax owner loses a turn": Fault(DECISIONS, "since = step - (owner > helper)", "since = step"),
    "jax threshold of the whole run": Fault(EVENTS, "less(left, lanes.left), ", "left, "),
}
FAULTS = INTERPRETED | COMPILED


def copy_of(package: str, folder: Path, fault: Fault | None = None) -> Path:
    """The package's sources in the folder, with the fault, if any."""
    copy = shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    if fault is not None:
        (folder / fault.file).write_text(fault.planted(ROOT))
    return Path(copy)


def worlds() -> Iterator[SurveyWorld]:
    return map(survey_world, WORLDS)


def rolled_out(package: str, one: SurveyWorld, traced: int) -> tuple[Any, Any, list[Any]]:
    """Tally, results and the first traces of the package's engine."""
    loop = one.loop()
    if package == "planner":
        return *run_range(loop, one.seed, 0, ROLLOUTS, singles=True), trace_rollouts(loop, one.seed, range(traced))
    from conftest import LANES  # not by the other engine's processes, which need neither this nor JAX

    from mrac_jax.closed_loop.engine import JaxClosedLoop

    engine = JaxClosedLoop(loop, one.seed, lanes=LANES)
    return *engine.run(0, ROLLOUTS), list(engine.traces(range(traced)))


@cache
def answers(package: str, traced: int) -> bytes:
    """What the repository's own engine comes to in each world, pickled."""
    return pickle.dumps({one.name: rolled_out(package, one, traced) for one in worlds()})


def compare_a_copy() -> None:
    """In a process of its own: the engine of the package copied below here, with the other's answers."""
    copy, traced, expected = Path(sys.argv[1]), int(sys.argv[2]), pickle.loads(Path(sys.argv[3]).read_bytes())
    if Path(str(__import__(copy.name).__file__)).parent != copy:
        raise ImportError(f"not the copy {copy}")
    for one in worlds():
        (tally, results, traces), theirs = rolled_out(copy.name, one, traced), expected.pop(one.name)
        assert_same_results(results, theirs[1], one.name)
        assert_same_tally(tally, theirs[0], one.name)
        for mine, other in zip(traces, theirs[2], strict=True):
            assert_same_trace(mine, other, one.name)
    assert not expected
    sys.stdout.write("alike\n")


def held() -> tuple[SurveyWorld, Plan]:
    """The world in which robots are held, and its plan."""
    one = survey_world(HELD)
    return one, make_plan(one.world, one.starts, replace(one.settings, policy="per_cell", risk_cap=0.5))


def compare_held_robots() -> None:
    """In a process of its own: when runs of the copied planner's compiled simulator end, and as Python do."""
    one, plan = held()
    results = run_range(compile_closed_loop(plan, one.world), one.seed, 0, HELD_RUNS, singles=True, threads=1)[1]
    expected = pickle.loads(Path(sys.argv[3]).read_bytes())
    assert results is not None and results.time.tolist() == expected, f"results differ: {one.name}"
    sys.stdout.write("alike\n")


def compare_in_a_process(
    package: Path, *, interpreted: bool, traced: int, expected: bytes | None = None, by: str = "compare_a_copy"
) -> subprocess.CompletedProcess[str]:
    """The comparison with this copy in the place of the repository's package.

    Programs may come from the cache folder: they are kept by their sources' content, so that a fault makes its own.
    `interpreted`: the compiled simulator runs uncompiled, which costs less than to compile it for a few rollouts.
    `expected`: the answers, None: the other engine's.
    """
    folder, (other,) = package.parent, set(PACKAGES) - {package.name}
    (folder / "answers").write_bytes(answers(other, traced) if expected is None else expected)
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join(map(str, (folder, ROOT, Path(__file__).parent)))
    if package.name == "planner" and interpreted:
        environment["NUMBA_DISABLE_JIT"] = "1"
    command = [sys.executable, "-c", COMPARISON.format(by), str(package), str(traced), str(folder / "answers")]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=600)


@pytest.mark.slow
def test_a_held_flag_of_another_branch_is_found(tmp_path: Path) -> None:
    one, plan = held()
    python = PythonLoop(plan, one.world)
    expected = pickle.dumps([python.run(one.seed, number).step for number in range(HELD_RUNS)])
    said = []
    for fault in (None, STALE_FLAG):
        package = copy_of("planner", tmp_path / str(bool(fault)), fault)
        done = compare_in_a_process(package, interpreted=True, traced=0, expected=expected, by="compare_held_robots")
        said.append((done.returncode, done.stdout, f"AssertionError: results differ: {HELD}\n" in done.stderr))
    assert said == [(0, "alike\n", False), (1, "", True)]


@pytest.mark.parametrize(
    ("package", "interpreted", "traced"),
    [("planner", True, 0), *(pytest.param(name, False, TRACED, marks=pytest.mark.slow) for name in PACKAGES)],
)
def test_no_fault_no_difference(package: str, interpreted: bool, traced: int, tmp_path: Path) -> None:
    done = compare_in_a_process(copy_of(package, tmp_path), interpreted=interpreted, traced=traced)
    assert (done.returncode, done.stdout) == (0, "alike\n"), done.stderr


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in FAULTS]
)
def test_a_fault_is_found(name: str, tmp_path: Path) -> None:
    """The comparison fails, and by what differs."""
    fault = FAULTS[name]
    package = copy_of(fault.file.split("/")[0], tmp_path, fault)
    done = compare_in_a_process(package, interpreted=name in INTERPRETED, traced=0)
    assert done.returncode == 1, done.stdout + done.stderr
    assert re.search(rf"^({fault.seen_in}) differ: [a-z-]+-\d+:", done.stderr, re.MULTILINE), done.stderr


def test_what_faults_are_planted_in_stands_there_once() -> None:
    assert all(fault.planted(ROOT) for fault in (*FAULTS.values(), STALE_FLAG))
