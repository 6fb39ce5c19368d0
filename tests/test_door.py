"""The front door, `import mrac_jax as mrac`: names, laziness, the everyday jobs, errors in its own words."""

import os
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import ROOT, error_of

import mrac_jax as mrac
from analysis.checking.check import make_survey
from analysis.inputs import Asked, load_task
from analysis.sampling import RolloutChoices
from analysis.search.team_size import make_goal
from planner.arguments import COMMAND_LINE, Numbers, argument, is_real, is_whole, nearest
from planner.errors import InputError, PlanError, RenamedWarning, UsageError, WorldError
from planner.make_plan import make_plan
from planner.settings import Choices, Settings
from planner.world.generate import ThreatPattern, random_world
from planner.world.start_rule import place_starts
from planner.world.world import World

# The front door, `import mrac_jax as mrac`: names, laziness, the five everyday jobs, and other people's packages.

REFERENCE = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
STRANGERS = {"planner.py": "raise RuntimeError('not yours')\n", "analysis/__init__.py": "raise RuntimeError('nor I')\n"}


def run_door(words: list[str], **given: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *words], capture_output=True, text=True, timeout=300, **given)  # type: ignore[call-overload]


def strangers_in(folder: Path) -> dict[str, str]:
    """The environment of somebody whose own `planner` and `analysis` come first."""
    for name, text in STRANGERS.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    return os.environ | {"PYTHONPATH": str(folder)}


def test_every_name_is_there_and_documented() -> None:
    assert set(mrac.__all__) - {"read_outcomes"} == set(dir(mrac))
    for name in mrac.__all__:
        assert getattr(mrac, name).__doc__, name
        assert re.search(rf":members: .*\b{name}\b|`mrac.{name}`", REFERENCE), name
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mrac.nothing


def test_names_of_release_0_3_work_with_one_warning_and_are_not_listed() -> None:
    assert len(dir(mrac)) <= 30 and not set(mrac.OF_0_3) & set(dir(mrac))
    world = mrac.load([[0.0, 0.2, 0.0, 0.1]])
    calls: dict[str, Callable[[Callable[..., Any]], Any]] = {
        "attack": lambda old: old(world, 1, count=2, p=0.3, rollouts=16, progress=False).known.threats,
        "clear": lambda old: old(world, 1, count=1, remove="areas", rollouts=16, progress=False).picks,
        "mission": lambda old: old(world, 1).orders,
        "reproduce": lambda old: old("fig4", maps=1, rollouts=1, processes=1, progress=False).points,
        "to_networkx": lambda old: old(world).nodes,
        "with_hazard": lambda old: old(world, "persistent", 0.5).uncertainty,
        "with_maps": lambda old: old(world, [world.threat]).uncertainty,
        "with_movers": lambda old: old(world, [{"walk": 0.5, "h": 0.2}]).moving_threats,
        "with_phases": lambda old: old(world, [(3, [[0, 0, 0, 0]])]).phases,
        "with_prior": lambda old: old(world, 0.1, sense=1).knowledge,
        "with_sense": lambda old: old(world.with_prior_map(0.1), 2).knowledge,
        "with_spread": lambda old: old(world, "lognormal", 0.3).uncertainty,
        "with_truth": lambda old: old(world, world).knowledge,
    }
    assert set(calls) == set(mrac.OF_0_3)
    for name, call in calls.items():
        with pytest.warns(RenamedWarning, match=rf"mrac_jax.{name} is now mrac_jax\.\w"):
            old = getattr(mrac, name)
        assert call(old), name
    with pytest.warns(RenamedWarning, match="`first_visit` is now `threat_checks`"):
        answer = mrac.evaluate(world, 1, rollouts=16, advice=False, band=False, first_visit=True)
    assert answer.choices.first_only


def test_the_door_imports_nothing_until_it_is_asked() -> None:
    code = (
        "import sys, mrac_jax; heavy = {'numpy', 'jax', 'numba', 'matplotlib', 'scipy', 'rich'} & set(sys.modules);"
        "assert not heavy, heavy; mrac_jax.World; assert 'numpy' in sys.modules;"
        "assert not {'jax', 'numba', 'matplotlib'} & set(sys.modules)"
    )
    done = run_door(["-c", code], cwd=ROOT)
    assert done.returncode == 0, done.stderr


