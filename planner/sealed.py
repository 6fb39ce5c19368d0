"""Files of compiled code, kept between runs: read only if they are whole and nobody else's, else made again.

Compiled code that is damaged ends the process, and whoever can write it can run anything: so a file carries the hash of
its content, and is used only if it belongs to this user (or to root) and nobody else may write it. It is written beside
its place and then moved there: whoever reads it meanwhile finds all of it, or what was there before. Whatever happens
to these files is no error: it costs a compilation, and a line in the log (which Python prints to standard error).
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import stat
import tempfile
import time
from contextlib import suppress
from pathlib import Path

LOG = logging.getLogger("mrac_jax")
NO_CACHE = "MRAC_JAX_NO_CACHE"
"""Environment variable that keeps such files from being read and written."""
SUFFIX = ".sealed"
MARK = b"mrac sealed 1\n\0\0"
HASH_BYTES = hashlib.sha256().digest_size
DAY = 86400.0
KEPT_DAYS = 30
MOST_BYTES = 2**29


class SealedFolder:
    """Content by name in one folder, which is made when it is first needed.

    Attributes:
        path: the folder.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._told = self._pruned = False
        self._trusted: bool | None = None

    def read(self, name: str) -> bytes | None:
        """What was written under the name; None if there is nothing, or nothing that can be trusted."""
        try:
            if not self._is_trusted():
                return None
            sealed = _read_own(self.path / (name + SUFFIX))
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError as error:
            self._tell(f"is made again: it cannot be read ({error.strerror})")
            return None
        content = memoryview(sealed)[len(MARK) + HASH_BYTES :]
        if sealed[: len(MARK) + HASH_BYTES] != MARK + _hash(name, content):
            self.damaged()
            return None
        return bytes(content)

    def write(self, name: str, content: bytes) -> None:
        """Keep the content under the name, if that is possible."""
        try:
            with suppress(FileExistsError):
                self.path.mkdir(mode=0o700, parents=True)
            if self._is_trusted():
                self._prune()
                _write_whole(self.path / (name + SUFFIX), MARK + _hash(name, content) + content)
        except OSError as error:
            self._tell(f"is not kept ({error.strerror}): expected a folder to write to, or XDG_CACHE_HOME set to one")

    def damaged(self) -> None:
        """Say that a file of this folder was of no use."""
        self._tell("is made again: it was damaged")

    def _is_trusted(self) -> bool:
        """Whether it is a folder that only this user and root may write to; raises OSError if there is none."""
        if self._trusted is None:
            facts = self.path.stat()
            self._trusted = stat.S_ISDIR(facts.st_mode) and _nobody_elses(facts)
            if not self._trusted:
                self._tell("is not used: expected a folder of yours that nobody else may write to (chown, chmod go-w)")
        return self._trusted

    def _tell(self, what: str) -> None:
        """The one line of a process on this folder; a worker leaves it to the process that started it."""
        if not self._told and multiprocessing.parent_process() is None:
            LOG.warning("note: compiled code in %s %s", self.path, what)
        self._told = True

    def _prune(self) -> None:
        """Once a process: remove what nobody has used for a month, and the longest unused above MOST_BYTES.

        Another process may be using them: it has read them whole, or compiles again.
        """
        if self._pruned:
            return
        self._pruned, old = True, time.time() - KEPT_DAYS * DAY
        found = [(path, path.stat()) for path in self.path.iterdir() if path.name.endswith((SUFFIX, ".partial"))]
        found.sort(key=lambda one: -one[1].st_mtime)
        total = 0
        for path, facts in found:
            total += facts.st_size
            if total > MOST_BYTES or facts.st_mtime < old:
                path.unlink(missing_ok=True)


def _hash(name: str, content: bytes | memoryview) -> bytes:
    digest = hashlib.sha256(name.encode() + b"\0")
    digest.update(content)
    return digest.digest()


def _nobody_elses(facts: os.stat_result) -> bool:
    """Whether only this user and root can have written it (where files have owners)."""
    return os.name != "posix" or (facts.st_uid in (0, os.geteuid()) and not facts.st_mode & 0o022)


def _read_own(path: Path) -> bytes:
    """A regular file of this user, marked as used today; raises OSError."""
    with os.fdopen(os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0)), "rb") as file:  # a pipe would wait
        facts = os.fstat(file.fileno())
        if not stat.S_ISREG(facts.st_mode) or not _nobody_elses(facts):
            raise PermissionError(0, "others may have written it")
        content = file.read()
    if facts.st_mtime < time.time() - DAY:
        with suppress(OSError):
            os.utime(path)
    return content


def _write_whole(path: Path, content: bytes) -> None:
    """Write beside the file, then move there: with mode 0600; raises OSError and leaves nothing."""
    handle, beside = tempfile.mkstemp(prefix=path.name, suffix=".partial", dir=path.parent)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
        Path(beside).replace(path)
    except BaseException:
        with suppress(OSError):
            Path(beside).unlink()
        raise
