"""Kills, signals, flipped bits, full disks, folders that may not be written and two writers (`make faults`).

python tests/faults.py [--kills N] [--flips N] [--only WORD] [--seed N]

Every long command is killed (SIGKILL, SIGTERM, SIGINT) at random moments, again and again in one folder, and then
goes on to its end. Commands are forked from this process, which has imported and compiled what they need; every tenth
begins anew. The promises: it ends within 20 CPU s and leaves no process; no traceback; whatever file there is, is
whole; in the end all is, byte for byte, as if nobody had killed it. A flipped bit: the same answer, or one line that
names the file.
"""

import argparse
import contextlib
import ctypes
import faulthandler
import hashlib
import http.client
import io
import json
import math
import os
import random
import re
import resource
import shutil
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from analysis.cli.app import run
from mrac_jax.__main__ import main as command_line
from planner.simulator.jit import CacheFolder

SECONDS, IDLE, LOOKS = 20.0, 120.0, 0.5
"""CPU seconds in which a command ends that was told to; seconds without any in which it hangs; between two looks.

CPU seconds, since others may use this machine: 50 of them to compile what an `evaluate` needs took it 300 seconds.
"""
ROOT = Path(__file__).parent.parent
KEPT = (".html", ".png", ".csv", ".mcap", ".npz")
"""Ends of the names of files that hold no times; a plan holds none either."""
HALF = re.compile(r"\.[0-9a-f]{16}\.partial|.*\.mcap\.partial|.*\.store-(wal|shm)")
"""Files that a killed process may leave behind."""
KILLED = {signal.SIGKILL: {-9, 0}, signal.SIGTERM: {130, 0, -15}, signal.SIGINT: {130, 0}}
"""How a command may end."""
ASKED = {signal.SIGTERM, signal.SIGINT}
"""What asks a command to end."""
SWEEP = """\
base: {kind: contiguous, size: 6x7, ratio: 0.2}
maps: 3
rollouts: 200
sweep: {robots: [1, 2], policy: [mrac, per_cell]}
"""
LONG = {
    "evaluate": "evaluate world.npz --rollouts 2000 --out new",
    "sweep": "sweep sweep.yaml --store a.store --processes 1 --out new",
    "reproduce": "check --paper fig4 --maps 2 --rollouts 20 --processes 1 --store r.store --out new",
    "record": "record world.npz --ids 1-20 --out a.mcap --force",
    "front": "front world.npz --losses 1 --rollouts 256 --plan-out plan.json --out new --force",
    "size": "size world.npz --target 0.8 --rollouts 512 --exact never --out new",
    "clear": "threats world.npz --remove 1 --rollouts 256 --exact never --out new",
    "attack": "threats world.npz --add 1 --rollouts 256 --exact never --out new",
    "starts": "starts world.npz --rollouts 256 --exact never --out new",
    "compare": "compare world.npz world.npz --b.policy per_cell --rollouts 512 --exact never --out new",
}
POOLED = {
    "sweep of two": "sweep sweep.yaml --store a.store --processes 2 --out new",
    "reproduce by two": "check --paper fig4 --maps 2 --rollouts 20 --processes 2 --store r.store --out new",
    "check by two": "check --worlds 6 --size 5x6 --rollouts 64 --processes 2 --out new",
}


class Ended(NamedTuple):
    """How a command ended: its status as a shell says it, or minus a signal."""

    status: int
    said: str


