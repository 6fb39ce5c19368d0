"""The planner's settings, each defined once: options, files, sweeps, checks and pages derive from its line here."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, make_dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

from planner.arguments import (
    ANY,
    COMMAND_LINE,
    ENGINES,
    MAX_STEP,
    MOST_ROLLOUTS,
    POSITIVE,
    SEED,
    Numbers,
    argument,
    check_each,
    check_word,
    did_you_mean,
    exactly,
    is_real,
    whole,
)
from planner.errors import LOOPS, PlanError, UsageError, warn_renamed
from planner.formatting import TIMES, UNPACED, Pace
from planner.policies import DEFAULT, RULES, Rule, rule_of
from planner.policies.rules import NEAREST, ORDERS, PER_CELL, InAreaOrder
from planner.simulator.offers import Offer

if TYPE_CHECKING:
    from planner.failure_model import FailureModel

Policy = str | Rule | Callable[[Offer], Any]
"""The name of a rule, or a user-defined `Rule` or function that orders areas (`planner.policies.own_rule`)."""
BEST = "best"
"""`"best"`: search for the policy with the highest coverage. Never stored in a plan."""
AUTO = "auto"
"""`deliver_every="auto"`: search for the number of cells with which most is delivered. Never stored in a plan."""
SEARCHED = {"policy": (BEST, PER_CELL.name), "deliver_every": (AUTO, None)}
"""Settings that a search may find: the value that asks for it, and the one that stands for it until then."""
POLICY = ("policy", "risk_cap", "robot_value", "priority")
"""A policy and its limits."""
BEARING = ("weibull_shape", "hazard_multiplier")
"""Settings of the failure model. No decision depends on them."""
AGAIN = ("recharge", "deliver_every", "deliver_value")
"""Settings by which robots go on after a return to base."""
KEPT = ("range", "deadline", "return_to", *AGAIN, "wrecks", "steps_per_move", "radio")
"""Limits of the robots under every policy."""
GROUPS = {"policy": POLICY, "plan_for": ("plan_for", "effort")}
"""Settings with dependent ones: a new choice of the first discards the input's values of the others."""
MOST_LEVELS = 1024
MOST_EFFORT = 10**9
MOST_DENSITY = 1e6
MOST_PACE = 64
"""Steps that a move may take."""
COUNT = whole(0, 2**31)
MOST_PRIORITY = 1000


