"""Interrupts, and how the process of a command ends."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pool_tasks import ENDS_WITH_US
from test_pool import none_left, two_below

from analysis.sweeps.store import Store
from analysis.utils.progress import run_loop

# An interrupt that is raised where nobody can catch it ends the command all the same; no socket listens meanwhile.

SWALLOWED = """
def callback(phase, info):
    if left and phase == "start":
        left.pop()
        os.write(1, b"lost ")
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(1000):
            pass

class Noisy:
    def __del__(self):
        callback("start", {})

left = [None] * int(sys.argv[2])
def run():
    if sys.argv[1] == "collector":
        gc.callbacks.append(callback)
        gc.collect()
    else:
        Noisy()
    for _ in range(100):  # a wait and a loop, both to be ended
        time.sleep(0.05)
        gc.collect()
    return 0
"""


ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}


def command(body: str) -> str:
    """A script in which `run` of this body is the command."""
    imports = "import gc, os, signal, sys, time\nimport analysis.cli.app\nfrom mrac_jax.__main__ import main\n"
    return f"{imports}{body}\nanalysis.cli.app.run = run\nmain()\n"


def ended(*words: str, **environment: str) -> tuple[int, str, str]:
    """Status, output and errors of a Python process."""
    done = subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, env=ENVIRONMENT | environment, timeout=60
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(("where", "times"), [("collector", 3), ("__del__", 1)])
def test_a_swallowed_interrupt_is_sent_again(where: str, times: int) -> None:
    status, said, errors = ended("-c", command(SWALLOWED), where, str(times))
    assert (status, errors) == (130, "interrupted\n") and said.startswith("lost ")


IN_TEXT = """
import sys

class Finder:
    def find_spec(self, name, path, target=None):
        if name == "analysis.cli.app":
            exec("raise KeyboardInterrupt")

sys.meta_path.insert(0, Finder())
"""


def test_interrupted_in_code_that_is_text(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(IN_TEXT)
    status, _, errors = ended("-m", "mrac_jax", PYTHONPATH=f"{tmp_path}:{ENVIRONMENT['PYTHONPATH']}")
    assert (status, errors) == (130, "interrupted\n")


MADE_ANOTHER_ERROR = """
def run():
    try:
        if sys.argv[1] == "interrupted":
            os.kill(os.getpid(), signal.SIGINT)
        raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise TypeError("no fitting overload") from None
"""


@pytest.mark.parametrize(("how", "status", "said"), [("interrupted", 130, "interrupted\n"), ("not", 1, "overload\n")])
def test_an_interrupt_of_which_native_code_makes_another_error(how: str, status: int, said: str) -> None:
    got, _, errors = ended("-c", command(MADE_ANOTHER_ERROR), how)
    assert got == status and errors.endswith(said) and (status == 1) == ("Traceback" in errors)


SPLITTING = """
def run():
    import numpy as np  # of which some builds begin threads: so after `main` blocked SIGTERM
    from planner.mrac.areas import metis_parts

    print("splits", flush=True)
    while True:
        metis_parts((300, 300), np.arange(300 * 300), 7)
