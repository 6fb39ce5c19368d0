"""Reproduction of the paper's experiments (section 7, Figs. 4 to 7) with many runs on each of many maps.

Map i of every setting has the same seed, and so have its rollouts, so that settings are compared on the same obstacles.
Each map is simulated with threats at every visit and at first visits only; its open loop is exact.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial, reduce
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from scipy.special import ndtri

from analysis.page.elements import Chart, Series
from analysis.report.model import Report, Section
from analysis.sampling import RolloutChoices
from analysis.statistics import variance_reduction as control_variate
from analysis.statistics.estimates import Estimate, over_maps
from analysis.sweeps.cases import check_maps, generated_case
from analysis.sweeps.engine import Done, Finished, Job, Swept, run_cases
from analysis.sweeps.results import KEPT, figures_of, unit_of
from analysis.sweeps.store import Run, Store
from analysis.utils.notes import ProgressCallback
from analysis.utils.tables import Column, csv_text, table_of
from planner.arguments import check_word
from planner.formatting import counted, in_percent, percent
from planner.tally import Tally, add_padded
from planner.world.generate import Kind

# Data of the paper's figures: one setting of the experiments, averaged over maps.

MEANINGS = ("visited", "survived")
COVERAGE = tuple(f"{meaning}{of}" for meaning in MEANINGS for of in ("", "_free"))
"""Coverage of the accessible cells and, `_free`, of all free ones."""
TIME_BIN = 10
"""Width of a bin, in steps."""
FIGURE4 = {4: (0.8033, 311), 10: (0.9733, 244)}
"""Robots: coverage and steps of the single runs in Fig. 4; 241 and 292 of 300 cells, hence of all free cells."""


Loop = Literal["open", "ideal", "closed", "first"]
Key = tuple[str, str, str]
"""Quantity ("mean", "run", "square", "share", "controls": mean with control variates, "errors"), loop, figure. Loops:
"closed", threats at every visit; "first", only at the first visit of a cell; "open", no reallocation, exact."""


@dataclass(frozen=True, eq=False)
class Point:
    """One setting over the same maps. Axis `M` = maps, in order of their seeds.

    Attributes:
        kind: "contiguous" or "scattered". robots: K. ratio: threats, of all cells.
        columns: float64 `[M]` each, of the quantities of `columns_of` and, as "mean", of the open loop's expectations
            and of ("ideal", "visited"), the upper bound of the team, of the accessible cells.
        runs: int64 by "coverage" `[101]` and "time" `[T]`: histograms of single runs (closed loop) by the percentage of
            free cells covered, rounded down, and by TIME_BIN steps; all maps together.
        rollouts: of each map.
    """

    kind: str
    robots: int
    ratio: float
    columns: dict[Key, NDArray[np.float64]]
    runs: dict[str, NDArray[np.int64]]
    rollouts: int
    json_keys = "kind robots ratio *estimates"

    @property
    def estimates(self) -> dict[Loop, dict[str, Estimate]]:
        """The means over maps by loop and figure."""
        means = [(loop, figure) for what, loop, figure in self.columns if what == "mean"]
        loops: tuple[Loop, ...] = get_args(Loop)
        return {of: {figure: self.estimate(of, figure) for loop, figure in means if loop == of} for of in loops}

    def estimate(self, loop: str, figure: str) -> Estimate:
        """Mean over maps; its Student interval from the variance between maps includes the rollouts' noise."""
        return over_maps(self.columns["mean", loop, figure])

    def spread_of_a_run(self, loop: str, figure: str) -> float:
        """Standard deviation of a single run on a single map, as in the paper's design of one run for each map."""
        mean, square = (float(self.columns[what, loop, figure].mean()) for what in ("run", "square"))
        return float(np.sqrt(max(square - mean**2, 0.0)))


