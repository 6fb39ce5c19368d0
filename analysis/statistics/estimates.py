"""Estimates from tallies: means, standard errors, intervals and quantiles of integer histograms.

Every figure is computed from integer counts. It depends only on the set of rollouts, not on their order.
"""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from functools import cache
from math import ceil, floor, isfinite, log10

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import bdtr, bdtrik, betaincinv, ndtri, stdtrit

from planner.arguments import MOST_ROLLOUTS, Numbers
from planner.formatting import NOTHING, counted, inside, percent
from planner.json_objects import WithKeys
from planner.tally import Tally

# Simultaneous confidence intervals for means and probabilities, for any number of rollouts.

ALPHA = 0.05
"""Largest probability that any claim of one search is wrong."""
ROUNDING = 1e-9
"""Tolerance at thresholds: exact values are sums of many rounded terms."""


def is_at_least(interval: tuple[float, float], wanted: float, slack: float = ROUNDING) -> bool | None:
    """Whether a value in the interval is at least `wanted`, to `slack`; None: the interval contains `wanted`."""
    low, high = interval
    return True if low >= wanted - slack else False if high < wanted - slack else None


def error_share(teams: int, looks: int) -> float:
    """Error probability of one look at one team: ALPHA divided among all possible looks (Bonferroni).

    Every team may be looked at up to `looks` times. The union bound over all `teams * looks` intervals holds for any
    order and any stopping rule.
    """
    return ALPHA / (teams * looks)


def mean_interval(counts: NDArray[np.int64], alpha: float) -> tuple[float, float]:
    """An interval that misses the mean of `0, 1, ..., len(counts) - 1` drawn as `counts` with probability <= `alpha`.

    The empirical Bernstein bound of Maurer & Pontil (COLT 2009, Theorem 4), alpha/2 for each end:
    `mean +- (sqrt(2 V L / n) + 7 range L / (3 (n - 1)))`, `L = ln(4 / alpha)`, V the sample variance. It holds for
    every n and every distribution; a normal interval at so small an alpha depends on the shape of the distribution.
    """
    n, most = int(counts.sum()), len(counts) - 1
    if n < 2:
        return 0.0, float(most)
    values = np.arange(most + 1)
    mean = int(counts @ values) / n
    variance = float(counts @ (values - mean) ** 2) / (n - 1)
    weight = np.log(4.0 / alpha)
    half = float(np.sqrt(2.0 * variance * weight / n) + 7.0 * most * weight / (3.0 * (n - 1)))
    return max(mean - half, 0.0), min(mean + half, float(most))


def chance_interval(successes: int, n: int, alpha: float) -> tuple[float, float]:
    """The exact binomial interval of Clopper & Pearson: it misses the probability with chance <= `alpha`, for every n.

    Wilson's interval, which tables show for probabilities away from 0 and 1, is narrower at 95 %, but its coverage is
    too low at small alpha.
    """
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, alpha / 2))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - alpha / 2))
    return low, high


BETS = np.array([0.99, 0.9, 0.75, *(0.5 ** np.arange(1.0, 12.0))])
"""Fractions of the capital that `bet_interval` bets on each value, float64 `[14]`."""


def bet_interval(values: NDArray[np.float64], alpha: float) -> tuple[float, float]:
    """An interval for the mean of `values` `[n]` in -1 .. 1 with error probability <= `alpha` at any stopping time.

    A bettor starts with capital 1 and bets the fraction b on each value, so that the capital is
    `prod (1 - b + b (1 + x) / (1 + m))`. If the mean is at most m, this is a supermartingale, which reaches 2 / alpha
    with probability <= alpha / 2 (Ville's inequality), for any distribution. The average over BETS has the same
    property. The interval contains the values m that neither side rejects (Waudby-Smith & Ramdas, "Estimating means of
    bounded random variables by betting", JRSS B 2024). For fewer than a thousand values of small variance, an empirical
    Bernstein bound is many times wider.
    """
    enough = np.log(2.0 / alpha) + np.log(len(BETS))
    different, times = np.unique(values, return_counts=True)  # few different values

    def least(values: NDArray[np.float64]) -> float:
        def rich(mean: float) -> float:
            fortune = np.log1p(BETS[:, None] * ((1.0 + values) / (1.0 + mean) - 1.0)) @ times
            return float(np.logaddexp.reduce(fortune) - enough)

        mean, lowest = float(values @ times / times.sum()), -1.0 + 1e-9
        return -1.0 if mean <= lowest or rich(lowest) <= 0 else float(brentq(rich, lowest, mean))

    return least(different), -least(-different)