@dataclass(frozen=True)
class Setting:
    """Accepted values and texts of a setting or of another option.

    Attributes:
        title: its name on pages. help: text of its option.
        group: heading in `--help`. default: of an option that is not a setting.
        form: kind of an option whose values are neither numbers nor words: "flag", "switch" (a flag with a `--no-`),
            "cells", "path", "text", "texts" (may be repeated), "effort" (of `exact`), "reach" (cells, or inf), "auto"
            (a whole number, or AUTO).
        rare: listed by `--help-all` only.
        numbers: accepted numbers. each: one for all, or a tuple with one a robot. words: accepted words.
        names: a name, or a tuple with one a robot.
        found: set by a search only, one number a cell of the map; it has no option.
        places: one of the words, or cells as a tuple of (row, col).
        unset: meaning of None on pages; "": never None.
        time: a step, which may be given as a time (`planner.formatting`).
        before: words of release 0.3 that are still read, with today's words.
        later: added after plans were first saved; its default does not change the identity of a plan.
    """

    title: str
    help: str
    numbers: Numbers = ANY
    each: bool = False
    words: tuple[str, ...] = ()
    unset: str = ""
    time: bool = False
    later: bool = False
    places: bool = False
    names: bool = False
    found: bool = False
    before: Mapping[str, str] = field(default_factory=dict)
    group: str = "Planning"
    default: Any = None
    form: str = ""
    rare: bool = True

    @property
    def kind(self) -> str:
        """ "word", "time", "places", "names", "whole", "number"; "wholes", "numbers" for one a robot; or the form."""
        if self.form:
            return self.form
        if self.names:
            return "names"
        if self.time or self.places:
            return "time" if self.time else "places"
        return "word" if self.words else ("whole" if self.numbers.whole else "number") + "s" * self.each

    def expected(self, unset: str) -> str:
        """Text of the accepted values. `unset`: spelling of None; "": None is not mentioned."""
        if self.names:
            return f"a type, or a list of one a robot{f', or {unset}' * bool(unset)}"
        if self.words:
            listed = " or ".join(f'"{word}"' for word in self.words)
            return listed + (f" or a list of [row, col]{f', or {unset}' * bool(unset)}" if self.places else "")
        listed = ", or a list of one a robot" if self.each else f", or a time, as {TIMES}" if self.time else ""
        return self.numbers.expected + listed + (f", or {unset}" if self.unset and unset else "")

    def accepts(self, value: Any) -> bool:
        """True for a value that the setting may have."""
        if self.names:
            each = value if isinstance(value, tuple) else (value,)
            return value is None or (bool(each) and all(isinstance(name, str) and name for name in each))
        if self.places and isinstance(value, tuple):
            return bool(value) and all(
                isinstance(p, tuple) and len(p) == 2 and all(map(COUNT.accepts, p)) for p in value
            )
        if value is None or self.words:
            return value in self.words if value is not None else bool(self.unset)
        if self.each and isinstance(value, tuple):
            return bool(value) and all(map(self.numbers.accepts, value))
        return self.numbers.accepts(value)

    def plain(self, value: Any) -> Any:
        """A value as files hold it: numbers that may have a fraction as float."""
        if self.words or self.names or self.numbers.whole or value is None:
            return value
        return tuple(map(float, value)) if isinstance(value, tuple) else float(value)

    def format(self, value: Any) -> str:
        """A value, on pages."""
        if self.places and isinstance(value, tuple):
            return " ".join(f"[{row}, {col}]" for row, col in value)
        if self.names and value is not None:
            return value if isinstance(value, str) else " ".join(value)
        if isinstance(value, tuple):
            return "found by a search" if self.found else " ".join(f"{one:,g}" for one in value)
        return self.unset if value is None else value if self.words else f"{value:,g}"


def _setting(default: Any, title: str, option: str, numbers: Numbers = ANY, **more: Any) -> Any:
    return field(default=default, metadata={"setting": Setting(title, option, numbers, **more)})


