"""Policies that other processes can import."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from analysis.cli import app
from analysis.statistics.variance_reduction import LEAST
from planner.failure_model import key_of
from planner.plan.plan import Plan, last_move
from planner.plan.plan_file import parse_plan, read_plan_json
from planner.rollout_sampling import LossDraws
from planner.rollouts import engine as engines
from planner.rollouts.closed_loop import compile_closed_loop, run_range, trace_rollouts
from planner.rollouts.engine import Chunk, Engine, closed_loop_engine, open_loop_engine
from planner.rollouts.loop import ClosedLoop
from planner.rollouts.names import EngineName
from planner.rollouts.open_loop import CompiledPlan
from planner.rollouts.single_run import PythonLoop, SingleRun
from planner.rollouts.threshold_classes import sums_by_threshold
from planner.simulator.codes import Doing
from planner.simulator.thresholds import threefry2x32
from planner.tally import RolloutResults, Tally, Trace
from planner.world.world import World

# --- Short ways for tests to load a plan and to roll out.

# Short ways for tests to roll out a compiled plan or a closed loop through the one engine.


def run_chunks(
    compiled: CompiledPlan, *, seed: int, count: int, engine: EngineName = "auto", **how: Any
) -> Iterator[Chunk]:
    """The open loop, chunk by chunk; `how`: as in `planner.rollouts.engine.run_chunks`."""
    return engines.run_chunks(open_loop_engine(compiled, seed, engine), count, **how)


def run_closed_chunks(
    loop: ClosedLoop, *, seed: int, count: int, engine: EngineName = "auto", **how: Any
) -> Iterator[Chunk]:
    """The closed loop, chunk by chunk; `how`: as in `planner.rollouts.engine.run_chunks`."""
    return engines.run_chunks(closed_loop_engine(loop, seed, engine), count, **how)


def rollouts(compiled: CompiledPlan, *, seed: int, count: int, **how: Any) -> Tally:
    """The tally of so many rollouts of the open loop; `how`: as in `run_chunks`."""
    *_, last = run_chunks(compiled, seed=seed, count=count, **how)
    return last.tally


def rollout_results(
    compiled: CompiledPlan, *, seed: int, count: int, start: int = 0, engine: EngineName = "auto"
) -> RolloutResults:
    """Every single rollout of the open loop."""
    return open_loop_engine(compiled, seed, engine).results(start, count)


# A random number for every visit, in the place of a failure threshold a robot: so release 0.3 could draw, and so the
# fixtures were made that have no runs with thresholds. A rollout drawn like this goes on from a state as if it had not
# been cut, where a threshold is drawn anew.


def uniform(seed: int, rollout: ArrayLike, step: ArrayLike, robot: ArrayLike) -> NDArray[np.float32]:
    """u(r, t, i) in [0, 1), float32: a visit of threat p by robot i at step t destroys it iff u < p."""
    counter = np.asarray(step, np.uint32) * np.uint32(1024) + np.asarray(robot, np.uint32)
    word, _ = threefry2x32(key_of(seed), np.asarray(rollout, np.uint32), counter)
    return (word >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


class VisitDraws(LossDraws):
    """Failures of one rollout, visit by visit."""

    _step = 0

    def hits(self, robot: int, step: int, cell: int) -> bool:
        self._step = step
        return super().hits(robot, step, cell)

    def _reaches_threshold(self, robot: int, chance: np.float32) -> bool:
        return bool(uniform(self._seed, self._rollout, self._step, robot) < chance)


class VisitLoop(PythonLoop):
    """The closed loop of the simulator as Python by these draws."""

    def begin(self, seed: int, rollout: int) -> SingleRun:
        world, model = self.problem.world, self.loop.failure_model  # the world of its type, where all robots are of one
        draws = VisitDraws(world, seed, rollout, model if world.types else replace(model, types=None))
        return SingleRun(self.loop, seed, rollout, hit=draws.hits)


# Many samples of rollouts from one long run, which costs a fraction of as many short ones.

AT_ONCE = 128
"""Samples that are rolled out together."""
SINGLE = {"visited": "visited", "survived": "survived", "time": "time", "alive": "alive", "outcomes": "outcome"}
"""Histograms of a tally, and what they are of."""


def samples(engine: Engine, count: int, seed: int | None, first: int = 0) -> Iterator[Tally]:
    """So many samples of LEAST rollouts each, from id `first` on: their histograms, and nothing by step or cell.

    `seed`: of the thresholds, by whose total figures are summed up too; None: they are not.
    """
    for start in range(0, count, AT_ONCE):
        many = min(AT_ONCE, count - start)
        tally, results = engine.run(first + start * LEAST, many * LEAST)
        for begin in range(0, many * LEAST, LEAST):
            yield part(tally, results, begin, begin + LEAST, seed)


def part(tally: Tally, results: RolloutResults, begin: int, end: int, seed: int | None) -> Tally:
    """Of rollouts `begin .. end - 1` of the `results`, counted from their first one."""
    columns = {field.name: getattr(results, field.name)[begin:end] for field in fields(results)[1:]}
    own = RolloutResults(results.start + begin, **columns)
    counts = {name: np.zeros(0, dtype=np.int64) for name in Tally.axes()}
    counts |= {
        name: np.bincount(getattr(own, column), minlength=len(getattr(tally, name))) for name, column in SINGLE.items()
    }
    if seed is not None:
        counts["by_threshold"] = sums_by_threshold(own, seed, tally.robots)
    return replace(tally, ids=((own.start, own.start + end - begin),), **counts)


def paths_of(run: SingleRun) -> list[np.ndarray]:
    """The cells of each robot up to its last move."""
    return [path[: last_move(path) + 1] for path in run.trace.cells.T]


# The plan in a file, for a world, before its nominal run is compared.


def load_plan(path: str | Path, world: World) -> Plan:
    """As `planner.make_plan.read_plan`, but a plan of today's rules alone, and nothing is planned. Raises PlanError."""
    return parse_plan(read_plan_json(path), world, str(path))