# Formatting of figures by their intervals: number of digits, rounding of intervals, values near none and all.

MOST_DIGITS = 4
"""Decimals that distinguish a sampled figure from none and all."""


def digits_of(half: float) -> int:
    """The fewest decimals with which a rounded figure stays within `half` of itself."""
    return max(0, ceil(-log10(2.0 * half) - 1e-9))


def between(low: float, high: float, digits: int = 2, most: float | None = None, less: str = "less") -> str:
    """An interval as "85.60 .. 85.76", rounded outwards; "" if it is unknown.

    For a figure in 0 .. `most`: "0.40 or less" (or "fewer") if it begins at 0, "99.60 or more" if it ends at `most`.
    """
    if not (isfinite(low) and isfinite(high)):
        return ""
    ends = (floor(low * 10**digits + 1e-6), ceil(high * 10**digits - 1e-6))
    down, up = (f"{end / 10**digits:,.{digits}f}" for end in ends)
    lowest, highest = low == 0, most is not None and abs(high - most) <= NOTHING * most
    if most is not None and (lowest or highest):
        return f"0 .. {most:g}" if lowest and highest else f"{up} or {less}" if lowest else f"{down} or more"
    return f"{down} .. {up}"


def in_unit(interval: str, unit: str = " %") -> str:
    """An interval from `between` with its unit: "99.5 % or more", "56.4 .. 56.6 %"; "" and "exact" are unchanged."""
    if interval in ("", "exact"):
        return interval
    ends, comma, how = interval.partition(", ")
    ends, word, rest = ends.partition(" or ")
    return f"{ends}{unit}{word}{rest}{comma}{how}"


def robots_text(mean: float, robots: int, digits: int = 2) -> str:
    """A mean number of robots: "1.87 of 5 robots", "more than 4.99 of 5 robots" (`of_all`)."""
    count = of_all(mean, robots, digits).replace("> ", "more than ").replace("< ", "fewer than ")
    return f"{count} of {counted(robots, 'robot')}"


def of_all(mean: float, robots: int, digits: int = 2) -> str:
    """A mean number of `robots` in digits: "1.87", "> 4.99"; one decimal at least, two if one would mislead."""
    return inside(mean, robots, max(digits, 1), 2)


Z95 = float(ndtri(0.975))
QUANTILES = (0.05, 0.5, 0.95)
MISSED = 6
"""Unseen rare events that an interval allows for."""
MOST_MISSED = 15
"""The squared standard error grows at most by this factor over the number of rollouts on the thinner side."""
NONE_SEEN = -math.log(0.025)
"""Expected number of events of which none is seen with probability 1/40: the rule of three, at 97.5 %."""
FIRST_LOOK = 1024
"""Rollouts before the first test of the precision."""
ENOUGH = 30
"""Rollouts on the thinner side of the mean at which the allowance for unseen values fades."""
RARE = 100
"""Rollouts of the rarer kind up to which a probability has Clopper & Pearson's interval."""
ROUNDED = 1e-9
"""Tolerance for printed ends of an interval beyond the possible range."""
FEW = 5
"""Number of different values up to which the allowance does not fade."""