@dataclass(frozen=True)
class Settings:
    """Settings that a plan depends on (SPEC sections 1-5). They are saved with it.

    Attributes:
        levels: maximum number of threat levels, `p = 0` included; maps with more distinct values are quantised.
        density: d of Algorithm 1, minimum number of cells a robot in a safe area; above 1.
        risk: "paper", eq. (3), or "log": the cheapest path has the highest survival probability.
        transit: "grid": legs inside an area may cross others; "area": they stay inside.
        max_steps: T_max; None = 8 * levels * accessible cells + 64.
        policy: choice of the next area (SPEC section 11): the name of a rule of `planner.policies.RULES`; or a
            user-defined `Rule` or function (`planner.policies.own_rule`), which is not saved.
        risk_cap: maximum fraction of the robots alive that may be at risk at once; None = all. With `per_cell`.
        robot_value: value of a robot in new cells; None = no limit. With `per_cell`.
        range: maximum number of moves of a robot, one number for all or one a robot; None = unlimited.
        deadline: step at which the mission ends; None = no deadline.
        weibull_shape: Weibull shape of the failure threshold (SPEC section 14); 1 = failures without memory.
        hazard_multiplier: factor of the exposure, one number for all or one a robot. No decision depends on these two.
        return_to: bases that robots return to (SPEC section 19): "home", their own starts; "nearest", the nearest
            start; or cells, a tuple of (row, col); None = robots stay at their last cell.
        wrecks: "block": lost robots are obstacles for the others (SPEC section 15); "ignore": they are not.
        deliver_every: undelivered cells with which a robot returns to a base and goes on; None = only at the end.
        deliver_value: value of undelivered cells with which it does so; None = only at the end.
        recharge: steps at a base that restore the range of a robot; None = never restored.
        types: robot types (SPEC section 22), one for all or one a robot, named in the world's matrix; None = the map's
            p applies to every robot.
        steps_per_move: steps a move (SPEC section 22), one number for all or one a robot. Only their ratios count:
            they are reduced to whole numbers without a common factor. None = 1 each.
        radio: radio range in cells between robots, and to a start or base (SPEC section 22). A robot without a chain
            to one of these takes and shares no area, and drives back. None = unlimited.
        in_area: choice of the next cell of an area: one of `planner.policies.rules.ORDERS`; or a user-defined function
            of a `CellOffer`, which is not saved.
        priority: weight of each cell when areas are compared, one number a cell of the map, row by row; set by
            `--policy best`. None = equal weights. With `per_cell`, without `robot_value`.
    """

    levels: int = _setting(
        16, "threat levels at most", "Largest number of threat levels, p = 0 included (default: the input's, else 16).",
        whole(2, MOST_LEVELS),
    )  # fmt: skip
    density: float = _setting(
        4.0, "density d", "Minimum number of cells per robot in a safe area (default: 4).",
        Numbers(1, MOST_DENSITY, above=True),
    )  # fmt: skip
    risk: Literal["paper", "log"] = _setting(
        "paper", "risk", "Cost of a dangerous cell: paper, p / p_min; log, -log(1 - p) (default: paper).",
        words=("paper", "log"),
    )  # fmt: skip
    transit: Literal["grid", "area"] = _setting(
        "grid", "transit", "Legs inside an area may cross other areas (grid) or not (area) (default: grid).",
        words=("grid", "area"),
    )  # fmt: skip
    max_steps: int | None = _setting(
        None, "step limit", "End an unfinished run at this step (default: 8 * levels * cells + 64).",
        whole(1, MAX_STEP), unset="8 x levels x cells + 64",
    )  # fmt: skip
    policy: Policy = _setting(  # noqa: RUF009
        DEFAULT, "policy",
        "Next area: mrac, the nearest; per_cell, the least cost per new cell; watchful, re-evaluated before every "
        "dangerous cell; frontier, for robots without a known map (default: mrac).",
        words=tuple(RULES), later=True, rare=False,
    )  # fmt: skip
    risk_cap: float | None = _setting(
        None, "risk cap", "Largest share of the surviving robots at risk at once, with per_cell (default: 1).",
        Numbers(0, 1, above=True), unset="none", later=True,
    )  # fmt: skip
    robot_value: float | None = _setting(
        None, "robot value",
        "Value of a robot in new cells, with per_cell; areas with a higher expected loss are skipped (default: none).",
        Numbers(0, above=True), unset="none", later=True,
    )  # fmt: skip
    plan_for: str = _setting(
        "closed_loop", "planned for",
        "closed_loop: survivors take over the work of lost robots (default); open_loop: fixed paths.",
        words=("closed_loop", "open_loop"), later=True, before=LOOPS,
    )  # fmt: skip
    effort: int | None = _setting(
        None, "effort of the search", "Paths that the search of --plan-for open_loop evaluates (default: 200000).",
        whole(0, MOST_EFFORT), unset="200,000 evaluations", later=True,
    )  # fmt: skip
    range: int | tuple[int, ...] | None = _setting(
        None, "range", "Number of moves before a robot stops: one number, or one per robot (default: unlimited).",
        whole(1, MAX_STEP), each=True, unset="any number of moves", later=True, rare=False,
    )  # fmt: skip
    deadline: int | None = _setting(
        None, "deadline", "End the mission at this step, or at a time: 45min, 1h30min, 90s.",
        whole(0, MAX_STEP), unset="none", time=True, later=True, rare=False,
    )  # fmt: skip
    weibull_shape: float = _setting(
        1.0, "Weibull shape", "Weibull shape of the failure threshold; above 1: risk grows with exposure (default: 1).",
        Numbers(0.25, 16.0), later=True,
    )  # fmt: skip
    hazard_multiplier: float | tuple[float, ...] = _setting(
        1.0, "hazard multiplier", "Factor on the hazard of every visit: one number, or one per robot (default: 1).",
        Numbers(1 / 64, 64.0), each=True, later=True,
    )  # fmt: skip
    return_to: str | tuple[tuple[int, int], ...] | None = _setting(
        None, "return to", 'Return to: home (its own start), nearest (any start) or bases "row,col;row,col;...".',
        words=("home", "nearest"), unset="nowhere", places=True, later=True, rare=False,
    )  # fmt: skip
    wrecks: str = _setting(
        "ignore", "wrecks", "Lost robots block their cells for the others: block, or ignore (default).",
        words=("ignore", "block"), later=True,
    )  # fmt: skip
    deliver_every: int | None = _setting(
        None, "deliver every",
        "Return to the base, and go on, with this many cells to deliver; auto: found by a search (default: never).",
        whole(1, MAX_STEP), unset="never", later=True, form="auto",
    )  # fmt: skip
    deliver_value: float | None = _setting(
        None, "deliver value", "Return to the base, and go on, with cells of this value to deliver (default: never).",
        Numbers(0, above=True), unset="never", later=True,
    )  # fmt: skip
    recharge: int | None = _setting(
        None, "recharge", "Steps at a base that restore the range, with --range and --return-to (default: never).",
        whole(1, MAX_STEP), unset="never", later=True,
    )  # fmt: skip
    types: str | tuple[str, ...] | None = _setting(
        None, "types of robots", "Type of all robots, or of each, from the scenario: drone,rover,rover.",
        unset="none", later=True, names=True,
    )  # fmt: skip
    steps_per_move: int | tuple[int, ...] | None = _setting(
        None, "steps a move", "Steps per move of each robot: 1,2 (default: 1 each).",
        whole(1, MOST_PACE), each=True, unset="1", later=True,
    )  # fmt: skip
    radio: float | None = _setting(
        None, "radio", "Radio range in cells, to another robot or a base (default: unlimited).",
        Numbers(0, 1e6, above=True), unset="any distance", later=True,
    )  # fmt: skip
    in_area: InAreaOrder = _setting(  # noqa: RUF009
        NEAREST, "order within areas", "Order of cells in safe areas (default: nearest).",
        words=ORDERS, later=True,
    )  # fmt: skip
    priority: int | tuple[int, ...] | None = _setting(
        None, "priority", "", whole(1, MOST_PRIORITY), each=True, unset="none", later=True, found=True,
    )  # fmt: skip

    @property
    def last_step(self) -> int | None:
        """The step at which every run ends, by `deadline` or by `max_steps`; None: neither is set."""
        return min((step for step in (self.deadline, self.max_steps) if step is not None), default=None)

    @property
    def ends_by_deadline(self) -> bool:
        """True if `deadline` ends the runs, not the step limit."""
        return self.deadline is not None and self.deadline == self.last_step

    def failure_model(self, begun: tuple[int, ...] = ()) -> FailureModel:
        """The failure model; `begun`: known exposure of each robot, in units of 2**-32 nat."""
        from planner.failure_model import FailureModel

        return FailureModel(self.weibull_shape, self.hazard_multiplier, begun, self.types)

    @property
    def alone(self) -> Settings:
        """The settings of a team of the first robot: its value of each per-robot setting."""
        each = (name for name, setting in SETTINGS.items() if (setting.each or setting.names) and not setting.found)
        own = {name: getattr(self, name) for name in each}
        return replace(self, **{name: given[0] for name, given in own.items() if isinstance(given, tuple)})

    @property
    def rule(self) -> Rule:
        """The policy's rule."""
        return rule_of(self.policy)

    @property
    def own_words(self) -> str:
        """Text that names the user-defined rule and order; "" if there are none."""
        rule = f"the user's own rule {self.rule.name}" if not isinstance(self.policy, str) else ""
        order = "" if isinstance(self.in_area, str) else "an in-area order of the user's own"
        return " and ".join(filter(None, (rule, order)))

    def check_team(self, robots: int, source: str = "") -> None:
        """Raise PlanError, naming `source`, for per-robot settings of another number of robots."""
        for name in (name for name, setting in SETTINGS.items() if setting.each and not setting.found):
            check_each(name, getattr(self, name), robots, source)

    @property
    def blocks(self) -> bool:
        """Whether lost robots become obstacles."""
        return self.wrecks == "block"

    def require_no_wrecks(self, what: str) -> None:
        """Raise PlanError for lost robots that become obstacles, which `what` does not support."""
        if self.blocks:
            raise PlanError(f"{what} with {argument('wrecks', 'block')}", fix=f"leave {argument('wrecks')} out")

    @property
    def paces(self) -> tuple[int, ...]:
        """Steps a move of each robot, without a common factor; none where all have one speed."""
        given = self.steps_per_move if isinstance(self.steps_per_move, tuple) else ()
        reduced = tuple(steps // math.gcd(*given) for steps in given)
        return reduced if len(set(reduced)) > 1 else ()

    def require_uniform(self, what: str, *others: str) -> None:
        """Raise PlanError for robots that differ or have a limited radio range, which `what` does not support.

        Args:
            what: subject of the message.
            others: further settings that it does not support.
        """
        differ = {"steps_per_move": bool(self.paces)}
        for name in (*others, "types", "steps_per_move", "radio"):
            if differ.get(name, getattr(self, name) is not None):
                raise PlanError(f"{what} with {argument(name)}", fix=f"leave {argument(name)} out")

    def check(self, source: str = "") -> None:
        """Raise PlanError, naming `source`, for unknown words, values out of range, limits without their policy.

        Without a source the message names arguments; on a command line, options.
        """
        typed = COMMAND_LINE.get() and not source

        def message(name: str, value: str) -> str:
            return f"{argument(name)} {value}" if typed else f"{name} is {value}"

        def called(name: str) -> str:
            return argument(name) if typed else name

        for name, setting in SETTINGS.items():
            value = getattr(self, name)
            if name in ("policy", "in_area") and (isinstance(value, Rule) or callable(value)):
                continue
            if setting.kind == "word":
                check_word(name, value, setting.words, PlanError, source)
            elif not setting.accepts(value):
                shown = f"{value:g}" if setting.kind == "number" and is_real(value) else repr(value)
                shown = ",".join(map(str, value)) if typed and isinstance(value, tuple) else shown
                expected = setting.expected("null" if source else "" if typed else "None")
                fix = did_you_mean(value, setting.words) or setting.numbers.meant(value)
                raise PlanError(message(name, shown), source=source, expected=expected, fix=fix)
        for name in POLICY[1:]:
            if getattr(self, name) is not None and not self.rule.limited:
                limited = " or ".join(rule.name for rule in RULES.values() if rule.limited)
                raise PlanError(
                    f"{message(name, SETTINGS[name].format(getattr(self, name)))} with {called('policy')} "
                    f"{self.rule.name}",
                    source=source,
                    expected=f"{called('policy')} {limited}",
                    fix=f"leave {called(name)} out, or choose that policy",
                )
        if self.priority is not None and self.robot_value is not None:
            fix = f"leave one of {called('priority')} and {called('robot_value')} out"
            raise PlanError(f"{called('priority')} with {called('robot_value')}", source=source, fix=fix)
        if self.effort is not None and self.plan_for != "open_loop":
            problem = f"{message('effort', str(self.effort))} with {called('plan_for')} {self.plan_for}"
            expected, fix = f"{called('plan_for')} open_loop", f"leave {called('effort')} out"
            raise PlanError(problem, source=source, expected=expected, fix=fix)
        for name in (name for name in AGAIN if getattr(self, name) is not None):
            needed = ("range", "return_to")[name != "recharge" :]
            if any(getattr(self, other) is None for other in needed):
                problem = f"{message(name, exactly(getattr(self, name)))} without {' and '.join(map(called, needed))}"
                fix = f"give {'it' if len(needed) == 1 else 'both'}, or leave {called(name)} out"
                raise PlanError(problem, source=source, fix=fix)

    def described(self, pace: Pace = UNPACED) -> dict[str, str]:
        """Every setting by its title, for pages."""
        said = {name: getattr(self, name) for name in SETTINGS} | {"policy": self.rule.name}
        said["in_area"] = self.in_area if isinstance(self.in_area, str) else "the user's own"
        shown = {setting.title: setting.format(said[name]) for name, setting in SETTINGS.items()}
        ends = {SETTINGS[name].title: said[name] for name in ("deadline", "max_steps") if said[name] is not None}
        return shown | {title: shown[title] + pace.also(step) for title, step in ends.items()}

    def as_json(self) -> dict[str, Any]:
        """Every setting by its name. The `id` of its object names a user-defined one, in this process only."""
        said = {name: getattr(self, name) for name in SETTINGS}
        said = {name: SETTINGS[name].plain(value) for name, value in said.items()}
        if not isinstance(self.policy, str):
            said["policy"] = f"own {self.rule.name} {id(self.policy):x}"
        if not isinstance(self.in_area, str):
            said["in_area"] = f"own {id(self.in_area):x}"
        return said

    def to_json(self) -> dict[str, Any]:
        """The settings for plan files and identities. Those marked `later` are left out at their default."""
        plain = _defaults()
        later = {name for name in plain if name not in SETTINGS or SETTINGS[name].later}
        return {name: value for name, value in self.as_json().items() if name not in later or value != plain[name]}


@cache
def _defaults() -> dict[str, Any]:
    return Settings().as_json()


SETTINGS: dict[str, Setting] = {item.name: item.metadata["setting"] for item in fields(Settings) if item.metadata}
LOOP_WORDS = ("closed", "open")
METRICS = ("visited", "survived", "delivered")
TEAM, GOAL, ROLLOUTS, SURVEY, TIMELINE, OUTPUT = "Team", "Goal", "Rollouts", "Many maps", "Timeline", "Output"
"""Groups of options, in addition to "Planning"."""


def _option(
    group: str, name: str, text: str, form: str = "", numbers: Numbers = ANY, default: Any = None, **more: Any
) -> tuple[str, Setting]:
    more = dict[str, Any]({"unset": "unset", "rare": False}) | more
    return name, Setting(name.replace("_", " "), text, numbers, group=group, form=form, default=default, **more)


OPTIONS: dict[str, Setting] = SETTINGS | dict([
    _option(TEAM, "robots", "Number of robots (default: the input's starts or count, else 1).", numbers=whole(1, 1024)),
    _option(TEAM, "starts", 'Start cells, "row,col;row,col;..." (default: the input\'s, else upper left).', "cells"),
    _option(TEAM, "cell_size", "Side of a cell in metres; a bare map is coarsened to it (default: its pixels)."),
    _option(TEAM, "step_seconds", "Duration of a step in seconds; adds times in minutes.", rare=True),
    _option(TEAM, "speed", "Speed in metres per second, instead of --step-seconds.", rare=True),
    _option(TEAM, "turn", "Steps per quarter turn; adds times with turns.", rare=True),
    _option(TEAM, "sensor_range", "Sensor range in cells of robots without a known map; inf: the whole map.", "reach",
            rare=True),
    _option("Planning", "plan", "Plan file to use instead of planning.", "path"),
    _option("Planning", "state", "Start from a mission state: JSON, tracks or visited cells (.csv), mask (.npy, .png), "
            "OccupancyGrid (.yaml, .mcap); --starts gives the robots' cells if the file does not.", "path"),
    _option(ROLLOUTS, "loop", "closed: survivors take over the work of lost robots (default); open: fixed paths.",
            words=LOOP_WORDS),
    _option(ROLLOUTS, "rollouts", "Number of rollouts.", numbers=whole(1, MOST_ROLLOUTS)),
    _option(ROLLOUTS, "precision", "Stop at this half-width of the 95 % interval of mean coverage, a fraction.",
            numbers=Numbers(0, 1, above=True, below=True, text="a fraction of the accessible cells in (0, 1)")),
    _option(ROLLOUTS, "seed", "Seed of the rollouts; the map and the plan do not depend on it (default: 0).",
            numbers=SEED, default=0),
    _option(ROLLOUTS, "engine", "Simulator; results do not depend on it. auto: numba, or jax on a GPU (default).",
            words=ENGINES, default="auto", rare=True),
    _option(ROLLOUTS, "exact", "Compute exact closed-loop values of small teams: auto (about 2 s), never, or seconds "
            "(default: auto).", "effort", default="auto", rare=True,
            numbers=Numbers(0, 1e6, above=True, text="auto, never, or a number of seconds above 0, at most 1e6")),
    _option(ROLLOUTS, "threat_checks", "Visits that may destroy a robot: every_visit (default), or the first_visit of "
            "each cell by any robot.", words=("every_visit", "first_visit"), default="every_visit", rare=True),
    _option(ROLLOUTS, "seconds", "Stop after this many seconds of rollouts (default: 10; none with --rollouts or "
            "--precision).", numbers=POSITIVE, rare=True),
    _option(GOAL, "target", "Fraction of the accessible cells to cover, above 0, at most 1."),
    _option(GOAL, "metric", "Cells that count: visited (default), survived (left alive) or delivered (brought to a "
            "base, with --return-to).", words=METRICS, default="visited"),
    _option(SURVEY, "processes", "Number of processes; results do not depend on it (default: one per core).",
            numbers=whole(1)),
    _option(SURVEY, "scheduler", "A dask.distributed scheduler, tls://host:8786 or tcp://host:8786.", "text"),
    _option(SURVEY, "store", "Keep results in this file, and reuse those that it has.", "path"),
    _option(OUTPUT, "bound", "Compute the sharpest upper bound, on maps with over 1,000 dangerous cells too.", "flag",
            default=False, rare=True),
    _option(OUTPUT, "out", "Write the page, pictures and JSON to this folder.", "path"),
    _option(OUTPUT, "force", "Replace existing files without asking.", "flag", default=False),
    _option(OUTPUT, "json", "Print one JSON object and nothing else.", "flag", default=False),
])  # fmt: skip
"""Every option that several commands, functions or files share, by name."""
_Given: Any = make_dataclass("_Given", [(name, Any, None) for name in SETTINGS], frozen=True)


class Choices(_Given):
    """The settings as given by a user, by name; None = not given."""

    def given(self) -> dict[str, Any]:
        """The choices that the user made."""
        values = {name: getattr(self, name) for name in SETTINGS}
        for name, value in values.items():
            if isinstance(value, str) and value in SETTINGS[name].before:
                values[name] = SETTINGS[name].before[value]
                warn_renamed(argument(name, value), argument(name, values[name]))
        return {name: value for name, value in values.items() if value is not None}

    @property
    def searched(self) -> tuple[str, ...]:
        """The settings that a search has to find."""
        return tuple(name for name, (word, _) in SEARCHED.items() if getattr(self, name) == word)

    def before_search(self) -> Choices:
        """The same with the values that stand for those to find."""
        return replace(self, **{name: SEARCHED[name][1] for name in self.searched})

    def require_no_search(self, other: str) -> None:
        """Raise UsageError for a search together with `other`, which needs none."""
        for name in self.searched:
            raise UsageError(f"both {argument(name, SEARCHED[name][0])} and {other}", expected="one of them")

    def over(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """The input's settings, replaced by these; a new policy discards the limits of the input's policy."""
        given = self.given()
        left = left_behind(given)
        return {name: value for name, value in asked.items() if name not in left} | given

    def settings(self, asked: Mapping[str, Any], pace: Pace, source: str = "", *, by: str = "") -> Settings:
        """The input's settings, replaced by these and checked; `pace` converts a deadline in minutes to a step.

        `by`: name of the input. Raises PlanError, naming `source`, and UsageError.
        """
        said = self.over(asked)
        if "deadline" in said:
            said["deadline"] = pace.last_step("deadline", said["deadline"], by if self.deadline is None else source)
        made = Settings(**said)
        try:
            made.check(source)
        except PlanError:  # If the input alone is wrong, the message names the input.
            alone = dict(asked) | ({"deadline": said.get("deadline")} if "deadline" in asked else {})
            Settings(**alone).check(by)
            raise
        return made


def left_behind(given: Mapping[str, Any]) -> tuple[str, ...]:
    """Settings that a new choice of these discards."""
    return tuple(name for chosen, group in GROUPS.items() if chosen in given for name in group)
