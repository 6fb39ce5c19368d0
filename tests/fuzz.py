"""Damaged and hostile files, and options, against the promises of every command (`make fuzz`).

python tests/fuzz.py [--count N] [--first M] [--only TARGET]

Input number n is always the same one: of target n % len(TARGETS), changed by what `random.Random(n)` draws; of target
"pairs" each is the next pair of options of a command. Commands run in this process, and their words are parsed once
where they are the same: most of an input's time was that. The promises: status 0, 1 or 2 within 20 CPU s and 2 GiB;
with 2 one line that begins `error:` and names the file; no traceback; no control bytes or right-to-left marks; JSON is
JSON, a page has no markup of the input's; nothing is left half-written.
"""

import argparse
import contextlib
import io
import json
import os
import random
import re
import resource
import signal
import struct
import sys
import tempfile
import traceback
import warnings
from collections.abc import Iterator
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pyogrio
import rasterio
import yaml
from cyclopts import App
from PIL import Image

from analysis.cli.app import app, run

SECONDS, MEMORY = 20, 2 * 2**30
LONG = re.compile(rb"rollouts: *[0-9]{8}")
"""In a sweep's file: so much was asked for that 20 s are too few."""
UNSEEN = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2066-\u2069\ufeff]")
"""What may not reach a terminal: control characters but the ends of lines and tabs, and marks that turn text round."""
SQLITE = ("-wal", "-shm")
"""Ends of the names of files that SQLite keeps beside a damaged one."""
HOSTILE: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**30, 0.5, -0.1, 1.5, 1e308, float("nan"), float("inf"), "", "nan",
    "-1", "1e999", "0,3", "../../x", "/dev/zero", "\x1b[31mred", "\u202eabc", "<script>alert(1)</script>", "a\nb",
    "{}", "[" * 200, "A" * 5000, [], {}, [[]], [0, 0], [[0, 0], [0, 0]], {"a": 1}, ["x"], [None],
)  # fmt: skip
"""Values in the place of others."""


NAME = "<script>alert(1)</script>\u202e\x1b[31m"
"""Of threats and sites."""
FILE = "<img src=x onerror=alert(1)>\u202e\x1b[31m.npz"
"""Of a world."""
MARKUP = re.compile(r"<script>alert|<img src=x")
PLAUSIBLE = ("1", "2", "0.5", "20", "0,0;1,1", "1,2", "new.csv", "new", "plan.json", "40s", "6x6")
ROLLED = {"evaluate", "record", "compare", "check", "front", "size", "starts", "threats"}
COMMANDS = (*sorted(ROLLED), "plan", "generate", "drive", "export", "debrief", "results")
VALID = {
    "--ids": "1-3", "--starts": "0,0;1,1", "--candidates": "0,0;1,1;2,2", "--range": "30", "--deadline": "20",
    "--hazard-multiplier": "1,2", "--return-to": "starts", "--plan": "plan.json", "--b.plan": "plan.json",
    "--state": "run.state.json", "--waypoints": "new.csv", "--animation": "new.gif", "--picture": "new.png",
    "--plan-out": "new.json", "--scenario-out": "new.yaml", "--plot": "new.png", "--csv": "new.csv",
    "--parquet": "new.parquet", "--merge": "kept.store", "--where": "robots=1", "--by": "robots", "--to": "kml",
    "--levels": "4", "--seconds": "2", "--size": "6x7", "--exact": "never", "--threat-scale": "0.5,2",
    "--sensor-range": "1", "--tracks": "tracks.csv", "--lost": "0", "--terrain": "dose.tif", "--battery": "20",
    "--risk-caps": "0,0.5", "--robot-values": "1,2", "--pick": "best", "--density": "0.5", "--risk-cap": "0.2",
    "--p": "0.1",
    "--target": "0.5", "--confidence": "0.9", "--weibull-shape": "1.5", "--gain": "0.5", "--precision": "0.2",
    "--ratio": "0.2",
    "--obstacles": "0.1", "--losses": "0.5", "--map": "world.npz", "--max-steps": "99", "--worlds": "2",
}  # fmt: skip
"""What an option takes, where it has no choices and "2" will not do."""