@dataclass(frozen=True)
class Estimate(WithKeys):
    """A mean with its standard error and 95 % interval, all in the unit of the mean."""

    mean: float
    se: float
    ci95: tuple[float, float]
    json_keys = "mean se ci95=known_interval"

    @property
    def half_width(self) -> float:
        """Half the width of the interval before it was clipped to the possible range."""
        return max(self.ci95[1] - self.mean, self.mean - self.ci95[0])

    def describe(
        self, scale: float = 1.0, unit: str = "", most: int | None = None, least: int = 0, less: str = "less"
    ) -> str:
        """The mean, times `scale`, with the half-width of its interval: "67.35 % ± 0.14 (95 %)".

        The interval itself is given if the half-width would leave 0 .. `most`, or go below 0 for non-negative values:
        "99.8 % (99.5 or more, 95 %)"; "exact" for a point. `unit`: " %" implies `most` = 100. `least`: fewest decimals.
        `less`: "fewer" for counts.
        """
        most, digits = 100 if unit == " %" else most, max(self.digits(scale), least)
        mean, interval = self._figures(scale, most, digits, less=less)
        if interval in ("", "exact"):
            return f"{mean}{unit}" + f" ({interval})" * bool(interval)
        half = self._half(scale, most, digits, mean)
        return f"{mean}{unit} ± {half} (95 %)" if half else f"{mean}{unit} ({interval}, 95 %)"

    def more(self, scale: float = 1.0, unit: str = "", words: tuple[str, str] = ("more", "fewer")) -> str:
        """A difference as text: "4.1 cells ± 0.2 (95 %) more"; below 0 "0.3 cells ± 0.2 (95 %) fewer"."""
        return f"{(self if self.mean >= 0 else self.negated).describe(scale, unit)} {words[self.mean < 0]}"

    def around(
        self, scale: float = 1.0, sign: str = "", most: int | None = None, digits: int = 1, unit: str = ""
    ) -> str:
        """ "67.4 ± 0.1", for a table; the mean alone if its interval is unknown. `sign`: "+" prints the sign.

        As in `said`: "0.0 (30.0 or less)" if the half-width would leave 0 .. `most`, "67.35 (exact)". `unit`:
        "67.4 ± 0.1 %", "67.35 % (exact)".
        """
        mean, interval = self._figures(scale, most, digits, sign)
        if interval in ("", "exact"):
            return f"{mean}{unit}" + f" ({interval})" * bool(interval)
        half = self._half(scale, most, digits, mean)
        return f"{mean} ± {half}{unit}" if half else f"{mean}{unit} ({interval})"

    def digits(self, scale: float = 1.0) -> int:
        """The decimals that the interval allows for the mean times `scale`; two for an exact or unknown interval."""
        half = scale * self.half_width
        return digits_of(half) if half > 0 and math.isfinite(half) else 2

    def columns(self, scale: float = 1.0, most: int | None = None) -> tuple[str, str]:
        """Mean and interval, times `scale`, with the decimals that the interval allows: ("56.5", "56.4 .. 56.6").

        `most`: the figure lies in 0 .. `most`; values near an end are not rounded to it (`between`, `inside`).
        """
        return self._figures(scale, most, self.digits(scale))

    def _figures(
        self, scale: float, most: int | None, digits: int, sign: str = "", less: str = "less"
    ) -> tuple[str, str]:
        mean, (low, high) = scale * self.mean, (scale * end for end in self.ci95)
        if most is not None and 0 <= mean <= most:  # some intervals are not clipped to the possible range
            low, high = max(low, 0.0), min(high, float(most))
        if most is None:
            shown = f"{mean:{sign}z,.{digits}f}"
            if low == high and mean and float(shown.replace(",", "")) == 0:
                shown = f"{mean:{sign}.2g}"  # an exact value other than 0 is not printed as 0
        else:
            shown = inside(mean, most, digits, digits if low == high else MOST_DIGITS)
        if not math.isfinite(self.half_width):  # a single map gives no interval
            return shown, ""
        return shown, "exact" if low == high else between(low, high, digits, most, less)

    def _half(self, scale: float, most: int | None, digits: int, mean: str) -> str:
        """The half-width, rounded up; "" if an end of the interval would be impossible."""
        half = math.ceil(scale * self.half_width * 10**digits - 1e-9) / 10**digits
        if mean[0] in "<>":
            return ""
        about = float(mean.replace(",", ""))
        below = (most is not None or self.ci95[0] >= 0) and about - half < -ROUNDED
        return "" if below or (most is not None and about + half > most + ROUNDED) else f"{half:,.{digits}f}"

    @property
    def negated(self) -> Estimate:
        """The estimate with the opposite sign."""
        low, high = self.ci95
        return Estimate(-self.mean, self.se, (-high, -low))

    def times(self, unit: float) -> Estimate:
        """The estimate multiplied by `unit`."""
        return Estimate(self.mean * unit, self.se * unit, (self.ci95[0] * unit, self.ci95[1] * unit))

    @property
    def known_interval(self) -> tuple[float, float] | None:
        """The 95 % interval; None where a single value does not determine it."""
        return self.ci95 if all(map(math.isfinite, self.ci95)) else None