"""
SPEC = "base: {kind: contiguous, size: 8x11, ratio: 0.2}\nmaps: 100000\nrollouts: 30\n"
SWEEP = ENDS_WITH_US + "import sys; sys.argv[0] = 'mrac-jax'; from mrac_jax.__main__ import main; main()"
WORDS = [sys.executable, "-c", SWEEP, "sweep", "a.yaml", "--processes", "2"]


def listening(pids: list[int]) -> set[str]:
    """Sockets of these processes that wait for somebody to call (Linux: the kernel's own tables)."""
    mine = set()
    for pid in pids:
        for file in Path(f"/proc/{pid}/fd").iterdir():
            try:
                mine.add(str(file.readlink()))
            except OSError:
                continue
    waiting = set()
    for family, state, at in (("tcp", "0A", 3), ("tcp6", "0A", 3)):
        for line in Path(f"/proc/net/{family}").read_text().splitlines()[1:]:
            words = line.split()
            if words[at] == state:
                waiting.add(f"socket:[{words[9]}]")
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        words = line.split()
        if words[3] == "00010000":  # takes calls
            waiting.add(f"socket:[{words[6]}]")
    return mine & waiting


@pytest.mark.parametrize(("times", "span"), [(1, 1.0), pytest.param(100, 5.0, marks=pytest.mark.slow)])
def test_ctrl_c_ends_a_sweep_which_opens_no_socket(tmp_path: Path, times: int, span: float) -> None:
    """At moments up to `span` seconds after the processes of `sweep --processes 2` are begun, on one store."""
    (tmp_path / "a.yaml").write_text(SPEC)
    for number in range(times):
        running = subprocess.Popen(
            WORDS, cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
        )
        assert not listening([running.pid, *(children := two_below(running.pid))])
        time.sleep((number + 0.5) / times * span)
        clock = time.monotonic()
        os.killpg(running.pid, signal.SIGINT)
        said, notes = running.communicate(timeout=60)
        assert running.returncode == 130 and b"interrupted" in (notes + said).lower(), notes
        assert b"Traceback" not in notes and b"ignored" not in notes
        assert time.monotonic() - clock < 10  # measured: 0.4 s on a quiet machine, most of it to print what was done
        assert none_left(children, 5)
    with Store.open(tmp_path / "a.store") as store:
        assert all(store.tally(run.key) is not None for run in store.runs())


@pytest.mark.parametrize("after", [0.2, pytest.param(0.1, marks=pytest.mark.slow)])
def test_sigterm_is_an_interrupt_while_metis_splits(after: float) -> None:
    splitting = subprocess.Popen(
        [sys.executable, "-c", command(SPLITTING)],
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert splitting.stdout is not None and splitting.stdout.readline() == "splits\n"
        time.sleep(after)
        splitting.terminate()
        assert splitting.communicate(timeout=60)[1] == "interrupted\n" and splitting.returncode == 130
    finally:
        splitting.kill()


# How the process of a command ends: its status, what it prints, and which signals end it.

ENDS = """
def run():
    print("said", end="")
    if sys.argv[1] == "returned":
        return 3
    if sys.argv[1] == "exit":
        sys.exit(4)
    raise ValueError("nobody caught it")
"""
WAITS = """
def run():
    print("waits", flush=True)
    time.sleep(1)
    return 0

if sys.argv[1] == "background":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
else:
    signal.signal(signal.SIGINT, signal.default_int_handler)
"""


@pytest.mark.parametrize(
    ("how", "status", "said"), [("returned", 3, ""), ("exit", 4, ""), ("raised", 1, "caught it\n")]
)
def test_status_and_what_was_printed(how: str, status: int, said: str) -> None:
    got, out, errors = ended("-c", command(ENDS), how)
    assert (got, out) == (status, "said") and errors.endswith(said)
    assert ("Traceback" in errors) == (how == "raised")


def test_a_closed_output_is_told_in_one_line() -> None:
    words = f"exec {sys.executable} -m mrac_jax plan example:paper >&-"
    done = subprocess.run(["sh", "-c", words], stderr=subprocess.PIPE, text=True, env=ENVIRONMENT, timeout=60)
    assert done.returncode == 2 and done.stderr.startswith("error: standard output is closed")
    assert done.stderr.count("\n") == 1


SIGNALS = [
    ("foreground", signal.SIGINT, 130), ("background", signal.SIGINT, 0), ("background", signal.SIGTERM, 130),
]  # fmt: skip


@pytest.mark.parametrize(("where", "sent", "status"), SIGNALS)
def test_who_was_told_to_ignore_ctrl_c_does(where: str, sent: signal.Signals, status: int) -> None:
    words = [sys.executable, "-c", command(WAITS), where]
    waiting = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)
    try:
        assert waiting.stdout is not None and waiting.stdout.readline() == "waits\n"
        time.sleep(0.1)
        waiting.send_signal(sent)
        assert waiting.communicate(timeout=60)[1] == "interrupted\n" * (status == 130)
        assert waiting.returncode == status
    finally:
        waiting.kill()


# An event loop that an interrupt ends, wherever it comes.

EVERYWHERE = """
import asyncio, signal, sys
from analysis.utils.progress import run_loop

def handler(number, frame):  # as the command line has it: not Python's own
    raise KeyboardInterrupt

async def busy():
    while True:
        await asyncio.sleep(0)

async def main():
    other = asyncio.create_task(busy())
    await asyncio.Event().wait()

def interrupted_at(line):
    def traced(frame, event, arg):
        if event == "line":
            left.pop()
            if not left:
                signal.raise_signal(signal.SIGINT)
                sys.settrace(None)
                return None
        return traced
    left = [None] * line
    return lambda frame, event, arg: traced if frame.f_code.co_name == "_run_once" else None

signal.signal(signal.SIGINT, handler)
for line in range(1, 61):  # of the loop's first steps
    sys.settrace(interrupted_at(line))
    try:
        run_loop(main())
    except KeyboardInterrupt:
        print(line, signal.getsignal(signal.SIGINT) is handler)
"""


def test_an_interrupt_between_any_two_steps_of_a_loop_ends_it() -> None:
    assert ended("-c", EVERYWHERE) == (0, "".join(f"{line} True\n" for line in range(1, 61)), "")


def test_an_interrupt_that_comes_too_late_to_cancel_anything_is_not_lost() -> None:
    async def answer() -> int:
        signal.raise_signal(signal.SIGINT)
        return 42

    with pytest.raises(KeyboardInterrupt):
        run_loop(answer())


def test_it_ends_with_what_its_task_returns_or_raises() -> None:
    async def answer() -> int:
        await asyncio.sleep(0)
        return 42

    async def gives_up() -> None:
        raise asyncio.CancelledError

    before = signal.getsignal(signal.SIGINT)
    assert run_loop(answer()) == 42
    with pytest.raises(asyncio.CancelledError):
        run_loop(gives_up())
    assert signal.getsignal(signal.SIGINT) is before