class Running:
    """A command in a process of its own, of a session of its own."""

    def __init__(self, words: str, folder: Path, *, anew: bool = False, before: Callable[[], object] = int) -> None:
        self.words, self.folder, self.log = words, folder, folder.parent / f"said{id(self)}"
        out = os.open(self.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        if anew:
            line = [sys.executable, "-m", "mrac_jax", *words.split()]
            env = os.environ | {"PYTHONPATH": str(ROOT), "PYTHONFAULTHANDLER": "1"}
            self.pid = subprocess.Popen(line, cwd=folder, stdin=-3, stdout=out, stderr=out, env=env,
                                        start_new_session=True).pid  # fmt: skip
        else:
            signal.pthread_sigmask(signal.SIG_BLOCK, ASKED)  # until it is the command, not a copy of this program
            if not (pid := os.fork()):
                self._begin(out, before)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ASKED)
            self.pid = pid
        os.close(out)

    def _begin(self, out: int, before: Callable[[], object]) -> None:
        status = 130
        try:
            os.setsid()
            os.chdir(self.folder)
            for number, to in enumerate((os.open(os.devnull, os.O_RDONLY), out, out)):
                os.dup2(to, number)
            signal.signal(signal.SIGINT, signal.default_int_handler)
            faulthandler.enable()
            faulthandler.register(signal.SIGUSR1)
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ASKED)
            sys.argv = ["mrac-jax", *self.words.split()]
            before()
            sys.stdin, sys.stdout, sys.stderr = os.fdopen(0), os.fdopen(1, "w"), os.fdopen(2, "w", 1)
            command_line()
        except SystemExit as ended:
            status = int(ended.code or 0)
            sys.stdout.flush()
        except Exception:
            traceback.print_exc()
        finally:  # whatever happens, what called this goes on in the parent alone
            os._exit(status)

    def kill(self, number: int, *, group: bool = False) -> None:
        with contextlib.suppress(ProcessLookupError):
            (os.killpg if group else os.kill)(self.pid, number)

    def others(self) -> list[int]:
        """Other processes of its session."""
        found = []
        for path in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                fields = path.read_text().rpartition(")")[2].split()
                if fields[3] == str(self.pid) and fields[0] != "Z" and path.parent.name != str(self.pid):
                    found.append(int(path.parent.name))
        return found

    def used(self) -> float:
        """CPU seconds that it and the processes for which it waited have had."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")

    def wait(self, seconds: float = 6 * SECONDS) -> Ended:
        """How it ended; it is killed where it does not: after so many CPU seconds, or IDLE ones without any."""
        had, since, looked = 0.0, time.monotonic(), time.monotonic()
        while not (found := os.waitpid(self.pid, os.WNOHANG))[0]:
            time.sleep(0.002)
            if time.monotonic() - looked < LOOKS:
                continue
            looked, before, had = time.monotonic(), had, self.used()
            since = looked if had > before else since
            if had > seconds or looked - since > IDLE:
                self.kill(signal.SIGUSR1)  # says where it is
                time.sleep(1)
                self.kill(signal.SIGKILL)
                os.waitpid(self.pid, 0)
                said = self.log.read_text(errors="replace")
                return Ended(-99, f"still there after {had} CPU s, idle for {looked - since:.0f} s: {said}")
        patience = time.monotonic() + IDLE
        while self.others() and time.monotonic() < patience:
            time.sleep(0.01)
        if left := self.others():
            return Ended(-99, f"left {left}")
        return Ended(os.waitstatus_to_exitcode(found[1]), self.log.read_text(errors="replace"))


def digest(folder: Path) -> dict[str, str]:
    """Hashes of the files that must be the same whenever the same is asked; of stores, of what they hold."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.suffix == ".store":
            connection = sqlite3.connect(path)
            tables = [f"SELECT * FROM {table} ORDER BY 1, 2" for table in ("runs", "blocks")]
            held = repr([connection.execute(table).fetchall() for table in tables]).encode()
            connection.close()
        elif (path.suffix in KEPT and ".interrupted." not in path.name) or path.name == "plan.json":
            held = path.read_bytes()
        else:
            continue
        found[str(path.relative_to(folder))] = hashlib.sha256(held).hexdigest()
    return found