def test_no_room_hides_a_function_of_the_door() -> None:
    rooms = {found.name for found in pkgutil.iter_modules(mrac.__path__)}
    assert rooms & set(mrac.__all__) == {"functional", "env"}  # a module by either name; a package that is called
    assert mrac.functional.__name__ == "mrac_jax.functional"
    assert mrac.plots.__name__ == "analysis.plots"
    from mrac_jax.env import making

    assert making.__name__ == "mrac_jax.env.making" and mrac.env is sys.modules["mrac_jax.env"]
    with pytest.raises(UsageError, match="did you mean 'actions'"):
        mrac.env(mrac.load([[0.0, 0.1]]), actionz="areas")


def test_five_jobs_with_one_import(tmp_path: Path) -> None:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7], threat[0, 8] = 0.2, np.nan
    world = mrac.load(threat)
    plan = mrac.plan(world, robots=2)
    answer = mrac.evaluate(world, plan, rollouts=4096)
    assert 0 < answer.tally.rollouts == 4096
    other = mrac.compare((world, plan), (world, mrac.plan(world, robots=3)), rollouts=4096)
    assert other.difference("visited").estimate.mean > 0
    figure = mrac.plots.world_figure(answer)
    figure.savefig(tmp_path / "world.png")
    assert (tmp_path / "world.png").stat().st_size > 1000
    done = mrac.record(world, plan, tmp_path / "run.mcap", ids=[3])
    (rollout,) = mrac.read_rollouts(done.path)
    assert rollout.trace.rollout == 3


def test_a_scenario_brings_its_team(tmp_path: Path) -> None:
    np.save(tmp_path / "danger.npy", np.zeros((4, 5)))
    (tmp_path / "s.yaml").write_text("map: danger.npy\nlevels: 3\nrobots: {count: 3}\n")
    plan = mrac.plan(mrac.load(tmp_path / "s.yaml"))
    assert len(plan.robots) == 3
    assert plan.settings.levels == 3
    assert len(mrac.plan(mrac.load("example:paper")).robots) == 1
    with pytest.raises(mrac.InputError):
        mrac.plan(mrac.load("example:paper"), starts=[[999, 0]])