@cache
def _student(freedom: int) -> float:
    """Student's 97.5 % quantile."""
    return float(stdtrit(freedom, 0.975))


@dataclass(frozen=True)
class Sample:
    """Statistics of `n` >= 2 values that determine an interval, in one unit.

    Attributes:
        n: number of values. scatter, lean: sums of squared and of cubed deviations from the mean.
        thin: number of values on the thinner side of the mean. step: greatest common divisor of all differences.
        few: at most FEW different values were seen. fitted: number of parameters estimated from the values.
    """

    n: int
    scatter: float
    lean: float
    thin: float
    step: float
    few: bool
    fitted: int = 1

    @property
    def se(self) -> float:
        """Standard error of the mean."""
        return math.sqrt(self.scatter / (self.n - self.fitted) / self.n)

    @property
    def half(self) -> float:
        """Half the width of the 95 % interval from the values seen; see `mean_estimate`."""
        if self.scatter <= 0:
            return 0.0
        missed = MISSED * (self.lean / self.scatter / self.n) ** 2
        if not self.few and self.fitted == 1:  # a control variate removes the bulk, not the rare events
            missed = min(missed, MOST_MISSED / max(self.thin, 1.0) * self.se**2)
        return _student(self.n - self.fitted) * math.sqrt(self.se**2 + missed) + self.step / 2 / self.n

    @property
    def unseen(self) -> float:
        """Probability of unseen values that the interval allows for."""
        fades = 1.0 if self.few else math.exp(-((self.thin / ENOUGH) ** 4))
        return min(NONE_SEEN / self.n * fades, 1.0)

    def interval(self, mean: float, low: float, high: float) -> tuple[float, float]:
        """The interval of the mean of values that lie in `low .. high`."""
        down, up = (max(self.half, self.unseen * end) for end in (mean - low, high - mean))
        return max(mean - down, low), min(mean + up, high)


def mean_estimate(counts: NDArray[np.int64], unit: float, most: int | None = None, certain: bool = False) -> Estimate:
    """Mean of the values `0, 1, 2, ...` (times `unit`) of a histogram `counts`, with its interval.

    The interval is `mean -+ max(t sqrt(se^2 + s^2) + step / 2n, u d)` on each side, d the distance from the mean to the
    end of the values that are possible:

    - t is Student's quantile. step is the greatest common divisor of the differences seen: a mean can only be a
      multiple of `step / n`, which matters for few values.
    - `s^2 = 6 (jump / n)^2`, at most `15 / m se^2`. The jump is the third central moment over the second: almost 0 for
      a normal distribution, and the size of the event if rare events dominate the variance. The sample may contain too
      few of these; six more are allowed for. m is the number of rollouts on the thinner side of the mean.
    - `u = 3.69 / n exp(-(m / 30)^4)` is the probability of an event that may be missing in n rollouts (the rule of
      three, `-ln(0.025) / n`). It fades as m grows, because 45 values on either side of the mean show the whole range.

    If at most FEW different values were seen, u does not fade and s^2 has no limit; with the control variate s^2 has no
    limit either. So the interval does not collapse to a point while all rollouts are equal, and it is at most 1.1 times
    1.96 se wide with 100 rollouts or more on each side of the mean and more than FEW different values. Its coverage:
    `tests/test_statistics.py`.

    Args:
        counts: int64 `[V]`, histogram. unit: factor of the result. certain: all runs are equal
            (`planner.plan.plan.is_certain`), so that the interval is a point.
        most: values lie in `0 .. most`, to which the interval is clipped; None: `len(counts) - 1`, which is too small
            for times, whose counts end at the largest seen (`analysis.theory.verdicts`).

    Raises:
        ValueError: the histogram is empty.
    """
    values = np.flatnonzero(counts)
    return mean_of(values, counts[values], unit, len(counts) - 1 if most is None else most, certain)


