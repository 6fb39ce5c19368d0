"""What searches say of their picks, sampled, against the same searches with every value exact: as often as they say.

Picks are chosen because they did well, so what is said of them is where luck would flatter (the winner's curse).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import cache
from importlib import import_module
from typing import Any, Literal

import numpy as np
import pytest

from analysis.estimators.trial import Known, Trial
from analysis.sampling import RolloutChoices
from analysis.search.pareto import Goal, find_front, settings_of
from analysis.search.start_positions import find_starts
from analysis.search.team_size import Goal as SizeGoal
from analysis.search.team_size import TeamVerdict, find_size
from analysis.search.threat_removal import find_clearing
from analysis.statistics.control_variate import LEAST
from analysis.statistics.estimates import Estimate
from planner.mrac.make_plan import make_plan
from planner.settings import Settings
from planner.simulator.tables import AllPairs
from planner.world.generate import Kind, ThreatPattern, random_world
from planner.world.levels import place_starts
from planner.world.world import World

SEARCHES = 300
BEFORE_LUCK = (
    "search.start_positions._places", "search.start_positions.allocated_plan", "search.threat_removal.any_strategy",
    "search.threat_removal.allocated_plan", "search.pareto.allocated_plan", "search.pareto.longest_mission",
    "search.team_size.plan_team", "search.team_size.team_ideals", "estimators.trial.compile_closed_loop",
)  # fmt: skip
"""What searches make of a map before any luck comes in."""
SLACK = 3 * np.sqrt(0.05 * 0.95 / SEARCHES)
"""Three standard errors of a share of 95 %."""
Held = Counter[str]


@pytest.fixture
def made_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """BEFORE_LUCK is made once of the same things, not for every seed."""
    for name in BEFORE_LUCK:
        room, function = name.rsplit(".", 1)
        monkeypatch.setattr(f"analysis.{name}", kept(getattr(import_module(f"analysis.{room}"), function)))


def kept(make: Callable[..., Any]) -> Callable[..., Any]:
    """The function with a memory: maps and arrays by what is in them, plans by which they are."""
    known: dict[tuple[object, ...], Any] = {}

    def one(given: object) -> object:
        if isinstance(given, World):
            return given.sha256
        if isinstance(given, np.ndarray):
            return given.tobytes()
        return None if isinstance(given, AllPairs) else given

    def made(*given: Any, **named: Any) -> Any:
        key = (*map(one, given), *((name, one(each)) for name, each in named.items()))
        if key not in known:
            known[key] = make(*given, **named)
        return known[key]

    return made


def world_of(kind: Kind, seed: int) -> World:
    return random_world(9, 10, ThreatPattern(kind, seed=seed), threats=0.3)


def asked(seed: int, exact: Literal["auto", "never"] = "never") -> RolloutChoices:
    return RolloutChoices(rollouts=LEAST, seed=seed, exact=exact, engine="numba")


def holds(found: Estimate | tuple[float, float], truth: float) -> bool:
    low, high = found.ci95 if isinstance(found, Estimate) else found
    return low - 1e-9 <= truth <= high + 1e-9


def starts_hold(world: World, seed: int, truth: Any, held: Held) -> None:
    """The pick's coverage, its gain, and whether all that is said of who is behind is true at once."""
    found = find_starts(world, 2, Settings(), asked(seed))
    true = [place.coverage and place.coverage.mean for place in truth.places]
    at = found.here if found.stay else found.best
    held["coverage"] += holds(found.confirmed.coverage, true[at])  # type: ignore[union-attr, arg-type, index]
    held["gain"] += found.gain is None or holds(found.gain, true[found.best] - true[found.here])  # type: ignore[index]
    told = [(place.behind, true[found.best] - mine) for place, mine in zip(found.places, true, strict=True) if mine]
    held["all behind"] += all(between is None or holds(between, gap) for between, gap in told)