WORLD = np.full((3, 4), 0.1)
WRONG = {
    "ragged": (lambda world, plan: mrac.load([[0.1, 0.2], [0.3]]), "in rows of one length"),
    "name": (lambda world, plan: mrac.plan("example:paper"), "world='example:paper'; expected a World"),
    "array": (lambda world, plan: mrac.evaluate(WORLD), "world=array"),
    "size": (lambda world, plan: mrac.size(WORLD, target=0.5), "expected a World"),
    "side": (lambda world, plan: mrac.compare((world, plan), world), "b=World"),
    "file": (lambda world, plan: mrac.record(world, plan, "run.txt", ids=[0]), "run.txt does not end in .mcap"),
    "negative": (
        lambda world, plan: mrac.evaluate(world, plan, threat_scale=[-1]),
        "threat_scale=-1; expected numbers",
    ),
    "nan": (lambda world, plan: mrac.evaluate(world, plan, threat_scale=[np.nan]), "threat_scale=nan"),
    "word": (lambda world, plan: mrac.evaluate(world, plan, threat_scale=["much"]), "threat_scale='much'"),
    "text": (lambda world, plan: mrac.plan(world, "3"), "robots='3'; expected a whole number"),
    "two teams": (lambda world, plan: mrac.plan(world, 2, starts=[[0, 0]] * 3), "robots=2 contradicts the 3 starts"),
    "obstacle": (
        lambda world, plan: mrac.plan(mrac.load([[0, np.nan]]), starts=[[0, 1]]),
        "use robots instead of starts",
    ),
    "other map": (lambda world, plan: mrac.evaluate(mrac.load([[0, 0.1]]), plan), "plan for another map: made for 3x4"),
    "its side": (
        lambda world, plan: mrac.compare((world, plan), (mrac.load([[0, 0.1]]), plan)),
        "plan for another map",
    ),
    "no file": (lambda world, plan: mrac.read_plan("none.json", world), "none.json: no such file"),
    "keyword": (
        lambda world, plan: mrac.evaluate(world, plan, robots=5),
        "evaluate has no argument 'robots'; expected one of policy, state, rollouts",
    ),
    "robots": (lambda world, plan: mrac.evaluate(world, robots=5), "; give plan=5, the number of robots to plan for"),
    "robots of check": (lambda world, plan: mrac.check(world, robots=5), "; give plan=5, the number of robots to"),
    "of front": (lambda world, plan: mrac.evaluate(world, losses=1), "; it is an argument of front"),
    "of plan": (
        lambda world, plan: mrac.check(world, policy="per_cell"),
        "; give it to `plan`, and the plan to `check`",
    ),
    "misspelt of front": (lambda world, plan: mrac.evaluate(world, loses=1), "did you mean 'losses', an argument of"),
    "plural": (
        lambda world, plan: mrac.front(world, 2, robot_value=3),
        "did you mean 'robot_values'? robot_value is an argument of",
    ),
    "of an environment": (lambda world, plan: mrac.env(world, 2, actionz="areas"), "did you mean 'actions'?"),
    "both threats": (lambda world, plan: mrac.threats(world, remove=1, add=1), "threats needs remove or add"),
    "unit": (lambda world, plan: mrac.threats(world, add=1, unit="areas"), "unit='areas' with add"),
    "two checks": (lambda world, plan: mrac.check(world, paper="fig4"), "both a world and paper are given"),
    "maps": (lambda world, plan: mrac.check(world, maps=9), "maps is for paper; leave it out"),
    "no value": (
        lambda world, plan: mrac.plots.left_figure(mrac.evaluate(world, rollouts=64, advice=False)),
        "the evaluation has no left.png; expected a world with values: `value:` in its scenario, or load(..., value=",
    ),
    "misspelt": (lambda world, plan: mrac.evaluate(world, plan, rolouts=5), "did you mean 'rollouts'?"),
    "quantile": (
        lambda world, plan: mrac.evaluate(world, rollouts=9).visited.quantile(5),
        "q=5; expected a fraction, 0 to 1; did you mean 0.05?",
    ),
    "percent": (lambda world, plan: mrac.evaluate(world, rollouts=9).visited.at_least(90), "did you mean 0.9?"),
    "target": (lambda world, plan: mrac.size(world, target=90), "did you mean 0.9?"),
    "front": (lambda world, plan: mrac.front(world, 2, target=90), "did you mean 0.9?"),
    "all lost": (lambda world, plan: mrac.front(world, 2, losses=99), "losses=99; expected at most 2"),
    "singles": (
        lambda world, plan: mrac.evaluate(world, rollouts=9).singles(-1),
        "most=-1; expected how many rollouts",
    ),
    "is a file": (
        lambda world, plan: mrac.evaluate(world, rollouts=9).save(__file__),
        f"folder {__file__} cannot be written",
    ),
    "of a log": (lambda world, plan: mrac.load("a.mcap", topic="/map"), "`map: {file: ..., topic: ...}`"),
    "of a scenario": (
        lambda world, plan: mrac.load(WORLD, unknown="free"),
        "scenario: `unknown: ...` next to `map: ...",
    ),
    "scenario": (lambda world, plan: mrac.load("example:terrain", cell_size=1), "leave cell_size out"),
}


