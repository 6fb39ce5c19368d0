"""Options of `record`, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from analysis.cli.options import ROLLOUTS, Engine, Hits, Luck, RunLoop, Seed, Text, Whole
from planner.errors import UsageError

if TYPE_CHECKING:
    from analysis.recording.rolling import Request

RECORDING = Group("Recording", sort_key=3)
EVALUATED = 4096
"""Rollouts that are evaluated unless it is said how many."""


@Parameter(name="*")
@dataclass
class Recording:
    """What is recorded.

    Attributes:
        ids: These rollouts in full, "0,5,7-9".
        pick: The worst, median, best, random or quantile:0.05 rollout by visited coverage, out of the evaluated
            ones; several with commas (default: median; not with --ids).
        rollouts: Evaluated for pick, tally and outcomes (default: 4096; with --ids and without --outcomes none).
        outcomes: Keep what every evaluated rollout came to.
        engine: Which engine; the file is the same (default: auto, numba).
        luck: By which robots are stopped: tolerance, or step as before 0.3 (default: tolerance).
    """

    ids: Annotated[Text, Parameter(group=RECORDING)] = None
    pick: Annotated[Text, Parameter(group=RECORDING)] = None
    rollouts: Annotated[Whole, Parameter(group=RECORDING)] = None
    outcomes: Annotated[bool, Parameter(group=RECORDING, negative="")] = False
    loop: RunLoop = None
    seed: Seed = None
    engine: Annotated[Engine, Parameter(group=ROLLOUTS)] = "auto"
    threat_checks: Hits = "every_visit"
    luck: Annotated[Luck, Parameter(group=ROLLOUTS)] = "tolerance"

    def request(self, foreign: bool, step_seconds: float | None = None) -> Request:
        """The same as a plain type, checked, but for the plan's origin.

        `foreign`: of paths alone. `step_seconds`: of a step in the file; None: 1.
        """
        from analysis.recording.contents import MOST_RECORDED
        from analysis.recording.pick import parse_ids, parse_picks
        from analysis.recording.rolling import Request

        if self.ids is not None and self.pick is not None:
            raise UsageError("both --ids and --pick are given", expected="one of them")
        few = self.ids is not None and not self.outcomes
        evaluated = (0 if few else EVALUATED) if self.rollouts is None else self.rollouts
        if self.rollouts is not None and not 1 <= self.rollouts <= 2**32:
            raise UsageError(f"--rollouts {self.rollouts}", expected=f"1 to {2**32}")
        request = Request(
            ids=() if self.ids is None else parse_ids(self.ids, MOST_RECORDED),
            picks=parse_picks("median" if self.pick is None else self.pick) if self.ids is None else (),
            evaluated=evaluated,
            outcomes=self.outcomes,
            loop=self.loop or ("open" if foreign else "closed"),
            seed=self.seed or 0,
            engine=self.engine,
            first_only=self.threat_checks == "first_visit",
            luck=self.luck,
            step_seconds=1.0 if step_seconds is None else step_seconds,
        )
        request.check()
        return request
