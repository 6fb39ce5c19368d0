"""Options of the command line: converters of their values, and commands with their options.

A command is made from a function of `analysis.api`: `@command(section, function, names of options)`. The type, the
default and the help of an option are those of the function's argument; options of the input, and of what is printed and
written, are those of `planner.settings.OPTIONS`. The decorated function reads the input, calls `given.call(function,
...)`, and delivers the answer.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import cache
from inspect import Parameter as Argument
from inspect import Signature, getdoc, signature
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Group, Parameter, Token

from analysis.utils.notes import say
from planner.arguments import ANY, Numbers, did_you_mean, exactly
from planner.errors import UsageError
from planner.formatting import SPANS, seconds_of
from planner.settings import (
    AUTO,
    BEST,
    GOAL,
    GROUPS,
    OPTIONS,
    OUTPUT,
    ROLLOUTS,
    SETTINGS,
    SURVEY,
    TEAM,
    Choices,
    Setting,
)

if TYPE_CHECKING:
    from analysis.inputs import Asked, Task
    from planner.plan.plan import Plan
    from planner.world.world import World

# Values: `parse(text, name)` gives a value without rounding or guessing, or refuses it in one line that names `name`.

STEPS = ("--max-steps", "--b.max-steps")
"""Options that are a number of steps and cannot be a time."""


def parse_whole(text: str, name: str) -> int:
    """A whole number in decimal digits, as 100000, 100_000 or 1e5; UsageError names `name`."""
    written = re.fullmatch(r"[+-]?[0-9]{1,30}(?:(?:_[0-9]{1,30}){0,10}|\.?[0-9]{0,30}e\+?[0-9]{1,2})", text.lower())
    value = Decimal(text.replace("_", "")) if written and text.isascii() else Decimal("nan")
    if not value.is_finite() or value != value.to_integral_value():
        what = "a whole number, as 100000, 100_000 or 1e5"
        what = SPANS if name == "--deadline" else "a whole number of steps, as 450" if name in STEPS else what
        raise UsageError(f"{name} {text!r}", expected=what)
    return int(value)


def parse_number(text: str, name: str, expected: str = "a number") -> float:
    """A finite number in decimal digits; UsageError names `name`."""
    if not re.fullmatch(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)(e[+-]?[0-9]+)?", text, re.ASCII | re.IGNORECASE):
        raise UsageError(f"{name} {text!r}", expected=expected)
    return float(text)


def _deadline(text: str, name: str) -> int | str:
    return text if seconds_of(text) is not None else parse_whole(text, name)


def _each(parse: Callable[[str, str], Any]) -> Callable[[str, str], Any]:
    """One value, or several of them between commas, one a robot."""

    def parse_each(text: str, name: str) -> Any:
        found = tuple(parse(part.strip(), name) for part in text.split(","))
        return found if len(found) > 1 else found[0]

    return parse_each


def _cells(text: str, name: str) -> tuple[tuple[int, ...], ...]:
    """Cells, "row,col;row,col;..."."""
    try:
        found = tuple(tuple(parse_whole(part.strip(), name) for part in cell.split(",")) for cell in text.split(";"))
    except UsageError:
        found = ((),)
    if any(len(cell) != 2 for cell in found):
        raise UsageError(f"{name} {text!r}", expected='cells in whole numbers, "row,col;row,col;..."')
    return found


def _places(text: str, name: str) -> str | tuple[tuple[int, ...], ...]:
    """A word, or cells."""
    return _cells(text, name) if re.search(r"[0-9]", text) else text


def _list(text: str, name: str) -> tuple[float, ...]:
    """Numbers between commas, inf among them; none in an empty text."""
    try:
        return tuple(map(float, text.split(","))) if text.strip() else ()
    except ValueError:
        raise UsageError(f"{name} {text!r}", expected='numbers, as "0.5,1,2"') from None


def _exactness(text: str, name: str) -> str | float:
    """A word of `analysis.sampling.Exactness`, or seconds."""
    return text if text in ("auto", "never") else parse_number(text, name, "auto, never, or a number of seconds")


def _ids(text: str, name: str) -> tuple[int, ...]:
    """Ids of rollouts; they are parsed where they are typed, before any work."""
    from analysis.recording.contents import MOST_RECORDED
    from analysis.recording.record import parse_ids

    return parse_ids(text, MOST_RECORDED)


def _picks(text: str, name: str) -> tuple[str, ...]:
    """Names of selections of rollouts."""
    from analysis.recording.record import parse_picks

    return tuple(pick.name for pick in parse_picks(text))


def _path(text: str, name: str) -> Path:
    if not text:
        raise UsageError(f"{name} ''", expected="a path")
    return Path(text)


def _text(text: str, name: str) -> str:
    return text


def converter(parse: Callable[[str, str], Any], numbers: Numbers = ANY) -> Any:
    """The converter of cyclopts that parses the first token, and checks that a number is one of `numbers`."""

    def convert(kind: Any, tokens: Sequence[Token]) -> Any:
        name = tokens[0].keyword or "argument"
        found = parse(tokens[0].value, name)
        if isinstance(found, int | float) and numbers != ANY and not numbers.accepts(found):
            raise UsageError(f"{name} {found:g}", expected=numbers.expected, fix=numbers.meant(found))
        return found

    return convert


def one_of(*words: str) -> Any:
    """A converter to one of `words`."""

    def choose(text: str, name: str) -> str:
        if text not in words:
            raise UsageError(f"{name} {text!r}", expected=" or ".join(words), fix=did_you_mean(text, words))
        return text

    return converter(choose)


# Types of the values, as a command's signature has them, by kind of option (`Setting.kind`).

KINDS: dict[str, tuple[Any, Callable[[str, str], Any]]] = {
    "whole": (int, parse_whole), "number": (float, parse_number), "wholes": (str, _each(parse_whole)),
    "numbers": (str, _each(parse_number)), "time": (str, _deadline), "places": (str, _places), "cells": (str, _cells),
    "names": (str, _each(_text)), "text": (str, _text), "path": (Path, _path), "list": (str, _list),
    "effort": (str, _exactness), "ids": (str, _ids), "picks": (str, _picks),
    "auto": (str, lambda text, name: text if text == AUTO else parse_whole(text, name)),
    "reach": (float, lambda text, name: inf if text == "inf" else parse_number(text, name)),
}  # fmt: skip
VERBATIM = converter(_text)
INPUT = Annotated[
    str,
    Parameter(
        name="INPUT",
        converter=VERBATIM,
        help="Scenario or ROS map .yaml .yml; MovingAI .map, .mcpp; sources .json; world .npz .npy .csv; log .mcap or "
        "rosbag2 folder; raster .tif .tiff .asc; image .png .pgm .ppm .pbm .pnm .bmp .gif .jpg .jpeg; boundary "
        ".geojson .kml .gpx .shp .gpkg; or example:NAME (terrain, building, paper).",
    ),
]


def file(name: str, help: str) -> Any:
    """The type of a positional argument that is a path."""
    return Annotated[Path, Parameter(name=name, converter=converter(_path), help=help)]


SECOND = "B, where it differs from A"
ORDER = (GOAL, TEAM, "Planning", ROLLOUTS, SECOND, SURVEY, OUTPUT)
"""Groups of options, in the order of `--help`."""


@cache
def group_of(name: str, place: int) -> Group:
    """The group of that name; cyclopts needs one object per group."""
    return Group(name, sort_key=place)


def _annotation(setting: Setting, spelt: str, shown: bool) -> Any:
    """The type of an option, for cyclopts."""
    more: dict[str, Any] = {"name": spelt, "help": setting.help, "show": shown, "show_default": False}
    place = ORDER.index(setting.group) if setting.group in ORDER else len(ORDER)
    more["group"] = group_of(setting.group, place)
    if setting.kind in ("flag", "switch"):
        more |= {"negative": ""} if setting.kind == "flag" else {}
        return Annotated[bool, Parameter(**more)]
    if setting.kind == "word":
        return Annotated[Literal[setting.words] | None, Parameter(converter=one_of(*setting.words), **more)]
    if setting.kind == "texts":
        several = lambda kind, tokens: [token.value for token in tokens]  # noqa: E731
        return Annotated[list[str] | None, Parameter(converter=several, **more)]
    kind, parse = KINDS[setting.kind]
    # Settings of the planner are checked with the input, whose values they may contradict.
    numbers = ANY if setting.group == "Planning" else setting.numbers
    return Annotated[
        kind if setting.default is ... else kind | None, Parameter(converter=converter(parse, numbers), **more)
    ]


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

    def task(self, source: str) -> Task:
        """The map, the team and the settings in an INPUT; their notes are printed."""
        from analysis.inputs import load_task

        task = load_task(self.asked(source))
        say(task.notes)
        return task

    def planned(self, source: str, **how: Any) -> tuple[World, Plan]:
        """The map in an INPUT, and its plan, which may be a file's or one for a state; the notes are printed."""
        from analysis.cli.console import load_or_make_plan

        files = self.values.get("plan"), self.values.get("state")
        world, made, notes = load_or_make_plan(self.asked(source), *files, **how)
        say(notes)
        return world, made

    def call(self, function: Callable[..., Any], *positional: Any, **more: Any) -> Any:
        """The answer of a function of `analysis.api`: with the given options, and with `more` in their place.

        After an interrupt it is the answer so far.
        """
        known = signature(function).parameters
        usual = {"progress": True, "on_interrupt": "return"}
        given = {name: value for name, value in {**usual, **self.values, **more}.items() if name in known}
        return function(*positional, **{name: value for name, value in given.items() if value is not None})

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
        return (";" if isinstance(value[0], tuple) else ",").join(map(_typed, value))
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