class Target(NamedTuple):
    """A reader: the file of a valid input that is changed ("": the options are), and the command that reads it."""

    name: str
    changed: str
    command: str

    @property
    def words(self) -> list[str]:
        return self.command.split()


TARGETS = (
    Target("npz", "world.npz", "plan world.npz --json"),
    Target("csv", "map.csv", "plan map.csv --json --robots 2"),
    Target("movingai", "grid.map", "plan grid.map --json --robots 2"),
    Target("picture", "plan.png", "plan plan.png --json --robots 2"),
    Target("ros", "ros.yaml", "plan ros.yaml --json --robots 2"),
    Target("geotiff", "dose.tif", "plan dose.tif --json --robots 2"),
    Target("scenario", "scenario.yaml", "plan scenario.yaml --json"),
    Target("unknown", "unknown.yaml", "evaluate unknown.yaml --json --rollouts 64 --no-advice"),
    Target("movers", "movers.yaml", "evaluate movers.yaml --json --rollouts 64 --no-advice"),
    Target("geojson", "zones.geojson", "plan geojson.yaml --json"),
    Target("kml", "zones.kml", "plan kml.yaml --json"),
    Target("gpkg", "zones.gpkg", "plan gpkg.yaml --json"),
    Target("shp", "zones.shp", "plan shp.yaml --json"),
    Target("dbf", "zones.dbf", "plan shp.yaml --json"),
    Target("points", "sites.csv", "plan scenario.yaml --json"),
    Target("plan file", "plan.json", "export plan.json --out new.csv"),
    Target("state", "run.state.json", "plan world.npz --state run.state.json --json"),
    Target("paths", "paths.json", "evaluate world.npz --plan paths.json --json --rollouts 64 --no-advice"),
    Target("sweep", "sweep.yaml", "sweep sweep.yaml --store kept.store --json --processes 1"),
    Target("store", "kept.store", "results kept.store --json"),
    Target("recording", "run.mcap", "inspect run.mcap --json"),
    Target("recovery", "run.mcap", "inspect run.mcap --repair new.mcap --json"),
    Target("logged map", "run.mcap", "plan run.mcap --json --robots 2"),
    Target("tracks", "tracks.csv", "debrief dose.tif --tracks tracks.csv --json"),
    Target("lines", "tracks.geojson", "debrief dose.tif --tracks tracks.geojson --json"),
    Target("drive", "lines.jsonl", "drive world.npz"),
    Target("threat names", "zones.geojson", "threats geojson.yaml --remove 1 --rollouts 64 --json"),
    Target("options", "", ""),
    Target("pairs", "", ""),
)
RING = [[15.01, 51.96], [15.05, 51.96], [15.05, 51.99], [15.01, 51.96]]
"""Corners of a threat, in degrees."""
TEXTS = {
    "scenario.yaml": """\
map: dose.tif
cell_size: 1000
threats:
- {polygons: zones.geojson}
- {points: sites.csv, falloff: {kind: gaussian, radius: 2000}}
- {raster: dose.tif}
keepout: [{polygons: zones.kml}]
value: [{polygons: zones.kml, value: 3}]
robots: {count: 2, range: 40}
combine: max
deadline: 60
step: {seconds: 2}
policy: per_cell
weibull_shape: 2
""",
    "unknown.yaml": "map: world.npz\nrobots: {count: 2}\nprior_map: {p: 0.04}\nsensor_range: {range: 1, sight: true}\n",
    "movers.yaml": "map: world.npz\nrobots: {count: 2}\n"
    "moving_threats: [{walk: 0.5, h: 0.2, count: 2}, {patrol: [[0, 0], [0, 1]], h: 0.6}]\n",
    "ros.yaml": "image: plan.png\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\n"
    "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
    "sweep.yaml": "base: {input: world.npz}\nrollouts: 64\nsweep: {robots: [1, 2]}\n",
    "lines.jsonl": "".join(
        json.dumps(line) + "\n"
        for line in (
            {"type": "report", "robot": 0, "cell": [0, 1]}, {"type": "report", "robot": 1, "stopped": True},
            {"type": "close", "cells": [[3, 5]]}, {"type": "orders"}, {"type": "step", "step": 1},
        )
    ),
    "paths.json": json.dumps({"paths": [[[0, 0], [0, 1], [0, 2]], [[0, 1], [1, 1]]]}),
    "sites.csv": "lon,lat,strength\n15.02,51.98,0.2\n15.04,51.97,0.1\n",
    "tracks.csv": "robot,time,lon,lat,status\n0,0,15.01,51.99,\n0,60,15.03,51.99,\n1,5,15.01,51.97,lost\n",
    "tracks.geojson": json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"name": NAME, "coordTimes": ["2026-05-01T12:00:00Z", "2026-05-01T12:01Z"]},
         "geometry": {"type": "LineString", "coordinates": [[15.01, 51.99], [15.03, 51.99]]}}]}),
    "map.csv": "0,0,0.2,0\n0,nan,0,0.1\n0,0,0,0\n",
    "grid.map": "type octile\nheight 3\nwidth 4\nmap\n....\n.@..\n....\n",
    "zones.geojson": json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"p": 0.2, "name": NAME},
         "geometry": {"type": "Polygon", "coordinates": [RING]}}]}),
    "zones.kml": '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>&lt;script>alert(1)&lt;/script>\u202e</name><ExtendedData>'
    '<Data name="p"><value>0.2</value></Data></ExtendedData><Polygon><outerBoundaryIs><LinearRing><coordinates>'
    + " ".join(f"{lon},{lat},0" for lon, lat in RING)
    + "</coordinates></LinearRing></outerBoundaryIs></Polygon></Placemark></Document></kml>",
    **{f"{kind}.yaml": f"map: dose.tif\nrobots: {{count: 2}}\nthreats: [{{polygons: zones.{kind}}}]\n"
       for kind in ("geojson", "kml", "gpkg", "shp")},
}  # fmt: skip


