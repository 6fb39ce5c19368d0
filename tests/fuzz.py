"""Damaged and hostile files, and options, against the promises of every command (`make fuzz`).

python tests/fuzz.py [--count N] [--first M] [--only TARGET]

Input number n is always the same one: of target n % len(TARGETS), changed by what `random.Random(n)` draws. Commands
run in this process. The promises: status 0, 1 or 2 within 20 s and 2 GiB; with 2 one line that begins `error:` and
names the file; no traceback; no control bytes or right-to-left marks; JSON is JSON; nothing is left half-written.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
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
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyogrio
import rasterio
import yaml
from PIL import Image

from analysis.cli.app import app, run

SECONDS, MEMORY = 20, 2 * 2**30
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


PLAUSIBLE = ("1", "2", "0.5", "20", "0,0;1,1", "1,2", "new.csv", "new", "plan.json", "40s", "6x6")
ROLLED = {"evaluate", "record", "compare", "check", "front", "size", "starts", "clear"}


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
    Target("recovery", "run.mcap", "recover run.mcap --out new.mcap --json"),
    Target("logged map", "run.mcap", "plan run.mcap --json --robots 2"),
    Target("drive", "lines.jsonl", "drive world.npz"),
    Target("options", "", ""),
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
wear: {shape: 2}
""",
    "unknown.yaml": "map: world.npz\nrobots: {count: 2}\nprior: {p: 0.04}\nsense: {range: 1, sight: true}\n",
    "movers.yaml": "map: world.npz\nrobots: {count: 2}\n"
    "movers: [{walk: 0.5, h: 0.2, count: 2}, {patrol: [[0, 0], [0, 1]], h: 0.6}]\n",
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
    "map.csv": "0,0,0.2,0\n0,nan,0,0.1\n0,0,0,0\n",
    "grid.map": "type octile\nheight 3\nwidth 4\nmap\n....\n.@..\n....\n",
    "zones.geojson": json.dumps({"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": {"p": 0.2, "name": "pond"},
         "geometry": {"type": "Polygon", "coordinates": [RING]}}]}),
    "zones.kml": '<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><name>pond</name><ExtendedData>'
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
    for target in TARGETS:
        given = Path(target.changed).read_bytes() if target.changed else b""
        if target.changed and (answer := called(target.words, given))[0]:
            raise SystemExit(f"{target.command}: {answer[2]}")


def called(words: list[str], given: bytes = b"") -> tuple[int, str, str]:
    """(status, standard output, standard error) of a command with this standard input."""
    out, err, before = io.StringIO(), io.StringIO(), sys.stdin
    sys.stdin = io.TextIOWrapper(io.BytesIO(given))
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("error")
            return run(words), out.getvalue(), err.getvalue()
    finally:
        sys.stdin = before


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


def options(draw: random.Random) -> list[str]:
    """A command with one to three of its options: some plausible, some hostile."""
    name = draw.choice(
        ("plan", "evaluate", "record", "compare", "generate", "check", "front", "size", "starts", "clear")
    )
    known = [one for one in app[name].assemble_argument_collection(parse_docstring=False) if one.name[:2] == "--"]
    words = [name, "new.npz" if name == "generate" else "world.npz"]
    for argument in draw.sample(known, draw.choice((1, 2, 3))):
        if argument.hint is bool:
            words.append(argument.name)
        elif draw.random() < 0.3:
            words += [argument.name, str(draw.choice(HOSTILE))]
        else:
            words += [argument.name, draw.choice((*(argument.get_choices() or PLAUSIBLE), "1"))]
    return words + (["--rollouts", "64"] if name in ROLLED else [])


def broken(number: int, valid: dict[str, bytes]) -> list[str]:
    """What input `number` shows to be broken; files of the folder are as before, but for what the command writes."""
    target, draw = TARGETS[number % len(TARGETS)], random.Random(number)
    words = target.words if target.changed else options(draw)
    given = b""
    if target.changed:
        given = changed(valid[target.changed], Path(target.changed).suffix, draw)
        Path(target.changed).write_bytes(given)
    found = list(_faults(words, given, target.changed))
    _restore(valid)
    return [f"{number} ({target.name}) {' '.join(words)}: {fault}" for fault in found]


def _faults(words: list[str], given: bytes, file: str) -> Iterator[str]:
    before, memory = {path.name for path in Path().iterdir()}, _most_memory()
    signal.alarm(SECONDS)
    try:
        status, out, err = called(words, given)
    except BaseException:  # the promise is that nothing gets here
        yield traceback.format_exc()
        return
    finally:
        signal.alarm(0)
    if _most_memory() > memory + MEMORY:  # what others had in this process is not its own
        yield "more than 2 GiB"
    if status not in (0, 1, 2):
        yield f"status {status}"
    if "Traceback" in out + err or UNSEEN.search(out + err):
        yield f"a traceback or bytes that may not be shown: {(out + err)[:400]!r}"
    if status == 2:
        yield from _of_error(err, file, before)
    elif "--json" in words and words[0] != "drive":
        try:
            json.loads(out, parse_constant=_refuse)
        except ValueError as error:
            yield f"no JSON, {error}: {out[:200]!r}"


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


def _restore(valid: dict[str, bytes]) -> None:
    """The folder as it was."""
    for path in Path().iterdir():
        if path.name not in valid:
            _remove(path)
    for name, data in valid.items():
        path = Path(name)
        if not path.exists() or path.read_bytes() != data:
            path.write_bytes(data)


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
    signal.signal(signal.SIGALRM, _too_long)
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        make_inputs()
        valid = {path.name: path.read_bytes() for path in Path().iterdir() if path.is_file()}
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
