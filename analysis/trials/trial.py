"""A plan that is tried: exactly where its tree ends in time, else by rollouts; the one place where searches ask which.

A search compares what is known alike: all of it exactly, or all on the same rollouts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from analysis.kit.compiling import compiles_for
from analysis.sampling import RolloutChoices, knowing_deadline, make_engine_for
from analysis.theory.exact import OpenLoopExact, open_loop_exact
from analysis.theory.value import Worth
from analysis.trials.exact_loop import tree_of
from analysis.trials.measured import Known, Measured, Sampled
from analysis.trials.valuing import weigh
from planner.kernels.closed_loop import compile_closed_loop
from planner.kernels.loop import ClosedLoop
from planner.kernels.tables import AllPairs
from planner.kernels.tree import WHOLE
from planner.plans.plan import Plan, is_certain
from planner.rollouts.engine import Engine, closed_loop_engine, run_by_luck, run_chunks
from planner.tally import RolloutResults, Tally
from planner.worlds.world import World


class Trial:
    """A plan in a world, ready to be asked what it comes to by the deadline of the choices."""

    def __init__(
        self,
        world: World,
        plan: Plan,
        choices: RolloutChoices,
        kept: AllPairs | None = None,
        loop: ClosedLoop | None = None,
    ) -> None:
        """`kept`: where all-pairs tables are kept. `loop`: in the place of the plan's. Raises InputError."""
        if loop is None:
            plan = knowing_deadline(world, plan, choices, nominal=False)
        self.world, self.plan, self.choices = world, plan, choices
        self.certain = choices.loop == "open" and is_certain(world, plan, "open")
        self._known: Known | None = None
        self._looked = -1.0
        self._last: tuple[tuple[int, int], Sampled | None] = ((0, 0), None)
        self.loop = None
        if choices.loop == "closed":
            how = choices
            compiles_for(plan)
            self.loop = loop or compile_closed_loop(plan, world, first_only=how.first_only, kept=kept, luck=how.luck)
            whole: Engine = closed_loop_engine(self.loop, choices.seed, choices.engine)
        else:
            whole = make_engine_for(world, plan, choices)
        self._whole = whole

    @cached_property
    def engine(self) -> Engine:
        """What rolls it out, to the deadline; in the closed loop with what is visited of values."""
        engine = self._whole if self.loop is None else weigh(self._whole, self.world)
        return engine if self.choices.deadline is None else engine.until(self.choices.deadline)

    def until(self, step: int | None) -> Trial:
        """The same, ended at the end of `step`."""
        return Trial(self.world, self.plan, replace(self.choices, deadline=step), loop=self.loop)

    def under(self, truth: World) -> Trial:
        """The same decisions, but robots are stopped by the threats of `truth`, a map of the same cells."""
        assert self.loop is not None
        return Trial(truth, self.plan, self.choices, loop=self.loop.under(truth))

    def known(self, share: float = 1.0) -> Known | None:
        """What it comes to exactly; None where that would take more than this `share` of the choices' exact seconds."""
        if self._known is None and share > self._looked:
            self._known, self._looked = self._exactly(self.choices.exact_seconds * share), share
        return self._known

    @cached_property
    def open_loop(self) -> OpenLoopExact | None:
        """The open loop's exact values by the deadline; None in the closed loop."""
        end = self.choices.deadline
        plan = self.plan if end is None else self.plan.until(end)
        return None if self.choices.loop == "closed" else open_loop_exact(plan, self.world)

    def stops(self, found: Measured) -> NDArray[np.float64]:
        """Robots stopped in each cell on average, float64 `[N]`."""
        if isinstance(found, Sampled):
            return found.tally.stops / found.rollouts
        assert self.loop is not None
        hits = np.zeros(self.world.threat.size)
        hits[self.loop.cells] = found.tree.counts.stops / WHOLE
        return hits

    def _exactly(self, seconds: float) -> Known | None:
        if self.loop is None:
            return None
        loop, end = self.loop, self.choices.deadline
        tree = tree_of(loop if end is None else loop.until(end), seconds)
        if tree is None or (seconds == 0 and tree.counts.stops.any()):  # unasked for, but where every run is the same
            return None
        if self.world.value is None:
            return Known(tree)
        worth = Worth.of(self.world)
        low, high = (float(chance @ worth.value[loop.cells]) / worth.total for chance in tree.cells("visited"))
        return Known(tree, (low, high))

    def sample(self, start: int, count: int) -> Sampled:
        """Rollouts `start .. start + count - 1`, each by itself; the last ones asked for are kept."""
        asked, found = self._last
        if found is None or asked != (start, count):
            engine, seed = self.engine, self._luck_seed
            ran = engine.run(start, count) if seed is None else run_by_luck(engine, seed, start, count)
            found = self._sampled(*ran)
            self._last = (start, count), found
        return found

    def roll(self, start: int, count: int, marks: Iterable[int]) -> Iterator[Sampled]:
        """The same, where it stands after every chunk, the `marks` among them; single rollouts only of value."""
        parts: list[RolloutResults] = []
        valued = self._valued
        for chunk in run_chunks(
            self.engine, count, start=start, checkpoints=marks, results=valued, by_luck=self._luck_seed
        ):
            parts += [chunk.results] if valued and chunk.results is not None else []
            yield self._sampled(chunk.tally, RolloutResults.join(parts) if parts else None, chunk.seconds)

    def _sampled(self, tally: Tally, results: RolloutResults | None, seconds: float = 0.0) -> Sampled:
        return Sampled(tally, results, self._luck_seed, self._valued, self.certain, seconds)

    @property
    def _luck_seed(self) -> int | None:
        return self.choices.seed if self.loop is not None and self.choices.luck == "tolerance" else None

    @property
    def _valued(self) -> bool:
        return self.loop is not None and self.world.value is not None


def alike(trials: Sequence[Trial], start: int, count: int, share: float = 1.0) -> Sequence[Measured]:
    """What they come to, all exactly or all on the same rollouts, so that it can be compared.

    `share`: as of `Trial.known`.
    """
    known: list[Measured] = []
    for trial in trials:
        found = trial.known(share)
        if found is None:
            return [trial.sample(start, count) for trial in trials]
        known.append(found)
    return known