def columns_of(run: Run, tally: Tally, loop: str) -> dict[Key, Any]:
    """Figures of one map's rollouts of a loop, from a run and its tally; and those of the open loop.

    run, square: mean and mean square of single runs, of each of COVERAGE (fractions) and "time" (steps). share: of runs
    that cover no more of the free cells ("coverage"), or take no longer ("time"), than the run of Fig. 4 with the same
    number of robots. controls, errors: see `analysis.statistics.variance_reduction.with_controls`. mean: the open
    loop's expectations, and the upper bound of the team.
    """
    found: dict[Key, Any] = {}
    means, errors = figures_of(run)
    assert run.sums is not None
    for figure in (*COVERAGE, "time"):
        name = figure.replace("_free", "_of_free")
        unit, (first, second) = unit_of(run, name), run.sums[figure.removesuffix("_free")]
        found["run", loop, figure] = first * unit / run.rollouts
        found["square", loop, figure] = second * unit**2 / run.rollouts
        found["controls", loop, figure], found["errors", loop, figure] = means[KEPT[name]], errors[KEPT[name]]
        cells = run.facts["cells"]["free" if name.endswith("_of_free") else "accessible"]
        expected = run.facts["exact"][figure.removesuffix("_free")]
        found["mean", "open", figure] = expected if figure == "time" else expected / cells
    found["mean", "ideal", "visited"] = means[KEPT["ideal"], 0]
    if tally.robots in FIGURE4:
        coverage, steps = FIGURE4[tally.robots]
        cells = int(np.floor(coverage * run.facts["cells"]["free"] + 0.5))
        found["share", loop, "coverage"] = float(tally.visited[: cells + 1].sum()) / tally.rollouts
        found["share", loop, "time"] = float(tally.time[: steps + 1].sum()) / tally.rollouts
    return found


def controlled_means(columns: dict[Key, NDArray[np.float64]], rollouts: int) -> None:
    """Add each map's "mean": its "run" with the control variate, fitted over all maps."""
    for _, loop, figure in [key for key in columns if key[0] == "controls"]:
        means, errors = columns["controls", loop, figure], columns["errors", loop, figure]
        columns["mean", loop, figure], _ = control_variate.controlled_means(means, errors, len(means) * (rollouts - 1))


