"""The commands `starts`, `clear` and `attack` of `mrac-jax`: what can still be chosen before a mission."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from analysis.cli.console import check_files, check_folder
from analysis.cli.deliver import deliver
from analysis.cli.groups import CommonLuck, Team, Together
from analysis.cli.options import (
    GOAL,
    TEAM,
    CellSize,
    Input,
    Json,
    Number,
    OutPath,
    Removed,
    Speed,
    StepSeconds,
    Text,
    Whole,
)
from analysis.kit.notes import say

if TYPE_CHECKING:
    from analysis.report.answer import Answer


def starts(
    source: Input,
    /,
    *,
    depot: Annotated[bool, Parameter(group=GOAL, negative="")] = False,
    candidates: Annotated[Text, Parameter(group=GOAL)] = None,
    robots: Annotated[Whole, Parameter(group=TEAM)] = None,
    cell_size: CellSize = None,
    step_seconds: StepSeconds = None,
    speed: Speed = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    scenario_out: OutPath = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """The best starts: one for each robot, or one depot for all.

    Candidates are screened by a bound and by eq. (4) of one robot, the best simulated on common random numbers, the
    better half of them with twice the rollouts, and so on, with the best depot and where the team stands now. The best
    found is compared with that on fresh rollouts, and named as a command; if it is not surely better, the answer is:
    stay.

    Args:
        depot: One place for all robots, not one each.
        candidates: Where robots may start: border, the safe cells on the border of the map; or a mask of the
            map or rows of row,col as .npy or .csv (default: border).
        robots: How many robots (default: as many as the input names, else 1).
        scenario_out: Write the scenario with the best starts (YAML) here.
        out: Write the page, the picture, the plan and JSON to this folder.
    """
    from analysis.depots.candidates import BORDER, read_candidates
    from analysis.depots.search import find_starts, team_size
    from analysis.inputs import input_path
    from analysis.kit.progress import show_progress
    from planner.worlds.restart import write_scenario

    what, planning = what or CommonLuck(), planning or Together()
    choices = what.choices()
    named = None if candidates in (None, BORDER) else Path(str(candidates))
    check_files(source, scenario_out, suffix=".yaml", beside=(named,))
    check_folder(out)
    given, notes = (BORDER, ()) if named is None else read_candidates(named)
    team = Team(cell_size=cell_size, step_seconds=step_seconds, speed=speed)
    asked = team.asked(source, planning.choices())
    world = asked.load()
    settings = asked.choices.settings(world.team.settings, world.pace, by=world.source)
    say((*world.notes, *(f"{named}: {note}" for note in notes)))
    with show_progress() as progress:
        answer = find_starts(
            world, team_size(world, robots), settings, choices, depot=depot, candidates=given,
            source=named or "", words=what.words(source, team, planning), progress=progress,
            doing=progress.doing,
        )  # fmt: skip
    if scenario_out is not None:
        write_scenario(scenario_out, input_path(source), answer.starts, settings, world.pace, cell_size)
        say([f"wrote {scenario_out}"])
    return deliver(answer, out=out, as_json=as_json, source=source, beside=(named,))


def clear(
    source: Input,
    /,
    *,
    count: Annotated[Whole, Parameter(group=GOAL)] = None,
    remove: Annotated[Removed, Parameter(group=GOAL)] = None,
    team: Team | None = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Which threat to remove first: after replanning, and with the old plan.

    Threats are screened by the bound for every strategy; the best are planned
    for anew and simulated on common random numbers, and the pick is told on fresh rollouts.

    Args:
        count: How many threats to clear, one after the other (default: 1).
        remove: What a threat is: a connected area of danger, or a polygon, point or site of the scenario's
            threats (default: sources where there are several, else areas).
        out: Write the page, the pictures and JSON to this folder.
    """
    from analysis.removal.search import find_clearing

    search = partial(find_clearing, count=1 if count is None else count, remove=remove)
    return _of_threats(search, source, team, what, planning, out, as_json)


def attack(
    source: Input,
    /,
    *,
    count: Annotated[Whole, Parameter(group=GOAL)] = None,
    p: Annotated[Number, Parameter(group=GOAL)] = None,
    team: Team | None = None,
    what: CommonLuck | None = None,
    planning: Together | None = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """Where threats would cost the team most: if robots know of them and plan anew, and if they do not.

    A threat is placed in the cell where fewest are visited on common random numbers, one after the other; then each is
    moved while that costs more. What they cost is told on fresh rollouts.

    Args:
        count: How many threats are placed (default: 1).
        p: The chance that a visit of one stops a robot, beside what else is there (default: 0.2).
        out: Write the page, the pictures, JSON and both maps (known.yaml, hidden.npz) to this folder.
    """
    from analysis.adversary.search import find_attack

    search = partial(find_attack, count=1 if count is None else count, p=0.2 if p is None else p)
    return _of_threats(search, source, team, what, planning, out, as_json)


def _of_threats(
    search: Callable[..., Answer],
    source: str,
    team: Team | None,
    what: CommonLuck | None,
    planning: Together | None,
    out: Path | None,
    as_json: bool,
) -> int:
    """Run a search for threats, and show its answer."""
    from analysis.inputs import load_task
    from analysis.kit.progress import show_progress

    team, what, planning = team or Team(), what or CommonLuck(), planning or Together()
    choices = what.choices()
    check_folder(out)
    task = load_task(team.asked(source, planning.choices()))
    say(task.notes)
    with show_progress() as progress:
        answer = search(task.world, task.starts, task.settings, choices, progress=progress, doing=progress.doing)
    return deliver(answer, out=out, as_json=as_json, source=source)
