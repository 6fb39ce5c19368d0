"""What is found of what the cells are worth, in the words of the field that asks (SPEC section 13).

The open loop's figures are exact. In the closed loop every rollout keeps how often each cell was visited and survived,
up to MOST_PASSES times: `P(found in c) = sum_n P(n or more) d (1 - d)^(n - 1)`, from integer counts. What further
visits add is at most `(1 - d)^MOST_PASSES` times P(MOST_PASSES or more), and at most `d (1 - d)^MOST_PASSES` times the
expected number of further visits, which the visits and stops of the cell tell: the interval is widened by that much.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from analysis.evaluation.outputs.output import Output, Run
from analysis.evaluation.outputs.value_words import SENTENCES, value_table
from analysis.sampling import make_engine_for
from analysis.statistics.coverage import expected_losses
from analysis.statistics.estimate import Estimate, exactly, mean_of
from analysis.statistics.mission import TAIL, at_least, robots_left, tail_mean, times_to
from analysis.theory.value import Worth, open_loop_found
from mrac_jax.blocks import run_ranges
from planner.arguments import check_word
from planner.kernels.state import MOST_PASSES
from planner.tally import Tally
from planner.worlds.reported import METRICS
from planner.worlds.world import World

UNITS = 2**40
"""The value of all cells in whole numbers: rounding is a millionth of a millionth of it a cell."""


@dataclass(frozen=True, eq=False)
class Value(Output):
    """Value covered, found and left. Axis `N` = H * W cells.

    Attributes:
        metrics: in whose words. world: the map. worth: of its cells.
        covered, found: expected value of the cells visited, and of what is found.
        covered_by_cell, found_by_cell: float64 `[N]`, chance that the cell is visited, that what is in it is found.
        remainder: what `found` may be too small by.
        tally: of the evaluation. losses: expected robots lost. robots_left: P(at least 1, ..., K are left at the end).
    """

    metrics: str
    world: World
    worth: Worth
    covered: Estimate
    found: Estimate
    covered_by_cell: NDArray[np.float64]
    found_by_cell: NDArray[np.float64]
    remainder: float
    tally: Tally
    losses: Estimate
    robots_left: list[Estimate]

    @classmethod
    def check(cls, asked: str, world: World) -> None:
        check_word("metrics", asked, METRICS)

    @classmethod
    def measure(cls, asked: str, run: Run) -> Iterator[Self]:
        worth, tally = Worth.of(run.world), run.last.tally
        if run.choices.loop == "open":
            visited, found = run.exact.visited_by_cell, open_loop_found(run.plan, run.world)
            covered, known = (exactly(float(worth.value @ chance)) for chance in (visited, found))
            lost = exactly(run.exact.expected_losses)
            alive = [exactly(float(chance)) for chance in at_least(run.exact.alive_chance)]
            yield cls(asked, run.world, worth, covered, known, visited, found, 0.0, tally, lost, alive)
            return
        run.doing("value covered and found")
        units = Units.of(worth)
        counted, columns = units.roll_out(run)
        found, rest = found_chances(counted, worth)
        covered, known = (units.estimate(column, run.certain) for column in columns)
        low, high = known.ci95
        known = Estimate(known.mean, known.se, (low, min(high + rest, worth.total)))
        visited, lost = counted.covered_visited / counted.rollouts, expected_losses(tally, run.certain)
        alive = robots_left(tally, run.certain)
        yield cls(asked, run.world, worth, covered, known, visited, found, rest, tally, lost, alive)

    @property
    def left(self) -> Estimate:
        """Expected value that is not found: that of all free cells without what is."""
        total, (low, high) = self.worth.total, self.found.ci95
        return Estimate(total - self.found.mean, self.found.se, (total - high, total - low))

    @property
    def left_by_cell(self) -> NDArray[np.float64]:
        """float64 `[N]`: expected value left in each cell."""
        return self.worth.value * (1.0 - self.found_by_cell)

    @property
    def scale(self) -> float:
        """What makes chances of values: 1 where they add up to at most 1, else one over their sum."""
        return 1.0 if self.worth.total <= 1 + 1e-6 else 1.0 / self.worth.total

    @property
    def detection(self) -> float | None:
        """Probability of detection: found of what was covered; None where nothing was."""
        return self.found.mean / self.covered.mean if self.covered.mean > 0 else None

    @property
    def route_left(self) -> tuple[float, float] | None:
        """Expected value left on the route, and that of its worst cell; None without a route.

        Read as chances, something is left on the route with a chance between the second and the first.
        """
        if self.world.team.route is None:
            return None
        rows, cols = self.world.team.route.T
        left = self.left_by_cell[np.unique(rows * self.world.shape[1] + cols)]
        return float(left.sum()), float(left.max())

    @property
    def cvar(self) -> float:
        """Mean coverage of the worst runs, a share TAIL of all: a fraction of the accessible cells."""
        return tail_mean(self.tally.visited) / self.tally.accessible

    def per_robot_lost(self, amount: float) -> float | None:
        """So much a robot lost; None where none is."""
        return amount / self.losses.mean if self.losses.mean > 0 else None

    @property
    def square_metres(self) -> float:
        """Expected ground visited."""
        return float(self.covered_by_cell.sum()) * self.world.cell_size**2

    def as_json(self) -> dict[str, Any]:
        shares = {name: getattr(self, name).to_json() for name in ("covered", "found", "left")}
        route = self.route_left
        return {"metrics": self.metrics, "total": self.worth.total, **shares, "remainder": self.remainder} | {
            "search": {
                "containment": self.covered.mean * self.scale,
                "detection": self.detection,
                "success": self.found.mean * self.scale,
            },
            "clearance": {
                "cleared": self.found.mean / self.worth.total,
                "remaining": self.left.mean,
                "route": None if route is None else {"remaining": route[0], "risk": [route[1], min(route[0], 1.0)]},
            },
            "square_metres": self.square_metres,
            "per_robot_lost": {
                "value": self.per_robot_lost(self.covered.mean),
                "square_metres": self.per_robot_lost(self.square_metres),
            },
            "robots_left": [chance.to_json() for chance in self.robots_left],
            "time_to": {f"{share:g}": step for share, step in times_to(self.tally).items()},
            "cvar": {f"{TAIL:g}": self.cvar},
        }

    def table(self) -> Table:
        return value_table(self)

    def sentences(self) -> Iterable[str]:
        yield SENTENCES[self.metrics](self)

    def footnotes(self) -> Iterable[str]:
        if self.remainder > 0:
            yield (
                f"of visits beyond the {MOST_PASSES}th of a cell at most {self.remainder:.3g} of the value found is "
                "left out; the interval has room for it"
            )

    def settings(self) -> dict[str, str]:
        return {"metrics": self.metrics}


@dataclass(frozen=True, eq=False)
class Units:
    """Values as whole numbers, UNITS all in all.

    Attributes:
        worth: of the cells. covered: int64 `[N]`. found: int64 `[N, MOST_PASSES + 1]`, by survived visits.
    """

    worth: Worth
    covered: NDArray[np.int64]
    found: NDArray[np.int64]

    @classmethod
    def of(cls, worth: Worth) -> Self:
        """What each cell adds to the sums of a rollout."""
        share = worth.value / worth.total * UNITS
        missed = (1.0 - worth.detect[:, None]) ** np.arange(MOST_PASSES + 1)
        return cls(worth, np.rint(share).astype(np.int64), np.rint(share[:, None] * (1.0 - missed)).astype(np.int64))

    def roll_out(self, run: Run) -> tuple[Tally, tuple[NDArray[np.int64], NDArray[np.int64]]]:
        """The ids of the evaluation once more: a tally with survived visits; units covered and found, `[B]` each."""
        engine = make_engine_for(run.world, run.plan, run.choices, kept=run.kept).weighing(self.covered, self.found)
        tally, parts, seconds, count = None, [], 0.0, run.last.tally.rollouts
        for start, size, (part, singles), took in run_ranges(engine.run, 0, count, unit=engine.least):
            tally, seconds = part if tally is None else tally + part, seconds + took
            parts.append((singles.worth_covered, singles.worth_found))
            run.progress(start + size, count, seconds)
        assert tally is not None
        covered, found = (np.concatenate(column) for column in zip(*parts, strict=True))
        return tally, (covered, found)

    def estimate(self, column: NDArray[np.int64], certain: bool) -> Estimate:
        """The mean of units `[B]`, as a value."""
        values, often = np.unique(column, return_counts=True)
        unit, most = self.worth.total / UNITS, UNITS + len(self.covered)
        found = mean_of(values, often, unit, most, most, certain)
        return Estimate(found.mean, found.se, (found.ci95[0], min(found.ci95[1], self.worth.total)))


def found_chances(tally: Tally, worth: Worth) -> tuple[NDArray[np.float64], float]:
    """P(found in c) of rollouts whose survived visits were counted, float64 `[N]`, and the value that it may lack."""
    at_least = tally.passes.reshape(-1, MOST_PASSES) / tally.rollouts
    missed = 1.0 - worth.detect
    found = worth.detect * _weighted(at_least, missed)
    further = (tally.visits - tally.stops) / tally.rollouts - at_least.sum(axis=1)
    rest = missed**MOST_PASSES * np.minimum(at_least[:, -1], worth.detect * further)
    return found, float(worth.value @ rest)


def _weighted(at_least: NDArray[np.float64], missed: NDArray[np.float64]) -> NDArray[np.float64]:
    """`sum_n at_least[c, n] missed[c]^n`, float64 `[N]`."""
    total = np.zeros(len(missed))
    for column in at_least.T[::-1]:
        total = column + missed * total
    return total
