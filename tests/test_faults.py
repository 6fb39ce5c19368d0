"""A few kills, full disks, second writers and flipped bits; `make faults` tries many more.

In a process of its own: it forks, which a process in which JAX has threads may not.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).parent / "faults.py"


@pytest.mark.parametrize(
    "words",
    [
        ("--flips", "250", "--only", "^flips$"),
        ("--kills", "1", "--only", "^sweep$"),
        pytest.param(
            ("--kills", "24", "--flips", "2000", "--seed", "1", "--only", "^(?!drive)"), marks=pytest.mark.slow
        ),
    ],
)
def test_no_promise_is_broken(words: tuple[str, ...]) -> None:
    command, environment = [sys.executable, str(FILE), *words], os.environ | {"PYTHONPATH": str(FILE.parent.parent)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and "0 broken promises" in done.stdout, done.stdout + done.stderr