def mean_of(
    values: NDArray[np.int64], often: NDArray[np.int64], unit: float, most: int, certain: bool = False
) -> Estimate:
    """As `mean_estimate`, from sorted integers `values` `[V]`, 0 or above, with frequencies `often` `[V]`.

    `most`: the largest possible value.
    """
    n = int(often.sum())
    if n == 0:
        raise ValueError("no rollouts to estimate from")
    # Python integers, because the sum may exceed int64.
    total = sum(map(operator.mul, often.tolist(), values.tolist()))
    mean = total / n
    if certain:
        return exactly(mean * unit)
    if n == 1:
        return Estimate(mean * unit, float("nan"), (0.0, most * unit))
    sample = sample_of(values, often)
    low, high = sample.interval(mean, 0.0, most)
    return Estimate(mean * unit, sample.se * unit, (low * unit, high * unit))


def sample_of(values: NDArray[np.int64], often: NDArray[np.int64]) -> Sample:
    """Statistics of at least two integers, as in `mean_of`."""
    n, total = int(often.sum()), sum(map(operator.mul, often.tolist(), values.tolist()))
    scatter, lean = (float(often @ (values - total / n) ** power) for power in (2, 3))
    above, below = ([side(value * n, total) for value in values.tolist()] for side in (operator.gt, operator.lt))
    thin = min(int(often[above].sum()), int(often[below].sum()))
    return Sample(n, scatter, lean, thin, float(np.gcd.reduce(values - values[0])), len(values) <= FEW)


def exactly(value: float) -> Estimate:
    """An exact value: its interval is a point."""
    return Estimate(value, 0.0, (value, value))


def quantiles(counts: NDArray[np.int64], unit: float, certain: bool = False) -> dict[float, float]:
    """QUANTILES of single rollouts; NaN if all rollouts may lie on one side; `certain` as in `mean_estimate`."""
    enough = {q: certain or max(q, 1.0 - q) ** int(counts.sum()) <= 0.05 for q in QUANTILES}
    return {q: quantile(counts, q) * unit if known else math.nan for q, known in enough.items()}


def assured(counts: NDArray[np.int64], share: float = 0.95) -> int | None:
    """A value that at least a `share` of all runs reach, with 95 % confidence; None: too few rollouts (below 59).

    The r-th smallest of n rollouts, r the largest with P(Binomial(n, 1 - share) >= r) >= 95 %. If more than 1 - share
    of the runs were below it, so few rollouts would be below it with probability 5 % at most, for any distribution.
    """
    n = int(counts.sum())
    # The inverse is continuous; the loop corrects it to the largest valid integer.
    place = math.ceil(bdtrik(0.05, n, 1.0 - share)) if (share**n <= 0.05) else 0
    while place > 0 and bdtr(place - 1, n, 1.0 - share) > 0.05:
        place -= 1
    return int(np.searchsorted(np.cumsum(counts), place, side="left")) if place else None


def quantile(counts: NDArray[np.int64], q: float) -> int:
    """The smallest value that at least a fraction `q` of the rollouts do not exceed."""
    total = np.cumsum(counts)
    return int(np.searchsorted(total, q * total[-1] - 1e-9 * total[-1], side="left"))


def proportion(successes: int, n: int, certain: bool = False) -> Estimate:
    """A probability with a 95 % interval whose coverage is 94 % or more for any probability.

    Wilson's interval; Clopper & Pearson's if at most RARE rollouts are of one kind, because the coverage of Wilson's
    may then fall to 84 %. `certain` as in `mean_estimate`.
    """
    if certain:
        return exactly(successes / n)
    p, z2 = successes / n, Z95**2
    se = math.sqrt(p * (1 - p) / n)
    if min(successes, n - successes) <= RARE:
        return Estimate(p, se, chance_interval(successes, n, 0.05))
    centre, half = (p + z2 / (2 * n)) / (1 + z2 / n), Z95 / (1 + z2 / n) * math.sqrt(p * (1 - p) / n + z2 / (4 * n * n))
    low, high = max(0.0, centre - half), min(1.0, centre + half)
    # Rounding must not exclude p.
    return Estimate(p, se, (min(low, p), max(high, p)))


