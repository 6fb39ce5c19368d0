"""Options of the command line: their types, taken exactly as meant or refused in one line, and groups by subject."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, make_dataclass, replace
from decimal import Decimal
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token

from planner.arguments import did_you_mean, exactly
from planner.errors import UsageError
from planner.formatting import SPANS, seconds_of
from planner.rollouts.names import ENGINES, EngineName
from planner.settings import BEST, GROUPS, SETTINGS, Choices, left_behind

if TYPE_CHECKING:
    from analysis.inputs import Asked
    from analysis.recording.record import Request
    from analysis.sampling import RolloutChoices


# Option types of the command line: every value is taken exactly as meant, or refused in one line.

GOAL = Group("Goal", sort_key=0)
TEAM = Group("Team", sort_key=1)
PLANNING = Group("Planning", sort_key=2)
ROLLOUTS = Group("Rollouts", sort_key=3)
SECOND = Group("B, where it differs from A", sort_key=4)
SURVEY = Group("Survey", sort_key=4)
OUTPUT = Group("Output", sort_key=5)
STEPS = ("--max-steps", "--b.max-steps")
"""Options whose whole number is one of steps: minutes are none."""


def whole(kind: Any, tokens: Sequence[Token]) -> int:
    """A whole number, as `parse_whole` takes it; UsageError names the option."""
    return parse_whole(tokens[0].value, _name(tokens))


def parse_whole(text: str, name: str) -> int:
    """A whole number in decimal digits, as 100000, 100_000 or 1e5; UsageError names `name`."""
    written = re.fullmatch(r"[+-]?[0-9]{1,30}(?:(?:_[0-9]{1,30}){0,10}|\.?[0-9]{0,30}e\+?[0-9]{1,2})", text.lower())
    value = Decimal(text.replace("_", "")) if written and text.isascii() else Decimal("nan")
    if not value.is_finite() or value != value.to_integral_value():
        what = "a whole number, as 100000, 100_000 or 1e5"
        what = SPANS if name == "--deadline" else "a whole number of steps, as 450" if name in STEPS else what
        raise UsageError(f"{name} {text!r}", expected=what)
    return int(value)


def deadline(kind: Any, tokens: Sequence[Token]) -> int | str:
    """A step, or a time in hours, minutes and seconds."""
    text = tokens[0].value
    return text if seconds_of(text) is not None else parse_whole(text, _name(tokens))


def wholes(kind: Any, tokens: Sequence[Token]) -> int | tuple[int, ...]:
    """A whole number, or several of them between commas, one a robot."""
    found = tuple(parse_whole(part.strip(), _name(tokens)) for part in tokens[0].value.split(","))
    return found if len(found) > 1 else found[0]


def numbers(kind: Any, tokens: Sequence[Token]) -> float | tuple[float, ...]:
    """A number, or several of them between commas, one a robot."""
    found = tuple(parse_number(part.strip(), _name(tokens)) for part in tokens[0].value.split(","))
    return found if len(found) > 1 else found[0]


def places(kind: Any, tokens: Sequence[Token]) -> str | tuple[tuple[int, int], ...]:
    """A word, or cells, "row,col;row,col;..."."""
    text = tokens[0].value
    if not re.search(r"[0-9]", text):
        return text
    found = [tuple(parse_whole(part.strip(), _name(tokens)) for part in cell.split(",")) for cell in text.split(";")]
    if any(len(cell) != 2 for cell in found):
        raise UsageError(f"{_name(tokens)} {text!r}", expected='cells, as "0,0;4,7"')
    return tuple((row, col) for row, col in found)


def names(kind: Any, tokens: Sequence[Token]) -> str | tuple[str, ...]:
    """A name, or several of them between commas, one a robot."""
    found = tuple(part.strip() for part in tokens[0].value.split(","))
    return found if len(found) > 1 else found[0]


def number(kind: Any, tokens: Sequence[Token]) -> float:
    """A finite number; UsageError names the option."""
    return parse_number(tokens[0].value, _name(tokens))


def parse_number(text: str, name: str) -> float:
    """A finite number in decimal digits; UsageError names `name`."""
    if not re.fullmatch(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?", text, re.ASCII | re.IGNORECASE):
        raise UsageError(f"{name} {text!r}", expected="a number")
    return float(text)


def how_far(kind: Any, tokens: Sequence[Token]) -> float:
    """A range of sensors: a number of cells, or inf."""
    return inf if tokens[0].value == "inf" else number(kind, tokens)


def exactness(kind: Any, tokens: Sequence[Token]) -> str | float:
    """A word of `analysis.sampling.Exactness`, or seconds."""
    text = tokens[0].value
    try:
        return text if text in ("auto", "never") else parse_number(text, _name(tokens))
    except UsageError:
        raise UsageError(f"{_name(tokens)} {text!r}", expected="auto, never, or a number of seconds") from None


def verbatim(kind: Any, tokens: Sequence[Token]) -> str:
    """The text itself, whatever it spells."""
    return tokens[0].value


def verbatims(kind: Any, tokens: Sequence[Token]) -> list[str]:
    """The texts themselves, of an option that may be given more than once."""
    return [token.value for token in tokens]


def path(kind: Any, tokens: Sequence[Token]) -> Path:
    """A path; the empty one is refused."""
    if not tokens[0].value:
        raise UsageError(f"{_name(tokens)} ''", expected="a path")
    return Path(tokens[0].value)


def one_of(*words: str) -> Any:
    """A converter to one of `words`."""

    def choose(kind: Any, tokens: Sequence[Token]) -> str:
        if tokens[0].value not in words:
            given = tokens[0].value
            raise UsageError(f"{_name(tokens)} {given!r}", expected=" or ".join(words), fix=did_you_mean(given, words))
        return tokens[0].value

    return choose


def _name(tokens: Sequence[Token]) -> str:
    return tokens[0].keyword or "argument"


Whole = Annotated[int | None, Parameter(converter=whole)]
Deadline = Annotated[str | None, Parameter(converter=deadline)]
Numbers = Annotated[str | None, Parameter(converter=numbers)]
Wholes = Annotated[str | None, Parameter(converter=wholes)]
Places = Annotated[str | None, Parameter(converter=places)]
Names = Annotated[str | None, Parameter(converter=names)]
Number = Annotated[float | None, Parameter(converter=number)]
Text = Annotated[str | None, Parameter(converter=verbatim)]
OutPath = Annotated[Path | None, Parameter(converter=path, group=OUTPUT)]
Loop = Annotated[Literal["closed", "open"] | None, Parameter(converter=one_of("closed", "open"))]
Meaning = Annotated[Literal["visited", "survived"], Parameter(converter=one_of("visited", "survived"))]
Kind = Annotated[Literal["contiguous", "scattered"], Parameter(converter=one_of("contiguous", "scattered"))]
Removed = Annotated[Literal["areas", "sources"] | None, Parameter(converter=one_of("areas", "sources"))]
Metrics = Annotated[
    Literal["coverage", "search", "clearance"], Parameter(converter=one_of("coverage", "search", "clearance"))
]
Exact = Annotated[str, Parameter(converter=exactness)]
Engine = Annotated[EngineName, Parameter(converter=one_of(*ENGINES))]
Checks = Annotated[Literal["every_visit", "first_visit"], Parameter(converter=one_of("every_visit", "first_visit"))]
Starts = Annotated[
    Text,
    Parameter(
        group=TEAM,
        help='Where they start, "row,col;row,col;..." (default: the input\'s starts, else upper-left).',
    ),
]
CellSize = Annotated[
    Number,
    Parameter(
        group=TEAM,
        help="Cells of a bare map in metres, the robot's footprint: the map is coarsened (default: its pixels).",
    ),
]
StepSeconds = Annotated[
    Number,
    Parameter(group=TEAM, help="Seconds that a step takes: times are said in minutes too, and may be given so."),
]
Turn = Annotated[Number, Parameter(group=TEAM, help="Steps that a quarter turn costs: times with turns are said too.")]
Speed = Annotated[Number, Parameter(group=TEAM, help="Instead of --step-seconds: metres a second, a cell a step.")]
Sense = Annotated[
    float | None,
    Parameter(
        converter=how_far,
        group=TEAM,
        help="How many cells robots see that are not told the map, inf: all of it (default: as the input says).",
    ),
]
RunLoop = Annotated[
    Loop,
    Parameter(
        group=ROLLOUTS,
        help="Reallocate and share at run time (closed, the default), or follow the plan until stopped (open).",
    ),
]
Seed = Annotated[Whole, Parameter(group=ROLLOUTS, help="Of the rollouts; never changes the world or the plan.")]
Hits = Annotated[
    Checks,
    Parameter(group=ROLLOUTS, help="Every visit can stop a robot, or only the first visit of a cell by anybody."),
]
StateFile = Annotated[
    Path | None,
    Parameter(
        name="--state",
        group=PLANNING,
        converter=path,
        help="Go on from here: a state (JSON), driven tracks or visited cells (CSV), a mask (.npy, .png), or an "
        "OccupancyGrid (.yaml, .mcap); --starts says where robots are now if the file does not.",
    ),
]
Json = Annotated[
    bool, Parameter(name="--json", group=OUTPUT, negative="", help="Print one JSON object and nothing else.")
]
Force = Annotated[
    bool, Parameter(group=OUTPUT, negative="", help="Replace a file of the output's name without asking.")
]
Bound = Annotated[bool, Parameter(group=OUTPUT, negative="")]
Input = Annotated[
    str,
    Parameter(
        name="INPUT",
        converter=verbatim,
        help="Scenario or ROS map .yaml .yml; MovingAI .map, .mcpp; sources .json; world .npz .npy .csv; log .mcap or "
        "rosbag2 folder; raster .tif .tiff .asc; image .png .pgm .ppm .pbm .pnm .bmp .gif .jpg .jpeg; boundary "
        ".geojson .kml .gpx .shp .gpkg; or example:NAME (terrain, building, paper).",
    ),
]


# Options of `record`, checked.

RECORDING = Group("Recording", sort_key=3)
EVALUATED = 4096
"""Rollouts that are evaluated unless it is said how many."""


@Parameter(name="*")
@dataclass
class Recording:
    """What is recorded.

    Attributes:
        ids: These rollouts in full, "0,5,7-9".
        pick: The worst, median, best, random or quantile:0.05 rollout by visited coverage, out of the evaluated
            ones; several with commas (default: median; not with --ids).
        rollouts: Evaluated for pick, tally and outcomes (default: 4096; with --ids and without --outcomes none).
        outcomes: Keep what every evaluated rollout came to.
        engine: Which engine; the file is the same (default: auto, numba).
    """

    ids: Annotated[Text, Parameter(group=RECORDING)] = None
    pick: Annotated[Text, Parameter(group=RECORDING)] = None
    rollouts: Annotated[Whole, Parameter(group=RECORDING)] = None
    outcomes: Annotated[bool, Parameter(group=RECORDING, negative="")] = False
    loop: RunLoop = None
    seed: Seed = None
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Hits = "every_visit"

    def request(self, foreign: bool, step_seconds: float | None = None) -> Request:
        """The same as a plain type, checked, but for the plan's origin.

        `foreign`: of paths alone. `step_seconds`: of a step in the file; None: 1.
        """
        from analysis.recording.contents import MOST_RECORDED
        from analysis.recording.record import Request, parse_ids, parse_picks

        if self.ids is not None and self.pick is not None:
            raise UsageError("both --ids and --pick are given", expected="one of them")
        few = self.ids is not None and not self.outcomes
        evaluated = (0 if few else EVALUATED) if self.rollouts is None else self.rollouts
        if self.rollouts is not None and not 1 <= self.rollouts <= 2**32:
            raise UsageError(f"--rollouts {self.rollouts}", expected=f"1 to {2**32}")
        request = Request(
            ids=() if self.ids is None else parse_ids(self.ids, MOST_RECORDED),
            picks=parse_picks("median" if self.pick is None else self.pick) if self.ids is None else (),
            evaluated=evaluated,
            outcomes=self.outcomes,
            loop=self.loop or ("open" if foreign else "closed"),
            seed=self.seed or 0,
            engine=self.engine,
            first_only=self.threat_checks == "first_visit",
            step_seconds=1.0 if step_seconds is None else step_seconds,
        )
        request.check()
        return request


# Options of the command line by subject: each group is a dataclass whose fields several commands share.

MANY = 100_000
"""Rollouts where nobody says how many, nor how precise."""


@Parameter(name="*")
@dataclass
class Team:
    """Who drives.

    Attributes:
        robots: How many robots (default: as many as the input's starts, else its count, else 1).
    """

    robots: Annotated[Whole, Parameter(group=TEAM)] = None
    starts: Starts = None
    cell_size: CellSize = None
    step_seconds: StepSeconds = None
    speed: Speed = None
    turn: Turn = None

    def asked(self, source: str, choices: Choices) -> Asked:
        """A plan for them in an INPUT, with these settings."""
        from analysis.inputs import Asked

        return Asked(source, choices, **vars(self))


@Parameter(name="*")
@dataclass
class SeeingTeam(Team):
    """Who drives, and sees how far.

    Attributes:
        robots: How many robots (default: as many as the input's starts, else its count, else 1).
    """

    sensor_range: Sense = None


@Parameter(name="*")
@dataclass
class Wanted:
    """When a team is enough.

    Attributes:
        target: Fraction of the accessible cells to cover, above 0, at most 1.
        confidence: The chance to cover that much is to reach this (default: the expected coverage is to reach the
            target; with --complete: 0.95).
        complete: The target is every accessible cell: --target 1 with a confidence.
        meaning: A cell counts once a robot entered it (visited) or left it alive (survived) (default: visited).
        most: Robots of the largest team to look at (default: 64; never more than there are starts).
        starts: Where they start, "row,col;row,col;...": a team takes the first of them (default: the input's starts,
            else upper-left).
    """

    target: Annotated[Number, Parameter(group=GOAL)] = None
    confidence: Annotated[Number, Parameter(group=GOAL)] = None
    complete: Annotated[bool, Parameter(group=GOAL, negative="")] = False
    meaning: Annotated[Meaning, Parameter(group=GOAL)] = "visited"
    most: Annotated[Whole, Parameter(group=GOAL)] = None
    starts: Annotated[Text, Parameter(group=TEAM)] = None
    cell_size: CellSize = None
    step_seconds: StepSeconds = None
    speed: Speed = None

    def team(self) -> Team:
        """The largest of them."""
        return Team(None, self.starts, self.cell_size, self.step_seconds, self.speed)


class _Chosen:
    """Options that are the planner's settings."""

    def choices(self) -> Choices:
        """The same as the planner's plain type."""
        return Choices(**vars(self))


def _planner_options(name: str, group: Group, without: tuple[str, ...] = (), best: bool = False) -> Any:
    """A dataclass of an option for each of the planner's settings but some, None where it is not given.

    `best`: the policy may be left to a search.
    """
    kinds: dict[str, Any] = {"time": Deadline, "whole": Whole, "wholes": Wholes, "number": Number, "numbers": Numbers}
    kinds |= {"places": Places, "names": Names}
    options = []
    for key in [key for key in SETTINGS if key not in without and not SETTINGS[key].found]:
        setting = SETTINGS[key]
        words = setting.words + (BEST,) * (best and key == "policy")
        kind = kinds.get(setting.kind) or Annotated[Literal[words] | None, Parameter(converter=one_of(*words))]
        options.append((key, Annotated[kind, Parameter(group=group, help=setting.help)], None))
    return make_dataclass(name, options, bases=(_Chosen,))


OF_ROLLOUTS = ("deadline",)
"""Settings whose option is that of the rollouts, where a command has these."""
_Planning: Any = _planner_options("_Planning", PLANNING, without=OF_ROLLOUTS)
_Sought: Any = _planner_options("_Sought", PLANNING, without=OF_ROLLOUTS, best=True)
_ToTheEnd: Any = _planner_options("_ToTheEnd", PLANNING, best=True)
_OfAnyPolicy: Any = _planner_options("_OfAnyPolicy", PLANNING, without=sum(GROUPS.values(), OF_ROLLOUTS))
_Together: Any = _planner_options("_Together", PLANNING, without=(*GROUPS["plan_for"], *OF_ROLLOUTS))
_SecondPlanning: Any = _planner_options("_SecondPlanning", SECOND, without=OF_ROLLOUTS)


@Parameter(name="*")
@dataclass
class Planning(_Planning):
    """How they plan."""


@Parameter(name="*")
@dataclass
class Sought(_Sought):
    """How they plan, if need be by the best policy."""


@Parameter(name="*")
@dataclass
class PlanningToTheEnd(_ToTheEnd):
    """How they plan, and when the mission ends."""


@Parameter(name="*")
@dataclass
class OfAnyPolicy(_OfAnyPolicy):
    """How they plan, whatever the policy."""


@Parameter(name="*")
@dataclass
class Together(_Together):
    """How they plan, to take over from each other."""


class _Rolled:
    """Options that say what is rolled out."""

    threat_checks: str

    def rolled(self, usual: int = MANY, **how: Any) -> RolloutChoices:
        """The same as a plain type, checked; `usual`: how many where nobody says. `how`: in the place of options."""
        from analysis.sampling import RolloutChoices

        known = RolloutChoices.__dataclass_fields__
        asked = {name: value for name, value in vars(self).items() if name in known and value is not None}
        first_only = self.threat_checks == "first_visit"
        return RolloutChoices(**{"rollouts": usual, **asked, "first_only": first_only, **how})


@Parameter(name="*")
@dataclass
class Rollouts(_Rolled):
    """What is rolled out.

    Attributes:
        rollouts: How many (default: 100000).
        precision: Instead of a number: stop when the half-width of the 95 % interval of mean coverage is below this.
        deadline: Report coverage by the end of this step too, or by a time: 45min, 1h30min, 90s. Robots that come home
            are home by then.
        engine: Which engine; the counts are the same. auto: numba, the faster one on a CPU.
        exact: Look for the closed loop's exact values, which small teams have: auto (about 2 s), never, or for about so
            many seconds; size: of each team.
    """

    loop: RunLoop = None
    rollouts: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    precision: Annotated[Number, Parameter(group=ROLLOUTS)] = None
    deadline: Annotated[Deadline, Parameter(group=ROLLOUTS)] = None
    seed: Seed = None
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto"
    exact: Annotated[Exact, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Hits = "every_visit"

    def amount(self, usual: int | None) -> dict[str, Any]:
        """How many, as of `analysis.sampling.how_much`."""
        from analysis.sampling import how_much

        return how_much(self.rollouts, self.precision, None, usual) | {"seconds": None}

    def choices(self, foreign: bool, usual: int | None = MANY) -> RolloutChoices:
        """The same as a plain type, checked; `foreign`: for paths alone, open loop if nothing else is asked for.

        `usual`: rollouts if nothing else is asked for; None: until they are precise enough.
        """
        return self.rolled(loop=self.loop or ("open" if foreign else "closed"), **self.amount(usual))


@Parameter(name="*")
@dataclass
class Timed(Rollouts):
    """What is rolled out, and for how long.

    Attributes:
        rollouts: How many (evaluate: as many as the precision needs; compare: 100000).
        precision: Stop when the half-width of the 95 % interval of mean coverage, or of the difference, is below this
            (evaluate: 0.001, a tenth of a point).
        seconds: Stop after so many seconds of rolling out too, if they are over first (default: 10; none where a number
            or a precision is given).
    """

    seconds: Annotated[Number, Parameter(group=ROLLOUTS)] = None

    def amount(self, usual: int | None) -> dict[str, Any]:
        """How many, as of `analysis.sampling.how_much`."""
        from analysis.sampling import how_much

        return how_much(self.rollouts, self.precision, self.seconds, usual)


@Parameter(name="*")
@dataclass
class CommonLuck(_Rolled):
    """The rollouts of everything that is compared, the same for all.

    Attributes:
        rollouts: The same for all that is compared (default: 4096).
        deadline: End every mission at this step, or by a time: 45min, 1h30min, 90s.
        engine: Which engine; the counts are the same (default: auto).
        exact: Instead of rollouts look for exact values, which small teams have: auto (about 2 s for all that is
            compared), never, or for about so many seconds.
    """

    rollouts: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    deadline: Annotated[Deadline, Parameter(group=ROLLOUTS)] = None
    seed: Seed = None
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Hits = "every_visit"
    exact: Annotated[Exact, Parameter(group=ROLLOUTS)] = "auto"

    def choices(self, usual: int | None = None) -> RolloutChoices:
        """The rollouts as a plain type, checked; `usual`: how many where nobody says."""
        from analysis.estimators.racing import USUAL

        return self.rolled(usual or USUAL)

    def words(self, source: str, team: Team, planning: OfAnyPolicy | Together) -> list[str]:
        """The words after `evaluate` that ask for the same input, team and settings."""
        given = {**vars(team), **planning.choices().given()}
        if self.threat_checks != "every_visit":
            given["threat_checks"] = self.threat_checks
        words = [source]
        for name, value in given.items():
            if value is not None:
                words += [f"--{name.replace('_', '-')}", _typed(value)]
        return words


def _typed(value: Any) -> str:
    """The value of an option as it is typed."""
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return exactly(value) if isinstance(value, float) else str(value)


@Parameter(name="*")
@dataclass
class Traded(CommonLuck):
    """What coverage may cost, and what is looked at.

    Attributes:
        losses: Pick the setting that covers most with at most so many robots lost on average.
        target: Pick the setting that loses the fewest robots with at least this fraction of the accessible cells
            covered on average.
        worths: Values of worth to look at, "5,10,20" (default: doubled from 1 / p of the worst cell until next to no
            robot is lost).
        reserves: Values of reserve to look at (default: 0.1,0.25,0.5 up to 1,000 accessible cells).
        rollouts: Of each setting (default: 4096; fewer above 2,048 accessible cells).
    """

    losses: Annotated[Number, Parameter(group=GOAL)] = None
    target: Annotated[Number, Parameter(group=GOAL)] = None
    robot_values: Annotated[Text, Parameter(group=PLANNING)] = None
    risk_caps: Annotated[Text, Parameter(group=PLANNING)] = None
    rollouts: Annotated[Whole, Parameter(group=ROLLOUTS)] = None


@Parameter(name="*")
@dataclass
class Checking(_Rolled):
    """What formulas are checked on.

    Attributes:
        robots: How many robots (default: as many as the input's starts, else its count, else 1); with --worlds: the
            sizes of team, "1,2,4,8,20" (the default).
        rollouts: Of the closed loop, where it is not known exactly (default: 20000; with --worlds 4096 a team).
        seed: Of the rollouts (default: 0); with --worlds: of the first world, and of the rollouts on it; the next
            world takes the next number.
        engine: Closed loop: which engine; the counts are the same (default: auto, numba).
        threat_checks: Closed loop: every visit can stop a robot, or only the first visit of a cell by anybody.
        worlds: Instead of an INPUT: so many random worlds of the paper's kind.
        kind: Of their threats (default: contiguous).
        size: Of each, HxW in cells (default: 20x20).
        processes: Worlds looked at at a time; no result depends on it (default: one a core).
        bound: Also compute the upper bound where that is expensive: above 1,000 dangerous cells, or with --worlds; as
            sharp as it gets above 500 accessible ones.
        theory: Of an INPUT: a row for each formula, or all, every reading and meaning of each.
    """

    robots: Annotated[Text, Parameter(group=TEAM)] = None
    starts: Starts = None
    cell_size: CellSize = None
    rollouts: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    seed: Annotated[Whole, Parameter(group=ROLLOUTS)] = None
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Annotated[Checks, Parameter(group=ROLLOUTS)] = "every_visit"
    worlds: Annotated[Whole, Parameter(group=SURVEY)] = None
    kind: Annotated[Kind | None, Parameter(group=SURVEY)] = None
    size: Annotated[Text, Parameter(group=SURVEY)] = None
    processes: Annotated[Whole, Parameter(group=SURVEY)] = None
    bound: Bound = False
    theory: Annotated[Literal["main", "all"], Parameter(group=OUTPUT)] = "main"

    def refuse(self, source: str | None, plan: object) -> None:
        """Raise UsageError for a contradiction between an INPUT and a survey."""
        given: dict[str, object] = {"--kind": self.kind, "--size": self.size, "--processes": self.processes}
        if self.worlds is None:
            if source is None:
                raise UsageError("nothing to check", expected="an INPUT, or --worlds N")
            wrong, where = given, "for --worlds"
        else:
            if source is not None:
                raise UsageError("both an INPUT and --worlds are given", expected="one of them")
            theory = None if self.theory == "main" else self.theory
            wrong = {"--starts": self.starts, "--cell-size": self.cell_size, "--plan": plan, "--theory": theory}
            where = "for an INPUT"
            if self.engine == "jax":
                raise UsageError("--engine jax is for an INPUT", fix="leave it out: a survey takes numba")
        named = [name for name, value in wrong.items() if value is not None]
        if named:
            are = "is" if len(named) == 1 else "are"
            raise UsageError(f"{' and '.join(named)} {are} {where}", fix=f"leave {'it' if are == 'is' else 'them'} out")

    def team_sizes(self) -> tuple[int, ...]:
        """Sizes of team of a survey, increasing."""
        text = "1,2,4,8,20" if self.robots is None else self.robots
        try:
            sizes = [parse_whole(part.strip(), "--robots") for part in text.split(",")]
        except UsageError:
            sizes = []
        if not sizes or not all(1 <= size <= 1024 for size in sizes):
            raise UsageError(f"--robots {text!r}", expected='sizes of team 1..1024, as "1,2,4,8,20"')
        return tuple(sorted(set(sizes)))

    def team(self) -> Team:
        """On an INPUT."""
        robots = None if self.robots is None else parse_whole(self.robots, "--robots")
        return Team(robots, self.starts, self.cell_size)


@Parameter(name="b")
@dataclass
class Second(_SecondPlanning):
    """What is other with B than with A.

    Attributes:
        robots: How many robots.
        starts: Where they start, "row,col;row,col;...".
        sensor_range: How many cells they see, inf: everything.
        loop: Reallocate and share at run time, or follow the plan until stopped.
        threat_checks: Every visit can stop a robot, or only the first visit of a cell by anybody.
        plan: Plan file of B.
    """

    robots: Annotated[Whole, Parameter(group=SECOND)] = None
    starts: Annotated[Text, Parameter(group=SECOND)] = None
    sensor_range: Annotated[float | None, Parameter(converter=how_far, group=SECOND)] = None
    loop: Annotated[Loop, Parameter(group=SECOND)] = None
    threat_checks: Annotated[Checks | None, Parameter(group=SECOND)] = None
    plan: Annotated[Path | None, Parameter(group=SECOND, converter=path)] = None

    def over(self, team: SeeingTeam, planning: Planning, what: Timed) -> tuple[SeeingTeam, Planning, Timed]:
        """A's options with these in their place.

        Other starts or robots leave A's of both behind, another policy its limits.
        """
        given = {name: value for name, value in vars(self).items() if value is not None}

        def changed(group: Any, drop: tuple[str, ...] = ()) -> Any:
            own = {name: given[name] for name in vars(group) if name in given}
            return replace(group, **dict.fromkeys(vars(group).keys() & drop) | own)

        others = ("robots", "starts") if {"robots", "starts"} & given.keys() else ()
        return (
            changed(team, others),
            changed(planning, left_behind(given)),
            changed(what),
        )
