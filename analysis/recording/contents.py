"""Attachments and metadata of a recording, written and read with checks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from analysis.recording.container import Log, LogMessage, open_log
from analysis.recording.viewers.topics import DATA_TOPICS, OWN
from analysis.theory.bounds import Bounds
from planner.arguments import MAX_PLAN_BYTES, is_whole
from planner.errors import InputError
from planner.files import npz_bytes, unpack_npz
from planner.json_objects import WithKeys, as_json
from planner.plan.plan import Plan
from planner.plan.plan_file import parse_plan
from planner.simulator.codes import Outcome
from planner.tally import COUNTS_OF_0_3, Tally, Trace, counts_by_word, counts_of_words
from planner.world.world import MAX_CELLS, MAX_ROBOTS, World, world_of

FORMAT, VERSION = "mrac-recording", 2
"""Version 2 added drawn topics (/areas_voxels and the robots' voxels); the data topics are those of version 1."""
METADATA = "mrac-jax"
_TOLD = ("format", "version", "mrac_jax", "loop", "luck", "threat_checks", "seed", "ids", "evaluated",
         "step_seconds")  # fmt: skip
"""Settings that are also in the metadata record."""
WORLD, PLAN, SETTINGS, TALLY, TALLY_CELLS = "world.npz", "plan.json", "settings.json", "tally.json", "tally-cells.npz"
BOUNDS, SCENARIO, LAYOUT = "bounds.json", "scenario.yaml", "layout.json"
AXES = Tally.axes()
"""Counts of a tally with one number for each cell go into `tally-cells.npz`."""
MOST_RECORDED = 10_000
"""Largest number of rollouts in full in one file."""
STEP_SECONDS = (1e-6, 500.0)
"""Limits of seconds per step: the longest rollout stays below the 2**31 s of a ROS time."""


@dataclass(frozen=True)
class Settings(WithKeys):
    """Settings of a recording: everything that messages depend on, except world and plan.

    Attributes:
        mrac_jax: version of the program that wrote it.
        loop: "closed" or "open". threat_checks: "every_visit" or "first_visit". seed: of the rollouts.
        ids: the rollouts in full, in the file's order.
        picks: the rollout selected by each `--pick`.
        evaluated: rollouts of the tally, ids from 0; 0: only the rollouts in full.
        outcomes: whether every evaluated rollout's outcome is in the file.
        step_seconds: time of a step.
        plan: "made": by the planner, from the world and the plan's settings; "given": from a plan file.
        version: of the format. Drawn topics differ between versions, data topics do not.
        per_visit: whether random numbers for each visit decided losses, as in files before 0.3, which do not state it;
            such files are read but not replayed.
    """

    loop: Literal["closed", "open"]
    threat_checks: Literal["every_visit", "first_visit"]
    seed: int
    ids: tuple[int, ...]
    picks: dict[str, int]
    evaluated: int
    outcomes: bool
    step_seconds: float
    plan: Literal["made", "given"]
    mrac_jax: str = ""
    version: int = VERSION
    per_visit: bool = False
    format = FORMAT
    json_keys = """
        format version loop threat_checks seed ids picks evaluated outcomes step_seconds plan mrac_jax *random_numbers
    """

    @property
    def random_numbers(self) -> dict[Literal["luck"], str]:
        """What the random numbers belong to: visits ("step"), or robots ("tolerance")."""
        return {"luck": "step" if self.per_visit else "tolerance"}


def own_version() -> str:
    """Version of this program."""
    return version("mrac-jax")


def json_bytes(value: object) -> bytes:
    """JSON text, the same for the same value."""
    return json.dumps(value, allow_nan=False, indent=1, sort_keys=False).encode() + b"\n"


def plan_bytes(plan: Plan) -> bytes:
    """The plan file (docs/spec.md section 9)."""
    return json.dumps(plan.to_json(), separators=(",", ":")).encode() + b"\n"


def bounds_bytes(bounds: Bounds) -> bytes:
    """All formulas, by the names of `analysis.theory.bounds.Bounds`; undefined values are null."""
    return json_bytes(as_json(asdict(bounds)))


def tally_bytes(tally: Tally, deadline: bool = False) -> tuple[bytes, bytes]:
    """(JSON, NumPy archive) of a tally: key, ids and histograms; and the counts by cell.

    `deadline`: whether the deadline, not the step limit, ends rollouts.
    """
    counts = tally.counts()
    said = {
        "key": tally.key,
        "shape": list(tally.shape),
        "ids": [list(span) for span in tally.ids],
        "rollouts": tally.rollouts,
        "outcomes": counts_by_word(tally.outcomes, deadline),
        **{name: array.tolist() for name, array in counts.items() if AXES[name] not in ("cell", "outcome")},
    }
    text = json.dumps(said, separators=(",", ":")).encode() + b"\n"
    return text, npz_bytes(**{name: array for name, array in counts.items() if AXES[name] == "cell"})


def read_tally(text: bytes, cells: bytes, source: str) -> Tally:
    """The tally of `tally_bytes`. Raises InputError."""
    try:
        said = {COUNTS_OF_0_3.get(name, name): value for name, value in json.loads(text).items()}
        arrays = unpack_npz(cells, 64 * MAX_CELLS, source)
        counts = {
            name: arrays[name] if axis == "cell" else said[name] for name, axis in AXES.items() if name in said | arrays
        }
        counts["outcomes"] = counts_of_words(said["outcomes"])
        return Tally(
            key=str(said["key"]),
            shape=(int(said["shape"][0]), int(said["shape"][1])),
            ids=tuple((int(start), int(stop)) for start, stop in said["ids"]),
            **{name: np.asarray(values, dtype=np.int64) for name, values in counts.items()},
        )
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{TALLY}: not a tally ({_short(error)})", source=source) from error


def read_world(data: bytes, source: str) -> World:
    """The world of a world file. Raises InputError."""
    where = f"{source} ({WORLD})"
    return world_of(unpack_npz(data, 8 * MAX_CELLS, where), where)


def read_plan(data: bytes, world: World, source: str) -> Plan:
    """The plan of `plan_bytes`, checked against the world. Raises InputError."""
    where = f"{source} ({PLAN})"
    if len(data) > MAX_PLAN_BYTES:
        raise InputError(f"{len(data)} bytes", source=where, expected=f"at most {MAX_PLAN_BYTES}")
    return parse_plan(read_json(data, where), world, where)


def read_settings(data: bytes, source: str) -> Settings:
    """The settings of `settings.json`, every value checked. Raises InputError."""
    where = f"{source} ({SETTINGS})"
    given = read_json(data, where)
    if not isinstance(given, dict) or given.get("format") != FORMAT:
        raise InputError("is not a recording of mrac-jax", source=where, expected=f'"format": "{FORMAT}"')
    if not is_whole(given.get("version"), 1, VERSION):
        problem = f"recording version {given.get('version')!r}"[:80]
        raise InputError(problem, source=where, expected=f"1 to {VERSION}", fix="read it with a newer mrac-jax")
    kinds = {
        "loop": lambda v: v in ("closed", "open"),
        "threat_checks": lambda v: v in ("every_visit", "first_visit"),
        "seed": lambda v: is_whole(v, 0, 2**64 - 1),
        "ids": lambda v: isinstance(v, list) and 1 <= len(v) <= MOST_RECORDED and all(map(_is_id, v)),
        "picks": lambda v: isinstance(v, dict) and all(map(_is_id, v.values())),
        "evaluated": lambda v: is_whole(v, 0, 2**32),
        "outcomes": lambda v: isinstance(v, bool),
        "step_seconds": lambda v: isinstance(v, int | float) and STEP_SECONDS[0] <= v <= STEP_SECONDS[1],
        "plan": lambda v: v in ("made", "given"),
        "mrac_jax": lambda v: isinstance(v, str),
        "luck": lambda v: v in ("tolerance", "step"),
    }
    # Files before 0.3 lack the key.
    given.setdefault("luck", "step")
    for name, is_right in kinds.items():
        if name not in given or not is_right(given[name]):
            problem = f"{name} is {_short(repr(given.get(name)))}"
            raise InputError(problem, source=where, expected="a value as `record` writes it")
    values = {name: given[name] for name in (*kinds, "version") if name != "luck"}
    values["ids"], values["step_seconds"] = tuple(given["ids"]), float(given["step_seconds"])
    return Settings(**values, per_visit=given["luck"] == "step")


def read_json(data: bytes, source: str) -> Any:
    """JSON text. Raises InputError."""
    try:
        return json.loads(data)
    except (ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"invalid JSON ({_short(error)})", source=source) from None


def metadata_of(settings: Settings, world: World, robots: int) -> dict[str, str]:
    """The metadata record: the settings as text, for tools that display it."""
    ids = [str(one) for one in settings.ids]
    said = settings.to_json() | {"ids": ",".join(ids if len(ids) <= 1000 else [*ids[:1000], "..."])}
    return {name: str(said[name]) for name in _TOLD} | {
        "rows": str(world.shape[0]),
        "columns": str(world.shape[1]),
        "robots": str(robots),
        "world_sha256": world.sha256,
    }


def _is_id(value: object) -> bool:
    return is_whole(value, 0, 2**32 - 1)


def _short(error: object) -> str:
    return " ".join(str(error).split())[:120]


# Readers: every rollout in full as a trace, and the outcomes of all evaluated ones.

MOST_VALUES, MOST_EVENTS = 2**25, 2**22
"""Limits of the numbers of one rollout's steps (steps x robots), and of its events, when reading."""
OUTCOME_COLUMNS = ("visited", "survived", "time", "alive", "outcome")
MOST_OUTCOMES = 2**27
"""Limit of outcomes when reading."""


@dataclass(frozen=True, eq=False)
class RecordedRollout:
    """A recorded rollout. Axis letters: `T` = time + 1 steps, `K` robots.

    Attributes:
        trace: the rollout, equal to the engine's trace.
        times: int64 `[T]`, nanoseconds of each step in the file.
        visited, survived, alive, unassigned: int64 `[T]`, at the end of each step: cells so far, robots, areas.
        loop: "closed" or "open". seed: of the rollouts. shape: (H, W). accessible: number of accessible cells.
    """

    trace: Trace
    times: NDArray[np.int64]
    visited: NDArray[np.int64]
    survived: NDArray[np.int64]
    alive: NDArray[np.int64]
    unassigned: NDArray[np.int64]
    loop: str
    seed: int
    shape: tuple[int, int]
    accessible: int


@dataclass(frozen=True, eq=False)
class RecordedOutcomes:
    """The results of all evaluated rollouts, in order of ids. Axis `B` = rollouts.

    Attributes:
        ids: int64 `[B]`. visited, survived: int32 `[B]`, cells. time: int32 `[B]`, steps. alive: int32 `[B]`.
        outcome: int8 `[B]`, values of `planner.simulator.codes.Outcome`.
    """

    ids: NDArray[np.int64]
    visited: NDArray[np.int32]
    survived: NDArray[np.int32]
    time: NDArray[np.int32]
    alive: NDArray[np.int32]
    outcome: NDArray[np.int8]


def read_rollouts(source: str | Path | Log) -> Iterator[RecordedRollout]:
    """The rollouts of a recording, one after the other; one is in memory at a time.

    Incomplete rollouts of a partial or recovered recording are omitted. Raises InputError.
    """
    log = source if isinstance(source, Log) else open_log(source)

    def broken(problem: str) -> None:
        if not log.partial:
            raise InputError(problem, source=log.path)

    collected: _Collected | None = None
    for message in log.messages(DATA_TOPICS):
        decoded = decode(message, log.path)
        if message.topic == "/rollout/start":
            if collected is not None:
                broken(f"rollout {collected.start.rollout} has no end")
            collected = _Collected(decoded, log.path)
        elif collected is None or not collected.add(message, decoded):
            broken(f"{message.topic}: belongs to no rollout that has begun")
            collected = None
        elif message.topic == "/rollout/end":
            # Only a rollout with all its steps is returned.
            if decoded.time + 1 == len(collected.steps):
                yield collected.finish(decoded)
            else:
                broken(f"rollout {decoded.rollout} is incomplete")
            collected = None
    if collected is not None:
        broken(f"rollout {collected.start.rollout} has no end")


def read_outcomes(source: str | Path | Log) -> RecordedOutcomes:
    """All outcomes that `record --outcomes` wrote, none without that option. Raises InputError.

    Memory: 25 bytes for each rollout.
    """
    log = source if isinstance(source, Log) else open_log(source)
    kinds = dict.fromkeys(OUTCOME_COLUMNS, np.int32) | {"outcome": np.int8}
    ids, columns = [np.zeros(0, dtype=np.int64)], {name: [np.zeros(0, dtype=kind)] for name, kind in kinds.items()}
    last = -1
    for message in log.messages(("/outcomes",)):
        block = decode(message, log.path)
        if len({len(getattr(block, name)) for name in kinds}) != 1:
            raise InputError("/outcomes: columns of unequal length", source=log.path)
        if not last < block.first < 2**32:
            raise InputError("/outcomes: ids out of order", source=log.path)
        ids.append(np.arange(len(block.outcome), dtype=np.int64) + block.first)
        last = block.first + len(block.outcome) - 1
        if last >= MOST_OUTCOMES:
            raise InputError(f"more than {MOST_OUTCOMES} outcomes", source=log.path)
        for name, kind in kinds.items():
            columns[name].append(np.array(getattr(block, name), dtype=np.int64).astype(kind))
    return RecordedOutcomes(np.concatenate(ids), **{name: np.concatenate(parts) for name, parts in columns.items()})


def decode(message: LogMessage, source: Path) -> Any:
    """One of the project's own messages. Raises InputError for other messages."""
    kind = OWN[message.topic]
    name = None if message.schema is None else message.schema.name
    if name != kind.DESCRIPTOR.full_name or message.channel.message_encoding != "protobuf":
        raise InputError(f"{message.topic} holds {name!r}"[:200], source=source, expected=kind.DESCRIPTOR.full_name)
    try:
        return kind.FromString(bytes(message.data))
    except DecodeError as error:
        raise InputError(f"{message.topic}: an invalid message", source=source) from error


class _Collected:
    """The messages of one rollout so far."""

    def __init__(self, start: Any, source: Path) -> None:
        self.start, self._source = start, source
        self._times: list[int] = []
        self.steps: list[Any] = []
        self._events: list[tuple[int, int, int, int, int]] = []
        if not 1 <= start.robots <= MAX_ROBOTS or start.height * start.width > MAX_CELLS:
            self._refuse(f"rollout {start.rollout}: {start.robots} robots on {start.height} x {start.width} cells")

    def _refuse(self, problem: str) -> None:
        raise InputError(problem, source=self._source, expected="values as `record` writes them")

    def add(self, message: LogMessage, decoded: Any) -> bool:
        """Add a message; False if it is out of order."""
        robots = self.start.robots
        if decoded.rollout != self.start.rollout:
            return False
        if message.topic == "/rollout/step":
            if {len(decoded.cells), len(decoded.doing), len(decoded.areas)} != {robots}:
                self._refuse(f"step {decoded.step} of rollout {decoded.rollout}: not {robots} robots")
            if decoded.step != len(self.steps):
                return False
            self.steps.append(decoded)
            self._times.append(message.log_time)
        elif message.topic == "/rollout/event":
            self._events.append((decoded.step, decoded.robot, decoded.kind, decoded.area, decoded.other))
        if len(self.steps) * robots > MOST_VALUES or len(self._events) > MOST_EVENTS:
            self._refuse(f"rollout {decoded.rollout}: more than {MOST_VALUES} numbers or {MOST_EVENTS} events")
        return True

    def finish(self, end: Any) -> RecordedRollout:
        """The rollout, once all its steps are there."""
        start = self.start
        if end.outcome not in tuple(Outcome) or len(end.area_of) != start.height * start.width:
            self._refuse(f"the end of rollout {end.rollout}")
        cells, areas = (self._of_steps(name).astype(np.int32) for name in ("cells", "areas"))
        events = np.array(self._events, dtype=np.int64).astype(np.int32).reshape(-1, 5)
        area_of, doing = np.array(end.area_of, dtype=np.int32), self._of_steps("doing").astype(np.int8)
        trace = Trace(end.rollout, cells, doing, areas, events, area_of, Outcome(end.outcome))
        figures = {name: self._of_steps(name) for name in ("visited", "survived", "alive", "unassigned")}
        times, shape = np.array(self._times, dtype=np.int64), (start.height, start.width)
        return RecordedRollout(trace, times, **figures, loop=start.loop, seed=start.seed, shape=shape,
                               accessible=start.accessible)  # fmt: skip

    def _of_steps(self, name: str) -> NDArray[np.int64]:
        return np.array([getattr(step, name) for step in self.steps], dtype=np.int64)