COMMANDS: list[Command] = []


def command(section: str, function: Callable[..., Any] | None, *names: str, **own: Any) -> Callable[[Any], Any]:
    """A decorator that makes a command of a function.

    Args:
        section: of `mrac-jax --help`. function: of `analysis.api`, that has the options as arguments.
        names: of options, between spaces; "Goal: losses" replaces the group of those that follow, and a rare one ends
            in "?". They may name some of `own`, whose place is then there, else after all others.
        own: help, or the whole option, by name.
    """

    def register(decorated: Callable[..., int]) -> Callable[..., int]:
        options: dict[str, Setting] = {}
        for some in names:
            group, _, listed = some.rpartition(": ")
            for one in listed.split():
                plain = one.rstrip("?")
                made = own[plain] if isinstance(own.get(plain), Setting) else _option_of(function, plain)
                made = replace(made, rare=True) if one != plain else made
                options[plain] = replace(made, group=group) if group else made
        if "exact" in options:  # a deadline of the rollouts, which does not end the mission of a plan
            options["deadline"] = replace(options["deadline"], group=ROLLOUTS)
        for one, said in own.items():
            options[one] = replace(options.get(one) or OPTIONS[one], help=said) if isinstance(said, str) else said
        COMMANDS.append(Command(decorated, decorated.__name__, section, options))
        return decorated

    return register


