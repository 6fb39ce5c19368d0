"""Shared by all tests: the worlds with known answers, and random small worlds for property tests."""

import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st

from planner.make_plan import make_plan
from planner.plan.plan import Area, Plan
from planner.tally import WORDS_OF_0_3
from planner.world.world import World, load_world_file

FOLDER = Path(__file__).parent / "fixtures"
NAMES = sorted(path.stem for path in FOLDER.glob("*.json"))
ANSWERS: dict[str, Any] = json.loads((FOLDER / "rules" / "answers.json").read_text())
"""What simulators written from docs/spec.md alone, without code of the product, came to (`source` there)."""

settings.register_profile("default", deadline=None, derandomize=True, print_blob=True)
settings.register_profile("quick", settings.get_profile("default"), max_examples=40)
settings.load_profile("default")
gc.set_threshold(100_000, 50, 100)  # compilers make and drop many small objects: a tenth of their time was collecting
os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of child processes: threads that wait for work spin
sys.path.append(str(Path(__file__).parents[1] / "docs" / "examples"))  # the studies there are tested here
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # set, every process would compile all modules: a third of its start
os.environ.pop("COLUMNS", None)  # a worker of pytest-xdist has 80: output is as on a pipe
os.unsetenv("COLUMNS")  # readline, which pytest imports, sets it for child processes alone
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background: tests of Ctrl-C need it to arrive
    signal.signal(signal.SIGINT, signal.default_int_handler)


LANES = 16
"""Of most JAX engines of the closed loop in tests: a number of lanes is a program to compile."""


def pytest_configure(config: pytest.Config) -> None:
    """In the quick tests XLA compiles without its dear optimisations: half the CPU, and the same whole numbers.

    They stay in the slow tests. A flag that a release of XLA does not know ends the process, so others than those of
    JAX 0.10 get none.

    Before all tests run on several processes, the programs of the closed loop are compiled, each once.
    """
    if config.getoption("markexpr") == "not slow":
        settings.load_profile("quick")
    if config.getoption("markexpr") == "not slow" and version("jaxlib").startswith("0.10."):
        flags = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
        os.environ.setdefault("XLA_FLAGS", flags)
    several = (config.getoption("numprocesses", None) or 0) > 1 and not config.getoption("collectonly")
    if several and config.args_source is config.ArgsSource.TESTPATHS:  # the controller's alone: workers have no number
        script = Path(__file__).parent / "warm.py"
        for running in [subprocess.Popen([sys.executable, script, rule]) for rule in ("mrac", "per_cell")]:
            running.wait()


OPENINGS = (
    ("test_mrac_jax_open_loop", "test_environments"),
    ("test_mrac_jax_closed_loop", "test_mrac_jax_planted_faults"),
)
"""Files that compile most for JAX, with which the first worker and the second begin: neither compiles what the other
does."""


@pytest.hookimpl(trylast=True)  # what is deselected is gone
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The first worker of two is given the first half of the tests, the second the other; each begins with its files.

    Whatever is compiled goes to the cache folder, so that who needs it later has it. Where not all files are there,
    the order is left as it is.
    """
    openings: list[list[pytest.Item]] = []
    for names in OPENINGS:
        found = {name: [item for item in items if item.path.stem == name] for name in names}
        if not all(found.values()):
            return
        openings.append([item for of_one in found.values() for item in of_one])
    moved = {item for opening in openings for item in opening}
    rest = [item for item in items if item not in moved]
    middle = max(len(items) // 2 - len(openings[0]), 0)
    items[:] = [*openings[0], *rest[:middle], *openings[1], *rest[middle:]]


def pytest_sessionstart(session: pytest.Session) -> None:
    """A worker reads the programs by which nominal runs are compiled: a plan then takes a tenth of the time."""
    if hasattr(session.config, "workerinput") and session.config.args_source is session.config.ArgsSource.TESTPATHS:
        from warm import run_nominal

        for rule in ("mrac", "per_cell"):
            run_nominal(rule)


def pytest_collection_finish() -> None:
    """What is imported stays for good: collections of garbage need not look at it."""
    gc.freeze()


@cache
def keep_all_programs() -> None:
    """JAX's compiled programs are kept, small ones too: tests of environments compile the same ones again and again."""
    import jax

    from mrac_jax.runtime import keep_jax_programs

    keep_jax_programs()
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)


def pytest_runtest_setup() -> None:
    """Once somebody has imported JAX."""
    if "jax" in sys.modules:
        keep_all_programs()


