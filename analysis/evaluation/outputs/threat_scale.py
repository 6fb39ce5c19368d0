"""How wrong may the threat map be? The same plan and decisions, robots stopped by threats that are s times the map's.

The planner and the robots go on believing the map: paths, areas, levels and costs stay, only the hit checks change. The
random numbers stay too, so a robot that is stopped at one scale is, as long as it drives the same way, stopped at every
larger one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from analysis.evaluation.figures import Figures
from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.kit.tables import make_table
from analysis.sampling import make_roll_out
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from planner.arguments import argument, is_real, numbers_of
from planner.errors import UsageError
from planner.files import Json
from planner.plans.plan import is_certain
from planner.tally import Tally
from planner.worlds.world import World

MOST_SCALES = 100
LARGEST_THREAT = float(np.nextafter(np.float32(1), np.float32(0)))


def parse_scales(text: str | None) -> tuple[float, ...]:
    """The scales of "0.5,1,2"; raises UsageError for what is no such list."""
    if text is None:
        return ()
    expected = 'numbers, 0 or above, as "0.5,1,2"'
    scales = numbers_of("threat_scale", text, expected)
    if len(scales) > MOST_SCALES:
        raise UsageError(f"{argument('threat_scale')} has {len(scales)} scales", expected=f"{MOST_SCALES} at most")
    if not all(0 <= scale < float("inf") for scale in scales):
        raise UsageError(f"{argument('threat_scale')} {text!r}", expected=expected)
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


@dataclass(frozen=True, eq=False)
class Scaled:
    """The same plan and luck, under threats that are `scale` times the map's.

    Attributes:
        scale: times the map's p. tally: of as many rollouts as the evaluation's, the same ids.
        exact: the open loop's closed form under those threats.
        certain: nothing can happen under them, so that one rollout is every run.
    """

    scale: float
    tally: Tally
    exact: OpenLoopExact
    certain: bool = False

    @cached_property
    def figures(self) -> Figures:
        """What these rollouts come to."""
        return Figures.of(self.tally, self.certain)

    def as_json(self) -> Json:
        """The figures of the whole run, in short."""
        found = self.figures
        return {
            "scale": self.scale,
            "certain": self.certain,
            "coverage": found.coverage_json(),
            "complete": found.complete.to_json(),
            "losses": found.losses.to_json(),
            "time": {"mean": found.time.mean},
            "exact": {"open_loop": {"visited": self.exact.visited, "survived": self.exact.survived}},
        }

    def columns(self) -> Iterator[str]:
        """A row of the table."""
        found, unit = self.figures, 100.0 / self.tally.accessible
        yield f"{self.scale:g}"
        yield from found.visited.mean.columns(unit, 100)
        yield found.survived.mean.columns(unit, 100)[0]
        yield found.complete.columns()[0]
        yield found.losses.columns()[0]
        yield f"{found.time.mean:.1f}"


@dataclass(frozen=True, eq=False)
class ThreatScale(Output):
    """The plan under other threats, one scale after the other."""

    scaled: tuple[Scaled, ...] = ()

    @classmethod
    def check(cls, asked: Sequence[float], world: World) -> None:
        world.check_settled(argument("threat_scale"))
        for scale in asked:
            scaled_threats(world, scale)

    @classmethod
    def measure(cls, asked: Sequence[float], run: Run) -> Iterator[Self]:
        found = cls()
        for scale in asked:
            run.doing(f"rollouts under {scale:g} times the threats")
            threats = scaled_threats(run.world, scale)
            certain = is_certain(threats, run.plan, run.choices.loop)
            count = 1 if certain else run.last.tally.rollouts
            few = replace(run.choices, rollouts=count, precision=None)
            for stage in make_roll_out(run.world, run.plan, few, threats, run.kept)(few, None):
                tally = stage.tally
                run.progress(tally.rollouts, count, stage.seconds)
            found = cls((*found.scaled, Scaled(scale, tally, open_loop_exact(run.plan, threats), certain)))
            yield found

    def as_json(self) -> list[Json]:
        return [scaled.as_json() for scaled in self.scaled]

    def blocks(self) -> Blocks:
        columns = ("times", "visited, %", "from .. to", "survived, %", "every cell, %", "robots lost", "time")
        title = "If every threat is so many times the map's"
        table = make_table(columns, title, dropped=("time", "every cell, %"))
        for scaled in self.scaled:
            table.add_row(*scaled.columns())
        return Blocks(tables=[table])
