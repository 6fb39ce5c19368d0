"""Damaged inputs, kills and full disks, random settings in every way: a few of what the scripts try at length."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from determinism import check

# Some damaged and hostile inputs against the promises of every command; `make fuzz` tries more.


@pytest.mark.parametrize("numbers", [range(54), pytest.param(range(54, 2000), marks=pytest.mark.slow)], ids=str)
def test_no_input_breaks_a_promise(numbers: range) -> None:
    from fuzz import fuzz

    assert list(fuzz(numbers)) == []


# A few kills, full disks, second writers and flipped bits; `make faults` tries many more.
#
# In a process of its own: it forks, which a process in which JAX has threads may not.

FILE = Path(__file__).parent / "faults.py"


PROMISES = [
    "--flips 30 --only ^flips$",
    pytest.param("--kills 24 --flips 2000 --seed 1 --only ^(?!drive)", marks=pytest.mark.slow),
]


@pytest.mark.parametrize("words", PROMISES)
def test_no_promise_is_broken(words: str) -> None:
    command, environment = (
        [sys.executable, str(FILE), *words.split()],
        os.environ | {"PYTHONPATH": str(FILE.parent.parent)},
    )
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "0 broken promises" in done.stdout, done.stdout + done.stderr


# Random settings of everything are the same bit for bit, however they are run; `make determinism` tries 1,000.


@pytest.mark.parametrize("numbers", [range(4), pytest.param(range(4, 15), marks=pytest.mark.slow)], ids=str)
def test_random_settings(numbers: range) -> None:
    assert list(check(numbers, Counter())) == []


@pytest.mark.slow
def test_three_hundred_more_with_jax() -> None:
    assert list(check(range(1000, 1300), Counter(), jax=lambda number: number % 15 == 0)) == []