def runs_of(tally: Tally, free: int) -> dict[str, NDArray[np.int64]]:
    """Single runs of one map, see `Point.runs`."""
    per_cent = np.minimum(100 * np.arange(len(tally.visited)) // free, 100)
    in_bins = np.arange(len(tally.time)) // TIME_BIN
    return {
        "coverage": np.bincount(per_cent, weights=tally.visited, minlength=101).astype(np.int64),
        "time": np.bincount(in_bins, weights=tally.time).astype(np.int64),
    }


# The statements of the paper's section on experiments, each compared with our maps: reproduced or not.
#
# A number is compared by `(ours - paper's) / sqrt(se^2 + se_paper^2 + rounding^2)`; the paper's standard error follows
# from its design, one run on each of 500 maps. A direction is compared with the difference of two settings, map by map
# with common random numbers, divided by its standard error.

PAPER_MAPS = 500
"""Maps for each point in the paper, one run each (section 7)."""
ENOUGH = 3.0
"""Standard errors that decide."""
FIRST = ", threats at first visits only"
LOOPS = (("closed", ""), ("first", FIRST))
"""The closed loop with threats at every visit or at first visits only, and the suffix of statements."""


STATED: dict[str, tuple[tuple[int, float], ...]] = {"fig5": ((1, 0.44), (2, 0.62))}
"""(abscissa, coverage) stated in the paper's text."""


class StatementVerdict(StrEnum):
    """The result of a comparison."""

    REPRODUCED = "reproduced"
    NOT_REPRODUCED = "not reproduced"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Finding:
    """A statement of the paper and our result.

    Attributes:
        figure: of the paper. statement: of the paper. found: our result. deviation: in standard errors; for a direction
            positive if the statement is right, for a number ours - paper's. verdict: of the deviation.
    """

    figure: str
    statement: str
    found: str
    deviation: float
    verdict: StatementVerdict


def findings(points: Sequence[Point]) -> list[Finding]:
    """All statements that these points can test."""
    compared = (_compared(*direction) for direction in _directions(points) if direction[2])
    return [*_figure4(points), *_numbers(points), *compared]


def _figure4(points: Sequence[Point]) -> Iterator[Finding]:
    """The map of Fig. 4 is not published: compare its two runs with the distribution of runs on our maps."""
    teams = [point for point in _teams(points, "contiguous") if ("share", "closed", "time") in point.columns]
    for point, (loop, how) in itertools.product(teams, LOOPS):
        coverage, steps = FIGURE4[point.robots]
        columns = [point.columns["share", loop, name] for name in ("coverage", "time")]
        shares = [float(column.mean()) for column in columns]
        less, faster = map(percent, shares)
        found = f"{less} of our runs cover no more of the free cells, {faster} take no longer"
        # Continuity correction: a share of 0 or 1 would give an infinite deviation.
        least = 0.5 / (len(columns[1]) * point.rollouts)
        deviation = max((float(ndtri(np.clip(share, least, 1 - least))) for share in shares), key=abs)
        said = f"one map, {counted(point.robots, 'robot')}: {100 * coverage:.2f} % in {counted(steps, 'step')}{how}"
        yield Finding("Fig. 4", said, found, deviation, _of_number(deviation))


def _teams(points: Sequence[Point], kind: str) -> list[Point]:
    found = [p for p in points if p.kind == kind and p.ratio == 0.25]
    return sorted(found, key=lambda point: point.robots)


def _numbers(points: Sequence[Point]) -> Iterator[Finding]:
    """The coverage that the paper states for one robot and for two."""
    by_team = {point.robots: point for point in _teams(points, "contiguous")}
    stated = [(by_team[robots], said) for robots, said in STATED["fig5"] if robots in by_team]
    for (point, said), (loop, how) in itertools.product(stated, LOOPS):
        ours = point.estimate(loop, "visited")
        # The paper gives no errors; its design determines them.
        paper = point.spread_of_a_run(loop, "visited") / math.sqrt(PAPER_MAPS)
        # Standard deviation of a uniform rounding error of one percent.
        rounding = 0.01 / math.sqrt(12)
        deviation = (ours.mean - said) / math.sqrt(ours.se**2 + paper**2 + rounding**2)
        found = f"{in_percent(ours.mean)} +- {100 * ours.se:.1f} %"
        statement = f"{counted(point.robots, 'robot')}: {100 * said:g} % covered{how}"
        yield Finding("Fig. 5", statement, found, deviation, _of_number(deviation))


def _of_number(deviation: float) -> StatementVerdict:
    return StatementVerdict.REPRODUCED if abs(deviation) <= ENOUGH else StatementVerdict.NOT_REPRODUCED


Direction = tuple[str, str, list[tuple[Point, Point]], str, int, str]
"""Figure, statement, pairs of points, the quantity that changes from the first to the second of every pair, the sign of
the change, and the loop."""


def _directions(points: Sequence[Point]) -> Iterator[Direction]:
    """The paper's statements on directions; those without pairs cannot be tested."""
    teams, scattered = (_teams(points, kind) for kind in ("contiguous", "scattered"))
    by_team = {point.robots: point for point in teams}
    both = [(by_team[point.robots], point) for point in scattered if point.robots in by_team]
    one_two = [(by_team[1], by_team[2])] if {1, 2} <= by_team.keys() else []
    ratios = sorted((p for p in points if p.kind == "contiguous" and p.robots == 8), key=lambda point: point.ratio)
    ratios = ratios if len({point.ratio for point in ratios}) >= 3 else []
    below, above = ([p for p in ratios if sign * (p.ratio - 0.15) <= 1e-9] for sign in (1, -1))

    def every(of: Sequence[Point]) -> list[tuple[Point, Point]]:
        return list(itertools.pairwise(of))

    for loop, how in LOOPS:
        yield "Fig. 5", f"time rises from one robot to two{how}", one_two, "time", 1, loop
    after = every([point for point in teams if point.robots >= 2])
    yield "Fig. 5", "time falls with every robot after the second", after, "time", -1, "closed"
    yield "Fig. 5", "coverage rises with every robot", every(teams), "visited", 1, "closed"
    yield "Fig. 6", "coverage is lower than in contiguous areas", both, "visited", -1, "closed"
    yield "Fig. 6", "coverage takes longer than in contiguous areas", both, "time", 1, "closed"
    yield "Fig. 6", "coverage rises with every robot", every(scattered), "visited", 1, "closed"
    yield "Fig. 6", "time falls with every robot", every(scattered), "time", -1, "closed"
    yield "Fig. 7", "coverage falls with the ratio of threats", every(ratios), "visited", -1, "closed"
    yield "Fig. 7", "time rises up to a ratio of 15 %", every(below), "time", 1, "closed"
    for loop, how in LOOPS:
        yield "Fig. 7", f"time falls above 15 %{how}", every(above), "time", -1, loop


def _compared(
    figure: str, statement: str, pairs: list[tuple[Point, Point]], what: str, sign: int, loop: str
) -> Finding:
    """The worst pair decides: the difference is taken map by map."""
    gaps = []
    for before, after in pairs:
        gap = over_maps(after.columns["mean", loop, what] - before.columns["mean", loop, what])
        change = sign * gap.mean
        gaps.append(
            (change / gap.se if gap.se > 0 else math.copysign(math.inf, change) if change else 0.0, gap, before, after)
        )
    worst, gap, before, after = min(gaps, key=lambda one: one[0])
    scale, unit = (1, "steps") if what == "time" else (100, "points")
    wrong = sum(deviation <= -ENOUGH for deviation, *_ in gaps)
    said = f"{wrong} of {len(gaps)} in the other direction; " if wrong and len(gaps) > 1 else ""
    where = f"worst {_named(before, after)}: " if len(gaps) > 1 else ""
    found = f"{said}{where}by {scale * gap.mean:+.1f} +- {scale * gap.se:.1f} {unit}"
    right = StatementVerdict.REPRODUCED if worst >= ENOUGH else StatementVerdict.UNDECIDED
    return Finding(figure, statement, found, worst, StatementVerdict.NOT_REPRODUCED if worst <= -ENOUGH else right)


def _named(before: Point, after: Point) -> str:
    if before.kind != after.kind:
        return f"k = {after.robots}"
    if before.robots != after.robots:
        return f"k = {before.robots} to {after.robots}"
    return f"{100 * before.ratio:g} to {100 * after.ratio:g} %"


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
"""The points of each figure. Fig. 6 is compared with Fig. 5, so `reproduce fig6` runs both."""


@dataclass(frozen=True, eq=False, repr=False)
class Reproduction(Swept):
    """The result: points by figure, and verdicts on the paper's statements.

    Attributes:
        figures: names, in order. points: by setting. maps: number that all points share; rollouts: of each map and
            loop. seed: of the first map. finished: summary of the run.
    """

    reported_by = "analysis.reproduction:report"

    figures: tuple[str, ...]
    points: dict[Setting, Point]
    maps: int
    rollouts: int
    seed: int
    finished: Finished
    json_keys = "answer=summary maps rollouts seed figures=points_by_figure statements=findings"

    @property
    def points_by_figure(self) -> dict[str, list[Point]]:
        """The points of each figure."""
        return {figure: self.of(figure) for figure in self.figures}

    def of(self, figure: str) -> list[Point]:
        """The points of a figure."""
        return [self.points[setting] for setting in SETTINGS[figure] if setting in self.points]

    @property
    def findings(self) -> list[Finding]:
        """The verdicts on the paper's statements about these figures."""
        wanted = {f"Fig. {name[-1]}" for name in self.figures}
        return [found for found in findings(list(self.points.values())) if found.figure in wanted]


@dataclass
class _Collected:
    """Columns and single runs of each setting, map by map, as they are computed."""

    settings: tuple[Setting, ...]
    store: Store
    found: dict[Setting, dict[int, tuple[Columns, Runs]]] = field(default_factory=dict)

    def take(self, done: Done) -> None:
        """Add a finished job: its runs' tallies and facts, as columns."""
        number, place = divmod(done.job.tag, len(self.settings))
        columns, singles = Columns(), list[Runs]()
        for loop, key in zip(("closed", "first"), done.keys, strict=True):
            run, tally = self.store.run(key), self.store.tally(key)
            assert run is not None and tally is not None
            columns |= columns_of(run, tally, loop)
            singles.append(runs_of(tally, run.facts["cells"]["free"]))
        self.found.setdefault(self.settings[place], {})[number] = (columns, singles[0])

    def points(self, rollouts: int) -> tuple[dict[Setting, Point], int]:
        """The points over the maps that every setting has, and the number of these maps."""
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
    progress: ProgressCallback | None = None,
    **where: Any,
) -> Reproduction:
    """Run the settings of a figure (or "all") and collect the points.

    Args:
        store: results are read from it and written to it; None: in memory.
        where: `processes`, `scheduler` as in `run_cases`.

    Returns:
        The result. After an interruption: the maps done so far.

    Raises:
        InputError: an argument out of range. KeyboardInterrupt: before the first map.
    """
    check_maps(maps, seed)
    check_word("figure", figure, (*SETTINGS, "all"))
    names = tuple(SETTINGS) if figure == "all" else (figure,)
    needed = [*names, *(("fig5",) if "fig6" in names else ())]
    settings = tuple(dict.fromkeys(setting for name in needed for setting in SETTINGS[name]))
    held = Store() if store is None else store
    collected = _Collected(settings, held)

    def take(done: Done) -> None:
        collected.take(done)
        if store is None:
            held.forget(done.keys)
        if progress is not None:
            progress(done.jobs, done.total, done.seconds)

    jobs = _jobs(settings, maps, rollouts, seed)
    finished = run_cases(jobs, held, total=maps * len(settings), progress=take, **where)
    points, done = collected.points(rollouts)
    if not points:
        raise KeyboardInterrupt
    return Reproduction(names, points, done, rollouts, seed, finished)


