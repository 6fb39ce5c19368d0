"""Times of JAX and Numba on this machine: `python -m mrac_jax.bench [--minutes M] [--small]`, or `make bench-gpu`.

Before it times an engine, the program checks that JAX and Numba agree: closed loop rollout by rollout, open loop count
for count. The exit status is 1 if they differ, and 3 if the time was over before the end. Each row is printed as soon
as it is measured. Rates are medians of wall time, of calls with ids that no call before them has rolled out. It needs
NumPy, SciPy, Numba, JAX, pymetis and PyYAML, and runs from a checkout that is not installed.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime
from functools import cache, partial
from typing import Any

import jax
import jaxlib
import numba
import numpy as np
from jax import monitoring

from mrac_jax.closed_loop.engine import JaxClosedLoop
from mrac_jax.functional import Counts, arrays, rollouts, thresholds
from planner.make_plan import make_plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.engine import closed_loop_engine, open_loop_engine
from planner.rollouts.open_loop import available_cores, compile_plan
from planner.tally import RolloutResults
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.start_rule import place_starts

Call = Callable[[int, int], Any]
"""Rolls out `(start, count)`."""
SEED, ROBOTS, CHECKED = 1, 8, 2**12
REPETITIONS, SECONDS = 3, 2.0
"""Limits of timed calls: their number, and the seconds after which no further call starts."""
COMPILES = "/jax/core/compile/"
"""Prefix of JAX's events of tracing, lowering and compilation."""
DIFFERENT, CUT_OFF = 1, 3
"""Exit statuses."""
WIDTHS = (20, 30, 13, 13, 13, 8, 10)
COLUMNS = ("world", "part", "rollouts/call", "JAX, 1/s", "Numba, 1/s", "ratio", "compile, s")
CHECKS_END, OPEN_ENDS = 0.4, 0.55
"""Fractions of the time at which the checks and the open loop end. The closed loop has the rest."""
CASES: tuple[tuple[Kind, int, float], ...] = (
    ("contiguous", 20, 0.25), ("contiguous", 20, 0.05), ("scattered", 20, 0.25), ("contiguous", 64, 0.25),
)  # fmt: skip
"""Kind, side, share of dangerous cells."""


@dataclass(frozen=True)
class Scale:
    """Sizes of a run.

    Attributes:
        cases: number of CASES. lanes: of the closed loop, the first also for the check; others: of all cases but the
            first. draws: rollouts whose thresholds are drawn in a call. open: rollouts of an open-loop call.
        batch: of `mrac.functional.rollouts`. least: rollouts of the smallest call when JAX and Numba are compared.
    """

    cases: int
    lanes: tuple[int, ...]
    others: tuple[int, ...]
    draws: int
    open: tuple[int, ...]
    batch: int
    least: int


draw = jax.jit(partial(thresholds, SEED, robots=ROBOTS))
MANY = tuple(2**power for power in (16, 12, 14, 18, 13, 15, 17))
SCALES = {
    "gpu": Scale(4, MANY, MANY[:4], 2**22, (2**20, 2**24), 2**16, 2**12),
    # Fewer worlds: the books of the others grow, so their programs are compiled several times, too slow on a CPU.
    "cpu": Scale(2, (2**10, 2**8), (2**10,), 2**18, (2**16, 2**18), 2**12, 2**12),
    "small": Scale(1, (2**8,), (), 2**14, (2**14,), 2**12, 2**12),
}


def print_row(*cells: str) -> None:
    """Print a row; cells after the columns may have any length."""
    sized = [f"{cell:{'<' if at < 2 else '>'}{width}}" for at, (cell, width) in enumerate(zip(cells, WIDTHS))]  # noqa: B905
    sys.stdout.write("  ".join([*sized, *cells[len(WIDTHS) :]]).rstrip() + "\n")
    sys.stdout.flush()


