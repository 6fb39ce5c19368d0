"""The suite as one object: worlds by name, and `judge`, which plays them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

from analysis.kit.calls import OnInterrupt, ask
from analysis.kit.notes import Progress
from analysis.standings.entries import own_of
from analysis.standings.search import run_suite
from analysis.standings.standing import Standing
from analysis.standings.worlds import choose, suite_world
from planner.policies.rule import Rule
from planner.shown import counted
from planner.worlds.world import World


class Suite(Mapping[str, World]):
    """Named worlds, each made when it is asked for, with its starts."""

    def __init__(self, only: str | Sequence[str] | None = None) -> None:
        """`only`: as of `choose`. Raises UsageError."""
        self.names = choose(only)

    def __getitem__(self, name: str) -> World:
        if name not in self.names:
            raise KeyError(name)
        return suite_world(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"Suite of {counted(len(self), 'world')}: {', '.join(self)}"

    def judge(
        self,
        policy: Callable[..., Any] | Rule | str | Path | None = None,
        *,
        plans: Mapping[str, str | Path] | None = None,
        actions: Literal["moves", "areas"] = "moves",
        rollouts: int = 1000,
        seed: int = 0,
        processes: int | None = None,
        progress: Progress | bool | None = None,
        on_interrupt: OnInterrupt = "raise",
    ) -> Standing:
        """Everybody on every world on the same luck, in a table with intervals and ranks.

        Args:
            policy: one's own: a function as of `mrac.judge`, a planner's `Rule`, or a Python file that defines one as
                `policy`. actions: what a function chooses.
            plans: by name the folder of another planner's plans, files ID.json as of `read_plan`; each is followed in
                the open loop, and in the closed one.
            rollouts, seed: of everybody; every mission ends after 4 steps for each accessible cell.
            processes: worlds at a time; the figures are the same. None: one a core, where the policy can be imported.
            progress, on_interrupt: as of `mrac.evaluate`; worlds are counted.
        """
        own = None if policy is None else own_of(policy, actions)
        run = partial(run_suite, self.names, own, plans or {}, rollouts, seed, processes)
        return ask(lambda tell, doing: run(tell), progress, on_interrupt, "worlds")