def _jobs(settings: tuple[Setting, ...], maps: int, rollouts: int, seed: int) -> Iterator[Job]:
    """Map after map, so that an interruption leaves complete maps."""
    for tag, (number, one) in enumerate(itertools.product(range(seed, seed + maps), settings)):
        models = tuple(RolloutChoices(seed=number, first_only=only) for only in (False, True))
        yield Job(generated_case(one.kind, one.ratio, one.robots, number), models, rollouts, tag)


def _point(setting: Setting, found: list[tuple[Columns, Runs]], rollouts: int) -> Point:
    shared = (key for key in found[0][0] if all(key in of_map for of_map, _ in found))
    columns = {key: np.array([of_map[key] for of_map, _ in found]) for key in shared}
    controlled_means(columns, rollouts)
    runs = {name: reduce(add_padded, (of_map[name] for _, of_map in found)) for name in found[0][1]}
    return Point(setting.kind, setting.robots, setting.ratio, columns, runs, rollouts)


# The report of `check --paper`: the paper's statements, and the points of its figures from our maps.

TITLES = {
    "fig4": "Fig. 4: single runs on contiguous maps",
    "fig5": "Fig. 5: 1 to 20 robots, contiguous threats",
    "fig6": "Fig. 6: 1 to 20 robots, scattered threats",
    "fig7": "Fig. 7: 8 robots, threats on 0 to 35 % of the cells",
}
TABLE = (
    ("visited", "closed", "visited", 100.0),
    ("survived", "closed", "survived", 100.0),
    ("of free", "closed", "visited_free", 100.0),
    ("first", "first", "visited", 100.0),
    ("open", "open", "visited", 100.0),
    ("ideal", "ideal", "visited", 100.0),
    ("time", "closed", "time", 1.0),
    ("first", "first", "time", 1.0),
    ("open", "open", "time", 1.0),
)
"""(heading, loop, figure, scale)."""
CURVES = {
    "coverage": (
        ("closed", "visited", "closed loop, visited"),
        ("closed", "survived", "... survived"),
        ("closed", "visited_free", "... visited, of all free cells"),
        ("first", "visited", "closed loop, threats at first visits only"),
        ("open", "visited", "open loop, exact"),
        ("ideal", "visited", "upper bound of the team"),
    ),
    "time": (
        ("closed", "time", "closed loop"),
        ("first", "time", "threats at first visits only"),
        ("open", "time", "open loop: last move of a live robot"),
    ),
}
"""(loop, figure, name) of the curves of each chart."""


