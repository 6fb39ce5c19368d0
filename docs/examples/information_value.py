"""A question's ways on the same random maps with common random numbers, for teams of both rules."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any, get_args

from by_map import MAP_FIGURES, ByMap, Columns
from rich.table import Table

from analysis.page.elements import Chart, Series
from analysis.report.model import Report, Section
from analysis.statistics.estimates import Estimate, over_maps
from analysis.sweeps.cases import Case, Generated, canonical, check_maps
from analysis.sweeps.engine import Finished, Swept
from analysis.sweeps.store import Store
from analysis.utils.notes import ProgressCallback
from analysis.utils.tables import csv_text, make_table
from planner.files import Json
from planner.formatting import counted
from planner.json_objects import as_json
from planner.policies import DEFAULT
from planner.settings import Choices
from planner.world.generate import Kind

# What is compared: ways to know a map, or for its threats to stand and move, and the teams that meet them.

Team = tuple[Kind, int, str]
"""Kind of map, robots, policy."""
ROBOTS = (1, 2, 4, 8, 20)
P = 0.04
"""The threat that robots expect of cells that they know nothing of."""


@dataclass(frozen=True)
class Question:
    """Ways that a random map may be met, compared on the same maps and random numbers.

    Attributes:
        name: of the command. title: in words.
        ways: by name, what the map has beside itself: keys of a scenario (`analysis.sweeps.cases.SCENARIO_KEYS`).
        policies: of the teams; the last one is also compared with the one before.
        less: (one, other): by how much more one covers. main: of these, those that the summary tells, with its words.
    """

    name: str
    title: str
    ways: dict[str, Json]
    policies: tuple[str, ...]
    less: tuple[tuple[str, str], ...]
    main: dict[tuple[str, str], str]

    @property
    def teams(self) -> tuple[Team, ...]:
        """Those that meet it."""
        return tuple(product(get_args(Kind), ROBOTS, self.policies))


@dataclass(frozen=True)
class Setting:
    """A team on maps of a kind that it meets in one way."""

    kind: Kind
    way: str
    robots: int
    policy: str

    def case(self, question: Question, seed: int) -> Case:
        """It on the map with this seed."""
        world = Generated(self.kind, seed=seed, unsaid=canonical(question.ways[self.way]))
        labels = {**vars(self), "map": seed}
        policy = None if self.policy == DEFAULT else self.policy
        return Case(world, self.robots, choices=Choices(policy=policy), labels=tuple(labels.items()))


def settings_of(question: Question, teams: Sequence[Team]) -> list[Setting]:
    """All of them, those of one world after the other."""
    found = [Setting(kind, way, robots, policy) for way in question.ways for kind, robots, policy in teams]
    return sorted(found, key=lambda one: one.kind)


TOLD, BLIND, SEES = "told", "blind", "obstacles told, see 3"


def _see(cells: int) -> str:
    return f"see {cells}"


ONLINE = Question(
    "online",
    "What is a map worth?",
    {
        TOLD: {},
        **{_see(cells): {"prior_map": {"p": P}, "sensor_range": cells} for cells in (5, 3, 2, 1)},
        SEES: {"prior_map": {"p": P, "obstacles": "known"}, "sensor_range": 3},
        BLIND: {"prior_map": {"p": P, "obstacles": "known"}, "sensor_range": 0},
    },
    ("mrac", "per_cell", "frontier"),
    (*((TOLD, _see(cells)) for cells in (5, 3, 2, 1)), (SEES, BLIND)),
    {
        (TOLD, _see(3)): "Robots that know nothing of the map and see three cells cover {} points less than those told",
        (SEES, BLIND): "to see three cells is worth {} points to robots that know the obstacles",
    },
)

STAND, LOST, WALK, PLANNED = "stand, told where", "stand, not told where", "walk", "walk, planned on p joined"


def _moving(stay: float, plan_on: str = "patrols") -> Json:
    return {"moving_threats": [{"walk": stay, "h": "threats"}], "plan_on": plan_on}


MOVING = Question(
    "moving",
    "What if the threats walk?",
    {STAND: {}, LOST: _moving(1), WALK: _moving(0.5), PLANNED: _moving(0.5, "joined")},
    ("mrac", "per_cell"),
    ((STAND, LOST), (WALK, LOST), (PLANNED, WALK)),
    {
        (STAND, LOST): "To be told where threats stand is worth {} points",
        (WALK, LOST): "where robots do not know, they cover {} points more if they walk",
    },
)
QUESTIONS = {question.name: question for question in (ONLINE, MOVING)}


@dataclass(frozen=True, eq=False, repr=False)
class Study(Swept):
    """The answer.

    Attributes:
        question: what was compared. teams: that met it. columns: of each setting, map by map.
        rollouts: of each map and setting. seed: of the first map. finished: how the run ended.
    """

    reported_by = "information_value:report"

    question: Question
    teams: tuple[Team, ...]
    columns: dict[Setting, Columns]
    rollouts: int
    seed: int
    finished: Finished

    @property
    def maps(self) -> int:
        """Of every setting."""
        return len(next(iter(self.columns.values()))["visited"])

    def estimate(self, team: Team, way: str, figure: str = "visited") -> Estimate:
        """Mean over maps."""
        return over_maps(self._of(team, way)[figure])

    def apart(self, team: Team, one: str, other: str) -> Estimate:
        """Coverage by which one way is ahead of another, map by map."""
        return over_maps(self._of(team, one)["visited"] - self._of(team, other)["visited"])

    def gain(self, kind: Kind, robots: int, way: str) -> Estimate | None:
        """Coverage by which the question's last rule is ahead of the one before; None if one of them was not asked."""
        before, last = ((kind, robots, policy) for policy in self.question.policies[-2:])
        if not {before, last} <= set(self.teams):
            return None
        return over_maps(self._of(last, way)["visited"] - self._of(before, way)["visited"])

    def _of(self, team: Team, way: str) -> Columns:
        kind, robots, policy = team
        return self.columns[Setting(kind, way, robots, policy)]


