"""How wrong may the threat map be? The same plan and decisions, robots stopped by threats that are s times the map's.

The planner and the robots go on believing the map: paths, areas, levels and costs stay, only the hit checks change. The
random numbers stay too, so a robot that is stopped at one scale is, as long as it drives the same way, stopped at every
larger one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from analysis.evaluation.answer import Scaled
from analysis.sampling import RolloutChoices, is_certain, make_roll_out
from analysis.theory.exact import open_loop_exact
from planner.arguments import argument, is_real
from planner.errors import UsageError
from planner.plans.plan import Plan
from planner.worlds.world import World

MOST_SCALES = 100
LARGEST_THREAT = float(np.nextafter(np.float32(1), np.float32(0)))


def parse_scales(text: str | None) -> tuple[float, ...]:
    """The scales of "0.5,1,2"; raises UsageError for what is no such list."""
    if text is None:
        return ()
    expected = 'numbers, 0 or above, as "0.5,1,2"'
    try:
        scales = tuple(float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--threat-scale {text!r}", expected=expected) from None
    if len(scales) > MOST_SCALES:
        raise UsageError(f"--threat-scale has {len(scales)} scales", expected=f"{MOST_SCALES} at most")
    if not all(0 <= scale < float("inf") for scale in scales):
        raise UsageError(f"--threat-scale {text!r}", expected=expected)
    return scales


def scaled_threats(world: World, scale: float) -> World:
    """The world with every threat times `scale` >= 0; raises UsageError if it is none, or makes some p >= 1."""
    if not (is_real(scale) and scale >= 0):
        raise UsageError(argument("threat_scale", scale), expected="numbers, 0 or above")
    threat = world.threat.astype(np.float64) * scale
    most = float(np.nanmax(world.threat)) if world.free.any() else 0.0
    if most * scale > LARGEST_THREAT:
        row, col = np.unravel_index(int(np.nanargmax(world.threat)), world.shape)
        named = argument("threat_scale", float(f"{scale:.10g}"))
        raise UsageError(
            f"{named}: the threat {most:g} of cell [{row}, {col}] would be {most * scale:.9g}",
            expected=f"at most {LARGEST_THREAT:.9g}: a scale of at most {LARGEST_THREAT / most:.9g}",
        )
    return replace(world, threat=threat.astype(np.float32))


def roll_out_scaled(
    world: World,
    plan: Plan,
    choices: RolloutChoices,
    rollouts: int,
    scale: float,
    threats: World,
    progress: Callable[[int, int, float], None] | None = None,
) -> Scaled:
    """`rollouts` rollouts of the plan for `world`, ids from 0, stopped by `threats`, the world of `scaled_threats`.

    One where nothing can happen under those threats: then every run is the same.
    """
    certain = is_certain(threats, plan)
    few = replace(choices, rollouts=1 if certain else rollouts, precision=None, control=False)
    for stage in make_roll_out(world, plan, few, threats)(few, None):
        tally = stage.tally
        if progress is not None:
            progress(tally.rollouts, few.rollouts, stage.seconds)
    return Scaled(scale, tally, open_loop_exact(plan, threats), certain)