def over_maps(values: NDArray[np.float64]) -> Estimate:
    """Mean of float64 `[M]` with Student's 95 % interval; the standard error is NaN for a single map.

    Rare maps widen it as rare events do in `mean_estimate`: for 25 maps from a distribution with a long tail, Student's
    interval alone contains the true mean in 90 of 100 samples.
    """
    maps, mean = len(values), float(values.mean())
    if maps < 2:
        return Estimate(mean, float("nan"), (-np.inf, np.inf))
    far = values - mean
    scatter = float(far @ far)
    se, rare = math.sqrt(scatter / (maps - 1) / maps), float(far @ far**2) / scatter / maps if scatter > 0 else 0.0
    half = _student(maps - 1) * math.sqrt(se**2 + MISSED * rare**2)
    return Estimate(mean, se, (mean - half, mean + half))


def looks(start: int = FIRST_LOOK) -> list[int]:
    """The numbers of rollouts after which `--precision` is tested: start * 2**j, up to the largest id."""
    return [start << j for j in range(32) if start << j <= MOST_ROLLOUTS]


# Coverage and losses as text: an amount, the fractions whose probabilities are reported, robots lost.

AT_LEAST = (0.5, 0.75, 0.9, 0.95, 0.99, 1.0)
"""Fractions x for which P(coverage >= x) is reported."""


@dataclass(frozen=True)
class Amount:
    """An exact amount of coverage: `mean`, a fraction of the accessible cells, and the same in `cells`."""

    mean: float
    cells: float

    @staticmethod
    def of(cells: float, accessible: int) -> Amount:
        """`cells` of the accessible cells."""
        return Amount(cells / accessible, cells)

    def __str__(self) -> str:
        return f"{percent(self.mean, 2)} ({self.cells:,.2f} cells)"


TARGETS = Numbers(0, 1, "a fraction of the accessible cells", above=True)
"""Valid targets of coverage."""


def losses_sentence(losses: Estimate, robots: int, *, mean_only: bool = False) -> str:
    """`losses_shown` in a sentence: "0.67 ± 0.01 (95 %) robots".

    `mean_only`: "0.67 robots", with the decimals that the interval allows, one at least.
    """
    if mean_only:
        return f"{of_all(losses.mean, robots, min(losses.digits(), 2))} robots"
    return f"{losses.describe(most=robots, least=1, less='fewer')} robots"


def losses_shown(losses: Estimate, robots: int) -> tuple[str, str]:
    """Robots lost of `robots`, and the interval: ("1.87 of 5", "1.85 .. 1.89"), ("> 4.99 of 5", "4.98 or more")."""
    (low, high), digits = losses.ci95, min(losses.digits(), 2)
    interval = "exact" if low == high else between(low, high, max(digits, 1), robots, "fewer")
    return f"{of_all(losses.mean, robots, digits)} of {robots}", interval


# Measures of a mission for decisions: the worst runs, surviving robots, time to a share of the cells.

SHARES = (0.5, 0.75, 0.9, 0.95, 0.99)
"""Shares of the accessible cells for which the mean time is reported."""
TAIL = 0.05
"""Share of the worst runs whose mean is the CVaR."""


def tail_mean(counts: NDArray[np.int64], tail: float = TAIL) -> float:
    """CVaR: the mean of the lowest share `tail` of the rollouts of a histogram of values `0, 1, 2, ...`.

    The value at the edge of the tail counts in part (Rockafellar & Uryasev 2002).
    """
    wanted = tail * float(counts.sum())
    taken = np.minimum(np.cumsum(counts), wanted)
    return float(np.diff(taken, prepend=0.0) @ np.arange(len(counts))) / wanted


def robots_left(tally: Tally, certain: bool = False) -> list[Estimate]:
    """P(at least m robots are left at the end) for m = 1, ..., K."""
    return [proportion(int(count), tally.rollouts, certain) for count in at_least(tally.alive)]


def at_least(counts: NDArray) -> NDArray:
    """Counts or probabilities of at least 1, ..., K, from those of 0, 1, ..., K."""
    return np.cumsum(counts[::-1])[::-1][1:]


def times_to(tally: Tally, shares: tuple[float, ...] = SHARES) -> dict[float, int | None]:
    """The first step by whose end a share of the accessible cells is visited on average; None: never."""
    curve = np.cumsum(tally.new_visited) / tally.rollouts
    found = {share: np.flatnonzero(curve >= share * tally.accessible - 1e-9) for share in shares}
    return {share: int(steps[0]) if len(steps) else None for share, steps in found.items()}
