"""How the process of a command ends: its status, what it prints, and which signals end it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
ENDS = """
import sys
import analysis.cli.app
from mrac_jax.__main__ import main

def run():
    print("said", end="")
    if sys.argv[1] == "returned":
        return 3
    if sys.argv[1] == "exit":
        sys.exit(4)
    raise ValueError("nobody caught it")

analysis.cli.app.run = run
main()
"""
WAITS = """
import signal, sys, time
import analysis.cli.app
from mrac_jax.__main__ import main

def run():
    print("waits", flush=True)
    time.sleep(2)
    return 0

analysis.cli.app.run = run
if sys.argv[1] == "background":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
else:
    signal.signal(signal.SIGINT, signal.default_int_handler)
main()
"""


@pytest.mark.parametrize(
    ("how", "status", "said"), [("returned", 3, ""), ("exit", 4, ""), ("raised", 1, "caught it\n")]
)
def test_status_and_what_was_printed(how: str, status: int, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ENDS, how], capture_output=True, text=True, env=ENVIRONMENT, timeout=60
    )
    assert (done.returncode, done.stdout) == (status, "said") and done.stderr.endswith(said)
    assert ("Traceback" in done.stderr) == (how == "raised")


def test_a_closed_output_is_told_in_one_line() -> None:
    words = f"exec {sys.executable} -m mrac_jax plan example:paper >&-"
    done = subprocess.run(["sh", "-c", words], stderr=subprocess.PIPE, text=True, env=ENVIRONMENT, timeout=60)
    assert done.returncode == 2 and done.stderr.startswith("error: standard output is closed")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("where", "sent", "status"),
    [
        ("foreground", signal.SIGINT, 130), ("foreground", signal.SIGTERM, 130),
        ("background", signal.SIGINT, 0), ("background", signal.SIGTERM, 130),
    ],
)  # fmt: skip
def test_who_was_told_to_ignore_ctrl_c_does(where: str, sent: signal.Signals, status: int) -> None:
    words = [sys.executable, "-c", WAITS, where]
    waiting = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        assert waiting.stdout is not None and waiting.stdout.readline() == "waits\n"
        time.sleep(0.1)
        waiting.send_signal(sent)
        assert waiting.communicate(timeout=60)[1] == "interrupted\n" * (status == 130)
        assert waiting.returncode == status
    finally:
        waiting.kill()