def study_knowing(
    question: str,
    *,
    maps: int,
    rollouts: int,
    seed: int = 0,
    store: Store | None = None,
    teams: tuple[Team, ...] | None = None,
    progress: ProgressCallback | None = None,
    **where: Any,
) -> Study:
    """Run every setting of "online" or "moving" on `maps` maps; `store` and `where` as of `reproduce`.

    An interruption leaves the maps that are done; none: KeyboardInterrupt again. Raises InputError.
    """
    check_maps(maps, seed)
    asked = QUESTIONS[question]
    teams = asked.teams if teams is None else teams
    settings = settings_of(asked, teams)
    by_map = ByMap(lambda number: ((one, one.case(asked, seed + number)) for one in settings), seed, rollouts)
    finished = by_map.run(maps, maps * len(settings), store, progress, **where)
    columns = by_map.columns(settings)
    if not columns:
        raise KeyboardInterrupt
    return Study(asked, teams, columns, rollouts, seed, finished)


# The report: coverage by way, what lies between ways, over the team.

NOTE = (
    "Visited, % of the accessible cells, and differences in points, common random numbers; ± half the 95 % "
    "interval over maps."
)


def report(study: Study) -> Report:
    """Coverage of every way, how far ways are apart, curves over the team, every point as CSV."""
    finished, question = study.finished, study.question
    kinds, _, policies = (list(dict.fromkeys(names)) for names in zip(*study.teams, strict=True))
    charts = {policy: [_chart(study, kind, policy) for kind in kinds] for policy in policies}
    return Report(
        question.name, "reproduce", question.title, summary(study), study_json(study),
        heading=[
            f"{counted(study.maps, 'map')} a point, {counted(study.rollouts, 'rollout')} a map, first seed {study.seed}"
        ],
        took=[finished.description],
        parts=(
            Section("Coverage", [ways_table(study)], figures=lambda: [one for pair in charts.values() for one in pair]),
            Section("What lies between", [less_table(study), gains_table(study)], [NOTE]),
        ),
        warnings=("Interrupted: the maps that were done.",) if finished.partial else (),
        pictures={f"{policy}.png": partial(list, pair) for policy, pair in charts.items()},
        files={"points.csv": lambda: _csv(study)},
    )  # fmt: skip