def make_inputs() -> None:
    """A small valid input for each target, in the working folder."""
    for name, text in TEXTS.items():
        Path(name).write_text(text)
    drawn = np.kron(np.array([[254, 254, 0], [254, 205, 254]], np.uint8), np.ones((2, 2), np.uint8))
    Image.fromarray(drawn).save("plan.png")
    with rasterio.open(
        "dose.tif", "w", driver="GTiff", height=6, width=7, count=1, dtype="float32", crs="EPSG:32633",
        transform=rasterio.Affine(1000, 0, 500_000, 0, -1000, 5_761_038),
    ) as raster:  # fmt: skip
        raster.write(np.full((6, 7), 0.1, np.float32), 1)
    shape = struct.pack("<BIII", 1, 3, 1, len(RING)) + np.array(RING, "<f8").tobytes()
    for kind in ("gpkg", "shp"):
        pyogrio.raw.write(
            f"zones.{kind}", np.array([shape], object), [np.array([0.2])], ["p"], geometry_type="Polygon",
            crs="EPSG:4326",
        )  # fmt: skip
    for command in (
        "generate world.npz --size 6x7 --robots 2 --areas 2", "plan world.npz --out plan.json",
        "record world.npz --ids 1 --state-at 5 --out run.mcap",
        "sweep sweep.yaml --store kept.store --processes 1",
    ):  # fmt: skip
        status, _, errors = called(command.split())
        if status:
            raise SystemExit(f"{command}: {errors}")
    Path(FILE).write_bytes(Path("world.npz").read_bytes())
    for policy in ("mrac", "per_cell"):  # compiled now: an input's time is its own
        for more in ("", " --return-to home", " --transit area"):
            called(f"evaluate world.npz --rollouts 64 --no-advice --policy {policy}{more}".split())
    called(["evaluate", "world.npz", "--rollouts", "64", "--plan", "plan.json", "--loop", "open"])
    for target in TARGETS:
        given = Path(target.changed).read_bytes() if target.changed else b""
        if target.changed and (answer := called(target.words, given))[0]:
            raise SystemExit(f"{target.command}: {answer[2]}")


