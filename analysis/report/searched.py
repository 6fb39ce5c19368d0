"""What the answers of all searches hold: on which map, by whose settings, on whose luck, and how far."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.report.answer import Answer
from analysis.sampling import RolloutChoices
from planner.settings import Settings
from planner.worlds.world import World


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
