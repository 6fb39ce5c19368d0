"""What an output of `evaluate` is: measured beside rollouts that were done, then only written down."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from rich.table import Table

from analysis.evaluation.figures import Covered
from analysis.page.charts import Chart, Series
from analysis.report.model import Pictured
from analysis.sampling import RollOut, RolloutChoices, Stage
from analysis.theory.exact import OpenLoopExact
from analysis.theory.verdicts import ClosedTruth
from analysis.utils.notes import ProgressCallback
from planner.formatting import in_percent
from planner.plan.plan import Plan
from planner.simulator.tables import AllPairs
from planner.world.world import World

if TYPE_CHECKING:
    from analysis.page.maps import CellLayer


@dataclass(frozen=True, eq=False)
class Run:
    """The rollouts that were done, for an output to measure more in.

    Attributes:
        world, plan, choices: what was rolled out. last: where it stands. roll_out: rolls it out again.
        exact: the open loop's expected values. closed: the closed loop's where they are known exactly, else None.
        certain: every run is the same. kept: tables for other plans of this map.
        progress, doing: told how far it has come, and in words what begins.
    """

    world: World
    plan: Plan
    choices: RolloutChoices
    last: Stage
    roll_out: RollOut
    exact: OpenLoopExact
    closed: ClosedTruth | None
    certain: bool
    kept: AllPairs
    progress: ProgressCallback
    doing: Callable[[str], None]


class Row(NamedTuple):
    """A row of the table of coverage, in percent: the open loop's exact value, and what stands in the other columns."""

    name: str
    exact: str
    shown: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Blocks:
    """What an output adds to the report of an evaluation, which every medium shows.

    Attributes:
        opens: sentences right after the headline. alternatives: what other settings achieve, after them. leads: then.
        rows: of the table of coverage. tables: below it. notes: below all of them.
        curves, marks: of the chart of coverage over time, in percent of the accessible cells, and its upright lines.
        below: charts below the answer. layers: of the maps cell by cell, each a picture by this name.
        pictures, files: as of `Report`. settings: what was asked for.
    """

    opens: Sequence[str] = ()
    alternatives: Sequence[str] = ()
    leads: Sequence[str] = ()
    rows: Sequence[Row] = ()
    tables: Sequence[Table] = ()
    notes: Sequence[str] = ()
    curves: Sequence[Series] = ()
    marks: Sequence[tuple[float, str]] = ()
    below: Sequence[Chart] = ()
    layers: Mapping[str, Callable[[], CellLayer]] = field(default_factory=dict)
    pictures: Mapping[str, Callable[[], Pictured]] = field(default_factory=dict)
    files: Mapping[str, Callable[[], str | bytes]] = field(default_factory=dict)
    settings: Mapping[str, str] = field(default_factory=dict)


class Output(ABC):
    """What was found of one output. A subclass states `measure`, its value in JSON, and its blocks of the report."""

    own_rollouts = True
    """It rolls out more, so that it is left out after an interruption."""
    late = True
    """The summary and the tables of coverage and chances do without it: they are shown before it is measured."""

    @classmethod
    def check(cls, asked: Any, world: World) -> None:
        """Raise UsageError for what cannot be measured in this world, before anything is rolled out."""
        return

    @classmethod
    @abstractmethod
    def measure(cls, asked: Any, run: Run) -> Iterator[Self]:
        """What is found, whole or, for a start, in part; each replaces the one before. `asked`: the option's value."""

    def as_json(self) -> object:
        """Its value in the JSON object; None: it is not in it."""
        return None

    def blocks(self) -> Blocks:
        """What it adds to the report."""
        return Blocks()


def coverage_row(name: str, covered: Covered, of: int, exact: float) -> Row:
    """Coverage in percent of `of` cells, beside the open loop's `exact` cells."""
    unit = 100.0 / of
    runs = (in_percent(cells / of, 1) for cells in covered.quantiles.values())
    return Row(name, in_percent(exact / of, 2), (*covered.mean.columns(unit, 100), *runs))


def known_words(value: float, form: str = "{:.2f}") -> str:
    """A number that is known; nothing where it is not (NaN)."""
    return "" if math.isnan(value) else form.format(value)