@cache
def _parsed(words: tuple[str, ...], parse: Any = App.parse_args) -> Any:
    return parse(app, words)


def called(words: list[str], given: bytes = b"", *, anew: bool = True) -> tuple[int, str, str]:
    """(status, standard output, standard error) of a command with this standard input; `anew`: its words are parsed."""
    out, err = io.StringIO(), io.StringIO()
    known = (
        contextlib.nullcontext() if anew else mock.patch.object(App, "parse_args", lambda *_, **__: _parsed((*words,)))
    )
    with (
        mock.patch("sys.stdin", io.TextIOWrapper(io.BytesIO(given))), contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err), warnings.catch_warnings(), known,
    ):  # fmt: skip
        warnings.simplefilter("error")
        return run(words), out.getvalue(), err.getvalue()


def changed(data: bytes, kind: str, draw: random.Random) -> bytes:
    """A damaged or hostile form of a file."""
    for _ in range(draw.choice((1, 1, 1, 2, 5))):
        trees = {".json": _other_json, ".geojson": _other_json, ".jsonl": _other_lines, ".yaml": _other_yaml,
                 ".csv": _other_csv}  # fmt: skip
        try:
            data = (trees[kind] if kind in trees and draw.random() < 0.7 else _other_bytes)(data, draw)
        except (ValueError, TypeError, IndexError, RecursionError, yaml.YAMLError):  # no longer such a file
            data = _other_bytes(data, draw)
    return data


