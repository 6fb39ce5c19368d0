"""This closed loop against another checkout's: `python -m analysis.bench.pairs CHECKOUT [NUMBER OF WORDS ...]`.

Both are loaded into one process and take turns, single-threaded, in CPU time, least of several repetitions, so that a
busy machine slows both alike. Before anything is timed their tallies must be equal count for count. `--many`: at many
rollouts a call, on the worlds where that is what pays; `--threads`: two threads of this one against one, by the clock,
medians, in calls as long as the program's own.
"""

from __future__ import annotations

import importlib
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.table import Table

from planner.errors import MracError
from planner.rollouts.blocks import CHUNK_SECONDS
from planner.worlds.generate import Kind

SEED = 1
REPETITIONS = 15
CHECKED = 500
EXAMPLES = Path(__file__).parents[1] / "examples"


class Case(NamedTuple):
    """A world of the paper's kind or an example, its team, and rollouts a call."""

    name: str
    kind: Kind | str
    side: int
    ratio: float
    robots: int
    rollouts: int
    many: int


CASES = (
    Case("20x20 contiguous 25 %", "contiguous", 20, 0.25, 8, 20_000, 262_144),
    Case("20x20 scattered 25 %", "scattered", 20, 0.25, 8, 20_000, 262_144),
    Case("20x20 contiguous 5 %", "contiguous", 20, 0.05, 8, 20_000, 1_000_000),
    Case("20x20 scattered 5 %", "scattered", 20, 0.05, 8, 20_000, 1_000_000),
    Case("20x20 contiguous 25 %, 2 robots", "contiguous", 20, 0.25, 2, 20_000, 1_000_000),
    Case("64x64 contiguous 25 %", "contiguous", 64, 0.25, 8, 1_500, 16_384),
    Case("64x64 contiguous 5 %", "contiguous", 64, 0.05, 8, 1_500, 16_384),
    Case("terrain", "terrain.yaml", 0, 0.0, 8, 600, 4_096),
)


class Version(NamedTuple):
    """One checkout's planner, as modules."""

    closed_loop: ModuleType
    generate: ModuleType
    starts: ModuleType
    make_plan: ModuleType
    scenario: ModuleType

    def loop_of(self, case: Case) -> object:
        """The closed loop of a case."""
        if case.side:
            pattern = self.generate.ThreatPattern(case.kind)
            world = self.generate.random_world(case.side, case.side, pattern, threats=case.ratio)
        else:
            found = self.scenario.load_input(EXAMPLES / case.kind)
            world = getattr(found, "world", found)  # older checkouts have scenarios
        starts = self.starts.place_starts(world, case.robots)[0]
        return self.closed_loop.compile_closed_loop(self.make_plan.make_plan(world, starts), world)


def load_version(checkout: Path) -> Version:
    """The planner of a checkout, beside any other that this process has loaded."""
    ours = {name: module for name, module in sys.modules.items() if _is_ours(name)}
    for name in ours:
        del sys.modules[name]
    sys.path.insert(0, str(checkout))
    rooms = ("kernels.closed_loop", "worlds.generate", "worlds.starts", "mrac.make_plan", "worlds.scenario")
    try:
        version = Version(*(importlib.import_module(f"planner.{room}") for room in rooms))
        if not str(version.closed_loop.__file__).startswith(str(checkout)):
            raise MracError(f"{checkout} holds no planner")
        return version
    finally:
        sys.path.remove(str(checkout))
        for name in [name for name in sys.modules if _is_ours(name)]:
            del sys.modules[name]
        sys.modules.update(ours)


def _is_ours(name: str) -> bool:
    return name.partition(".")[0] in ("planner", "mrac_jax", "analysis") and name != "__main__"


def _timed(work: Callable[[], object], clock: Callable[[], float]) -> float:
    began = clock()
    work()
    return clock() - began


def in_turns(*works: Callable[[], object], clock: Callable[[], float] = time.process_time) -> NDArray[np.float64]:
    """Seconds that each took, `[REPETITIONS, works]`: a row a turn."""
    return np.array([[_timed(work, clock) for work in works] for _ in range(REPETITIONS)])


def compare(case: Case, this: Version, other: Version, many: bool) -> tuple[str, ...]:
    """A row: rates and their ratio. Raises MracError if the tallies differ."""
    mine, theirs = this.loop_of(case), other.loop_of(case)
    one, two = (
        version.closed_loop.run_range(loop, SEED, 0, CHECKED, threads=1)[0]
        for version, loop in ((this, mine), (other, theirs))
    )
    if any(not _same(one.counts()[name], counts) for name, counts in two.counts().items()):
        raise MracError(f"the tallies differ: {case.name}")
    count = case.many if many else case.rollouts
    few = min(count, case.rollouts)  # the other one's rate does not depend on it
    fast, slow = in_turns(
        lambda: this.closed_loop.run_range(mine, SEED, 0, count, threads=1),
        lambda: other.closed_loop.run_range(theirs, SEED, 0, few, threads=1),
    ).min(axis=0)
    return (case.name, f"{count:,}", f"{few / slow:,.0f}", f"{count / fast:,.0f}", f"{count / fast * slow / few:.2f}")


def _same(one: NDArray[np.int64], two: NDArray[np.int64]) -> bool:
    """Equal; what only one of them can count (an outcome of later days) is 0."""
    shared = min(len(one), len(two))
    return bool((one[:shared] == two[:shared]).all()) and not one[shared:].any() and not two[shared:].any()


def over_threads(case: Case, this: Version) -> tuple[str, ...]:
    """A row: one thread and two, by the clock."""
    loop, count = this.loop_of(case), case.many

    def run(threads: int) -> None:
        this.closed_loop.run_range(loop, SEED, 0, count, threads=threads)

    run(2)  # code is loaded once
    while _timed(partial(run, 2), time.perf_counter) < CHUNK_SECONDS / 2:
        count *= 2
    took = in_turns(partial(run, 1), partial(run, 2), clock=time.perf_counter)
    one, two = np.median(took, axis=0)
    ratio = np.median(took[:, 0] / took[:, 1])  # nobody else may use a core: what is least for two is seldom seen
    return (case.name, f"{count:,}", f"{count / one:,.0f}", f"{count / two:,.0f}", f"{ratio:.2f}")


def main() -> None:
    """Print the table."""
    words = [word for word in sys.argv[1:] if not word.startswith("--")]
    chosen = [CASES[int(word)] for word in words[1:]] or CASES
    here = Path(__file__).parents[2]
    this, threads, many = load_version(here), "--threads" in sys.argv, "--many" in sys.argv
    columns = ("1 thread", "2 threads") if threads else ("theirs", "ours")
    table = Table(title="Closed loop, full tally, rollouts/s", box=box.SIMPLE_HEAD, title_justify="left")
    for column in ("world", "rollouts", *columns, "ratio"):
        table.add_column(column, justify="left" if column == "world" else "right")
    other = this if threads else load_version(Path(words[0]).resolve())
    console = Console(width=100)
    for case in chosen:
        table.add_row(*(over_threads(case, this) if threads else compare(case, this, other, many)))
    console.print(table)


if __name__ == "__main__":
    main()
