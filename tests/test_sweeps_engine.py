"""The engine: however a sweep is run, split, resumed or interrupted, the store holds the same counts."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
import pytest
from pool_tasks import ENDS_WITH_US
from test_pool import below, kill
from test_sweeps_store import blocks_of

from analysis.sampling import RolloutChoices
from analysis.sweeps import cases as tasks
from analysis.sweeps import engine
from analysis.sweeps.cases import Case, Generated, Places, generated_case, run_key, run_task
from analysis.sweeps.engine import Done, Job, run_cases, share_of
from analysis.sweeps.store import Store
from analysis.sweeps.store_files import cut
from planner.arguments import BLOCK
from planner.errors import InputError, UsageError
from planner.plan.plan import Plan
from planner.rollouts.closed_loop import compile_closed_loop
from planner.rollouts.engine import closed_loop_engine, run_with_threshold_sums
from planner.rollouts.loop import ClosedLoop
from planner.settings import Choices
from planner.tally import Tally
from planner.world.world import World

MODELS = (RolloutChoices(seed=4), RolloutChoices(first_only=True, seed=4), RolloutChoices(loop="open", seed=4))


def jobs_of(maps: int = 4, rollouts: int = 30, robots: tuple[int, ...] = (1, 3)) -> Iterator[Job]:
    for seed in range(maps):
        for count in robots:
            yield Job(generated_case("contiguous", 0.2, count, seed, (8, 11)), MODELS, rollouts)


def build(case: Case) -> tuple[World, Plan]:
    team = Places().team(case)
    return team.world, team.build()


def facts_in(store: Store, key: str) -> Any:
    run = store.run(key)
    return None if run is None else run.facts


def counted(loop: ClosedLoop, count: int) -> Tally:
    """The tally of the first rollouts, as sweeps keep it."""
    return run_with_threshold_sums(closed_loop_engine(loop, 4, "numba"), 4, 0, count)[0]


def contents(store: Store) -> dict[str, tuple[Any, Tally | None]]:
    return {run.key: (run.facts, store.tally(run.key)) for run in store.runs()}


def swept(jobs: Iterator[Job], **where: Any) -> dict[str, tuple[Any, Tally | None]]:
    with Store() as store:
        run_cases(jobs, store, **where)
        return contents(store)


def test_counts_are_those_of_the_engines() -> None:
    case = generated_case("scattered", 0.3, 3, 2, (8, 11))
    world, plan = build(case)
    with Store() as store:
        run_cases([Job(case, MODELS, 50)], store, processes=1)
        keys = [run_key(Places().team(case), model) for model in MODELS]
        closed, first = (counted(compile_closed_loop(plan, world, first_only=only), 50) for only in (False, True))
        for key, right in zip(keys, (closed, first), strict=False):
            found = store.tally(key)
            assert all(np.array_equal(np.trim_zeros(a, "b"), np.trim_zeros(b, "b")) for a, b in _counts(found, right))
        assert closed == store.tally(keys[0])
        facts, open_loop = facts_in(store, keys[2]), store.tally(keys[2])
        values = np.arange(len(open_loop.visited))
        mean = float(open_loop.visited @ values) / 50
        spread = float(np.sqrt(open_loop.visited @ (values - mean) ** 2 / 49 / 50))
        assert abs(mean - facts["exact"]["visited"]) < 5 * spread + 1e-9
        assert facts["cells"]["accessible"] == len(open_loop.visited) - 1


def _counts(left: Tally, right: Tally) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    return ((values, right.counts()[name]) for name, values in left.counts().items())


def test_settings_of_a_team_share_its_areas_and_no_result_depends_on_that() -> None:
    asked = [
        Choices(), Choices(policy="per_cell"), Choices(policy="per_cell", risk_cap=0.25, robot_value=9.0),
        Choices(range=6), Choices(max_steps=12), Choices(density=1.5), Choices(risk="log"), Choices(levels=2),
    ]  # fmt: skip
    cases = [generated_case("scattered", 0.3, 4, seed, (8, 11), choices=one) for seed in range(2) for one in asked]
    before = tasks._allocated.cache_info().misses
    with Store() as store:
        run_cases([Job(case, MODELS[:1], 40) for case in cases], store, processes=1)
        assert tasks._allocated.cache_info().misses - before == 2 * 4
        for case in cases:
            team, key = Places().team(case), run_key(Places().team(case), MODELS[0])
            plan = team.build()
            assert facts_in(store, key) == tasks.facts_of(team, plan)
            assert store.tally(key) == counted(compile_closed_loop(plan, team.world), 40)
        assert len({json.dumps(facts_in(store, run_key(Places().team(case), MODELS[0]))) for case in cases}) > 8


def test_a_split_by_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    right = swept(jobs_of(), processes=1)
    assert len(right) == 4 * 2 * 3
    monkeypatch.setattr(engine, "SHARE", 7)
    monkeypatch.setattr(engine, "LEAST_SHARE", 7)
    assert swept(jobs_of(), processes=1) == right


def test_ids_are_split_into_blocks() -> None:
    assert cut(((10, 30), (4000, 9000)), BLOCK) == [(10, 30), (4000, 4096), (4096, 8192), (8192, 9000)]
    small, large = (Places().team(Case(Generated(size=(side, side)))) for side in (20, 300))
    assert share_of(small) == 4 * BLOCK and 64 <= share_of(large) < BLOCK
    case = generated_case(robots=1, seed=1, size=(4, 5))
    with Store() as store:
        run_cases([Job(case, MODELS[:1], 2 * BLOCK + 5)], store, processes=1)
        assert blocks_of(store) == [BLOCK, BLOCK, 5]


def test_resuming_and_a_bigger_run_that_reuses_the_smaller(tmp_path: Path) -> None:
    right = swept(jobs_of(rollouts=50), processes=1)
    with Store.open(tmp_path / "a.db") as store:
        run_cases(jobs_of(maps=2, rollouts=20), store, processes=1)
    with Store.open(tmp_path / "a.db") as store:
        seen: list[Done] = []
        done = run_cases(jobs_of(rollouts=50), store, processes=1, total=8, progress=seen.append)
        assert (done.jobs, done.reused, done.rollouts) == (8, 2 * 2 * 3 * 20, 8 * 3 * 50 - 2 * 2 * 3 * 20)
        assert contents(store) == right
        assert [step.jobs for step in seen] == list(range(1, 9)) and len(seen[0].keys) == 3
        assert run_cases(jobs_of(rollouts=50), store, processes=1).rollouts == 0


def test_bad_input_names_the_case() -> None:
    for robots in (0, 5000):
        with Store() as store, pytest.raises(InputError, match=rf"ratio=0.3 robots={robots} map=7.*expected"):
            run_cases([Job(generated_case(ratio=0.3, robots=robots, seed=7), MODELS, 5)], store, processes=1)
    bad = generated_case(robots=2, choices=Choices(density=0.5))
    with Store() as store, pytest.raises(InputError, match=r"robots=2 map=0.*density"):
        run_cases([Job(bad, MODELS, 5)], store, processes=2)
    for wrong in ({"processes": 0}, {"processes": 2, "scheduler": "tcp://host:1"}):
        with Store() as store, pytest.raises(UsageError):
            run_cases(jobs_of(), store, **wrong)
    with pytest.raises(UsageError):
        Job(generated_case(), MODELS, 0)


def test_a_team_is_made_once_a_job(monkeypatch: pytest.MonkeyPatch) -> None:
    made, make = list[Case](), Places._team

    def counted_team(self: Places, case: Case) -> Any:
        made.append(case)
        return make(self, case)

    monkeypatch.setattr(Places, "_team", counted_team)
    with Store() as store:
        run_cases([Job(generated_case(ratio=0.3, size=(4, 4)), MODELS[:2], 2)], store, processes=1)
    assert len(made) == 1


def test_interrupted_and_gone_on_with() -> None:
    def stop(step: Done) -> None:
        if step.jobs == 3:
            raise KeyboardInterrupt

    with Store() as store:
        first = run_cases(jobs_of(), store, processes=1, progress=stop)
        assert first.partial and len(store) == 9
        assert run_cases(jobs_of(), store, processes=1).reused == 9 * 30
        assert contents(store) == swept(jobs_of(), processes=1)


def test_parts_that_another_process_ran_meanwhile_are_run_again() -> None:
    case = generated_case(robots=1, seed=1, size=(4, 5))
    key = run_key(Places().team(case), MODELS[0])
    with Store() as store:
        stolen: list[bool] = []

        def jobs() -> Iterator[Job]:
            yield Job(case, MODELS[:1], 100)

        original = store.missing

        def missing(*args: Any) -> Any:
            found = original(*args)
            if not stolen:  # now the other process writes ids that overlap ours
                stolen.append(True)
                team = Places().team(case)
                wanted = tasks.RunRequest(key, MODELS[0], ((50, 120),))
                store.add(run_task(tasks.Task(case, team, (wanted,))))
            return found

        store.missing = missing  # type: ignore[method-assign]
        run_cases(jobs(), store, processes=1)
        assert store.held(key) == ((0, 120),) or store.held(key)[0][0] == 0
        assert not original(key, 0, 100)
        right = counted(compile_closed_loop(*reversed(build(case))), store.held(key)[0][1])
        assert store.tally(key) == right


def test_one_process_two_processes_and_a_killed_one_which_costs_only_what_was_in_flight() -> None:
    right = swept(jobs_of(maps=8), processes=1)
    killed: list[int] = []

    def kill_one(step: Done) -> None:
        if step.jobs == 3:
            victim = below(os.getpid())[-1]
            os.kill(victim, signal.SIGKILL)
            killed.append(victim)

    with Store() as store:
        run_cases(jobs_of(maps=8), store, processes=2, progress=kill_one)
        assert len(killed) == 1 and contents(store) == right


SWEEP = """if True:
    import sys
    sys.path.insert(0, "tests")
    from test_sweeps_engine import *
    ran = [0]
    def say(step):
        if step.rollouts > ran[0]:
            print("ran", flush=True)
        ran[0] = step.rollouts
    def main():
        with Store.open(sys.argv[1]) as store:
            print("begun", flush=True)
            run_cases(jobs_of(maps={maps}, rollouts={rollouts}), store, processes={processes}, progress=say)
    if __name__ == "__main__":
        main()
