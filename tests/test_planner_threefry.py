"""The generator against the published known-answer vectors and the fixtures' values."""

from __future__ import annotations

import numpy as np
import pytest
from rolling import uniform

from planner.failure_model import key_of, threefry2x32

# Random123's known answers for threefry2x32, 20 rounds: (counter, key, result).
KNOWN = [
    ((0x00000000, 0x00000000), (0x00000000, 0x00000000), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
    ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), (0xC4923A9C, 0x483DF7A0)),
]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_known_answers(counter: tuple[int, int], key: tuple[int, int], expected: tuple[int, int]) -> None:
    words = threefry2x32(key, counter[0], counter[1])
    assert tuple(int(word) for word in words) == expected


def test_draws_are_the_fixtures() -> None:
    known = {
        (1, 0, 0, 0): 0.70394366979599,
        (1, 0, 1, 0): 0.4450523853302002,
        (1, 3, 17, 5): 0.9260450601577759,
        (1, 4095, 200, 7): 0.15700453519821167,
        (7 * 2**32 + 5, 2, 3, 4): 0.15028107166290283,
    }
    for (seed, rollout, step, robot), value in known.items():
        assert float(uniform(seed, rollout, step, robot)) == value


def test_draws_are_uniform_and_address_what_they_say() -> None:
    draws = uniform(3, np.arange(200_000), 5, 2)
    assert draws.dtype == np.float32
    assert 0 <= draws.min() <= draws.max() < 1
    counts = np.bincount((draws * 64).astype(int), minlength=64)
    assert ((counts - 3125) ** 2 / 3125).sum() < 63 + 5 * np.sqrt(2 * 63)
    assert uniform(3, 7, 5, 2) == draws[7]
    assert key_of(2**32 + 5) == (5, 1)