def report(answer: Reproduction) -> Report:
    """Verdicts on the statements; coverage and time over the team or the ratio of threats, on the paper's axes."""
    finished, said = answer.finished, summary(answer)
    over = [figure for figure in answer.figures if figure != "fig4"]
    charts = {figure: [_chart(answer, figure, what) for what in CURVES] for figure in answer.figures}
    return Report(
        "reproduction", "reproduce", "The paper's experiments, reproduced", said,
        answer,
        heading=[
            f"{counted(answer.maps, 'map')} a point, {counted(answer.rollouts, 'rollout')} a map and loop, "
            f"first seed {answer.seed}"
        ],
        took=[finished.description],
        parts=(
            Section("Statements", [_statements(answer.findings)] if answer.findings else (), [DEVIATION]),
            Section("Points", [_report_points(figure, answer.of(figure)) for figure in over], [POINTS] if over else (),
                 figures=lambda: [chart for pair in charts.values() for chart in pair]),
        ),
        warnings=("Interrupted: only the maps that are done.",) if finished.partial else (),
        pictures={f"{name}.png": partial(list, pair) for name, pair in charts.items()},
        files={"points.csv": lambda: _csv(answer)},
    )  # fmt: skip


DEVIATION = "Deviation: in standard errors; for Fig. 4, normal quantile among our runs. Beyond 3 decides."
POINTS = (
    "Coverage in %, time in steps, means over maps; se: the largest standard error of a coverage and of a time in the "
    "row. visited, survived: of the accessible cells, threats at every visit; first: only the first visit of a cell "
    "can destroy a robot."
)


