"""What robots gain by learning about hazards from what happens to them: told, learning and blind, on the same luck.

Those that are told know which cells have a hazard: each rollout is planned for the ones that it meets. And what the
team knows of each cell in the end, on average over runs: the posterior, and the doubt that is left (SPEC section 15).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import Any, Self

import numpy as np
from matplotlib.colors import Normalize
from numpy.typing import NDArray

from analysis.evaluation.outputs.output import Blocks, Output, Run
from analysis.exporting.geotiff import raster
from analysis.kit.tables import make_table
from analysis.page.cell_maps import CellLayer
from analysis.pictures.style import COVERED, LOSSES
from analysis.statistics.coverage import more_said
from analysis.statistics.estimate import Estimate
from analysis.trials.measured import Measured
from analysis.trials.told import told_of_hazards
from analysis.trials.trial import Trial
from planner.arguments import argument
from planner.errors import UsageError
from planner.files import Json
from planner.kernels.closed_loop import compile_closed_loop, final_odds
from planner.mrac.make_plan import allocated_plan
from planner.shown import counted, percent
from planner.worlds.doubt import Hazard
from planner.worlds.evidence import chance_of
from planner.worlds.world import World

MOST, MOST_MAPS, MOST_ENDS = 8192, 128, 256
"""Rollouts of each team, of robots that are told (each is a plan of its own), and that are looked at when they end."""
BANDS = {
    "prior": "chance that a hazard is in the cell, before anything happens",
    "posterior": "the same as the team knows it at the end of a run, mean over runs",
    "entropy": "doubt left at the end of a run, bits, mean over runs",
}


@dataclass(frozen=True, eq=False)
class Experience(Output):
    """Three teams, and what is known in the end.

    Attributes:
        told, learning, blind: what they come to; told ones on the first of the others' rollouts.
        world: whose robots learn. reach: bool `[H, W]`, cells that robots can reach.
        posterior, entropy: float64 `[H, W]`, mean over `ends` runs; entropy in bits.
    """

    told: Measured
    learning: Measured
    blind: Measured
    world: World
    reach: NDArray[np.bool_]
    posterior: NDArray[np.float64]
    entropy: NDArray[np.float64]
    ends: int

    @classmethod
    def check(cls, asked: Any, world: World) -> None:
        if world.learned_hazard is None:
            fix = "give the scenario `hazard: {..., learn: true}`"
            raise UsageError(argument("experience", asked), expected="robots that learn about hazards", fix=fix)

    @classmethod
    def measure(cls, asked: bool, run: Run) -> Iterator[Self]:
        world, plan, hazard = run.world, run.plan, run.world.doubt
        if not isinstance(hazard, Hazard) or run.choices.loop == "open":
            return
        count = min(run.last.tally.rollouts, MOST)
        choices = replace(
            run.choices, rollouts=count, precision=None, seconds=None, deadline=None, exact="never", engine="numba"
        )
        run.doing("the same team, if it learns nothing")
        unaware = replace(world, doubt=replace(hazard, learn=False, detector=None))
        blind = Trial(unaware, allocated_plan(unaware, plan.starts, plan.require(world)), choices).sample(0, count)
        learning = Trial(world, plan, choices).sample(0, count)
        run.doing("the same team, told where hazards are")
        told = told_of_hazards(world, plan, choices, min(count, MOST_MAPS))
        run.doing("what is known in the end")
        loop, ends = compile_closed_loop(plan, world, luck=choices.luck), min(count, MOST_ENDS)
        prior = np.where(world.free, hazard.q, np.nan).astype(np.float64).ravel()
        posterior, entropy = prior.copy(), entropy_of(prior)
        if loop.learns:
            known = chance_of(final_odds(loop, choices.seed, 0, ends))
            posterior[loop.cells], entropy[loop.cells] = known.mean(axis=0), entropy_of(known).mean(axis=0)
        reach, shape = world.accessible(plan.starts), world.shape
        yield cls(told, learning, blind, world, reach, posterior.reshape(shape), entropy.reshape(shape), ends)

    @property
    def prior(self) -> NDArray[np.float64]:
        """float64 `[H, W]`: the chance that a hazard is there, before anything happens."""
        assert isinstance(self.world.doubt, Hazard)
        return self.world.doubt.q.astype(np.float64)

    @cached_property
    def price(self) -> Estimate:
        """How much more of the cells robots visit that are told."""
        return self.told.ahead(self.learning, "visited", self._unit)

    @cached_property
    def worth(self) -> Estimate:
        """How much more of the cells they visit than if they learned nothing."""
        return self.learning.ahead(self.blind, "visited", self._unit)

    @property
    def bits(self) -> tuple[float, float]:
        """Doubt a cell in reach, at first and in the end, bits, on average."""
        return float(entropy_of(self.prior)[self.reach].mean()), float(self.entropy[self.reach].mean())

    @property
    def _unit(self) -> float:
        return 1.0 / self.learning.largest("visited")

    def as_json(self) -> Json:
        before, after = self.bits
        return {
            **{name: self._team(found) for name, found in self._teams()},
            "price_of_not_knowing": self.price.to_json(),
            "worth_of_learning": self.worth.to_json(),
            "maps": self.told.rollouts,
            "rollouts": self.learning.rollouts,
            "posterior": {"rollouts": self.ends, "entropy": {"before": before, "after": after}},
        }

    def _teams(self) -> Iterator[tuple[str, Measured]]:
        return iter((("told", self.told), ("learning", self.learning), ("blind", self.blind)))

    def _team(self, found: Measured) -> Json:
        figures = {
            "coverage": found.mean("visited", self._unit),
            "losses": found.mean("lost"),
            "time": found.mean("time"),
        }
        return {name: value.to_json() for name, value in figures.items()}

    def blocks(self) -> Blocks:
        table = make_table(("robots that", "visited %", "95 %", "lost", "steps"), "What learning is worth")
        for (_, found), said in zip(self._teams(), ("are told", "learn", "learn nothing"), strict=True):
            time = f"{found.mean('time').mean:.1f}"
            table.add_row(
                said, *found.mean("visited", self._unit).columns(100.0, 100), found.mean("lost").columns()[0], time
            )
        blind, told = (found.mean("visited", self._unit) for found in (self.blind, self.told))
        before, after = self.bits
        price = more_said(self.price, "not knowing it costs", "robots that are not told it visit")
        worth = more_said(self.worth, "learning is worth", "robots that learn visit", "less")
        sure = "" if told.half_width == 0 else f" ({told.columns(100.0, 100)[1]}, 95 %)"
        leads = [
            f"Robots that learn nothing visit {percent(blind.mean)}: {worth}.",
            f"Robots that are told where hazards are visit {told.columns(100.0, 100)[0]} % of the cells in "
            f"{counted(self.told.rollouts, 'run')}{sure}: {price}.",
        ]
        notes = [
            f"what learning is worth: {counted(self.learning.rollouts, 'rollout')} of each, common random numbers; "
            f"told: the first {self.told.rollouts:,}, a plan for each",
            f"doubt where hazards are: {before:.3f} bits a cell at first, {after:.3f} at the end of a run "
            f"(mean of {self.ends:,})",
        ]
        files: dict[str, Callable[[], str | bytes]] = {}
        if find_spec("rasterio") is not None:
            bands = np.stack([self.prior, self.posterior, self.entropy])
            files["posterior.tif"] = lambda: raster(self.world, BANDS, bands)
        layers = {"posterior.png": lambda: self._posterior(), "entropy.png": lambda: self._entropy()}
        return Blocks(leads=leads, tables=[table], notes=notes, layers=layers, files=files)

    def _posterior(self) -> CellLayer:
        about = (
            f"The chance that a hazard is there, as the team knows it at the end of a run; mean of {self.ends:,} runs."
        )
        values = np.nan_to_num(self.posterior)
        return CellLayer(
            "Hazards, as known in the end", about, values, LOSSES, "%", root=True, digits=2, short="Posterior"
        )

    def _entropy(self) -> CellLayer:
        about = f"Bits; 1: as likely there as not, 0: the team is sure. Mean of {self.ends:,} runs."
        scale = Normalize(0, 1)
        return CellLayer(
            "Doubt left in the end",
            about,
            np.nan_to_num(self.entropy),
            COVERED,
            norm=scale,
            labels=(0, 0.5, 1),
            short="Doubt",
        )


def entropy_of(chance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a hazard that is there with this chance, in bits; NaN of none."""
    sides = np.stack([chance, 1 - chance])
    return np.asarray(-(sides * np.log2(np.where(sides > 0, sides, 1))).sum(axis=0))