def _other_bytes(data: bytes, draw: random.Random) -> bytes:
    if not data:
        return draw.randbytes(20)
    at, length = draw.randrange(len(data)), draw.choice((1, 4, 32, len(data) // 2))
    piece = data[at : at + length]
    return draw.choice((
        lambda: data[:at] + bytes([data[at] ^ 1 << draw.randrange(8)]) + data[at + 1 :],
        lambda: data[:at],
        lambda: data[:at] + data[at + length :],
        lambda: data[:at] + piece + data[at:],
        lambda: data[:at] + bytes(len(piece)) + data[at + length :],
        lambda: data[:at] + b"\xff" * len(piece) + data[at + length :],
        lambda: data[:at] + str(draw.choice(HOSTILE)).encode("utf-8", "replace") + data[at + length :],
        lambda: data[:at] + draw.randbytes(length) + data[at + length :],
    ))()  # fmt: skip


def _other_json(data: bytes, draw: random.Random) -> bytes:
    return json.dumps(_other_tree(json.loads(data), draw)).encode()


def _other_yaml(data: bytes, draw: random.Random) -> bytes:
    return yaml.safe_dump(_other_tree(yaml.safe_load(data), draw), sort_keys=False).encode()


def _other_lines(data: bytes, draw: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    at = draw.randrange(len(lines))
    lines[at] = draw.choice((_other_json(lines[at], draw) + b"\n", lines[at] * 2, b"", draw.choice(lines)))
    return b"".join(lines)


def _other_csv(data: bytes, draw: random.Random) -> bytes:
    rows = [line.split(",") for line in data.decode().splitlines()]
    row = draw.choice(rows)
    row[draw.randrange(len(row))] = str(draw.choice(HOSTILE))
    return "\n".join(map(",".join, rows)).encode("utf-8", "replace")


def _other_tree(tree: Any, draw: random.Random) -> Any:
    """With one node replaced, left out, doubled, or taken from elsewhere."""
    places = list(_places(tree))
    if not places:
        return draw.choice(HOSTILE)
    inside, key = draw.choice(places)
    match draw.randrange(7):
        case 0:
            del inside[key]
        case 1 if isinstance(inside, dict):
            inside[draw.choice(("p", "map", "cells", "\u202e", "x" * 300, "seed"))] = inside[key]
        case 2:
            other, name = draw.choice(places)
            inside[key] = json.loads(json.dumps(other[name], default=str))
        case 3 | 4 | 5 if isinstance(number := inside[key], int | float):
            inside[key] = draw.choice((-number, number + 1, number / 2, number * 1.001, number * 1000, str(number)))
        case _:
            inside[key] = draw.choice(HOSTILE)
    return tree


def _places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of every node below the root."""
    for key in range(len(tree)) if isinstance(tree, list) else tree if isinstance(tree, dict) else ():
        yield tree, key
        yield from _places(tree[key])


@cache
def known(command: str) -> list[Any]:
    """The options of a command."""
    made = app[command].assemble_argument_collection(parse_docstring=False)
    return [one for one in made if one.name[:2] == "--" and one.name != "--b"]


def begun(command: str, draw: random.Random) -> list[str]:
    """A command and what it works on."""
    source = draw.choice(("world.npz", "world.npz", "geojson.yaml", FILE))
    words = {"generate": ["new.npz"], "results": ["kept.store"], "compare": [source, "world.npz"]}
    few = ["--rollouts", "64"] if command in ROLLED else []
    needed = {
        "record": ["--out", "new.mcap"],
        "export": ["--out", "new.csv"],
        "size": ["--target", "0.6"],
        "threats": ["--add"],
    }
    return [command, *words.get(command, [source]), *few, *needed.get(command, [])]


def options(draw: random.Random) -> list[str]:
    """A command with one to three of its options: some plausible, some hostile."""
    words = begun(draw.choice(COMMANDS), draw)
    for argument in draw.sample(known(words[0]), draw.choice((1, 2, 3))):
        if argument.hint is bool:
            words.append(argument.name)
        elif draw.random() < 0.3:
            words += [argument.name, str(draw.choice(HOSTILE))]
        else:
            words += [argument.name, draw.choice((*(argument.get_choices() or PLAUSIBLE), "1"))]
    return words


@cache
def pairs() -> list[tuple[str, Any, Any]]:
    """All pairs of options of all commands."""
    return [(name, *pair) for name in COMMANDS for pair in combinations(known(name), 2)]


def pair(number: int, draw: random.Random) -> list[str]:
    """A command with two of its options that take what is good for each alone."""
    command, *both = pairs()[number % len(pairs())]
    words = begun(command, draw)
    for argument in both:
        if argument.name in words:
            continue
        choices = [one for one in argument.get_choices() or () if one != "jax"]  # which compiles for half a minute
        good = draw.choice(choices) if choices else VALID.get(argument.name, "2")
        words += (
            [argument.name] if argument.hint is bool else [argument.name, "new" if argument.name == "--out" else good]
        )
    return words


def broken(number: int, valid: dict[str, tuple[bytes, int]]) -> list[str]:
    """What input `number` shows to be broken; files of the folder are as before, but for what the command writes."""
    target, draw = TARGETS[number % len(TARGETS)], random.Random(number)
    given = b""
    if target.changed:
        given, words = changed(valid[target.changed][0], Path(target.changed).suffix, draw), target.words
        Path(target.changed).write_bytes(given)
        if draw.random() < 0.5 and "--json" in words:
            words.remove("--json")
        if draw.random() < 0.01 and words[0] in ("evaluate", "sweep", "threats"):
            words += ["--out", "new"]
    else:
        words = options(draw) if target.name == "options" else pair(number // len(TARGETS), draw)
    found = list(_faults(words, given, target.changed))
    _restore(valid)
    return [f"{number} ({target.name}) {' '.join(words)!r}: {fault}" for fault in found]


def _faults(words: list[str], given: bytes, file: str) -> Iterator[str]:
    before, memory = {path.name for path in Path().iterdir()}, _most_memory()
    signal.setitimer(signal.ITIMER_PROF, SECONDS)  # of the processor: who shares it with others is not to blame
    signal.alarm(10 * SECONDS)
    try:
        status, out, err = called(words, given, anew=not file)
    except BaseException as error:  # the promise is that nothing gets here
        if not (isinstance(error, TooLong) and file == "sweep.yaml" and LONG.search(given)):
            yield traceback.format_exc()
        return
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
    if _most_memory() > memory + MEMORY:  # what others had in this process is not its own
        yield "more than 2 GiB"
    if status not in (0, 1, 2):
        yield f"status {status}"
    if "Traceback" in out + err or UNSEEN.search(out + err):
        yield f"a traceback or bytes that may not be shown: {(out + err)[:400]!r}"
    if status == 2:
        yield from _of_error(err, file, before)
        return
    if "--json" in words and words[0] != "drive":
        yield from _of_text("", ".json", out)
    for path in Path().rglob("*"):
        if path.parts[0] not in before and path.suffix in (".html", ".json", ".geojson", ".txt", ".csv", ".kml"):
            yield from _of_text(str(path), path.suffix, path.read_text())


def _of_text(name: str, suffix: str, text: str) -> Iterator[str]:
    """What is wrong in an answer, or in a file of one."""
    if suffix.endswith("json"):
        try:
            json.loads(text, parse_constant=_refuse)
        except ValueError as error:
            yield f"{name} no JSON, {error}: {text[:200]!r}"
    if UNSEEN.search(text):
        yield f"{name} holds bytes that may not be shown"
    if suffix == ".html" and (found := MARKUP.search(text)):
        yield f"{name} holds the input's markup: {text[found.start() - 100 : found.end() + 100]!r}"


def _most_memory() -> int:
    """Bytes that this process has had at most."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _of_error(err: str, file: str, before: set[str]) -> Iterator[str]:
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    if len(lines) != 1:
        yield f"{len(lines)} lines of error: {err[:400]!r}"
    elif file and not any(name in lines[0] for name in before):  # that of another file, where both do not fit
        yield f"names no file: {lines[0][:400]}"
    if more := {path.name for path in Path().iterdir() if not path.name.endswith(SQLITE)} - before:
        yield f"left behind: {more}"


def _refuse(word: str) -> None:
    raise ValueError(f"{word} in JSON")


def _restore(valid: dict[str, tuple[bytes, int]]) -> None:
    """The folder as it was: what is gone, or was written since, is written again."""
    there = {entry.name: entry for entry in os.scandir()}
    for name in there.keys() - valid.keys():
        _remove(Path(name))
    for name, (data, written) in valid.items():
        if name not in there or there[name].stat().st_mtime_ns != written:
            Path(name).write_bytes(data)
            os.utime(name, ns=(written, written))


def _remove(path: Path) -> None:
    if path.is_dir():
        for inside in path.iterdir():
            _remove(inside)
        path.rmdir()
    else:
        path.unlink()


class TooLong(BaseException):
    """Not an error that a command would mend."""


def _too_long(*_: object) -> None:
    raise TooLong(f"more than {SECONDS} s")


def fuzz(numbers: range, only: str = "") -> Iterator[str]:
    """What inputs of these numbers break, in a folder of its own."""
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _too_long)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        make_inputs()
        files = [path for path in Path().iterdir() if path.is_file() and not path.name.endswith(SQLITE)]
        valid = {path.name: (path.read_bytes(), path.stat().st_mtime_ns) for path in files}
        _restore(valid)
        for number in numbers:
            if not only or TARGETS[number % len(TARGETS)].name == only:
                yield from broken(number, valid)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=20_000)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    asked = parser.parse_args()
    found = 0
    for fault in fuzz(range(asked.first, asked.first + asked.count), asked.only):
        found += 1
        sys.stdout.write(f"{fault}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{asked.count} inputs from {asked.first}: {found} broken promises\n")
    return int(found > 0)


if __name__ == "__main__":
    sys.exit(main())
