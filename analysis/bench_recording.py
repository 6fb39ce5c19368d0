"""How fast rollouts are recorded, and how large the files are: `python -m analysis.bench_recording [--outcomes N]`."""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

from analysis.recording.container import LogWriter
from analysis.recording.drawn import Clock, Stage, rollout_messages, topic_types, type_of
from analysis.recording.pick import parse_picks
from analysis.recording.record import CHUNK_SIZE, Request, make_runner, record
from planner.generate import ThreatPattern, random_world
from planner.plan import Plan, Settings
from planner.planner import make_plan
from planner.starts import place_starts
from planner.world import World

WARM = Request(ids=(0,))


def bench_task(side: int = 50, robots: int = 8) -> tuple[World, Plan]:
    """A world of the paper's kind, `side` x `side`, with faint threats, so that rollouts are long."""
    pattern = ThreatPattern(levels=(0.001, 0.002, 0.003, 0.004, 0.005), seed=1)
    world = random_world(side, side, pattern)
    starts, _ = place_starts(world, robots)
    return world, make_plan(world, starts, Settings())


def bench_rollout(folder: Path, side: int, robots: int) -> None:
    """Steps, milliseconds a step and bytes of one rollout in full."""
    world, plan = bench_task(side, robots)
    runner, types = make_runner(world, plan, WARM), topic_types()
    trace = next(iter(runner.traces((0,))))
    path = folder / "rollout.mcap"
    best = float("inf")
    for _ in range(3):
        clock = time.perf_counter()
        with LogWriter(path, chunk_size=CHUNK_SIZE) as log:
            for message in rollout_messages(Stage(world, plan, "closed", 0), trace, Clock(0, 1.0)):
                log.write(log.channel(message.topic, type_of(message.topic, types)), message.time, message.data)
        best = min(best, time.perf_counter() - clock)
    steps, size = len(trace.cells), path.stat().st_size
    print(  # noqa: T201
        f"{side}x{side}, {robots} robots: {steps} steps, {1e3 * best / steps:.3f} ms a step, {size / 1e6:.3f} MB, "
        f"{size / steps:.0f} bytes a step"
    )


def bench_outcomes(folder: Path, count: int) -> None:
    """Seconds and bytes that the outcomes of `count` rollouts take beyond their evaluation."""
    world, plan = bench_task(20, 8)
    request = Request(picks=parse_picks("median"), evaluated=count)
    record(world, plan, Request(ids=(0,)), folder / "warm.mcap")
    sizes, seconds = [], []
    for outcomes in (False, True):
        path = folder / f"outcomes-{outcomes}.mcap"
        made = record(world, plan, Request(picks=request.picks, evaluated=count, outcomes=outcomes), path)
        sizes.append(path.stat().st_size)
        seconds.append(made.evaluate_seconds)
    runner = make_runner(world, plan, WARM)
    clock = time.perf_counter()
    for _ in runner.chunks(0, count):
        pass
    alone = time.perf_counter() - clock
    print(  # noqa: T201
        f"{count} outcomes: evaluation alone {alone:.1f} s, with picking {seconds[0]:.1f} s, with outcomes "
        f"{seconds[1]:.1f} s; {(sizes[1] - sizes[0]) / 1e6:.2f} MB"
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
