"""Sets of rollouts parted several at a time: who is hit is whom a plain loop over the project's Threefry hits."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from planner.failure_model import threefry2x32
from planner.jit import program
from planner.simulator.failure_sampling import MANY, part_many

Part = Callable[..., int]


@program
def parted(ids, words, key0, key1, counter, limit, turned):  # type: ignore[no-untyped-def]
    return part_many(ids, words, key0, key1, counter, limit, turned)


def check(part: Part, sizes: range) -> int:
    """Compare sets of these sizes, of disordered ids, at every kind of limit; returns how many rollouts were hit."""
    random, hits = np.random.default_rng(5), 0
    for size in sizes:
        for limit in np.uint32([0, 1, 2**20, 2**31, 2**32 - 2**20, 2**32 - 1]):
            key0, key1, counter = random.integers(2**32, size=3, dtype=np.uint32)
            around = random.integers(2**32, size=size + 2, dtype=np.uint32)
            ids, words = around.copy(), np.zeros(size, dtype=np.uint32)
            mine: NDArray[np.uint32] = around[1:-1]
            turned = np.uint32(0 if size % 2 else 2**32 - 1)
            hit = threefry2x32((int(key0), int(key1)), mine, counter)[0] ^ turned >= limit
            kept = part(ids[1:-1], words, key0, key1, counter, limit, turned)
            assert kept == size - hit.sum()
            assert ids.tolist() == [around[0], *mine[~hit], *mine[hit], around[-1]], (size, limit)
            hits += int(hit.sum())
    return hits


def test_the_sets_are_those_of_a_plain_loop() -> None:
    assert check(parted, range(1, 3 * len(MANY))) > 10_000
    assert check(parted, range(5000, 5003)) > 10_000


@pytest.mark.parametrize(
    "environment", [{"NUMBA_CPU_NAME": "generic"}, {"NUMBA_DISABLE_JIT": "1"}], ids=["a plain processor", "uncompiled"]
)
def test_where_lanes_cannot_be_permuted(environment: dict[str, str]) -> None:
    code = "import test_planner_lanes as tests; print(tests.check(tests.parted, range(1, 70)))"
    done = subprocess.run(
        [sys.executable, "-W", "ignore:overflow", "-c", code],
        cwd=Path(__file__).parent,
        env={**os.environ, **environment, "MRAC_JAX_NO_CACHE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 5000