def _option_of(function: Callable[..., Any] | None, name: str) -> Setting:
    """The option of an argument: by its annotation, or by `planner.settings.OPTIONS` if it has the name.

    A text in the docstring that begins with a capital letter is the option's help too.
    """
    parameters, texts = ({}, {}) if function is None else _arguments_of(function)
    argument, known = parameters.get(name), OPTIONS.get(name)
    text = "" if argument is None else texts.get(name, "")
    help = re.sub(r"`(\w+)`", lambda found: f"--{found[1].replace('_', '-')}", text)
    kind = "" if argument is None else str(argument.annotation)
    if known is not None and not kind.startswith("Sequence[float]"):
        return replace(known, help=help) if help[:1].isupper() else known
    assert argument is not None, name
    words = tuple(re.findall(r"'(\w+)'", kind)) if kind.startswith("Literal") else ()
    form = "" if words else next(form for start, form in FORMS.items() if kind.startswith(start))
    form = "switch" if argument.default is True else form
    return option("", help, form, *words, default=argument.default if words or kind == "bool" else None)


FORMS = {
    "bool": "flag", "int": "whole", "float": "number", "Sequence[float]": "list", "str | Path": "path", "str": "text",
    "ArrayLike": "text",
}  # fmt: skip
"""Kinds of options, by the beginning of an annotation."""


@cache
def _arguments_of(function: Callable[..., Any]) -> tuple[Mapping[str, Argument], dict[str, str]]:
    """The arguments of a function, and the text of each in its docstring."""
    found = re.findall(r"^    (\w[\w, ]*): (.*(?:\n {8}.*)*)", getdoc(function) or "", re.MULTILINE)
    texts = {name: " ".join(text.split()) for names, text in found for name in names.split(", ")}
    return signature(function).parameters, texts


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