# --- Are two engines' tallies, single results or traces the same? If not: which array, and where.


def play_both_ways(
    plan: Plan,
    world: World,
    seed: int,
    rollouts: int,
    *,
    first_only: bool = False,
    tabled: Sequence[bool | None] = (True, False),
) -> list[SingleRun]:
    """Rollouts from 0 on, of the simulator as Python. The compiled one's are the same, event for event, and its counts.

    So is the last of them where `LossDraws`, which is written apart, says visit by visit who is lost. `tabled`: with
    tables of distances, or with searches, where the plan allows both.
    """
    python = PythonLoop(plan, world, first_only=first_only)
    runs = [python.run(seed, rollout) for rollout in range(rollouts)]
    luck = LossDraws(world, seed, rollouts - 1, plan.failure_model)
    assert_same_trace(SingleRun(python.loop, seed, rollouts - 1, hit=luck.hits).play().trace, runs[-1].trace, "told")
    for with_tables in tabled:
        loop = compile_closed_loop(plan, world, first_only=first_only, tabled=with_tables)
        if loop.tabled != with_tables and len(tabled) > 1:
            continue
        for mine, run in zip(trace_rollouts(loop, seed, range(rollouts)), runs, strict=True):
            assert_same_trace(mine, run.trace, world.source)
        tally, singles = run_range(loop, seed, 0, rollouts, threads=1, singles=True)
        columns = np.transpose([(run.step, run.outcome, *run.raw.marks[["bisected", "divided"]]) for run in runs])
        for name, column in zip(("time", "outcome", "bisected", "divided"), columns.tolist(), strict=True):
            assert getattr(singles, name).tolist() == column, (world.source, name)
        for name in ("visited", "survived", "alive", "home")[: None if loop.comes_home else 3]:
            assert getattr(singles, name).tolist() == [getattr(run, name).sum() for run in runs], (world.source, name)
        for name in ("visited", "survived"):
            counts = np.sum([getattr(run, name) for run in runs], axis=0)
            np.testing.assert_array_equal(getattr(tally, f"covered_{name}").ravel(), counts, f"{world.source}: {name}")
        if loop.comes_home and plan.state is None:
            assert singles.delivered.tolist() == [len(delivered(run.trace, plan.bases)) for run in runs], world.source
        assert tally.stops.sum() == sum(int((~run.alive).sum()) for run in runs)
    return runs


