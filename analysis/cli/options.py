"""Option types of the command line: every value is taken exactly as meant, or refused in one line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token

from planner.arguments import did_you_mean
from planner.errors import UsageError
from planner.formatting import SPANS, seconds_of
from planner.rollouts.names import ENGINES, EngineName

if TYPE_CHECKING:
    from analysis.recording.record import Request

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