@pytest.mark.parametrize("name", WRONG)
def test_easy_mistakes_are_told(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    world = mrac.load(WORLD)
    call, said = WRONG[name]
    with pytest.raises(mrac.InputError) as raised:
        call(world, mrac.plan(world))
    assert said in str(raised.value)
    assert not list(tmp_path.iterdir())


def test_a_plan_is_a_plan_its_file_or_a_number_of_robots(tmp_path: Path) -> None:
    world = mrac.load(WORLD)
    plan, file = mrac.plan(world, 2), tmp_path / "plan.json"
    plan.save(file)
    loaded = mrac.read_plan(file, world)
    assert [robot.path.tolist() for robot in loaded.robots] == [robot.path.tolist() for robot in plan.robots]
    ways = (plan, file, str(file), 2)
    means = {mrac.evaluate(world, way, rollouts=1e3, advice=False).visited.mean for way in ways}  # type: ignore[arg-type]
    assert len(means) == 1
    for way in ways:
        same = mrac.compare((world, way), (world, plan), rollouts=100)
        assert same.difference("visited").estimate.mean == 0
        assert mrac.export(world, way, tmp_path / "paths.csv", force=True)
    alone = tmp_path / "paths.json"
    alone.write_text("[[[0, 0], [0, 1]]]")
    assert mrac.compare((world, 1), (world, alone), rollouts=100).b.choices.loop == "open"  # as `evaluate` takes paths


def test_the_command_line_outlives_other_peoples_packages(tmp_path: Path) -> None:
    environment = strangers_in(tmp_path)
    script = str(Path(sys.executable).parent / "mrac-jax")
    done = run_door([script, "generate", "w.npz", "--size", "4x5"], cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr
    (tmp_path / "s.yaml").write_text("base: {input: w.npz}\nrollouts: 10\nsweep: {robots: [1]}\n")
    done = run_door(["-m", "mrac_jax", "sweep", "s.yaml", "--processes", "2"], cwd=tmp_path, env=environment)
    assert done.returncode == 0, done.stderr


def test_the_door_names_the_package_that_is_in_the_way(tmp_path: Path) -> None:
    environment = strangers_in(tmp_path)
    code = f"import sys; sys.path.insert(2, {str(ROOT)!r}); import mrac_jax as mrac; mrac.load('example:paper')"
    done = run_door(["-c", code], cwd=tmp_path, env=environment)
    *_, last = done.stderr.strip().splitlines()
    assert last.startswith("ImportError: mrac_jax needs its own package 'planner'")
    assert str(tmp_path / "planner.py") in last
    assert str(ROOT) in last


@pytest.mark.usefixtures("one_picture")
def test_an_answer_says_its_figures_once(tmp_path: Path) -> None:
    threat = np.zeros((6, 9))
    threat[2:4, 3:7], threat[0, 8] = 0.2, np.nan
    world = mrac.load(threat)
    plan = mrac.plan(world, robots=3)
    answer = mrac.evaluate(world, plan, rollouts=4096, seed=3)
    cells, n = answer.tally.accessible, answer.tally.rollouts
    said = answer.to_json()
    assert answer.visited.mean == said["coverage"]["visited"]["mean"] or answer.exact.visited is not None
    assert answer.visited.cells == pytest.approx(answer.visited.mean * cells)
    assert answer.visited.quantile(0.05) == said["coverage"]["visited"]["quantiles"]["0.05"]
    assert answer.bounds.ideal.cells == said["bounds"]["ideal_team"]
    assert answer.losses.mean == said["best"]["losses"]["mean"]
    singles = answer.singles()
    assert len(singles["rollout"]) == n
    for name in ("visited", "survived"):
        assert np.array_equal(np.bincount(singles[name], minlength=cells + 1), getattr(answer.tally, name))
    assert np.array_equal(np.bincount(singles["alive"], minlength=4), answer.tally.alive)
    assert set(singles["outcome"]) <= {"complete", "all_robots_lost", "no_progress", "step_limit"}
    assert {"index.html", "plan.json", "evaluation.json"} <= {file.name for file in answer.save(tmp_path / "out")}
    cut = mrac.evaluate(world, plan, rollouts=4096, seed=3, deadline=4)
    assert all(np.array_equal(cut.singles()[name], singles[name]) for name in singles)  # of the whole run, as its tally
    compared = mrac.compare((world, plan), (world, plan), rollouts=10).save(tmp_path / "compared")
    assert {"index.html", "compare.json"} <= {file.name for file in compared}
    opened = mrac.evaluate(world, plan, loop="open", rollouts=10)
    assert opened.visited.mean == opened.exact.visited.mean
    assert opened.exact.visited.cells == opened.closed_form.visited
    assert opened.losses.ci95 == (opened.losses.mean, opened.losses.mean)


def test_singles_as_a_data_frame() -> None:
    pytest.importorskip("pandas")
    world = mrac.load(np.array([[0.0, 0.1, 0.2], [0.0, 0.0, 0.3]]))
    frame = mrac.evaluate(world, 2, rollouts=50).to_dataframe()
    assert list(frame.columns) == ["rollout", "visited", "survived", "time", "alive", "outcome"]
    assert len(frame) == 50


def test_what_a_person_prints_fits_a_screen() -> None:
    world = mrac.load("example:paper")
    plan = mrac.plan(world, robots=20)
    answer = mrac.evaluate(world, plan, rollouts=4096)
    other = mrac.compare((world, plan), (world, mrac.plan(world, robots=2)), rollouts=4096)
    for shown in (world, plan, answer, other):
        assert 2 <= len(repr(shown).splitlines()) <= 24
        assert len(repr(shown)) < 2500
        assert shown._repr_html_().startswith("<b>")
    assert "20 robots visit" in repr(answer)
    assert "B (2 robots) visits" in repr(other)


USER = """import mrac_jax as mrac

world = mrac.load("example:paper")
answer = mrac.evaluate(world, mrac.plan(world, robots=3))
share: float = answer.visited.mean
reveal_type(answer)
"""


@pytest.mark.parametrize(
    ("imports", "said"), [("skip", "Any"), pytest.param("normal", "Evaluation", marks=pytest.mark.slow)]
)
def test_type_checkers_find_the_installation(tmp_path: Path, imports: str, said: str) -> None:
    """From outside the checkout, as editors look for it: a file finder, no import hook."""
    (tmp_path / "user.py").write_text(USER)
    options = ["--strict", "--config-file=", f"--cache-dir={os.devnull}", f"--follow-imports={imports}"]
    done = run_door(["-m", "mypy", *options, "user.py"], cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert f'{said}"' in done.stdout


def test_every_answer_is_a_data_frame(tmp_path: Path) -> None:
    """A row for each of what it lists; intervals are two columns."""
    pytest.importorskip("pandas")
    threat = np.zeros((3, 4))
    threat[1, 1:] = 0.3
    world = mrac.load(threat)
    (tmp_path / "s.yaml").write_text("base: {input: example:paper}\nrollouts: 10\nsweep: {robots: [1, 2]}\n")
    swept = mrac.sweep(tmp_path / "s.yaml", tmp_path / "s.store", processes=1, progress=False)
    front = mrac.front(world, 2, rollouts=64)
    size = mrac.size(world, target=0.5, most=2, rollouts=64)
    compared = mrac.compare((world, 1), (world, 2), rollouts=64)
    listed = [
        (front, len(front.points), "coverage.ci95.low"),
        (size, len(size.points), "coverage.mean"),
        (mrac.starts(world, 1, rollouts=64), None, "coverage.mean"),
        (mrac.threats(world, 2, remove=1, rollouts=64), None, "known.ci95.high"),
        (mrac.threats(world, 2, add=1, rollouts=64), None, "known.ci95.high"),
        (mrac.check(world, 2, rollouts=64), None, "formula"),
        (compared, None, "figure"),
        (swept, 2, "visited.mean"),
        (mrac.results(tmp_path / "s.store"), 2, "visited.mean"),
    ]
    for answer, rows, column in listed:
        frame = answer.to_dataframe()  # type: ignore[attr-defined]
        assert column in frame.columns, type(answer)
        assert len(frame) == rows if rows else len(frame) > 0
    difference = compared.to_dataframe().set_index("figure").loc["visited"]
    assert difference["mean"] == pytest.approx(compared.difference("visited").estimate.mean)


# Arguments of the Python interface: unknown words are errors in its own words, and options are named as typed.

WORLD_ARGUMENTS = World.create(np.zeros((2, 3)))


WRONG_CHOICES = [
    ({"loop": "both"}, "loop='both'; expected 'closed' or 'open'"),
    ({"loop": None}, "loop=None; expected 'closed' or 'open'"),
    ({"loop": "opn"}, "did you mean 'open'?"),
    ({"loop": ["open"]}, "loop=['open']"),
    ({"engine": "cuda"}, "engine='cuda'; expected 'auto' or 'jax' or 'numba'"),
    ({"rollouts": 0}, "rollouts=0; expected a whole number, 1 to 4294967296"),
    ({"rollouts": 1e6 + 0.5}, "rollouts=1000000.5; expected a whole number"),
    ({"rollouts": True}, "rollouts=True"),
    ({"rollouts": "100"}, "rollouts='100'"),
    ({"precision": 2}, "precision=2; expected a fraction of the accessible cells in (0, 1); did you mean 0.02?"),
    ({"engine": "Num-ba"}, "did you mean 'numba'?"),
    ({"precision": "0.1"}, "precision='0.1'"),
    ({"seed": -1}, "seed=-1; expected a whole number"),
    ({"deadline": 2.5}, "deadline=2.5; expected steps, as 450, or a time"),
    (
        {"deadline": 10**10},
        "deadline=10000000000; expected steps, as 450, or a time, as 45min, 1h30min or 90s, at most",
    ),
    ({"first_only": True, "loop": "open"}, "first_only=True needs the closed loop; use loop='closed'"),
]


@pytest.mark.parametrize(("choices", "said"), WRONG_CHOICES)
def test_choices_of_rollouts_speak_python(choices: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError) as caught:
        RolloutChoices(**choices)
    assert said in str(caught.value)
    assert "--" not in str(caught.value)


WRONG_SETTINGS = [
    ({"risk": "brave"}, "risk='brave'; expected 'paper' or 'log'"),
    ({"levels": 2.5}, "levels is 2.5"),
    ({"density": "4"}, "density is '4'"),
]


@pytest.mark.parametrize(("settings", "said"), WRONG_SETTINGS)
def test_settings_are_checked_before_planning(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(PlanError, match=re.escape(said)):
        make_plan(WORLD_ARGUMENTS, [[0, 0]], Settings(**settings))


WRONG_CALLS = [
    (lambda: make_goal(0.9, None, False, "seen"), "metric='seen'"),
    (lambda: make_goal(2, None, False), "target=2"),
    (lambda: make_goal(0.5, None, True), "both complete and target"),
    (lambda: make_survey(0, None, None, (1,), Choices()), "worlds=0"),
    (lambda: make_survey(1, "patchy", None, (1,), Choices()), "kind='patchy'"),  # type: ignore[arg-type]
    (lambda: random_world(pattern=ThreatPattern(kind="patchy")), "kind='patchy'"),  # type: ignore[arg-type]
    (lambda: random_world(pattern=ThreatPattern(seed=1.5)), "seed=1.5"),  # type: ignore[arg-type]
    (lambda: place_starts(WORLD_ARGUMENTS, 1, "middle"), "start rule 'middle'"),
    (lambda: load_task(Asked("example:paper", Choices(), 0)), "robots=0"),
    (lambda: load_task(Asked("example:paper", Choices(risk="brave"))), "risk='brave'"),  # type: ignore[arg-type]
]


@pytest.mark.parametrize(("call", "said"), WRONG_CALLS)
def test_the_rest_of_the_interface_speaks_python(call: Any, said: str) -> None:
    with pytest.raises((InputError, WorldError)) as caught:
        call()
    assert said in str(caught.value)
    assert "--" not in str(caught.value)


def test_the_command_line_names_its_options(capsys: pytest.CaptureFixture[str]) -> None:
    assert argument("step_seconds", 0.5) == "step_seconds=0.5"
    told = COMMAND_LINE.set(True)
    assert argument("step_seconds", 0.5) == "--step-seconds 0.5"
    assert argument("first_only", True) == "--threat-checks first_visit"
    COMMAND_LINE.reset(told)
    assert "--rollouts 0; expected" in error_of(capsys, "evaluate", "example:paper", "--rollouts", "0")
    assert argument("rollouts", 0) == "rollouts=0"


def test_whole_and_real_numbers() -> None:
    assert is_whole(np.int64(3), 0, 3)
    assert not any(is_whole(value, 0, 9) for value in (True, 3.0, "3", None, 10, -1))
    assert is_real(np.float32(0.5))
    assert not any(is_real(value) for value in (True, "1", None, float("nan"), float("inf"), 10**400))


def test_a_percentage_in_the_place_of_a_fraction_is_meant_as_one() -> None:
    share = Numbers(0, 1)
    assert [share.meant(value) for value in (5, 95.5, 100)] == [f"did you mean {n}?" for n in ("0.05", "0.955", "1")]
    assert [share.meant(value) for value in (1, 0.5, -5, 101, True, "5", None)] == [""] * 7
    assert Numbers(0, 10).meant(50) == Numbers(0, 0.1).meant(50) == ""


def test_the_nearest_word_is_found_whatever_its_case_and_hyphens() -> None:
    words = ("per_cell", "mrac", "every-visit")
    assert [nearest(given, words) for given in ("percell", "PER CELL", "mrack", "every_visit", "x")] == [
        "per_cell", "per_cell", "mrac", "every-visit", "",
    ]  # fmt: skip
