"""Components of variance against plain twins: variances from their definitions, errors by leaving one out at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scipy import stats

from analysis.statistics.differences import known_between, of_means, of_values
from analysis.statistics.estimates import Estimate


def jackknife(figure: Callable[[np.ndarray], float], kept: int) -> tuple[float, float]:
    """(figure of all, its standard error): `figure` takes the indices that stay."""
    left = np.array([figure(np.delete(np.arange(kept), one)) for one in range(kept)])
    return figure(np.arange(kept)), float(np.sqrt((kept - 1) / kept * ((left - left.mean()) ** 2).sum()))


def is_deviation(found: Estimate, variance: float, error: float) -> bool:
    """A standard deviation with error and interval of its variance: below as it is, above on a scale of logarithms."""
    half = stats.norm.ppf(0.975) * error
    ratio = half / variance
    high = variance * np.exp(ratio) if ratio <= 1 else variance + half * np.expm1(1.0)
    ends = np.sqrt([max(variance - half, 0.0), high])
    return (found.mean, found.se, *found.ci95) == pytest.approx(
        (np.sqrt(variance), error / (2 * np.sqrt(variance)), *ends), rel=1e-9
    )


@pytest.mark.parametrize(
    ("apart", "sizes"), [(0.5, range(1, 10)), (3.0, range(1, 10)), (30.0, range(1, 10)), (3.0, [3, 1])]
)
def test_of_groups_of_unequal_size_each_value_is_left_out_once(apart: float, sizes: Sequence[int]) -> None:
    draw = np.random.default_rng(30)
    group = np.repeat(np.arange(len(sizes)), sizes)
    value = draw.normal(size=len(group)) + apart * draw.normal(size=len(sizes))[group]

    def within(kept: np.ndarray) -> float:
        sums = [((part := value[kept][group[kept] == one]) - part.mean()) ** 2 for one in np.unique(group[kept])]
        return sum(map(np.sum, sums)) / (len(kept) - len(sums))

    found = of_values(group, value, 100.0)
    assert is_deviation(found.within, *jackknife(within, len(group)))
    both = jackknife(lambda kept: float(np.var(value[kept], ddof=1)) - within(kept), len(group))
    assert is_deviation(found.between, *both)
    means = np.array([value[group == one].mean() for one in range(len(sizes))])
    drawn = means.mean() + (means - means.mean()) * min(found.between.mean / means.std(), 1)
    assert found.means == pytest.approx(np.sort(drawn))


def test_of_means_of_equally_many_each_group_is_left_out_once() -> None:
    draw = np.random.default_rng(31)
    values = draw.normal(size=(12, 40)) + draw.normal(size=12)[:, None]
    found = of_means(values.mean(axis=1), values.var(axis=1, ddof=1), 40, 100.0)
    assert is_deviation(found.within, *jackknife(lambda kept: float(values[kept].var(axis=1, ddof=1).mean()), 12))

    def between(kept: np.ndarray) -> float:
        return float(values[kept].mean(axis=1).var(ddof=1) - values[kept].var(axis=1, ddof=1).mean() / 40)

    assert is_deviation(found.between, *jackknife(between, 12))
    assert found.means.std() == pytest.approx(min(found.between.mean, values.mean(axis=1).std()))


@pytest.mark.parametrize("all_of_them", [True, False])
def test_of_means_that_are_exact_the_rest_of_the_scatter_is_luck(all_of_them: bool) -> None:
    means, counts = np.array([0.2, 0.4, 0.7, 0.5]), np.array([9, 20, 41, 17, 13])
    found = known_between(means, all_of_them, counts)
    values = np.repeat(np.arange(5) / 4, counts)
    if all_of_them:
        assert (found.between.mean, found.between.se) == (means.std(), 0)
    else:
        assert is_deviation(found.between, *jackknife(lambda kept: float(means[kept].var(ddof=1)), 4))
    off = (values - values.mean()) ** 2
    error = np.sqrt(((off - values.var(ddof=1)) ** 2).sum()) / len(values)
    assert is_deviation(found.within, values.var(ddof=1) - found.between.mean**2, error)
    assert found.means.tolist() == [0.2, 0.4, 0.5, 0.7]


def test_where_no_draw_made_a_difference_the_rule_of_three_holds() -> None:
    """Of `n` values alike: a chance of -ln(.025) / n or less (a quarter at most of what two values can scatter)."""
    for n in (8, 400):
        found = of_values(np.arange(n) % 2, np.ones(n), 10.0)
        chance = min(-np.log(0.025) / n, 0.25)
        assert found.within.mean == 0 == found.within.ci95[0]
        assert found.within.ci95[1] == pytest.approx(10 * np.sqrt(chance * np.expm1(1.0)))
