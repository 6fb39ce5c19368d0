"""What the answers of all searches hold: on which map, by whose settings, on whose luck, and how far."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from analysis.report.answer import Answer, json_end
from analysis.report.model import KeyFigure
from analysis.sampling import RolloutChoices
from analysis.statistics.estimates import Estimate, in_unit, losses_shown
from planner.files import Json
from planner.formatting import counted
from planner.settings import Settings
from planner.world.world import World


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Searched(Answer):
    """What they share.

    Attributes:
        world, settings: the map, and what plans are made with. cells: accessible cells.
        choices: what was rolled out: most rollouts of each, seed, the step at which every mission ends.
        engine: that rolled out; "": all is exact. words: of the command `evaluate` for this input; empty in Python.
        partial: it was interrupted, and holds what was done. notes: what a user should know.
    """

    world: World
    settings: Settings
    choices: RolloutChoices
    cells: int
    engine: str
    words: tuple[str, ...] = ()
    partial: bool = False
    notes: tuple[str, ...] = ()

    @property
    def exact(self) -> bool:
        """Whether nothing was rolled out."""
        return not self.engine


# What reports say alike: on which map, on whose luck, how much is covered and lost, where an interval lies.

EXACT = "exact: nothing was rolled out"


def asked(world: World, robots: int, question: str) -> str:
    """ "site.npz, 3 robots: where to start?"."""
    return f"{world.name}, {counted(robots, 'robot')}: {question}"


def map_words(world: World, cells: int, robots: int = 0) -> str:
    """ "site.npz: 14 x 23 cells of 1 m, 300 accessible; 3 robots"; the team where there is one."""
    height, width = world.shape
    size = f"{height} x {width} cells of {world.cell_size:g} m, {cells:,} accessible"
    return f"{world.name}: {size}" + (f"; {counted(robots, 'robot')}" if robots else "")


def luck_words(world: World, choices: RolloutChoices, engine: str, rolled: str = "") -> str:
    """ "seed 0, numba", after what was `rolled` out; without an engine, that nothing was."""
    ends = "" if choices.deadline is None else f", every mission ended at {world.pace.step(choices.deadline)}"
    return (f"{rolled}seed {choices.seed}, {engine}" if engine else EXACT) + ends


def sourced(rollouts: int, said: str) -> str:
    """Where the figures of what was found come from, and they: "Exact expectation: 88.67 % covered"."""
    return f"Fresh rollouts: {said}" if rollouts else f"Exact expectation: {said.replace(' (exact)', '')}"


def share_figure(estimate: Estimate, name: str, note: str = "") -> KeyFigure:
    """A share as a key figure, with its interval."""
    mean, interval = estimate.columns(100.0, 100)
    return KeyFigure(f"{mean} %", name, in_unit(interval) + note)


def run_again(words: Sequence[str], how: Sequence[str], choices: RolloutChoices, *, exact: bool) -> str:
    """The command that evaluates what a search found; by another seed, whose luck had no part in it, if not `exact`."""
    luck = [] if exact else ["--rollouts", str(choices.rollouts), "--seed", str(choices.next_seed)]
    return shlex.join(["mrac-jax", "evaluate", *words, *how, *luck])


def search_end(answer: Any) -> Json:
    """What the JSON object of a search ends with: team, map, rollouts, and what every object ends with."""
    choices = answer.choices
    return {
        "robots": len(answer.starts),
        "starts": answer.starts,
        "accessible": answer.cells,
        "rollouts": choices.rollouts,
        "seed": choices.seed,
        "engine": answer.engine or None,
        "exact": not answer.engine,
        **json_end(answer, answer.notes),
    }


def team_figure(estimate: Estimate, robots: int, name: str = "robots lost") -> KeyFigure:
    """Of so many robots those that are lost, or what `name` says, as a key figure."""
    mean, interval = losses_shown(estimate, robots)
    return KeyFigure(mean, name, interval)
