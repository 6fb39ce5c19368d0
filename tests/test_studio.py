"""The studio: what it answers is what the command line says, and who has no business there is refused."""

import asyncio
import base64
import http.client
import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from conftest import FOLDER
from helpers import ROOT, error_of
from page_reader import Browser, check_page_is_sound, needs_browser

from analysis.cli.app import run
from analysis.page.document import asset
from analysis.studio.server import HOST, MOST_BYTES, Latest, Sketch, Studio, read_sketch, serve, studio_page
from analysis.theory.exact import open_loop_exact
from planner.errors import InputError
from planner.formatting import Pace
from planner.make_plan import make_plan
from planner.settings import Settings
from planner.world.frame import Georeference
from planner.world.scenario import load_input
from planner.world.world import World, load_world_file

PATIENCE = 600.0
"""Seconds: the first answer of a clean clone waits for the compiler."""
HOSTILE = "<img src=x onerror=alert(1)>.npz"


def sketch() -> Sketch:
    world = load_world_file(FOLDER / "contiguous-14x23-1000.npz").with_starts(None)
    return Sketch(world, 3, Settings())


@dataclass
class Served:
    """A studio that is running."""

    studio: Studio
    address: str

    @property
    def token(self) -> dict[str, str]:
        return {"Authorization": f"Bearer {self.studio.token}"}

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(HOST, urlsplit(self.address).port or 0, timeout=PATIENCE)

    def ask(self, method: str, path: str, body: Any = None, **headers: str) -> tuple[int, bytes]:
        """Status and body of the reply to a request with these headers alone."""
        connection = self.connect()
        try:
            connection.request(method, path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read()
        finally:
            connection.close()

    def post(self, path: str, board: dict[str, Any]) -> tuple[int, list[dict[str, Any]]]:
        """Status and lines of the reply to a board, asked for as the page does."""
        body = json.dumps(board)
        status, said = self.ask("POST", path, body, **self.token, **{"Content-Type": "application/json"})
        return status, [json.loads(line) for line in said.splitlines()]


@contextmanager
def serving(studio: Studio) -> Iterator[Served]:
    told: list[Any] = []
    begun = threading.Event()

    async def main() -> None:
        over = asyncio.Event()

        def ready(address: str) -> None:
            told.extend((address, asyncio.get_running_loop(), over))
            begun.set()

        await serve(studio, 0, ready, over)

    thread = threading.Thread(target=asyncio.run, args=(main(),))
    thread.start()
    assert begun.wait(30)
    address, loop, over = told
    try:
        yield Served(studio, address)
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join()


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    out = tmp_path_factory.mktemp("studio") / "painted.yaml"
    with serving(Studio(sketch(), HOSTILE, out, seed=5)) as found:
        assert found.post("/answer", found.studio.first.to_json())[0] == 200  # compiled
        yield found


EVERY_KEY: dict[str, Any] = {
    "levels": 4, "weibull_shape": 2.0, "deadline": 90, "in_area": "rows", "range": (20, 30),
    "hazard_multiplier": (1.0, 3.0), "return_to": ((0, 0), (2, 1)), "recharge": 3, "steps_per_move": (1, 2),
    "radio": 3.5,
}  # fmt: skip
"""Settings that a scenario can name, but for a policy's and types; not all of them together make a plan."""


# --- answers ---


def test_the_saved_board_gives_the_same_figures_on_the_command_line(
    served: Served, capfd: pytest.CaptureFixture[str]
) -> None:
    """One board answered over HTTP, saved, and run again by the command that the page shows."""
    first = served.studio.first
    starts = [[0, 0], [13, 22], [13, 22], [0, 0]]
    board = first.to_json() | {"starts": starts, "policy": "per_cell", "risk_cap": 0.5, "deadline": 60}
    cells = np.frombuffer(base64.b64decode(board["cells"]), dtype="<f4").copy()
    cells[[30, 31, 53]] = 0.25
    cells[0] = cells[-1] = 0
    board["cells"] = base64.b64encode(cells.tobytes()).decode()
    status, lines = served.post("/answer", board)
    assert status == 200 and lines[0]["stage"] == "open" and lines[-1]["stage"] == "done"
    world = World.create(cells.reshape(14, 23), starts)
    exact = open_loop_exact(make_plan(world, starts, Settings(policy="per_cell", risk_cap=0.5)), world)
    covered = 100 * exact.visited / world.accessible(starts).sum()
    assert f"would cover {covered:.2f} % (exact)" in lines[0]["summary"]

    status, (saved,) = served.post("/save", board | {"rollouts": lines[-1]["rollouts"]})
    program, *words = shlex.split(saved["command"])
    assert status == 200 and program == "mrac-jax" and words[1] == str(served.studio.out)
    assert run([*words, "--json", "--no-advice"]) == 0
    answer = json.loads(capfd.readouterr().out)
    done = lines[-1]
    assert (answer["rollouts"], answer["seed"]) == (done["rollouts"], 5)
    said = done["summary"].partition("cover ")[2].partition(" % ±")[0]
    assert said == f"{100 * answer['coverage']['visited']['mean']:.{len(said.partition('.')[2])}f}"
    assert answer["losses"]["mean"] == 4 and done["figures"][1][0] == "4 of 4"
    by_then = done["figures"][3][0].partition(" % ±")[0]
    assert by_then == f"{100 * answer['deadline']['visited']['mean']:.{len(by_then.partition('.')[2])}f}"


def test_what_robots_do_not_know_costs_what_evaluate_says(
    served: Served, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """A corner is hidden, obstacles and all: answered, saved, run again, and painted on again."""
    first = served.studio.first
    unknown = np.zeros((14, 23), dtype=np.uint8)
    unknown[4:, 8:] = 1
    hidden = base64.b64encode(unknown.tobytes()).decode()
    board = first.to_json() | {"unknown": hidden, "believed": 0.1, "sensor_range": 1}
    status, lines = served.post("/answer", board)
    assert status == 200 and {"sure", "done"} <= {line["stage"] for line in lines} <= {"closed", "sure", "done"}
    figures = {name: (value, note) for value, name, note in lines[-1]["figures"]}
    assert "covered in the open loop" not in figures and lines[-1]["paths"] is None
    _, (saved,) = served.post("/save", board | {"rollouts": lines[-1]["rollouts"]})
    assert run([*shlex.split(saved["command"])[1:], "--json", "--no-advice"]) == 0
    answer = json.loads(capfd.readouterr().out)
    mean = lines[-1]["summary"].partition("robots cover ")[2].partition(" %")[0]
    assert mean == f"{100 * answer['coverage']['visited']['mean']:.{len(mean.partition('.')[2])}f}"
    price = answer["knowledge"]["price_of_not_knowing"]
    said, _, wide = figures["cost of the unknown map"][0].removesuffix(" (95 %)").partition(" points ± ")
    assert price["ci95"][0] > 0 and abs(float(said) - 100 * price["mean"]) < 2 * float(wide) < 2
    world = load_input(served.studio.out)
    true = first.world.threat
    assert np.array_equal(world.met, true, equal_nan=True)
    assert np.array_equal(world.threat, np.where(unknown, np.float32(0.1), true), equal_nan=True)
    again = Sketch.of(world, 3, Settings())
    assert (again.believed, again.sensor.range) == (pytest.approx(0.1), 1)
    assert np.array_equal(again.unknown, unknown & ~(true == np.float32(0.1)))
    read, _ = read_sketch(json.dumps(again.to_json()).encode(), again)
    assert read.world.randomness_sha256 == world.randomness_sha256
    with pytest.raises(InputError, match="the prior map has several values"):
        Sketch.of(first.world.with_true_map(np.where(np.isnan(true), np.nan, 0.5), 1), 3, Settings())
    with pytest.raises(InputError, match="wrong about an obstacle"):
        read_sketch(json.dumps(board | {"sensor_range": 0}).encode(), first)


def test_a_saved_board_is_the_same_board_again(tmp_path: Path) -> None:
    world = replace(
        sketch().world, cell_size=2.5, origin=(3.0, -4.0, 0.5), georeference=Georeference("EPSG:32633", (5.0, 6.0))
    ).with_values(2.0, 0.5)
    boards = (
        Sketch(world, 7, Settings(levels=4, range=900)),
        Sketch(
            world.with_starts([[0, 1], [0, 1]]),
            2,
            Settings(policy="per_cell", risk_cap=0.25, robot_value=1e-7, range=(5, 8)),
        ),
        Sketch(replace(world, pace=Pace(7.0, 2.0)), 2, Settings(**EVERY_KEY)),
    )
    for board in boards:
        found = load_input(board.save(tmp_path / "on: #.yaml")[0])
        assert found.sha256 == world.sha256 and (found.team.robots or len(found.starts)) == board.robots
        assert (found.cell_size, found.origin) == (2.5, (3.0, -4.0, 0.5))
        assert found.georeference == world.georeference
        assert np.array_equal(found.value, world.value) and np.array_equal(found.detect, world.detect)
        assert Settings(**found.team.settings) == board.settings and found.pace == board.world.pace
        assert np.array_equal(found.starts, board.world.starts)


def test_the_newest_board_wins_and_only_one_waits() -> None:
    told: list[list[Any]] = [[] for _ in range(100)]
    begun, go = threading.Event(), threading.Event()

    def work(board: int, go_on: Callable[[], None]) -> Iterator[dict[str, Any]]:
        begun.set()
        go.wait(30)
        go_on()
        yield {"board": board}

    latest = Latest(work)
    latest.submit(0, told[0].append)
    assert begun.wait(30)
    for number in range(1, 100):
        latest.submit(number, told[number].append)
    assert all(lines == [{"superseded": True}, None] for lines in told[1:99])
    go.set()
    while not told[99] or told[99][-1] is not None:
        assert latest._thread.is_alive()
    assert told[0] == [{"superseded": True}, None] and told[99] == [{"board": 99}, None] and latest.begun == 2
    latest.close()


def test_a_fault_is_told_and_the_next_board_answered(caplog: pytest.LogCaptureFixture) -> None:
    over = threading.Semaphore(0)
    told: list[Any] = []

    def tell(line: Any) -> None:
        told.append(line)
        if line is None:
            over.release()

    def work(board: Any, go_on: Callable[[], None]) -> Iterator[dict[str, Any]]:
        raise board

    latest = Latest(work)
    for error in (ZeroDivisionError("x"), InputError("p is 2", expected="less")):
        latest.submit(error, tell)
        assert over.acquire(timeout=30)
    assert "ZeroDivisionError" in told[0]["error"] and told[2] == {"error": "p is 2; expected less"}
    assert [record.message for record in caplog.records] == ["studio"]
    latest.close()


# --- who is refused ---


def test_whoever_is_not_the_page_is_refused(served: Served) -> None:
    port, begun = urlsplit(served.address).port, served.studio.latest.begun
    body, typed = json.dumps(served.studio.first.to_json()), {"Content-Type": "application/json"}
    token = served.token
    for headers, status in (
        (typed, 401),
        (typed | {"Authorization": "Bearer " + "x" * 43}, 401),
        (typed | {"Authorization": "Bearer caf\u00e9"}, 401),
        (typed | token | {"Origin": "http://evil.example"}, 403),
        (typed | token | {"Origin": "null"}, 403),
        (typed | token | {"Origin": f"http://{HOST}:{port}0"}, 403),
        (typed | token | {"Host": f"evil.example:{port}"}, 403),
        (typed | token | {"Sec-Fetch-Site": "cross-site"}, 403),
        (token | {"Content-Type": "text/plain"}, 415),
        (token, 415),
    ):
        for path in ("/answer", "/save"):
            found, said = served.ask("POST", path, body, **headers)
            assert found == status and len(said) < 100 and b"Traceback" not in said, (headers, said)
    for method, path, headers, status in (
        ("GET", "/board", {}, 401),
        ("GET", "/", {"Host": "evil.example"}, 403),
        ("GET", "/answer", token, 405),
        ("PUT", "/board", token, 405),
        ("GET", "/../../etc/passwd", token, 404),
        ("OPTIONS", "/answer", {"Origin": "http://evil.example"}, 403),
    ):
        assert served.ask(method, path, **headers)[0] == status, (method, path)
    assert served.studio.latest.begun == begun and not served.studio.out.with_name("evil").exists()
    assert served.ask("GET", "/board", **token, Origin=f"http://{HOST}:{port}")[0] == 200


def test_the_page_tells_nothing_of_the_map_and_forbids_all_else(served: Served) -> None:
    connection = served.connect()
    connection.request("GET", "/")
    reply = connection.getresponse()
    page = reply.read().decode()
    connection.close()
    assert page == studio_page() and HOSTILE not in page and served.studio.token not in page
    assert "frame-ancestors 'none'" in reply.headers["Content-Security-Policy"]
    assert reply.headers["X-Content-Type-Options"] == "nosniff" and reply.headers["Cache-Control"] == "no-store"
    reader = check_page_is_sound(page, asks="fetch(")
    assert not [word for word in ("Team", "Save", "Undo") if word not in reader.text]


@pytest.mark.parametrize("chunked", [False, True])
def test_a_body_of_100_megabytes_is_not_read(served: Served, chunked: bool) -> None:
    """The connection ends long before all of it could be sent, and the studio goes on."""
    head = f"POST /answer HTTP/1.1\r\nHost: {urlsplit(served.address).netloc}\r\n"
    head += f"Authorization: Bearer {served.studio.token}\r\nContent-Type: application/json\r\n"
    head += "Transfer-Encoding: chunked\r\n\r\n" if chunked else f"Content-Length: {100 * 2**20}\r\n\r\n"
    part, sent, said = b"10000\r\n" + b"x" * 2**16 + b"\r\n", 0, b""
    with socket.create_connection((HOST, urlsplit(served.address).port or 0), timeout=30) as connection:
        connection.sendall(head.encode())
        try:
            while sent < 100 * 2**20:
                connection.sendall(part)
                sent += len(part)
            said = connection.recv(100)
        except OSError:
            pass
    assert sent < MOST_BYTES + 16 * 2**20 and b" 200 " not in said  # what the kernel holds for both sides included
    assert served.ask("GET", "/", Host=urlsplit(served.address).netloc)[0] == 200


def test_100_boards_at_once_are_answered_with_the_last_one(served: Served) -> None:
    begun, board = served.studio.latest.begun, served.studio.first.to_json()
    connections = [served.connect() for _ in range(100)]
    for number, connection in enumerate(connections):
        headers = served.token | {"Content-Type": "application/json"}
        connection.request("POST", "/answer", json.dumps(board | {"deadline": number + 1}), headers)
    last = []
    for connection in connections:
        last.append(json.loads(connection.getresponse().read().splitlines()[-1]))
        connection.close()
    answered = [line for line in last if line != {"superseded": True}]
    assert [line["stage"] for line in answered] == ["done"] * len(answered) and 1 <= len(answered) < 50
    assert served.studio.latest.begun - begun < 100


WRONG_BOARDS = [
    ({"cells": "AAAA"}, "`cells`"),
    ({"cells": "?"}, "`cells`"),
    ({"cells": [0.1]}, "`cells`"),
    ({"cells": base64.b64encode(np.full(14 * 23, 2, "<f4").tobytes()).decode()}, "threat is 2 at [0, 0]"),
    ({"cells": base64.b64encode(np.full(14 * 23, np.nan, "<f4").tobytes()).decode()}, "every cell is an obstacle"),
    ({"unknown": "AAAA"}, "`unknown`"),
    ({"believed": 1}, "`believed`"),
    (
        {"sensor_range": 0.5, "unknown": base64.b64encode(np.ones(14 * 23, "u1").tobytes()).decode()},
        "sensor_range is 0.5",
    ),
    ({"deadline": "45min"}, "the duration of a step is not given"),
    ({"deadline": "soon"}, "`deadline` is soon"),
    ({"starts": [[99, 0]]}, "outside the map"),
    ({"starts": [[2**70, 0]]}, "`starts[0][0]`"),
    ({"starts": [[0, 0, 0]]}, "`starts[0]`"),
    ({"starts": []}, "`starts`"),
    ({"robots": 0}, "`robots`"),
    ({"robots": 1e9}, "`robots`"),
    ({"policy": "<b>"}, "`policy`"),
    ({"risk_cap": 0.5}, "risk_cap is 0.5 with policy mrac"),
    ({"policy": "per_cell", "robot_value": -1}, "robot_value is -1"),
    ({"deadline": 0}, "`deadline`"),
    ({"out": "/etc/passwd"}, "unknown key `out`"),
]


@pytest.mark.parametrize(("change", "named"), WRONG_BOARDS)
def test_a_wrong_board_is_named_in_one_line(change: dict[str, Any], named: str) -> None:
    first = sketch()
    with pytest.raises(InputError) as found:
        read_sketch(json.dumps(first.to_json() | change).encode(), first)
    assert named in str(found.value) and "\n" not in str(found.value)


def test_a_deadline_may_be_a_time_where_the_pace_is_known() -> None:
    first = replace(sketch(), world=sketch().world.with_pace(3.0))
    for given, step in (("2min", 40), ("1min30s", 30), (7, 7)):
        assert read_sketch(json.dumps(first.to_json() | {"deadline": given}).encode(), first)[0].deadline == step
    with pytest.raises(InputError, match="`deadline` is 0"):
        read_sketch(json.dumps(first.to_json() | {"deadline": "1s"}).encode(), first)


def test_what_is_no_board_is_refused(served: Served) -> None:
    headers = served.token | {"Content-Type": "application/json"}
    for body in (b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b'{"cells": NaN}', b"[1, 2]"):
        status, said = served.ask("POST", "/answer", body, **headers)
        assert status == 400 and set(json.loads(said)) == {"error"}, body


# --- the command line ---


def test_the_command_names_what_is_wrong(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    large = tmp_path / "large.npy"
    np.save(large, np.zeros((501, 500)))
    np.save(tmp_path / "small.npy", np.full((3, 3), 0.1))
    (tmp_path / "painted.yaml").write_text("map: large.npy\n")
    (tmp_path / "doubt.yaml").write_text("map: small.npy\nlatent_hazard: {kind: persistent}\n")
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        for words, said in (
            (["example:paper", "--port", "70000"], "--port 70000; expected a port"),
            (
                ["example:paper", "--port", str(port), "--out", str(tmp_path / "a.yaml")],
                f"--port {port} is not available",
            ),
            (["example:paper", "--out", str(tmp_path / "a.txt")], "a.txt does not end in .yaml"),
            (["example:paper", "--out", str(tmp_path / "none" / "a.yaml")], "there is no folder"),
            ([str(tmp_path / "painted.yaml"), "--out", str(tmp_path / "painted.yaml")], "is an input"),
            ([str(tmp_path / "doubt.yaml")], "painting requires one known map"),
            ([str(large)], "250,500 cells; expected at most 250,000"),
            (["example:paper", "--seed", "-1"], "--seed -1"),
            (["no.yaml"], "no such file"),
        ):
            assert said in error_of(capfd, "studio", *words)


@pytest.mark.slow
def test_ctrl_c_ends_the_studio_in_the_middle_of_an_answer(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mrac_jax", "studio", "example:paper"]
    with subprocess.Popen(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE,
                          text=True) as process:  # fmt: skip
        address = process.stderr.readline().split()[-1]
        place = urlsplit(address)
        connection = http.client.HTTPConnection(place.hostname or "", place.port, timeout=60)
        token = {"Authorization": f"Bearer {place.fragment}"}
        connection.request("GET", "/board", headers=token)
        board = json.loads(connection.getresponse().read())["board"]
        connection.request("POST", "/answer", json.dumps(board), token | {"Content-Type": "application/json"})
        process.send_signal(signal.SIGINT)
        said = process.communicate(timeout=60)[1]
        connection.close()
    assert process.returncode == 0 and said.splitlines()[-1] == "studio ended" and "Traceback" not in said


def test_without_the_extra_the_fix_is_named(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "tornado", None)
    assert run(["studio", "example:paper"]) == 2
    assert capfd.readouterr().err == 'error: tornado is not installed; pip install "mrac-jax[studio]"\n'


# --- the board's script, and the whole in a browser ---


@needs_browser
def test_the_worst_threat_has_the_last_colour_of_the_scale(browser: Browser) -> None:
    script = (
        asset("picture.js", "analysis.studio")
        + """
      function make() { return { style: {} }; }
      function play(p) {
        let drawn = null;
        const createImageData = (cols, rows) => ({ data: new Array(4 * cols * rows) });
        const context = { createImageData, putImageData: (image) => { drawn = image.data; } };
        const canvas = { getContext: () => context }, style = { setProperty: () => {} };
        const box = { querySelector: () => canvas, style: {}, parentElement: { style } };
        const layer = { name: "Threat", root: true, colours: ["#ffffff", "#ff8000", "#ff0000"] };
        const palettes = { obstacle: "#000000", unreachable: "#0000ff", unknown: "#00ff00", layers: [layer] };
        const picture = makePicture(box, { style: {}, replaceChildren: () => {} }, palettes);
        picture.draw({ rows: 1, cols: 3, cells: new Float32Array([0, p, NaN]), unknown: [0, 0, 0] }, layer, null, 0);
        return drawn;
      }"""
    )
    drawn = browser.run(f"(() => {{ {script} return [0.05, 0.1, 0.25, 0.5].map(play); }})()")
    assert drawn == 4 * [[255, 255, 255, 255, 255, 0, 0, 255, 0, 0, 0, 255]]


@needs_browser
def test_the_board_paints_and_takes_back(browser: Browser) -> None:
    script = (
        asset("board.js", "analysis.studio")
        + """
      function play() {
        const board = makeBoard(3, 4, new Float32Array([0, 0, 0, 0, 0, NaN, 0, 0, 0, 0, 0, 0]), null, 2), seen = [];
        const cells = () => [...board.cells].map((p) => Number.isNaN(p) ? "#" : p).join(" ");
        const look = () => seen.push([cells(), board.starts, board.robots]);
        board.keep(); board.paint("Threat", 0.5, 1, [0, 0], [2, 2]); look();
        board.keep(); board.toggleStart(2, 3, [[0, 0], [0, 1]], 9); look();
        board.keep(); board.paint("Obstacle", 0.5, 3, [2, 3], [2, 3]); look();
        board.back(); board.back(); look();
        board.forth(); look();
        board.keep(); board.paint("Safe", 0, 7, [1, 1], [1, 1]); look();
        board.keep(); const refused = board.paint("Safe", 0, 1, [1, 1], [1, 1]); board.drop();
        board.place(5); look();
        const unknown = () => hidden.push([...board.unknown].join("")), hidden = [];
        board.keep(); board.paint("Unknown", 0, 3, [0, 0], [0, 1]); unknown();
        board.keep(); board.paint("Known", 0, 1, [0, 0], [0, 0]); unknown();
        board.back(); unknown(); board.back(); unknown(); board.forth(); board.forth(); board.back(); board.back();
        return { seen, hidden, refused, back: board.canGoBack, forth: board.canGoForth };
      }"""
    )
    painted, threats = [[0, 0], [0, 1], [2, 3]], "0.5 0 0 0 0 # 0 0 0 0 0.5 0"
    found = browser.run(f"(() => {{ {script} return play(); }})()")
    assert found["seen"] == [
        [threats, None, 2],
        [threats, painted, 3],
        ["0.5 0 0 0 0 # # # 0 0 # #", painted[:2], 3],
        [threats, None, 2],
        [threats, painted, 3],
        ["0 0 0 0 0 0 0 0 0 0 0 0", painted, 3],
        ["0 0 0 0 0 0 0 0 0 0 0 0", None, 5],
    ]
    assert found["hidden"] == ["111011100000", "011011100000", "111011100000", "000000000000"]
    assert not found["refused"] and found["back"] and found["forth"]


@needs_browser
def test_a_finger_paints_or_moves_an_enlarged_map(browser: Browser, tmp_path: Path) -> None:
    """On a phone: with Move chosen it scrolls the map and paints nothing, with a brush the other way round."""
    world = World.create(np.zeros((41, 50)))
    studio = Studio(Sketch(world, 1, Settings()), "x", tmp_path / "x.yaml", 0)
    stage = "document.getElementById('summary').dataset.stage"
    view = "(() => { const v = document.querySelector('.view'); return [v.scrollLeft, v.scrollTop] })()"
    with serving(studio) as served:
        browser.open(served.address, width=390)
        browser.until(f"{stage} === 'done'")
        for _ in range(2):
            browser.run("document.querySelector('.zoom button').click()")
        browser.run("document.querySelector('.view').scrollTo(0, 0)")
        browser.run("document.querySelector('#brushes label:last-of-type input').click()")
        browser.run("document.getElementById('board').scrollIntoView()")
        way = [0.7 - 0.02 * step for step in range(21)]
        browser.swipe(".view", *((part, 0.5) for part in way))
        browser.until(f"{view}[0] > 40")
        browser.swipe(".view", *((0.5, part) for part in way))
        browser.until(f"{view}[1] > 40")
        assert not studio.board.world.threat.any()
        browser.run("document.querySelector('#brushes label input').click()")
        still = "let last = -1, times = 0; const look = () => { const at = String(" + view + "); "
        still += "times = at === last ? times + 1 : 0; last = at; times > 20 ? ok() : requestAnimationFrame(look); }"
        browser.run(f"new Promise((ok) => {{ {still}; look(); }})")  # the swipe has run out
        moved = browser.run(view)
        browser.swipe(".view", *((part, 0.5) for part in way))
        browser.until(f"{stage} === 'done'")
        assert browser.run(view) == moved and studio.board.world.threat.any() and browser.noticed == []


@needs_browser
def test_a_browser_paints_and_saves(served: Served, browser: Browser) -> None:
    """A stroke by the pointer, one by the keyboard, undone, saved: the summary follows; nothing in names is run."""
    summary, stage = ("document.getElementById('summary')." + name for name in ("textContent", "dataset.stage"))

    def answered() -> str:
        browser.until(f"{stage} === 'done'")
        return browser.run(summary).replace("\xa0", " ")

    browser.open(served.address)
    first = answered()
    assert "3 robots cover " in first and served.studio.token not in browser.run("location.href")
    assert HOSTILE in browser.run("document.getElementById('name').textContent")
    assert browser.run("document.querySelectorAll('img').length") == 0
    browser.run("document.querySelector('#sizes label:last-of-type input').click()")
    browser.drag("#board", (0.2, 0.5), (0.8, 0.5))
    second = answered()
    assert second != first
    browser.run("document.getElementById('board').focus()")
    browser.key("2")  # obstacles
    browser.key("ArrowRight")
    browser.key(" ")
    third = answered()
    assert third != second
    for _ in range(2):
        browser.run("document.getElementById('undo').click()")
        answered()
    assert browser.run(summary).replace("\xa0", " ") == first and browser.run(
        "document.getElementById('undo').disabled"
    )
    browser.run("document.getElementById('redo').click()")
    assert answered() == second
    change = "dispatchEvent(new Event('change', {bubbles: true}))"
    for step, problem in (("-1", "Deadline: "), ("''", "")):
        browser.run(f"(() => {{ const e = document.getElementById('deadline'); e.value = {step}; e.{change} }})()")
        assert browser.run("document.getElementById('problem').textContent")[: len("Deadline: ")] == problem
    assert answered() == second
    browser.run("document.getElementById('save').click()")
    browser.until("!document.querySelector('.command').hidden")
    assert str(served.studio.out) in browser.run("document.getElementById('command').textContent")
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")
    assert browser.run("document.querySelectorAll('.paths path').length") == 3
    browser.open("about:blank")
    browser.open(served.address)  # nothing is lost
    assert answered() == second
    reached = browser.stops()
    assert all(any(f'id="{name}"' in stop for stop in reached) for name in ("board", "again", "policy", "save"))
    browser.run("document.getElementById('again').click()")
    assert answered() == first
    browser.run("document.getElementById('undo').click()")
    assert answered() == second
    assert browser.noticed == [] and {urlsplit(asked).netloc for asked in browser.asked} == {
        urlsplit(served.address).netloc
    }
    assert (load_input(served.studio.out).threat == np.float32(0.1)).sum() > 20
