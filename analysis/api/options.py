"""Options that several functions of the public API share, each said once: the planner's settings, and the rollouts.

A function that takes them is written `def f(..., **options: Unpack[SearchOptions])` and decorated with `takes`, which
gives it a signature that names each option, and refuses others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import Parameter, signature
from typing import Any, Literal, TypedDict, TypeVar

from analysis.sampling import Exactness
from analysis.utils.notes import ProgressCallback, UnknownArgument
from analysis.utils.progress import OnInterrupt
from planner.policies.rules import InAreaOrder
from planner.rollouts.names import EngineName
from planner.settings import Policy

Loop = Literal["closed", "open"]
ReturnTo = str | Sequence[Sequence[int]] | None
"""Where robots come home to: "home", "nearest", bases `[[row, col], ...]`, or nowhere."""


class PlannerOptions(TypedDict, total=False):
    """Settings of `plan` that go with any policy."""

    levels: int | None
    density: float | None
    risk: Literal["paper", "log"] | None
    transit: Literal["grid", "area"] | None
    max_steps: int | None
    range: int | Sequence[int] | None
    wear: float | None
    susceptibility: float | Sequence[float] | None
    return_to: ReturnTo
    recharge: int | None
    types: str | Sequence[str] | None
    steps_per_move: int | Sequence[int] | None
    radio: float | None
    in_area: InAreaOrder | None


class PolicyOptions(PlannerOptions, total=False):
    """Settings of `plan` for robots that take over from each other."""

    policy: Policy | None
    reserve: float | None
    worth: float | None


class RolledOptions(TypedDict, total=False):
    """What is rolled out besides how many, and what is shown meanwhile: as of `evaluate`."""

    seed: int
    deadline: int | str | None
    first_visit: bool
    engine: EngineName
    exact: Exactness
    progress: ProgressCallback | bool | None
    on_interrupt: OnInterrupt


class FrontOptions(PlannerOptions, RolledOptions, total=False):
    """Of `front`, which chooses the policy itself."""


class SearchOptions(PolicyOptions, RolledOptions, total=False):
    """Of `starts`, `clear` and `attack`."""


class SizeOptions(SearchOptions, total=False):
    """Of `size`, which also plans for the open loop."""

    plan_for: Loop | None
    effort: int | None


DEFAULTS: dict[str, Any] = {
    "seed": 0, "first_visit": False, "engine": "auto", "exact": "auto", "on_interrupt": "raise",
}  # fmt: skip
"""Of options whose default is not None."""
Function = TypeVar("Function", bound=Callable[..., Any])


def takes(options: type) -> Callable[[Function], Function]:
    """A decorator: the function's `**options` are these, each keyword-only and with its default.

    The function is called with all of them. An argument that it does not have is an UnknownArgument.
    """
    more = {
        name: Parameter(name, Parameter.KEYWORD_ONLY, default=DEFAULTS.get(name), annotation=kind.__forward_arg__)
        for name, kind in options.__annotations__.items()
    }

    def named(function: Function) -> Function:
        own = signature(function)
        first = [one for one in own.parameters.values() if one.kind is not Parameter.VAR_KEYWORD]
        known = [*(one.name for one in first), *more]

        @wraps(function)
        def call(*args: Any, **given: Any) -> Any:
            for name in given.keys() - set(known):
                raise UnknownArgument.of(function, name, given[name], known)
            return function(*args, **{name: one.default for name, one in more.items()} | given)

        call.__signature__ = own.replace(parameters=[*first, *more.values()])  # type: ignore[attr-defined]
        return call  # type: ignore[return-value]

    return named
