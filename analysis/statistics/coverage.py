"""Coverage and losses as they are said: an amount, the fractions whose chances are given, robots lost."""

from __future__ import annotations

from dataclasses import dataclass

from analysis.statistics.estimate import Estimate
from analysis.statistics.words import between, of_all, robots_words
from planner.arguments import Numbers
from planner.shown import percent

AT_LEAST = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
"""Fractions x for which P(coverage >= x) is reported."""


@dataclass(frozen=True)
class Amount:
    """A known amount of coverage: `mean`, a fraction of the accessible cells, and the same in `cells`."""

    mean: float
    cells: float

    @staticmethod
    def of(cells: float, accessible: int) -> Amount:
        """So many of the accessible cells."""
        return Amount(cells / accessible, cells)

    def __str__(self) -> str:
        return f"{percent(self.mean, 2)} ({self.cells:,.2f} cells)"


TARGETS = Numbers(0, 1, "a fraction of the accessible cells", above=True)
"""What a user may want covered."""


def more_said(more: Estimate, costs: str, instead: str, other: str = "more") -> str:
    """ "not knowing it costs 4.1 points ± 0.2 (95 %)"; below 0: "robots that are not told it visit 0.5 points more"."""
    if more.mean >= 0:
        return f"{costs} {more.said(100, ' points')}"
    return f"{instead} {more.negated.said(100, f' points {other}')}"


def losses_said(losses: Estimate, robots: int, *, mean_only: bool = False) -> str:
    """The same in a sentence: "all 4 robots", "no robot", "0.67 ± 0.01 (95 %) robots".

    `mean_only`: "0.67 robots", with the decimals that the interval allows, one at least.
    """
    words = robots_words(losses.mean, robots, digits := min(losses.digits(), 2))
    if not words[0].isdigit():
        return words
    mean = of_all(losses.mean, robots, digits) if mean_only else losses.said(most=robots, least=1, less="fewer")
    return f"{mean} robots"


def losses_shown(losses: Estimate, robots: int) -> tuple[str, str]:
    """Robots lost of so many, and the interval: ("1.87 of 5", "1.85 .. 1.89"), ("> 4.99 of 5", "4.98 or more")."""
    (low, high), digits = losses.ci95, min(losses.digits(), 2)
    interval = "exact" if low == high else between(low, high, max(digits, 1), robots, "fewer")
    return f"{of_all(losses.mean, robots, digits)} of {robots}", interval