def clear_holds(world: World, seed: int, truth: Any, held: Held) -> None:
    """The pick's gain in cells and in robots, on rollouts that had no part in the choice, and who is behind."""
    starts = place_starts(world, 2)[0]
    found = find_clearing(world, starts, Settings(), asked(seed), remove="areas")
    mine, true = found.turns[0], truth.turns[0]
    gains = [one.known for one in true.options]
    best = gains[mine.pick]
    held["gain"] += holds(found.gain.cells, best.cells.mean)  # type: ignore[union-attr]
    held["robots"] += holds(found.gain.robots, best.robots.mean)  # type: ignore[union-attr]
    told = [(one.behind, best.cells.mean - gain.cells.mean) for one, gain in zip(mine.options, gains, strict=True)]
    held["all behind"] += all(between is None or holds(between, gap) for between, gap in told)


def front_holds(world: World, seed: int, truth: Any, held: Held) -> None:
    """What is said of the pick, and that it keeps the limit."""
    starts = place_starts(world, 2)[0]
    found = find_front(world, starts, Settings(), asked(seed), goal=Goal(losses=truth))
    if found.confirmed is None:
        held["none"] += 1
        return
    known = exact_setting(world.sha256, found.confirmed.setting, world)
    held["coverage"] += holds(found.confirmed.coverage, known.mean("visited").mean / known.largest("visited"))
    held["losses"] += holds(found.confirmed.losses, known.mean("lost").mean)
    held["keeps"] += known.mean("lost").mean <= truth


@cache
def exact_setting(_: str, setting: Any, world: World) -> Known:
    plan = make_plan(world, place_starts(world, 2)[0], settings_of(Settings(), setting))
    known = Trial(world, plan, asked(0, "auto")).known()
    assert known is not None
    return known


def size_holds(world: World, seed: int, truth: Any, held: Held) -> None:
    """Every verdict of the search at once, and the team's coverage on fresh rollouts."""
    found = find_size(world, Settings(), truth.goal, asked(seed))
    sure = (TeamVerdict.ENOUGH, TeamVerdict.NOT_ENOUGH)
    true = {point.robots: point for point in truth.points}
    held["all verdicts"] += all(
        point.verdict not in sure or point.verdict == true[point.robots].verdict for point in found.points
    )
    if found.confirmed is None:
        held["none"] += 1
    else:
        held["coverage"] += holds(found.confirmed.coverage, true[found.confirmed.robots].coverage.mean)  # type: ignore[arg-type]


def exactly(world: World, what: str) -> Any:
    """The same search with every value exact; a limit of losses; a target that two robots just miss."""
    starts, choices = place_starts(world, 2)[0], asked(0, "auto")
    if what == "starts":
        answer: Any = find_starts(world, 2, Settings(), choices)
    elif what == "clear":
        answer = find_clearing(world, starts, Settings(), choices, remove="areas")
    elif what == "front":
        return 0.8
    else:
        two = Trial(world, make_plan(world, starts, Settings()), choices).known()
        assert two is not None
        target = two.mean("visited").mean / two.largest("visited") + 0.005
        answer = find_size(world, Settings(), SizeGoal(round(target, 3), most=3), choices)
    assert answer.engine == ""
    return answer


CHECKS = {"starts": starts_hold, "clear": clear_holds, "front": front_holds, "size": size_holds}


def shares(world: World, what: str, searches: int) -> dict[str, float]:
    """How often each claim was true, of the searches that made it."""
    truth, held = exactly(world, what), Held()
    for seed in range(searches):
        CHECKS[what](world, seed, truth, held)
    none = held.pop("none", 0)
    return {name: count / (searches if name == "all verdicts" else searches - none) for name, count in held.items()}


@pytest.mark.slow
@pytest.mark.usefixtures("made_once")
@pytest.mark.parametrize("kind", ["contiguous", "scattered"])
@pytest.mark.parametrize("what", CHECKS)
def test_what_is_said_of_picks_holds(what: str, kind: Kind) -> None:
    """300 searches on each of two maps."""
    for seed in (0, 1):
        found = shares(world_of(kind, seed), what, SEARCHES)
        assert found and min(found.values()) >= 0.95 - SLACK, (seed, found)