class Run:
    """The time of a run in seconds, by parts, and the seconds that JAX compiles."""

    def __init__(self, seconds: float, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock, self._began, self._seconds = clock, clock(), seconds
        self._end = self._since = self._longest = self._compiled = 0.0
        monitoring.register_event_duration_secs_listener(self._add)

    def _add(self, event: str, duration_secs: float, **_: str | int) -> None:
        self._compiled += duration_secs if event.startswith(COMPILES) else 0.0

    def begin(self, share: float) -> None:
        """Begin a part, which ends at this fraction of the time; time left by earlier parts is available to it."""
        self._end, self._since, self._longest = share * self._seconds, self.elapsed(), 0.0

    def allows(self, title: str, what: str) -> bool:
        """True if a measurement as long as the longest of this part would end in time; else prints a row."""
        now = self.elapsed()
        self._since, self._longest = now, max(self._longest, now - self._since)
        fits = now + self._longest < self._end
        if not fits:
            print_row(title, what, "skipped: the time of this part is over")
        return fits

    def elapsed(self) -> float:
        """Seconds since the begin."""
        return self._clock() - self._began

    def compiled(self) -> str:
        """Seconds that JAX took to trace and compile programs, or to read them from its cache, since the last call."""
        seconds, self._compiled = self._compiled, 0.0
        return f"{seconds:.1f}" if seconds else ""


class WatchedLoop(JaxClosedLoop):
    """The closed loop in JAX, which counts how often its program is started, each time with the book as it is then."""

    starts = 0

    def book(self) -> Any:
        """The book on the devices."""
        self.starts += 1
        return super().book()


@cache
def rate(call: Call, count: int) -> float:
    """Rollouts a second: the median of a few calls, after one that is not timed."""
    call(0, count)
    taken = list[float]()
    while len(taken) < REPETITIONS and sum(taken) < SECONDS:
        clock = time.perf_counter()
        call((len(taken) + 1) * count, count)
        taken.append(time.perf_counter() - clock)
    return count / statistics.median(taken)


def overtakes(of_jax: Call, of_numba: Call, most: int, least: int) -> str:
    """The least number of rollouts a call from which on, up to `most`, JAX is faster than Numba, by factors of 4."""
    found, count = "none", most
    while count >= least and rate(of_jax, count) > rate(of_numba, count):
        found, count = f"{count:,}", count // 4
    return found


def same_counts(one: Any, other: Any) -> bool:
    """True if counts are equal up to trailing zeros."""
    first, second = (np.trim_zeros(np.asarray(each, dtype=np.int64).reshape(-1), "b") for each in (one, other))
    return np.array_equal(first, second)


def same_results(one: RolloutResults, other: RolloutResults) -> bool:
    """True if all rollouts have equal results."""
    return all(np.array_equal(getattr(one, column.name), getattr(other, column.name)) for column in fields(one))


class Case:
    """A world, its plan and its engines. The closed loop in JAX has the first number of lanes.

    Args:
        kind, side, ratio: of the world. scale: of the run.
    """

    def __init__(self, kind: Kind, side: int, ratio: float, scale: Scale) -> None:
        self.title, self.scale = describe_world(kind, side, ratio), scale
        self.world = random_world(side, side, ThreatPattern(kind), threats=ratio)
        plan = make_plan(self.world, place_starts(self.world, ROBOTS)[0])
        self.loop, compiled = compile_closed_loop(plan, self.world), compile_plan(plan, self.world)
        self.closed_numba = closed_loop_engine(self.loop, SEED, "numba")
        self.open_numba = open_loop_engine(compiled, SEED, "numba")
        self.open_jax = open_loop_engine(compiled, SEED, "jax")
        self.arrays = arrays(self.world, plan)
        self.closed_jax: WatchedLoop

    def check(self, run: Run) -> bool:
        """Print whether JAX and Numba agree and how long JAX's programs took to compile; return whether they agree."""
        all_equal = True
        for what, equal in self._checks():
            said = "equal" if equal else "DIFFERENT"
            print_row(self.title, f"check: {what}", f"{CHECKED:,}", said, "", "", run.compiled())
            all_equal &= equal
        return all_equal

    def _checks(self) -> Iterator[tuple[str, bool]]:
        self.closed_jax = WatchedLoop(self.loop, SEED, lanes=self.scale.lanes[0])
        (ours, mine), (theirs, other) = self.closed_jax.run(0, CHECKED), self.closed_numba.run(0, CHECKED)
        yield "closed loop, by rollout", ours == theirs and same_results(mine, other)
        expected = self.open_numba.tally(0, CHECKED)
        yield "open loop, counts", self.open_jax.tally(0, CHECKED) == expected
        found = self.functional(0, CHECKED)
        pairs = ((found.cells_visited, expected.visited), (found.cells_survived, expected.survived),
                 (found.visits, expected.visits), (found.losses, expected.stops))  # fmt: skip
        yield "mrac.functional, counts", all(same_counts(*pair) for pair in pairs)
        high, low = np.moveaxis(np.asarray(self.draw(0, CHECKED)).astype(np.int64), -1, 0)
        yield "thresholds", np.array_equal((high << 32) + low, self.draw_on_host(0, CHECKED))

    def functional(self, start: int, count: int) -> Counts:
        """Open-loop rollouts by `mrac.functional`."""
        found = rollouts(SEED, self.arrays, self.world.threat, count, self.scale.batch, start)
        return jax.block_until_ready(found)

    def draw(self, start: int, count: int) -> jax.Array:
        """Failure thresholds, drawn on the device."""
        return draw(np.arange(start, start + count, dtype=np.uint32)).block_until_ready()

    def draw_on_host(self, start: int, count: int) -> Any:
        """Failure thresholds, drawn by NumPy."""
        return self.loop.failure_model.thresholds(SEED, np.arange(start, start + count), ROBOTS)

    def measure(self, run: Run, what: str, of_jax: Call, of_numba: Call, count: int) -> None:
        """Print the rates of both."""
        speed, other = rate(of_jax, count), rate(of_numba, count)
        row = f"{count:,}", f"{speed:,.0f}", f"{other:,.0f}", f"{speed / other:.3g}", run.compiled()
        print_row(self.title, what, *row)

    def compare(self, run: Run, loop: str, of_jax: Call, of_numba: Call, most: int) -> None:
        """Print the number of rollouts a call at which JAX overtakes Numba."""
        what = f"{loop}: JAX is faster from"
        if run.allows(self.title, what):
            print_row(self.title, what, overtakes(of_jax, of_numba, most, self.scale.least), f"(up to {most:,} a call)")

    def time_open(self, run: Run) -> None:
        """Thresholds, and the open loop by `mrac.functional` and by the engine."""
        calls: list[tuple[str, Call, Call, int]]
        calls = [("thresholds (host: NumPy)", self.draw, self.draw_on_host, self.scale.draws)]
        for count in self.scale.open:
            calls.append(("open loop, mrac.functional", self.functional, self.open_numba.tally, count))
            calls.append(("open loop, engine", self.open_jax.tally, self.open_numba.tally, count))
        for what, *call in calls:
            if run.allows(self.title, what):
                self.measure(run, what, *call)  # type: ignore[arg-type]
        self.compare(run, "open loop", self.open_jax.tally, self.open_numba.tally, max(self.scale.open))

    def time_closed(self, run: Run, lanes: Sequence[int]) -> None:
        """The closed loop with these numbers of lanes."""
        for number in lanes:
            what = f"closed loop, {number:,} lanes"
            if run.allows(self.title, what):
                engine = self.closed_jax if number == lanes[0] else WatchedLoop(self.loop, SEED, lanes=number)
                self.measure(run, what, engine.tally, self.closed_numba.tally, engine.least)
                size = sum(table.rows.nbytes for table in engine.host.tables.values()) / 2**20
                starts = engine.starts
                engine.tally((REPETITIONS + 1) * engine.least, engine.least)
                book = f"{engine.host.entries.used:,} entries, {size:.1f} MiB"
                print_row("", f"  book: {book}; {engine.starts - starts} trips to the host in the next call")
        most = self.closed_jax.least
        self.compare(run, "closed loop", self.closed_jax.tally, self.closed_numba.tally, most)
        rate.cache_clear()  # it holds the engines and their memory on the device


def describe_world(kind: str, side: int, ratio: float) -> str:
    """Size, kind and share of dangerous cells."""
    return f"{side}x{side} {kind} {ratio:.0%}"


def describe(sizes: str) -> str:
    """Devices, versions, cores and date."""
    devices = jax.local_devices()
    cache = "on" if jax.config.jax_enable_compilation_cache else "off"  # type: ignore[attr-defined]
    return (
        f"{len(devices)} x {devices[0].device_kind} ({devices[0].platform}), {sizes} sizes\n"
        f"Python {platform.python_version()}, NumPy {np.__version__}, Numba {numba.__version__}, "
        f"JAX {jax.__version__}, jaxlib {jaxlib.__version__}; JAX's cache of programs: {cache}\n"
        f"{os.cpu_count()} CPU cores, Numba uses {available_cores()}; {datetime.now(UTC):%Y-%m-%d %H:%M} UTC\n"
    )


def memory() -> str:
    """Peak memory of the process on a device in GB; empty if JAX does not report it."""
    most = [(device.memory_stats() or {}).get("peak_bytes_in_use", 0) for device in jax.local_devices()]
    return f", {max(most) / 1e9:.2f} GB of device memory at most" if any(most) else ""


def measure(sizes: str, run: Run) -> int:
    """Print the table; return the exit status."""
    scale, cases = SCALES[sizes], list[Case]()
    sys.stdout.write(describe(sizes))
    print_row(*COLUMNS)
    run.begin(CHECKS_END)
    for world in CASES[: scale.cases]:
        if run.allows(describe_world(*world), "check (no check, no rates)"):
            cases.append(Case(*world, scale))
            run.compiled()
            if not cases[-1].check(run):
                return DIFFERENT
    for world in CASES[scale.cases :]:
        print_row(describe_world(*world), f"not among the {sizes} sizes")
    run.begin(OPEN_ENDS)
    for case in cases:
        case.time_open(run)
    for number, case in enumerate(cases, 1):
        run.begin(OPEN_ENDS + (1 - OPEN_ENDS) * number / len(cases))
        case.time_closed(run, scale.lanes if number == 1 else scale.others)
    sys.stdout.write(f"{run.elapsed():.0f} s{memory()}\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure for so many minutes at most; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m mrac_jax.bench", description="Time JAX and Numba.")
    parser.add_argument("--minutes", type=float, default=8.0, help="the run ends by then (default: 8)")
    parser.add_argument("--small", action="store_true", help="one world, few rollouts; reads JAX's cache of programs")
    asked = parser.parse_args(arguments)
    if not asked.minutes > 0:
        parser.error(f"minutes: {asked.minutes:g}, expected a number above 0")
    if not asked.small:  # a program that is read from the cache has no compile time
        jax.config.update("jax_enable_compilation_cache", False)

    def stop() -> None:
        print_row("", f"stopped after {asked.minutes:g} minutes")
        os._exit(CUT_OFF)  # a compilation cannot be interrupted

    timer = threading.Timer(60 * asked.minutes, stop)
    timer.daemon = True
    timer.start()
    try:
        sizes = "small" if asked.small else "cpu" if jax.default_backend() == "cpu" else "gpu"
        return measure(sizes, Run(57 * asked.minutes))
    finally:
        timer.cancel()


if __name__ == "__main__":
    sys.exit(main())