EFFORTS = {
    "analysis.estimators.trial.EFFORT": 0.01,
    "analysis.evaluation.outputs.advice.FEWEST": 32.0,
    "analysis.theory.upper_bound.GAIN": 20.0,
    "analysis.theory.upper_bound.PATIENCE": 0.3,
    "analysis.theory.flow_programme.ROUNDS": 0.1,
    "analysis.theory.flow_programme.MOST": 0.1,
}
"""Factors of the quick tests: histories of an exact tree; fewest rollouts of a plan for which there are alternatives;
where the policy-independent upper bound ends.

Most evaluations in tests are about none of these. A tree that is found is the same; a bound is less sharp, but holds.
Processes that tests start make the full effort.
"""


@pytest.fixture(autouse=True, scope="session")
def little_effort(pytestconfig: pytest.Config) -> dict[str, float]:
    """The full ones."""
    full = {}
    for name, factor in EFFORTS.items():
        module, _, constant = name.rpartition(".")
        full[name] = getattr(import_module(module), constant)
        if pytestconfig.getoption("markexpr") == "not slow":
            setattr(import_module(module), constant, type(full[name])(factor * full[name]))
    return full


@pytest.fixture
def full_effort(little_effort: dict[str, float], monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests of exact values and bounds, and of other processes that find the same."""
    for name, value in little_effort.items():
        monkeypatch.setattr(name, value)


@pytest.fixture(scope="module")
def chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """One browser for all tests of a file: to start it is most of what a short one costs."""
    from page_reader import Browser

    with Browser(tmp_path_factory.mktemp("profile")) as found:
        yield found


@pytest.fixture
def browser(chromium: Any) -> Any:
    """The file's browser (`page_reader.Browser`) on an empty page."""
    chromium.clear()
    return chromium


@pytest.fixture
def few_lanes(monkeypatch: pytest.MonkeyPatch) -> None:
    """JAX's closed loop takes the program that the comparisons of engines have compiled."""
    monkeypatch.setattr("mrac_jax.closed_loop.engine.LANES", {"cpu": LANES, "gpu": LANES})


@pytest.fixture
def one_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the pictures of an evaluation's folder few are drawn: they have tests of their own."""
    room = import_module("analysis.evaluation.report")
    real, kept = room._pictures, ("world.png", "rest.png")
    few = lambda *given: {name: draw for name, draw in real(*given).items() if name in kept}  # noqa: E731
    monkeypatch.setattr(room, "_pictures", few)


@dataclass(frozen=True, eq=False)
class Fixture:
    """One world with its allocation and the answers of an independent simulator."""

    name: str
    world: World
    allocation: tuple[Area, ...]
    answers: dict[str, Any]

    @property
    def starts(self) -> np.ndarray:
        return np.array(self.answers["starts"])

    @cached_property
    def plan(self) -> Plan:
        """Of the paper's rule, on the fixture's own areas."""
        return make_plan(self.world, self.starts, allocation=self.allocation)


@cache
def load_fixture(name: str) -> Fixture:
    answers = json.loads((FOLDER / f"{name}.json").read_text())
    for figures in answers.keys() & {"closed_loop_exact", "closed_loop_sampled"}:  # which have the words of 0.3
        answers[figures] = {WORDS_OF_0_3.get(key, key): value for key, value in answers[figures].items()}
    world = load_world_file(FOLDER / answers["world"])
    allocation = tuple(Area(a["level"], a["robot"], np.array(a["cells"])) for a in answers["allocation"])
    return Fixture(name, world, allocation, answers)


@pytest.fixture(params=NAMES)
def fixture(request: pytest.FixtureRequest) -> Fixture:
    return load_fixture(request.param)


@st.composite
def worlds_with_starts(draw: st.DrawFn, most_side: int = 8, most_robots: int = 5) -> tuple[World, np.ndarray]:
    """A small world, rarely square, with obstacles and up to four levels, and robots on free cells."""
    shape = draw(st.tuples(st.integers(1, most_side), st.integers(1, most_side)))
    kinds = st.sampled_from([np.nan, 0.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.37])
    cells = draw(st.lists(kinds, min_size=shape[0] * shape[1], max_size=shape[0] * shape[1]))
    if np.isnan(cells).all():
        cells[0] = 0.0
    threat = np.array(cells, dtype=np.float32).reshape(shape)
    free = np.argwhere(~np.isnan(threat))
    chosen = draw(st.lists(st.integers(0, len(free) - 1), min_size=1, max_size=most_robots))
    return World.create(threat), free[chosen]
