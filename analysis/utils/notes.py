"""Notes for the user on standard error, progress callbacks, and hints for unknown arguments."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial, wraps
from inspect import Parameter, signature
from typing import Any

from planner.arguments import nearest
from planner.errors import UsageError, visible, with_new_names

ProgressCallback = Callable[[int, int, float], None]
"""`progress(done, total, seconds)`, called after every chunk; `total` is 0 when it is not known."""
Doing = Callable[[str], None]
"""`doing(stage)`, called when a stage begins."""


def quiet(*_: object) -> None:
    """The `Progress` and the `Doing` that show nothing."""


def of_things(progress: ProgressCallback, things: str) -> ProgressCallback:
    """The same progress, with `things` counted instead of rollouts if it shows a unit."""
    said: Callable[..., None] = progress
    return partial(said, things=things) if getattr(progress, "says_things", False) else progress


def say(lines: Sequence[str]) -> None:
    """Print notes to standard error, one a line, with control characters escaped."""
    for line in lines:
        print(visible(line, kept="\t"), file=sys.stderr)  # noqa: T201


# Hints for an unknown argument or option: the function or command that has it.

MOST_NAMED = 4
"""Most functions or commands in a hint."""
ALMOST = 0.9
"""Similarity from which an own name is suggested although another function or command has the given one."""


def elsewhere(given: str, own: Iterable[str], others: Mapping[str, Iterable[str]], kind: str) -> str:
    """A hint for a name that is not in `own`, as the end of an error's line; "" if there is none.

    Args:
        given: the unknown name. own: the valid names.
        others: the names of other functions or commands, by function or command.
        kind: of the names: "argument" or "option".
    """
    owners: dict[str, list[str]] = {}
    for owner, names in others.items():
        for name in names:
            owners.setdefault(name, []).append(owner)

    def of(name: str) -> str:
        more = len(owners[name]) - MOST_NAMED
        listed = ", ".join(owners[name][:MOST_NAMED])
        return f"an {kind} of {listed}" + (f" and {more} more" if more > 0 else "")

    own = list(own)
    if given in owners:
        close = nearest(given, own, ALMOST)
        return f"did you mean {close!r}? {given} is {of(given)}" if close else f"it is {of(given)}"
    close = nearest(given, [*owners, *own])  # among equally similar names the own one, which is last
    return "" if not close else f"did you mean {close!r}?" if close in own else f"did you mean {close!r}, {of(close)}?"


class UnknownArgument(UsageError):
    """An unknown keyword of a function of the public API. It can be raised again in another process.

    Attributes:
        name: of the keyword. number: its value if that is an integer. known: the valid names.
    """

    name: str
    number: int | None
    known: list[str]

    @classmethod
    def of(cls, function: Callable[..., Any], name: str, value: object, known: Iterable[str]) -> UnknownArgument:
        """The error for a call of `function` with `name=value`."""
        known = list(known)
        error = cls(f"{function.__name__} has no argument {name!r}", expected=f"one of {', '.join(known)}")
        error.name, error.number, error.known = name, value if isinstance(value, int) else None, known
        return error

    def with_fix(self, function: Callable[..., Any], public: Mapping[str, Callable[..., Any]]) -> UsageError:
        """The error with a hint; `function`: that was called; `public`: the functions of the API by name."""
        from planner.world.scenario import place_of

        own, here = signature(function).parameters, function.__name__
        if "plan" in own and self.name == "robots" and self.number is not None:
            fix = f"give plan={self.number}, the number of robots to plan for"
        elif "plan" in own and "plan" in public and self.name in signature(public["plan"]).parameters:
            fix = f"give it to `plan`, and the plan to `{here}`"
        else:
            others = {name: signature(one).parameters for name, one in public.items() if name != here}
            fix = elsewhere(self.name, self.known, others, "argument")
            said = place_of(self.name) if here == "load" else ""
            fix = fix if not said or self.name in set().union(*others.values()) else f"set it in a scenario: {said}"
        return UsageError(self.problem, expected=self.expected, fix=fix)


@cache
def with_hints(
    function: Callable[..., Any], public: Callable[[], Mapping[str, Callable[..., Any]]]
) -> Callable[..., Any]:
    """The function, with hints in its error for an unknown keyword."""
    own = signature(function).parameters
    known = set(own) | set(getattr(function, "settings", ()))
    takes_any = any(one.kind is Parameter.VAR_KEYWORD for one in own.values())

    @wraps(function)
    def call(*arguments: Any, **given: Any) -> Any:
        given = with_new_names(given, known)
        try:
            for name in () if takes_any else given.keys() - own.keys():
                raise UnknownArgument.of(function, name, given[name], own)
            return function(*arguments, **given)
        except UnknownArgument as error:
            raise error.with_fix(function, public()) from None

    return call
