"""The state of every search: its map, settings and rollouts, the trials of its candidates, and its interruption."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.estimators.trial import Trial
from analysis.sampling import RolloutChoices
from analysis.utils.notes import Doing, ProgressCallback, quiet
from planner.make_plan import allocated_plan
from planner.rollouts.engine import choose_engine
from planner.rollouts.tables import AllPairs
from planner.settings import Settings
from planner.world.world import World


class Search:
    """State that the searches share.

    Attributes:
        cells: number of cells that robots at the starts can reach. exact: whether all results so far are exact.
        partial: whether the search was interrupted. notes: for the user. kept: cache of the map's distance tables.
    """

    def __init__(
        self,
        world: World,
        starts: NDArray[np.int64],
        settings: Settings,
        choices: RolloutChoices,
        progress: ProgressCallback | None = None,
        doing: Doing | None = None,
    ) -> None:
        """`starts`: int64 `[K, 2]`, of the team; of searches for a team, cells in the same part of the map."""
        self.world, self.starts, self.settings = world, starts, settings
        self.choices = choices.timed(world.pace)
        self.progress, self.doing = progress or quiet, doing or quiet
        self.accessible = world.accessible(starts)
        self.cells = int(self.accessible.sum())
        self.kept, self.exact, self.partial, self.notes = AllPairs(), True, False, list[str]()

    def trial(self, **other: Any) -> Trial:
        """A trial of a new plan, before its nominal run; `other`: a `world`, `starts`, `settings` or `choices`."""
        made = {name: other.get(name, getattr(self, name)) for name in ("world", "starts", "settings", "choices")}
        plan = allocated_plan(made["world"], made["starts"], made["settings"])
        return Trial(made["world"], plan, made["choices"], self.kept)

    @contextmanager
    def stoppable(self, found: Callable[[], object]) -> Iterator[None]:
        """Work that an interrupt ends, after which the search is `partial`; it is raised while nothing is `found`."""
        try:
            yield
        except KeyboardInterrupt:
            if not found():
                raise
            self.partial = True

    def fields(self) -> dict[str, Any]:
        """The fields that all results have (`analysis.report.result.Searched`)."""
        engine = "" if self.exact else choose_engine(self.choices.engine).name
        return {
            "world": self.world, "settings": self.settings, "choices": self.choices, "cells": self.cells,
            "engine": engine, "partial": self.partial, "notes": tuple(self.notes),
        }  # fmt: skip