"""


def begin(path: Path, script: Path, **values: int) -> subprocess.Popen[bytes]:
    script.write_text(ENDS_WITH_US + SWEEP.format(**values))
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent)}
    return subprocess.Popen([sys.executable, str(script), str(path)], stdout=subprocess.PIPE, env=environment)


@pytest.mark.parametrize(("numbers", "seed"), [(range(1, 2), 1), pytest.param(range(20), 2, marks=pytest.mark.slow)])
def test_kill_9_at_random_moments(tmp_path: Path, numbers: range, seed: int) -> None:
    """kill -9 the client, or a worker and then the client; after each, and at the end, compare with the whole."""
    random, maps = np.random.default_rng(seed), 40 + 3 * len(numbers)  # processes get a dozen jobs at a time
    values = {"maps": maps, "rollouts": 30, "processes": 2}
    right = swept(jobs_of(maps=maps, rollouts=30), processes=1)
    path, before, middle = tmp_path / "a.db", 0, 0
    for number in numbers:
        running = begin(path, tmp_path / "sweep.py", **values)
        if number % 5 == 4:  # while it begins: imports, opening the store, starting processes
            sleep(random.uniform(0.0, 1.5))
        else:
            read_lines(running, int(random.integers(2, 6)))
        if number % 2:
            for victim in below(running.pid)[-1:]:
                kill(victim)
            read_lines(running, int(random.integers(0, 4)))
        sleep(random.uniform(0.0, 0.05))
        running.kill()
        running.wait()
        running.stdout.close()
        if path.exists() and path.stat().st_size:
            with Store.open(path, write=number % 3 == 0) as store:
                held = contents(store)
            assert len(held) >= before and all(right[key] == value for key, value in held.items())
            middle += before < len(held) < len(right)
            before = len(held)
    assert middle >= 0.6 * len(numbers)
    with Store.open(path) as store:
        run_cases(jobs_of(maps=maps, rollouts=30), store, processes=1)
        assert contents(store) == right


def read_lines(running: subprocess.Popen[bytes], count: int) -> None:
    for _ in range(count):
        running.stdout.readline()


def test_two_processes_on_one_store(tmp_path: Path) -> None:
    """The same sweep twice at once, one of them here, one with more rollouts: nothing doubled, nothing lost."""
    path = tmp_path / "a.db"
    running = begin(path, tmp_path / "a.py", maps=12, rollouts=50, processes=1)
    read_lines(running, 2)  # it has begun, and has run something
    with Store.open(path) as store:
        run_cases(jobs_of(maps=12, rollouts=20), store, processes=1)
    assert running.wait(120) == 0
    running.stdout.close()
    with Store.open(path) as store:
        assert contents(store) == swept(jobs_of(maps=12, rollouts=50), processes=1)


@pytest.mark.slow
def test_memory_is_flat_over_ten_thousand_settings(tmp_path: Path) -> None:
    """Resident memory between the thousandth and the last job of 10,000 different cases."""
    sizes: dict[int, int] = {}

    def jobs() -> Iterator[Job]:
        for seed in range(10_000):
            yield Job(generated_case("scattered", 0.2, 1, seed, (4, 5)), (RolloutChoices(seed=seed),), 5)

    def look(step: Done) -> None:
        if step.jobs in (1000, 10_000):
            sizes[step.jobs] = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    with Store.open(tmp_path / "a.db") as store:
        run_cases(jobs(), store, processes=1, total=10_000, progress=look)
        assert len(store) == 10_000
    assert sizes[10_000] - sizes[1000] < 8 * 2**20, sizes