def _chart(answer: Reproduction, figure: str, what: str) -> Chart:
    """Coverage or time over the points of a figure; for Fig. 4, a histogram."""
    if figure == "fig4":
        return _runs(answer.of(figure), what)
    scale, unit, limits = (100.0, "%", (0.0, 100.0)) if what == "coverage" else (1.0, "", None)
    points = answer.of(figure)
    at = [_at(figure, point) for point in points]
    series = [
        Series.of(name, at, [point.estimate(loop, of) for point in points], scale, dashed=name.startswith("..."))
        for loop, of, name in CURVES[what]
    ]
    if what == "coverage" and figure in STATED:
        teams, stated = zip(*STATED[figure], strict=True)
        series.append(Series("stated in the paper", teams, [100 * value for value in stated], kind="points"))
    axis = "threats, % of the cells" if figure == "fig7" else "robots"
    words = "steps" if what == "time" else "covered"
    return Chart(f"{TITLES[figure]}: {what}", tuple(series), axis, words, unit=unit, y_range=limits)


def _runs(points: list[Point], what: str) -> Chart:
    """The single runs of Fig. 4 in the distribution of runs on our maps."""
    covered, series, marks = what == "coverage", [], []
    for point in points:
        counts, (coverage, steps) = np.trim_zeros(point.runs[what], "b"), FIGURE4[point.robots]
        at = (1 if covered else TIME_BIN) * np.arange(len(counts))
        series.append(Series(counted(point.robots, "robot"), at, 100 * counts / counts.sum(), kind="step"))
        marks.append((100 * coverage if covered else steps, f"the paper's, {counted(point.robots, 'robot')}"))
    axis = "coverage of the free cells, %" if covered else "steps"
    return Chart(f"{TITLES['fig4']}: {what}", tuple(series), axis, "runs, %", unit="%", at_x=tuple(marks))


def summary(answer: Reproduction) -> str:
    """The number of reproduced statements."""
    found = answer.findings
    counts = {verdict: sum(one.verdict is verdict for one in found) for verdict in StatementVerdict}
    said = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"Of {len(found)} statements of the paper on these figures: {said}." if found else "Nothing to compare."


def _statements(found: list[Finding]) -> Table:
    columns = (
        Column("figure", lambda one: one.figure, words=True),
        Column("statement", lambda one: one.statement, words=True),
        Column("here", lambda one: one.found, words=True),
        Column("deviation", lambda one: f"{one.deviation:+.1f}"),
        Column("", lambda one: one.verdict, words=True),
    )
    return table_of(columns, found, "Statements of the paper", padding=(0, 1, 0, 0))


def _report_points(figure: str, points: list[Point]) -> Table:

    def mean(title: str, loop: str, name: str, scale: float) -> Column:
        return Column(title, lambda point: f"{scale * point.estimate(loop, name).mean:.1f}")

    def largest(point: Point, unit: float) -> str:
        """The largest standard error of the figures with a scale."""
        return f"{max(scale * point.estimate(loop, name).se for _, loop, name, scale in TABLE if scale == unit):.1f}"

    columns = (
        Column("threats, %" if figure == "fig7" else "robots", lambda point: f"{_at(figure, point):g}"),
        *itertools.starmap(mean, TABLE),
        Column("se", lambda point: f"{largest(point, 100)} / {largest(point, 1)}"),
    )  # fmt: skip
    return table_of(columns, points, TITLES[figure], padding=(0, 1, 0, 0))


def _at(figure: str, point: Point) -> float:
    return 100 * point.ratio if figure == "fig7" else point.robots


def _csv(answer: Reproduction) -> str:
    """Mean, standard error and interval of every figure at every point."""
    names = ("kind", "robots", "ratio", "loop", "figure", "maps", "rollouts", "mean", "se", "low", "high")
    rows = (
        (point.kind, point.robots, point.ratio, loop, figure, answer.maps, point.rollouts,
         *(f"{value:.9g}" for value in (one.mean, one.se, *one.ci95)))
        for point in answer.points.values() for loop, found in point.estimates.items() for figure, one in found.items()
    )  # fmt: skip
    return csv_text(names, rows)