def delivered(trace: Trace, bases: Sequence[set[int]], last: int | None = None) -> set[int]:
    """The cells that a robot visited and brought to one of its bases, by the end of step `last`."""
    found = set[int]()
    for cells, doing, own in zip(trace.cells[:last].T.tolist(), trace.doing[:last].T, bases, strict=bool(bases)):
        at_base = [step for step, cell in enumerate(cells) if cell in own and doing[step] != Doing.DEAD]
        found |= set(cells[: max(at_base, default=-1) + 1])
    return found


def assert_same_tally(mine: Tally, other: Tally, what: str = "") -> None:
    """The same rollouts of the same thing with the same counts; steps that hold nothing do not matter."""
    said, theirs = f"tallies differ: {what}", other.counts()
    for name, counts in mine.counts().items():
        common = min(len(counts), len(theirs[name]))
        np.testing.assert_array_equal(counts[:common], theirs[name][:common], f"{said}: {name}")
    assert (mine.key, mine.shape, mine.ids) == (other.key, other.shape, other.ids), said
    assert mine == other, said


def assert_same_results(mine: RolloutResults, other: RolloutResults, what: str = "") -> None:
    """The same ids with the same results."""
    for name in (field.name for field in fields(RolloutResults)):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"results differ: {what}: {name}")


def assert_same_trace(mine: Trace, other: Trace, what: str = "") -> None:
    """Identical, event for event; what happened is compared before what follows from it."""
    said = f"traces differ: {what}: rollout {mine.rollout}"
    for name in ("rollout", "events", "cells", "doing", "areas", "area_of", "outcome"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(other, name), f"{said}: {name}")
    assert mine == other, said


# --- Commands, and programs in processes of their own.

ROOT = Path(__file__).parent.parent


def answer_of(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> dict[str, Any]:
    """The object that a command prints with `--json`."""
    assert app.run([*words, "--json"]) == status
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def error_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The last line of a command that exits with 2; lines may come before it, unlike in `page_reader.refused`."""
    assert app.run(words) == 2, words
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: "), last
    return last


def run_python(code: str, *words: str, options: Sequence[str] = (), **environment: str) -> str:
    """What a new process prints in which the project and its tests can be imported; `options`: of Python."""
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests")))
    done = subprocess.run(
        [sys.executable, *options, "-c", code, *words],
        cwd=ROOT, env=os.environ | {"PYTHONPATH": paths} | environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


# --- Interruptions.


def after(calls: int) -> Callable[[int, int, float], None]:
    """A progress function that is interrupted in its so many-th call."""
    left = [calls]

    def tell(done: int, total: int, seconds: float) -> None:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt

    return tell


def interrupt_rollouts(monkeypatch: pytest.MonkeyPatch, call: int) -> None:
    """The closed loop is interrupted in its so many-th call of `run_range`, counted from here."""
    left = [call]

    def interrupted(*given: Any, **options: Any) -> Any:
        left[0] -= 1
        if left[0] == 0:
            raise KeyboardInterrupt
        return run_range(*given, **options)

    monkeypatch.setattr("planner.rollouts.closed_loop.run_range", interrupted)


# --- Policies that other processes can import.


def mostly_east(seen: NDArray[np.float32], luck: np.random.Generator) -> NDArray[np.int64]:
    """East, and now and then wherever."""
    return np.where(luck.random(len(seen)) < 0.8, 3, luck.integers(0, 5, len(seen)))
