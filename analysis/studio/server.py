"""The server behind the page: on the loopback alone, for whoever holds its token, and for no other page.

Tornado, because it is kept, needs no other package, bounds what a request may hold, and comes with `dask` anyway.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from hmac import compare_digest
from pathlib import Path
from typing import Any

from tornado.httpserver import HTTPServer
from tornado.iostream import StreamClosedError
from tornado.web import Application, HTTPError, RequestHandler

from analysis.studio.answering import PRECISION, answers
from analysis.studio.latest import Latest
from analysis.studio.page import palettes, security_headers, studio_page
from analysis.studio.sketch import Sketch, read_sketch
from analysis.studio.words import command_words
from planner.arguments import whole
from planner.errors import InputError, UsageError
from planner.files import Json
from planner.kernels.tables import AllPairs
from planner.limits import MOST_ROLLOUTS

HOST = "127.0.0.1"
MOST_BYTES = 2 * 2**20
"""Of a request's body; a larger one is refused before it is read."""
MOST_CELLS = 250_000
"""Of a map, so that its cells have room in a request."""
PATIENCE = 20.0
"""Seconds that a request's body may take to come."""
IDLE = 60.0
"""Seconds that a connection is kept without a request."""


@dataclass(eq=False)
class Studio:
    """What the handlers share.

    Attributes:
        first: the board as the input has it. name: of the input, as shown. out: the scenario to save.
        seed: of the rollouts. token: what a request must name. latest: answers boards.
        board: the newest one, which a page that is loaded again goes on with.
    """

    first: Sketch
    name: str
    out: Path
    seed: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32))
    latest: Latest = field(init=False)
    board: Sketch = field(init=False)

    def __post_init__(self) -> None:
        if self.first.settings.plan_for != "closed":
            problem = f"plan_for is {self.first.settings.plan_for} in the studio"
            raise UsageError(problem, source=self.name, expected="closed", fix="leave it out")
        cells = self.first.world.threat.size
        if cells > MOST_CELLS:
            problem, fix = f"{cells:,} cells", "coarsen the map (--cell-size, or the scenario's cell_size)"
            raise UsageError(problem, source=self.name, expected=f"at most {MOST_CELLS:,} to paint on", fix=fix)
        kept = AllPairs()
        work = lambda board, go_on: answers(board, self.seed, kept, go_on)  # noqa: E731
        self.latest, self.board = Latest(work), self.first


class _Handler(RequestHandler):
    """Refuses who has no business here, and says what is wrong in one line of JSON."""

    def initialize(self, studio: Studio, hosts: tuple[str, ...]) -> None:
        self.studio, self.hosts = studio, hosts

    def set_default_headers(self) -> None:
        self.clear_header("Server")
        for name, value in security_headers().items():
            self.set_header(name, value)

    def prepare(self) -> None:
        """The page's own origin alone: other sites may send requests here, even under another name (DNS rebinding)."""
        headers = self.request.headers
        if self.request.host not in self.hosts:
            raise HTTPError(403, reason="Wrong host")
        if headers.get("Origin", f"http://{self.request.host}") != f"http://{self.request.host}":
            raise HTTPError(403, reason="Wrong origin")
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            raise HTTPError(403, reason="Wrong site")

    def write_error(self, status_code: int, **more: Any) -> None:
        """No traceback: the reason, or what is wrong with the board."""
        error = more.get("exc_info", (None, None))[1]
        said = str(error) if isinstance(error, InputError) else self._reason
        self.set_header("Connection", "close")
        self.finish({"error": said})

    def log_exception(self, kind: Any, value: Any, trace: Any) -> None:
        """Refusals are no news for the terminal."""
        if not isinstance(value, HTTPError | InputError):
            super().log_exception(kind, value, trace)

    def send_error(self, status_code: int = 500, **more: Any) -> None:
        """Bad input is the request's fault."""
        bad = isinstance(more.get("exc_info", (None, None))[1], InputError)
        super().send_error(400 if bad else status_code, **more)


class _Page(_Handler):
    """The page itself: nothing of the map is in it."""

    def get(self) -> None:
        self.set_header("Content-Type", "text/html; charset=utf-8")
        self.finish(studio_page())


