"""Random settings of everything are the same bit for bit, however they are run; `make determinism` tries 1,000."""

from collections import Counter

import pytest
from determinism import check


def test_thirty_random_settings() -> None:
    assert list(check(range(30), Counter())) == []


@pytest.mark.slow
def test_three_hundred_more_with_jax() -> None:
    assert list(check(range(1000, 1300), Counter(), jax=lambda number: number % 15 == 0)) == []
