"""Options of the command line: converters of their values, and commands with their options.

A command is a function with `@command(group, names of options, ...)`: `planner.settings.OPTIONS` has the type, the
default, the help and the group of each, which the command may replace by its own.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cache
from inspect import Parameter as Argument
from inspect import Signature, signature
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Group, Parameter, Token

from planner.arguments import did_you_mean, exactly
from planner.errors import UsageError
from planner.formatting import SPANS, seconds_of
from planner.settings import BEST, GOAL, GROUPS, OPTIONS, OUTPUT, ROLLOUTS, SETTINGS, SURVEY, TEAM, Choices, Setting

if TYPE_CHECKING:
    from analysis.inputs import Asked
    from analysis.sampling import RolloutChoices

# Values: a converter accepts a value without rounding or guessing, or refuses it in one line.

STEPS = ("--max-steps", "--b.max-steps")
"""Options that are a number of steps and cannot be a time."""


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
    """The text itself: no conversion."""
    return tokens[0].value


def verbatims(kind: Any, tokens: Sequence[Token]) -> list[str]:
    """The texts themselves, of an option that may be repeated."""
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


# Types of the values, as a command's signature has them, by kind of option (`Setting.kind`).

KINDS: dict[str, tuple[Any, Any]] = {
    "whole": (int, whole), "number": (float, number), "wholes": (str, wholes), "numbers": (str, numbers),
    "time": (str, deadline), "places": (str, places), "names": (str, names), "text": (str, verbatim),
    "path": (Path, path),
    "texts": (list[str], verbatims), "effort": (str, exactness), "reach": (float, how_far),
}  # fmt: skip
INPUT = Annotated[
    str,
    Parameter(
        name="INPUT",
        converter=verbatim,
        help="Scenario or ROS map .yaml .yml; MovingAI .map, .mcpp; sources .json; world .npz .npy .csv; log .mcap or "
        "rosbag2 folder; raster .tif .tiff .asc; image .png .pgm .ppm .pbm .pnm .bmp .gif .jpg .jpeg; boundary "
        ".geojson .kml .gpx .shp .gpkg; or example:NAME (terrain, building, paper).",
    ),
]


def file(name: str, help: str) -> Any:
    """The type of a positional argument that is a path."""
    return Annotated[Path, Parameter(name=name, converter=path, help=help)]


SECOND = "B, where it differs from A"
ORDER = (GOAL, TEAM, "Planning", ROLLOUTS, SECOND, SURVEY, OUTPUT)
"""Groups of options, in the order of `--help`."""


@cache
def _group(name: str, place: int) -> Group:
    """The group of that name; cyclopts needs one object per group."""
    return Group(name, sort_key=place)


def _annotation(setting: Setting, spelt: str, shown: bool) -> Any:
    """The type of an option, for cyclopts."""
    more: dict[str, Any] = {"name": spelt, "help": setting.help, "show": shown, "show_default": False}
    place = ORDER.index(setting.group) if setting.group in ORDER else len(ORDER)
    more["group"] = _group(setting.group, place)
    if setting.kind in ("flag", "switch"):
        more |= {"negative": ""} if setting.kind == "flag" else {}
        return Annotated[bool, Parameter(**more)]
    if setting.kind == "word":
        return Annotated[Literal[setting.words] | None, Parameter(converter=one_of(*setting.words), **more)]
    kind, converter = KINDS[setting.kind]
    kind = kind if setting.default is ... else kind | None
    return Annotated[kind, Parameter(converter=converter, **more)]


# Commands.


class Given:
    """The options of a command as they were given, by name; None, or the default: not given."""

    def __init__(self, values: Mapping[str, Any]) -> None:
        self.values = dict(values)

    def __getattr__(self, name: str) -> Any:
        try:
            return self.values[name]
        except KeyError:
            raise AttributeError(name) from None

    @property
    def choices(self) -> Choices:
        """The planner's settings. A deadline given with rollouts is theirs, not the plan's."""
        theirs = ("deadline",) if "exact" in self.values else ()
        return Choices(**{name: self.values[name] for name in SETTINGS if name in self.values and name not in theirs})

    def asked(self, source: str) -> Asked:
        """A plan for the team in an INPUT, with these settings."""
        from analysis.inputs import Asked

        team = [name for name in Asked.__dataclass_fields__ if name in self.values]
        return Asked(source, self.choices, **{name: self.values[name] for name in team})

    def rolled(self, usual: int = 4096, **more: Any) -> RolloutChoices:
        """The rollouts, checked; `usual`: default number. `more`: values that replace options."""
        from analysis.sampling import RolloutChoices

        known = RolloutChoices.__dataclass_fields__
        asked = {name: value for name, value in self.values.items() if name in known and value is not None}
        first_only = self.threat_checks == "first_visit"
        return RolloutChoices(**{"rollouts": usual, **asked, "first_only": first_only, **more})

    def enough(self, external: bool, usual: int | None) -> RolloutChoices:
        """The rollouts of one plan, checked: by number, precision or seconds. `external`: it has no areas."""
        from analysis.sampling import how_much

        amount = how_much(self.rollouts, self.precision, self.values.get("seconds"), usual)
        if "seconds" not in self.values:
            amount["seconds"] = None
        return self.rolled(100_000, loop=self.loop or ("open" if external else "closed"), **amount)

    def arguments(self, source: str) -> list[str]:
        """The words after `evaluate` for the same input, team and settings."""
        team = {name: value for name, value in self.values.items() if name in OPTIONS and OPTIONS[name].group == TEAM}
        given = team | self.choices.given()
        if self.threat_checks != "every_visit":
            given["threat_checks"] = self.threat_checks
        words = [source]
        for name, value in given.items():
            if value is not None:
                words += [f"--{name.replace('_', '-')}", _typed(value)]
        return words

    def over(self, second: str) -> Given:
        """The same, with the options of the prefix `second` in place of those without it.

        Other starts or robots discard both of the first side; another policy discards its limits.
        """
        from planner.settings import left_behind

        own = {name.removeprefix(second): value for name, value in self.values.items() if name.startswith(second)}
        own = {name: value for name, value in own.items() if value is not None}
        dropped = left_behind(own) + (("robots", "starts") if {"robots", "starts"} & own.keys() else ())
        return Given(self.values | dict.fromkeys(dropped) | own)


def _typed(value: Any) -> str:
    """The value of an option as typed."""
    if isinstance(value, tuple):
        return ",".join(map(str, value))
    return exactly(value) if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Command:
    """A command: a function of its positional arguments and, as `given`, of its options.

    Attributes:
        section: of `mrac-jax --help`. options: by name; those of another side, `b_robots`, are typed `--b.robots`.
    """

    function: Callable[..., int]
    name: str
    section: str
    options: dict[str, Setting]

    def bound(self, everything: bool) -> Callable[..., int]:
        """The function with its options as arguments, for cyclopts; `everything`: help includes the rare ones."""

        def call(*positional: Any, **given: Any) -> int:
            defaults = {name: option.default for name, option in self.options.items()}
            return self.function(*positional, given=Given(defaults | given))

        arguments = list(signature(self.function, eval_str=True).parameters.values())[:-1]
        for name, option in self.options.items():
            spelt = f"--b.{name[2:]}" if option.group == SECOND else f"--{name}"
            shown = _annotation(option, spelt.replace("_", "-"), everything or not option.rare)
            default = Argument.empty if option.default is ... else option.default  # a required option
            arguments.append(Argument(name, Argument.KEYWORD_ONLY, default=default, annotation=shown))
        call.__signature__ = Signature(arguments, return_annotation=int)  # type: ignore[attr-defined]
        call.__doc__, call.__module__ = self.function.__doc__, self.function.__module__
        return call

    def register(self, app: App, section: int, place: int, everything: bool) -> None:
        """Add it to `app`, at its place in `--help`."""
        app.command(self.bound(everything), name=self.name, group=_group(self.section, section), sort_key=place)


COMMANDS: list[Command] = []


def command(section: str, *names: str, name: str = "", **own: Any) -> Callable[[Any], Any]:
    """A decorator: the function is a command. `names`: of options, between spaces. `own`: help or option by name."""

    def register(function: Callable[..., int]) -> Callable[..., int]:
        options = {one: OPTIONS[one] for some in names for one in some.split()}
        for one, said in own.items():
            options[one] = replace(options.get(one) or OPTIONS[one], help=said) if isinstance(said, str) else said
        COMMANDS.append(Command(function, name or function.__name__, section, options))
        return function

    return register


def option(
    group: str, help: str, form: str = "", *words: str, default: Any = None, numbers: Any = None, **more: Any
) -> Setting:
    """An option of one command; without a form it is a number or one of `words`."""
    more = {"rare": False, "words": words, "default": default, "form": form, "group": group, **more}
    return Setting("", help, **more, **({} if numbers is None else {"numbers": numbers}))


def of(name: str, **change: Any) -> Setting:
    """An option of the table with some attributes replaced."""
    return replace(OPTIONS[name], **change)


THE_TEAM = "robots starts cell_size step_seconds speed turn"
PLANNING = " ".join(name for name, setting in SETTINGS.items() if name != "deadline" and not setting.found)
"""Settings of the planner for commands with rollouts. A deadline is that of the rollouts."""
WITHOUT_POLICY = " ".join(name for name in PLANNING.split() if name not in sum(GROUPS.values(), ()))
TAKING_OVER = " ".join(name for name in PLANNING.split() if name not in GROUPS["plan_for"])
ONE_PLAN = "loop rollouts precision deadline seed engine exact threat_checks"
COMPARED = "rollouts deadline seed engine threat_checks exact"
"""Rollouts of compared plans, on common random numbers."""
ANY_POLICY = of("policy", words=(*OPTIONS["policy"].words, BEST))
EARLY = of("deadline", group=ROLLOUTS, help="Also report coverage at this step or time: 450, 45min, 1h30min, 90s.")
"""A deadline of the rollouts: it does not end the mission of the plan."""
