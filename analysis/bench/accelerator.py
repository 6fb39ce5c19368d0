"""How fast an accelerator is: `make bench-gpu`, or `python -m analysis.bench.accelerator`. Full tallies.

JAX on all devices against Numba on all cores, open and closed loop, at 20x20, 64x64 and on the terrain, in one run;
where JAX has no accelerator, a line that says so. Option, to try it out: `--device cpu`, JAX's own processor instead.
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path

import jax
from rich.console import Console

from analysis.bench.race import Contender, engine_contender, planned, print_row, race
from planner.mrac.make_plan import make_plan
from planner.plans.plan import Plan
from planner.rollouts.engine import Rolling, choose_engine, make_engine
from planner.rollouts.names import EngineName
from planner.worlds.scenario import load_input
from planner.worlds.starts import place_starts
from planner.worlds.world import World

TERRAIN = Path(__file__).parents[1] / "examples" / "terrain.yaml"
ROBOTS, SEED = 8, 1
HOWS = (Rolling("open", seed=SEED, luck="tolerance"), Rolling("closed", seed=SEED, luck="tolerance"))
ENGINES: tuple[EngineName, ...] = ("numba", "jax")
COLUMNS = ("engine", "rollouts/s", "agent-moves/s", "first call, s", "device memory, GB")
CHECKED, REPETITIONS = 256, 3


def cases() -> dict[str, tuple[World, Plan]]:
    """The worlds, and their plans."""
    terrain = load_input(TERRAIN)
    found = {f"{side}x{side} 25 %": planned("contiguous", side) for side in (20, 64)}
    return {**found, "terrain": (terrain, make_plan(terrain, place_starts(terrain, ROBOTS)[0]))}


def raced(world: World, plan: Plan, how: Rolling) -> list[tuple[Contender, float]]:
    """The engines, and how many moves a rollout has."""
    makes = {name: partial(make_engine, plan, world, how, name) for name in ENGINES}
    found = [engine_contender(name, make, CHECKED) for name, make in makes.items()]
    race(found, REPETITIONS)
    tally = makes["numba"]().tally(0, CHECKED)
    return [(one, float(tally.visits.sum()) / CHECKED) for one in found]


def memory() -> str:
    """The most memory of a device that the process has had so far, in GB; nothing where JAX does not say."""
    most = [(device.memory_stats() or {}).get("peak_bytes_in_use", 0) for device in jax.local_devices()]
    return f"{max(most) / 1e9:.2f}" if any(most) else "-"


def main() -> None:
    """Print a line for every engine, loop and world."""
    console = Console(highlight=False)
    if choose_engine("auto").name != "jax" and sys.argv[1:] != ["--device", "cpu"]:
        console.print("no accelerator here: not measured")
        return
    console.print(f"devices: {', '.join(device.device_kind for device in jax.local_devices())}")
    print_row(console, f"{ROBOTS} robots", COLUMNS)
    for name, (world, plan) in cases().items():
        for how in HOWS:
            for one, moves in raced(world, plan, how):
                used = memory() if one.name == "jax" else ""
                rates = f"{one.rate:,.0f}", f"{one.rate * moves:,.0f}", f"{one.compile_seconds:.1f}"
                print_row(console, name, (f"{how.loop}, {one.name}", *rates, used))


if __name__ == "__main__":
    main()