def prepare(folder: Path) -> Path:
    """An empty folder with the inputs."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    shutil.copy(folder.parent / "world.npz", folder)
    (folder / "sweep.yaml").write_text(SWEEP)
    return folder


class Whole:
    """A command that nobody disturbed: its digest, and how long it took, forked and anew."""

    def __init__(self, name: str, words: str, home: Path, *, anew: bool = True) -> None:
        self.name, self.words, self.folder, self.took = name, words, home / "now", [0.0, 0.0]
        with contextlib.chdir(prepare(self.folder)):  # imports and compiles what it needs
            answer(words.replace("--processes 2", "--processes 1"))
        for way in (False, True)[: 1 + anew]:
            self.ended(anew=way, fresh=True)
            self.digest = digest(self.folder)

    def ended(self, *, anew: bool = False, fresh: bool = False) -> Ended:
        """Run it to its end."""
        clock = time.monotonic()
        done = Running(self.words, prepare(self.folder) if fresh else self.folder, anew=anew).wait()
        self.took[anew] = time.monotonic() - clock
        if fresh and done.status:
            raise SystemExit(f"{self.words}: {done}")
        return done

    def broken(self, what: str, fault: object) -> str:
        return f"{self.name}, {what}: {fault}"

    def cleared(self) -> Path:
        """The folder, as the errors of `record` ask for it: half a recording is recovered, or removed."""
        for path in self.folder.glob("*.mcap.partial"):
            path.unlink()
        return self.folder

    def resumed(self, what: str) -> Iterator[str]:
        """It goes on to its end: is all as if nothing had been?"""
        self.cleared()
        done, found = self.ended(), digest(self.folder)
        if done.status:
            yield self.broken(what, f"afterwards {done}")
        elif found != self.digest:
            yield self.broken(what, f"afterwards other files: {sorted(dict(found.items() ^ self.digest.items()))}")


def killed(whole: Whole, count: int, draw: random.Random) -> Iterator[str]:
    """So many kills, up to eight in a row on what the one before left."""
    for number in range(count):
        if number % 8 == 0:
            prepare(whole.folder)
            sent = draw.choice(list(KILLED))
        anew, group = number % 10 == 9, draw.random() < 0.5
        moment = draw.uniform(0.3 if anew else 0, 1.05 * whole.took[anew])
        what = f"signal {sent} after {moment:.3f} s"
        running = Running(whole.words, whole.cleared(), anew=anew)
        time.sleep(moment)
        running.kill(sent, group=group)
        done = running.wait(SECONDS)
        if done.status not in KILLED[sent] or "Traceback" in done.said or "ignored" in done.said:
            yield whole.broken(what, done)
        yield from (whole.broken(what, fault) for fault in half_written(whole, sent))
        if number % 8 == 7 or number == count - 1:
            yield from whole.resumed(what)


def half_written(whole: Whole, sent: int) -> Iterator[str]:
    """Files that are neither what they will be nor of a name that says so; an interrupted answer has other content."""
    for path in whole.folder.rglob("*"):
        name = str(path.relative_to(whole.folder))
        if HALF.fullmatch(path.name):
            if sent != signal.SIGKILL and not path.name.endswith(("-wal", "-shm")):
                yield f"left {name}"
        elif path.suffix == ".json":
            json.loads(path.read_text())
        elif path.suffix == ".html" and not path.read_text().rstrip().endswith("</html>"):
            yield f"half of {name}"
    if sent == signal.SIGKILL:
        with contextlib.suppress(sqlite3.DatabaseError):
            found = {name: now for name, now in digest(whole.folder).items() if not name.endswith(".store")}
            if found.items() - whole.digest.items():
                yield f"other files: {sorted(found.items() - whole.digest.items())}"


def workers(whole: Whole, count: int, draw: random.Random) -> Iterator[str]:
    """Kills of worker processes, two a run: nothing is lost, and nobody notices."""
    kills = 0
    while kills < count:
        running = Running(whole.words, prepare(whole.folder))
        for _ in range(2):
            time.sleep(draw.uniform(0, whole.took[0] / 2))
            if found := running.others():
                kills += 1
                with contextlib.suppress(ProcessLookupError):
                    os.kill(draw.choice(found), signal.SIGKILL)
        done = running.wait()
        if done.status or "Traceback" in done.said or digest(whole.folder) != whole.digest:
            yield whole.broken("worker killed", done)


def limited(whole: Whole, count: int, draw: random.Random) -> Iterator[str]:
    """Files that may not grow further, as on a full disk: one line, nothing half-written, and it goes on with room."""
    most = max(path.stat().st_size for path in whole.folder.rglob("*"))
    for _ in range(count):
        room = 10_000 + int(most * draw.random() ** 2)  # what is said goes to a file too
        limit = lambda room=room: resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))  # noqa: E731
        done = Running(whole.words, prepare(whole.folder), before=limit).wait()
        yield from refused(whole, f"files of {room} bytes", done)


def read_only(whole: Whole, count: int, draw: random.Random) -> Iterator[str]:
    """A folder that may not be written, by root without its rights over files."""
    for _ in range(count):
        prepare(whole.folder).chmod(0o555)
        done = Running(whole.words, whole.folder, before=without_rights).wait()
        whole.folder.chmod(0o755)
        yield from refused(whole, "read-only folder", done)
        if done.status == 0:
            yield whole.broken("read-only folder", "status 0")


def without_rights() -> None:
    """Give up CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH (Linux): who owns a file may then do what its mode says."""
    header, held = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None)
    libc.capget(header, held)
    for place in range(3):  # effective, permitted, inheritable
        held[place] &= ~0b110
    libc.capset(header, held)


def refused(whole: Whole, what: str, done: Ended) -> Iterator[str]:
    lines = [line for line in done.said.splitlines() if line.startswith("error:")]
    if done.status not in (0, 2) or len(lines) != (done.status == 2) or "Traceback" in done.said:
        yield whole.broken(what, done)
    yield from (whole.broken(what, fault) for fault in half_written(whole, signal.SIGKILL))
    yield from whole.resumed(what)


def two(whole: Whole, count: int, draw: random.Random) -> Iterator[str]:
    """Two writers of the same files at once, one of them killed in half of the trials."""
    for number in range(count):
        both = [Running(whole.words, prepare(whole.folder)), Running(whole.words, whole.folder)]
        if number % 2:
            time.sleep(draw.uniform(0, whole.took[0]))
            both[0].kill(signal.SIGKILL)
        ends = [running.wait() for running in both]
        if any(end.status and "error: a.mcap.partial is" not in end.said for end in ends[number % 2 :]):
            yield whole.broken("two writers", ends)
        yield from whole.resumed("two writers")


KINDS = {"killed": killed, "full": limited, "read-only": read_only, "two": two}
SHARE = {"killed": 1.0, "full": 0.1, "read-only": 0.01, "two": 0.04}
"""Of each kind, to one kill."""


def driven(folder: Path, dies: float = 0.0, *, steps: bool = True) -> tuple[dict[str, str], Ended]:
    """What `drive` says to a team whose luck is that of its step and robot: orders by both, and its end.

    `dies`: seconds after which it is ended where it stands (SIGALRM, which nobody catches).
    `steps`: reports say theirs; without, no line that is said may be out of date.
    """
    (ask, reports), (lines, tell) = os.pipe(), os.pipe()

    def before() -> None:
        os.dup2(ask, 0)
        os.dup2(tell, 1)
        for one in (ask, reports, lines, tell):
            os.close(one)
        signal.setitimer(signal.ITIMER_REAL, dies)

    running, seen = Running("drive world.npz --state now.json", folder, before=before), dict[str, str]()
    os.close(ask)
    os.close(tell)
    with contextlib.suppress(BrokenPipeError), os.fdopen(lines) as said, os.fdopen(reports, "w") as answers:
        for line in said:
            if not line.endswith("\n"):
                break
            told = json.loads(line)
            if told["type"] == "end":
                seen["end"] = line
                break
            for order in told["orders"]:
                seen[f"{told['step']}: {order['robot']}"] = str(order["cell"])
                stopped = random.Random(f"{told['step']} {order['robot']}").random() < 0.01
                report = {"type": "report", "robot": order["robot"], "cell": order["cell"], "stopped": stopped}
                report |= {"step": told["step"]} if steps else {}
                answers.write(json.dumps(report) + "\n")
                answers.flush()
    return seen, running.wait()


def drives(home: Path, count: int, draw: random.Random) -> Iterator[str]:
    """A mission that is killed again and again, and goes on: the orders and the end of the one that nobody killed."""
    driven(prepare(home / "now"))
    clock = time.monotonic()
    right, _ = driven(prepare(home / "now"))
    took, kills = time.monotonic() - clock, 0
    while kills < count:
        folder, seen, steps = prepare(home / "now"), dict[str, str](), draw.random() < 0.5
        while "end" not in seen:
            more, done = driven(folder, draw.uniform(0, took) if kills < count else 0.0, steps=steps)
            kills += done.status < 0
            if done.status not in (0, -signal.SIGALRM) or "Traceback" in done.said:
                yield f"drive: {done}"
                return
            if more.items() - right.items():
                yield f"drive, killed: {sorted(more.items() - right.items())}"
            seen |= more
        if seen != right:
            yield f"drive: orders are missing: {sorted(right.keys() - seen.keys())}"


def studios(home: Path, count: int, draw: random.Random) -> Iterator[str]:
    """The studio, killed while it answers and saves; a scenario that is there can be planned."""
    for _ in range(count):
        folder, sent = prepare(home / "now"), draw.choice(list(KILLED))
        running = Running("studio world.npz --out new.yaml", folder)
        patience = time.monotonic() + SECONDS
        while not (found := re.search(r"http://([^:/]+):(\d+)/\S*#(\S+)", running.log.read_text())):
            if time.monotonic() > patience:
                yield f"studio: no address: {running.log.read_text()}"
                return
            time.sleep(0.01)
        asked = http.client.HTTPConnection(found[1], int(found[2]), timeout=SECONDS)
        head = {"Authorization": f"Bearer {found[3]}", "Content-Type": "application/json"}
        asked.request("GET", "/board", headers=head)
        board = json.dumps(json.loads(asked.getresponse().read())["board"])
        asked.request("POST", draw.choice(("/save", "/answer")), board, head)
        time.sleep(draw.uniform(0, 0.1))
        running.kill(sent)
        done = running.wait(SECONDS)
        asked.close()
        if done.status not in KILLED[sent] or "Traceback" in done.said:
            yield f"studio, signal {sent}: {done}"
        if (folder / "new.yaml").exists() and (again := Running("plan new.yaml", folder).wait()).status:
            yield f"studio, signal {sent}: what it saved: {again}"


READ = {
    "kept.store": ("results kept.store --json", "sweep sweep.yaml --store kept.store --processes 1 --json",
                   "results new.store --merge kept.store --json"),
    "plan.json": ("export plan.json --out new.csv", "evaluate world.npz --plan plan.json --rollouts 64 --json"),
    "run.state.json": ("plan world.npz --state run.state.json --json",),
    "now.json": ("drive world.npz --state now.json",),
    "a.mcap": ("inspect a.mcap --json", "replay a.mcap --json", "recover a.mcap --out new.mcap --json",
               "plan a.mcap --json"),
}  # fmt: skip
"""Files in which a bit is flipped, and what reads them."""
TIMES = re.compile(r'"[a-z_]*(?:seconds|per_second|reused)": [0-9.e+-]+')


def answer(words: str) -> tuple[int, str, str]:
    """What a command in this process says, without times, with the file that it writes; and its errors."""
    out, err = io.StringIO(), io.StringIO()
    nothing = mock.patch("sys.stdin", io.TextIOWrapper(io.BytesIO()))
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), nothing:
        status = run(words.split())
    written = Path("new.csv").read_text() if Path("new.csv").exists() else ""
    for path in Path().glob("new.*"):
        path.unlink()
    return status, TIMES.sub("", out.getvalue()) + written, err.getvalue()


def flips(home: Path, count: int, draw: random.Random) -> Iterator[str]:
    """One bit at a time: the same answer, or a refusal in one line, or a note of what is lost or differs."""
    with contextlib.chdir(prepare(home / "now")):
        for words in ("plan world.npz --out plan.json", "record world.npz --ids 1 --state-at 5 --out a.mcap",
                      "sweep sweep.yaml --store kept.store --processes 1"):  # fmt: skip
            if (made := answer(words))[0]:
                raise SystemExit(made[2])
        Path("a.state.json").rename("run.state.json")
        answer("drive world.npz --state now.json")
        whole = {name: Path(name).read_bytes() for name in READ}
        right = {words: answer(words) for name in READ for words in READ[name]}
        for number in range(count):
            name = list(READ)[number % len(READ)]
            words, data = draw.choice(READ[name]), bytearray(whole[name])
            data[at := draw.randrange(len(data))] ^= 1 << (bit := draw.randrange(8))
            Path(name).write_bytes(data)
            try:
                status, out, err = answer(words)
            except BaseException as error:
                status, out, err = -1, "", f"Traceback {error!r}"
            lines = err.splitlines()
            told = status == 2 and sum(line.startswith("error:") for line in lines) == 1 and name in err
            noted = status in (0, 1) and any(
                word in out + err for word in ("lost", "cannot be read", "different", "was changed")
            )
            if "Traceback" in err or not (told or noted or (status, out) == right[words][:2]):
                yield f"{words}: bit {bit} of byte {at}: status {status}, {err[-300:]!r}"
            for path in (*Path().glob("*.store-*"), Path(name)):
                path.unlink(missing_ok=True)
            Path(name).write_bytes(whole[name])
        folder = CacheFolder(Path.cwd() / "compiled")
        folder.write("code", content := draw.randbytes(4000))
        (file,) = folder.path.iterdir()
        for _ in range(count // 5):
            data = bytearray(kept := file.read_bytes())
            data[at := draw.randrange(len(data))] ^= 1 << draw.randrange(8)
            file.write_bytes(data)
            if folder.read("code") is not None:
                yield f"compiled code with another byte {at} is used"
            file.write_bytes(kept)
        if folder.read("code") != content:
            yield "compiled code is not read"


def faults(kills: int, flipped: int, seed: int = 0, only: str = "") -> Iterator[str]:
    """Everything that breaks a promise."""
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        with contextlib.redirect_stderr(io.StringIO()):
            run(f"generate {home}/world.npz --size 8x9 --robots 2 --areas 3".split())
        for name, words in (LONG | POOLED).items():
            if not re.search(only, name):
                continue
            whole = Whole(name, words, home, anew=kills > 9)  # of fewer none begins anew
            for kind, trial in KINDS.items():
                yield from trial(whole, math.ceil(kills * SHARE[kind]), draw)
            if name in POOLED:
                yield from workers(whole, kills, draw)
        for name, runs, count in (("drive", drives, kills), ("studio", studios, kills), ("flips", flips, flipped)):
            if re.search(only, name):
                yield from runs(home, count, draw)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=300, help="of each command")
    parser.add_argument("--flips", type=int, default=5000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", help="commands with such names (a pattern); drive, studio, flips")
    asked, found = parser.parse_args(), 0
    for fault in faults(asked.kills, asked.flips, asked.seed, asked.only):
        found += 1
        sys.stdout.write(f"{fault}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{asked}: {found} broken promises\n")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