class _Guarded(_Handler):
    """What needs the token."""

    def prepare(self) -> None:
        super().prepare()
        given = self.request.headers.get("Authorization", "")
        if not compare_digest(given.encode(), f"Bearer {self.studio.token}".encode()):
            raise HTTPError(401, reason="No token")
        if self.request.method == "POST" and self.request.headers.get("Content-Type") != "application/json":
            raise HTTPError(415, reason="Not JSON")


class _Board(_Guarded):
    """The board to go on with, and the input's."""

    def get(self) -> None:
        studio, first = self.studio, self.studio.first
        about: Json = {"name": studio.name, "out": str(studio.out), "shape": first.world.shape, "palettes": palettes()}
        about |= {"paced": bool(first.world.pace)}
        self.finish(about | {"board": studio.board.to_json(), "first": first.to_json(), "notes": first.world.notes})


class _Answer(_Guarded):
    """Lines of JSON, each surer than the one before, until it is sure or another board has come."""

    async def post(self) -> None:
        board, _ = read_sketch(self.request.body, self.studio.first)
        self.studio.board = board
        lines: asyncio.Queue[Json | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()
        self.job = self.studio.latest.submit(board, partial(_hand_over, loop, lines))
        self.set_header("Content-Type", "application/x-ndjson")
        with suppress(StreamClosedError):
            while (line := await lines.get()) is not None:
                self.write(json.dumps(line, allow_nan=False) + "\n")
                await self.flush()

    def on_connection_close(self) -> None:
        """Nobody reads on."""
        if hasattr(self, "job"):
            self.job.end()


def _hand_over(loop: asyncio.AbstractEventLoop, lines: asyncio.Queue, line: Json | None) -> None:
    with suppress(RuntimeError):  # the server has ended
        loop.call_soon_threadsafe(lines.put_nowait, line)


class _Save(_Guarded):
    """The board as a scenario, and the command that repeats its answer."""

    def post(self) -> None:
        board, keys = read_sketch(self.request.body, self.studio.first)
        rollouts = None
        if "rollouts" in keys and keys["rollouts"].value is not None:
            rollouts = keys["rollouts"].number(whole(1, MOST_ROLLOUTS, "a number of rollouts"))
        written = board.save(self.studio.out)
        command = command_words(self.studio.out, rollouts, PRECISION, board.deadline, self.studio.seed)
        self.finish({"written": list(map(str, written)), "command": command})


def make_application(studio: Studio, port: int) -> Application:
    """The addresses of a server that listens at this port."""
    shared = {"studio": studio, "hosts": (f"{HOST}:{port}", f"localhost:{port}")}
    pages = {"/": _Page, "/board": _Board, "/answer": _Answer, "/save": _Save}
    return Application(
        [(path, handler, shared) for path, handler in pages.items()],
        default_handler_class=_Missing,
        default_handler_args=shared,
        log_function=lambda handler: None,
    )


class _Missing(_Guarded):
    """Every other address."""

    def prepare(self) -> None:
        super().prepare()
        raise HTTPError(404)


async def serve(studio: Studio, port: int, ready: Callable[[str], None], over: asyncio.Event | None = None) -> None:
    """Serve until `over` is set, or for ever; `ready` is told the address. Port 0: a free one. Raises UsageError."""
    logging.getLogger("tornado.general").setLevel(logging.ERROR)
    try:
        with _listening(port) as listener:
            place = listener.getsockname()[1]
            server = HTTPServer(
                make_application(studio, place), max_body_size=MOST_BYTES, max_buffer_size=2 * MOST_BYTES,
                body_timeout=PATIENCE, idle_connection_timeout=IDLE, max_header_size=2**14,
            )  # fmt: skip
            server.add_socket(listener)
            ready(f"http://{HOST}:{place}/#{studio.token}")
            try:
                await (over or asyncio.Event()).wait()
            finally:
                server.stop()
                await server.close_all_connections()
    finally:
        studio.latest.close()


def _listening(port: int) -> socket.socket:
    try:
        listener = socket.create_server((HOST, port))
    except OSError as error:
        problem = f"--port {port} cannot be listened at ({error.strerror})"
        raise UsageError(problem, expected="a free port", fix="leave it out") from None
    listener.setblocking(False)
    return listener
