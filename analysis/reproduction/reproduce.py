"""The paper's experiments (section 7, Figs. 4 to 7) again, with many runs on each of many maps.

Map number i of every setting has the same seed, so that settings are compared on the same obstacles, and so have its
rollouts. Each map is rolled out with every visit checked and with first visits alone, and its open loop is exact.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import reduce
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.kit.notes import Progress
from analysis.reproduction.points import COVERAGE, Key, Point, columns_of, put_right, runs_of
from analysis.reproduction.statements import Finding, findings
from analysis.sampling import RolloutChoices
from analysis.sweeps.cases import generated_case
from analysis.sweeps.engine import Done, Finished, Job, Swept, run_cases, stored_luck
from analysis.sweeps.store.memory import Memory
from analysis.sweeps.store.store import Store
from analysis.sweeps.worlds import check_maps
from planner.arguments import check_word
from planner.files import Json
from planner.luck_names import LuckName
from planner.tally import add_padded
from planner.worlds.generate import Kind

if TYPE_CHECKING:
    from distributed import Client

TEAMS = (1, 2, 4, 8, 10, 12, 16, 20)
RATIOS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35)
RATIO = 0.25
FigureName = Literal["fig4", "fig5", "fig6", "fig7", "all"]
Columns = dict[Key, Any]
Runs = dict[str, NDArray[np.int64]]


@dataclass(frozen=True)
class Setting:
    """A point of a figure."""

    kind: Kind
    robots: int
    ratio: float = RATIO


SETTINGS: dict[str, tuple[Setting, ...]] = {
    "fig4": (Setting("contiguous", 4), Setting("contiguous", 10)),
    "fig5": tuple(Setting("contiguous", robots) for robots in TEAMS),
    "fig6": tuple(Setting("scattered", robots) for robots in TEAMS),
    "fig7": tuple(Setting("contiguous", 8, ratio) for ratio in RATIOS),
}
"""The points of each figure. Fig. 6 is compared with Fig. 5, so `reproduce fig6` runs that too."""


@dataclass(frozen=True, eq=False, repr=False)
class Reproduction(Swept):
    """The answer: points by figure, what became of the paper's statements.

    Attributes:
        figures: names, in order. points: by setting. maps: that all points share; rollouts: of each map and loop.
        seed: of the first map. finished: how the run ended.
    """

    reported_by = "analysis.reproduction.report:report"

    figures: tuple[str, ...]
    points: dict[Setting, Point]
    maps: int
    rollouts: int
    seed: int
    finished: Finished

    def of(self, figure: str) -> list[Point]:
        """The points of a figure."""
        return [self.points[setting] for setting in SETTINGS[figure] if setting in self.points]

    @property
    def findings(self) -> list[Finding]:
        """What became of the paper's statements about these figures."""
        wanted = {f"Fig. {name[-1]}" for name in self.figures}
        return [found for found in findings(list(self.points.values())) if found.figure in wanted]


@dataclass
class _Collected:
    """Columns and single runs of each setting, map by map, as they come."""

    settings: tuple[Setting, ...]
    seed: int
    store: Store
    found: dict[Setting, dict[int, tuple[Columns, Runs]]] = field(default_factory=dict)

    def take(self, done: Done) -> None:
        """A finished job: its runs' tallies and facts, as columns."""
        labels = dict(done.job.case.labels)
        kind: Kind = "contiguous" if labels["kind"] == "contiguous" else "scattered"
        setting = Setting(kind, int(labels["robots"] or 0), float(labels["ratio"] or 0))
        columns, singles = Columns(), list[Runs]()
        for loop, key in zip(("closed", "first"), done.keys, strict=True):
            run, tally = self.store.run(key), self.store.tally(key)
            assert run is not None and tally is not None
            free, accessible = run.facts["cells"]["free"], run.facts["cells"]["accessible"]
            columns |= columns_of(run, tally, loop, free) | _exact_columns(run.facts, free, accessible)
            singles.append(runs_of(tally, free))
        number = int(labels["map"] or 0) - self.seed
        self.found.setdefault(setting, {})[number] = (columns, singles[0])

    def points(self, rollouts: int) -> tuple[dict[Setting, Point], int]:
        """The points over the maps that every setting has, and how many those are."""
        maps = [self.found.get(setting, {}) for setting in self.settings]
        shared = sorted(set.intersection(*map(set, maps)))
        if not shared:
            return {}, 0
        points = zip(self.settings, maps, strict=True)
        return {one: _point(one, [found[n] for n in shared], rollouts) for one, found in points}, len(shared)


def reproduce(
    figure: FigureName,
    *,
    maps: int,
    rollouts: int,
    seed: int = 0,
    store: Store | None = None,
    processes: int | None = None,
    scheduler: str | Client | None = None,
    progress: Progress | None = None,
) -> Reproduction:
    """Run what a figure (or "all") needs and put it together; the executors are those of `run_cases`.

    `store`: results are taken from it and kept in it; None: in memory. An interruption leaves the maps that are done;
    none: KeyboardInterrupt again. Raises InputError.
    """
    check_maps(maps, seed)
    check_word("figure", figure, (*SETTINGS, "all"))
    names = tuple(SETTINGS) if figure == "all" else (figure,)
    needed = [*names, *(("fig5",) if "fig6" in names else ())]
    settings = tuple(dict.fromkeys(setting for name in needed for setting in SETTINGS[name]))
    held = Memory() if store is None else store
    collected = _Collected(settings, seed, held)

    def take(done: Done) -> None:
        collected.take(done)
        if store is None:
            held.forget(done.keys)
        if progress is not None:
            progress(done.jobs, done.total, done.seconds)

    luck = stored_luck(next(_jobs(settings, maps, rollouts, seed)), held)
    finished = run_cases(
        _jobs(settings, maps, rollouts, seed, luck),
        held,
        processes=processes,
        scheduler=scheduler,
        total=maps * len(settings),
        progress=take,
    )
    points, done = collected.points(rollouts)
    if not points:
        raise KeyboardInterrupt
    return Reproduction(names, points, done, rollouts, seed, finished)


def _jobs(
    settings: tuple[Setting, ...], maps: int, rollouts: int, seed: int, luck: LuckName = "tolerance"
) -> Iterator[Job]:
    """Map after map, so that an interruption leaves whole maps."""
    for number in range(seed, seed + maps):
        models = tuple(RolloutChoices(seed=number, first_only=only, luck=luck) for only in (False, True))
        for setting in settings:
            yield Job(generated_case(setting.kind, setting.ratio, setting.robots, number), models, rollouts)


def _exact_columns(facts: Json, free: int, accessible: int) -> Columns:
    """The open loop's expected values and the ideal of the team."""
    exact, columns = facts["exact"], Columns()
    for figure in COVERAGE:
        cells = free if figure.endswith("_free") else accessible
        columns["mean", "open", figure] = exact[figure.removesuffix("_free")] / cells
    ideal = facts["ideal_team"] / accessible
    return columns | {("mean", "open", "time"): exact["time"], ("mean", "ideal", "visited"): ideal}


def _point(setting: Setting, found: list[tuple[Columns, Runs]], rollouts: int) -> Point:
    shared = (key for key in found[0][0] if all(key in of_map for of_map, _ in found))
    columns = {key: np.array([of_map[key] for of_map, _ in found]) for key in shared}
    put_right(columns, rollouts)
    runs = {name: reduce(add_padded, (of_map[name] for _, of_map in found)) for name in found[0][1]}
    return Point(setting.kind, setting.robots, setting.ratio, columns, runs, rollouts)