def summary(study: Study) -> str:
    """The main differences, from the least to the largest of all teams."""
    said = []
    for pair, words in study.question.main.items():
        found = [100 * study.apart(team, *pair).mean for team in study.teams]
        said.append(words.format(f"{min(found):.1f} to {max(found):.1f}"))
    return "; ".join(said) + "."


def _chart(study: Study, kind: Kind, policy: str) -> Chart:
    series, teams = [], [team for team in study.teams if team[0] == kind and team[2] == policy]
    for way in study.question.ways:
        found = [study.estimate(team, way) for team in teams]
        series.append(Series.of(way, [robots for _, robots, _ in teams], found, dashed=", " in way))
    title = f"{study.question.title} {kind}, {policy}"
    return Chart(title, tuple(series), "robots", "visited", unit="%", y_range=(0.0, 100.0))


def ways_table(study: Study) -> Table:
    """What every team covers, by way."""
    table = _table("Visited, %", list(study.question.ways))
    for team in study.teams:
        table.add_row(*_named(team), *(study.estimate(team, way).around(100, most=100) for way in study.question.ways))
    return table


def less_table(study: Study) -> Table:
    """How much more one way covers than another."""
    pairs = study.question.less
    table = _table("Points more", [f"{one} - {other}" for one, other in pairs])
    for team in study.teams:
        table.add_row(*_named(team), *(study.apart(team, *pair).around(100, "+") for pair in pairs))
    return table


def gains_table(study: Study) -> Table:
    """How much more a team covers by the last rule than by the one before it, by way."""
    before, last = study.question.policies[-2:]
    table = make_table(("kind", "k", *study.question.ways), f"Points more by {last} than by {before}", left=("kind",))
    for kind, robots in dict.fromkeys(team[:2] for team in study.teams):
        gains = [study.gain(kind, robots, way) for way in study.question.ways]
        table.add_row(kind, str(robots), *("" if gain is None else gain.around(100, "+") for gain in gains))
    return table


def _table(title: str, columns: list[str]) -> Table:
    return make_table(("kind", "k", "policy", *columns), title, left=("kind", "policy"), padding=(0, 1, 0, 0))


def _named(team: Team) -> tuple[str, str, str]:
    kind, robots, policy = team
    return kind, str(robots), policy


def study_json(study: Study) -> Json:
    """The JSON object; coverage and differences are fractions."""
    teams = {team: dict(zip(("kind", "robots", "policy"), team, strict=True)) for team in study.teams}
    return {
        "answer": summary(study),
        "question": study.question.name,
        "ways": study.question.ways,
        "points": [
            said | {"way": way} | {figure: study.estimate(team, way, figure).to_json() for figure in MAP_FIGURES}
            for team, said in teams.items()
            for way in study.question.ways
        ],
        "differences": [
            said | {"of": one, "less": other, "visited": study.apart(team, one, other).to_json()}
            for team, said in teams.items()
            for one, other in study.question.less
        ],
        "gains": [
            {
                "kind": kind,
                "robots": robots,
                "way": way,
                "of": study.question.policies[-1],
                "less": study.question.policies[-2],
                "visited": gain.to_json(),
            }
            for kind, robots in dict.fromkeys(team[:2] for team in study.teams)
            for way in study.question.ways
            if (gain := study.gain(kind, robots, way)) is not None
        ],
        "maps": study.maps,
        "rollouts": study.rollouts,
        "seed": study.seed,
        "seconds": study.finished.seconds,
        **as_json(study),
    }


def _csv(study: Study) -> str:
    """Every figure of every setting on every map."""
    rows = [
        (*vars(one).values(), study.seed + n, *(f"{columns[figure][n]:.9g}" for figure in (*MAP_FIGURES, "se")))
        for one, columns in study.columns.items()
        for n in range(study.maps)
    ]
    return csv_text((*next(iter(study.columns)).__dataclass_fields__, "map", *MAP_FIGURES, "se"), rows)
