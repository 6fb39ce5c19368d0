"""How fast rollouts are recorded, and how large the files are: `python -m analysis.bench.recording [--outcomes N]`."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from analysis.recording.mcap.container import LogWriter
from analysis.recording.pick import Picker
from analysis.recording.record import CHUNK_SIZE, record
from analysis.recording.rolling import OutcomeColumns, Request, engine_of
from analysis.recording.viewers.topics import topic_types
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.plans.settings import Settings
from planner.rollouts.engine import run_chunks
from planner.worlds.generate import ThreatPattern, random_world
from planner.worlds.starts import place_starts
from planner.worlds.world import World

ROLLOUT = 202
"""Of `bench_task` with 50 x 50 cells and 8 robots: 1,000 steps, t = 0 counted."""
TIMES = 3


def bench_task(side: int = 50, robots: int = 8) -> tuple[World, Plan]:
    """A world of the paper's kind, `side` x `side`, with faint threats, so that rollouts are long."""
    pattern = ThreatPattern(levels=(0.004, 0.008, 0.012, 0.016, 0.02), seed=1)
    world = random_world(side, side, pattern)
    starts, _ = place_starts(world, robots)
    return world, make_plan(world, starts, Settings())


def bench_rollout(folder: Path, side: int, robots: int) -> None:
    """Steps, milliseconds a step (rolling out included) and bytes of a file with one rollout in full."""
    world, plan = bench_task(side, robots)
    path = folder / "rollout.mcap"
    runs = [record(world, plan, Request(ids=(ROLLOUT,)), path) for _ in range(TIMES)]
    seconds, steps, size = min(run.record_seconds for run in runs), runs[0].steps, path.stat().st_size
    print(  # noqa: T201
        f"{side}x{side}, {robots} robots: {steps} steps, {1e3 * seconds / steps:.3f} ms a step, {size / 1e6:.3f} MB, "
        f"{size / steps:.0f} bytes a step"
    )


def bench_outcomes(folder: Path, count: int) -> None:
    """Seconds and bytes that picking from `count` rollouts, and keeping their outcomes, take beyond evaluating them."""
    world, plan = bench_task(20, 8)
    engine, columns, types = engine_of(world, plan, Request()), OutcomeColumns(), topic_types()
    picker = Picker(engine.accessible)
    seconds = dict.fromkeys(("evaluate", "pick", "outcomes"), 0.0)
    path = folder / "outcomes.mcap"

    def spend(on: str, since: float) -> float:
        now = time.perf_counter()
        seconds[on] += now - since
        return now

    with LogWriter(path, chunk_size=CHUNK_SIZE) as log:
        clock = time.perf_counter()
        for chunk in run_chunks(engine, count, results=True):
            assert chunk.results is not None
            clock = spend("evaluate", clock)
            picker.add(chunk.results)
            clock = spend("pick", clock)
            for message in columns.add(chunk.results):
                log.write(log.channel(message.topic, types[message.topic]), message.time, message.data)
            clock = spend("outcomes", clock)
    print(  # noqa: T201
        f"{count:,} rollouts: evaluated in {seconds['evaluate']:.1f} s; beyond that {seconds['pick']:.2f} s for "
        f"picking and {seconds['outcomes']:.2f} s for their outcomes, {path.stat().st_size / 1e6:.2f} MB"
    )


def main() -> None:
    """Print all of it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--outcomes", type=int, default=1_000_000)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        for side, robots in ((20, 8), (50, 8), (100, 8), (50, 32)):
            bench_rollout(Path(name), side, robots)
        if chosen.outcomes:
            bench_outcomes(Path(name), chosen.outcomes)


if __name__ == "__main__":
    main()
