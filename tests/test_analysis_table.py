"""The terminal's answer: what comes first, what is folded away, and that it can be read at 80 columns."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from conftest import FOLDER

from analysis.checking.check import check_input
from analysis.checking.report import check_report
from analysis.cli.app import run
from analysis.evaluation.answer import Evaluation
from analysis.evaluation.evaluate import evaluate
from analysis.evaluation.report import headline, losses_words
from analysis.evaluation.report import report as evaluation_report
from analysis.evaluation.table import formulas_words
from analysis.report.answer import print_report
from analysis.sampling import RolloutChoices
from analysis.utils.folder import as_text
from planner.mrac.make_plan import make_plan
from planner.world.levels import place_starts
from planner.world.world import World, load_world_file

WORLD = str(FOLDER / "contiguous-14x23-1000.npz")
MOST_LINES = 4


@pytest.fixture(scope="module")
def world() -> World:
    return load_world_file(Path(WORLD))


@pytest.fixture(scope="module")
def answers(world: World) -> dict[str, Evaluation]:
    """Both loops, with everything that can be asked for."""
    plan = make_plan(world, place_starts(world, 8)[0])
    known = {"deadline": 40, "rollouts": 200}
    return {
        "closed": evaluate(world, plan, RolloutChoices(**known), threat_scale=(0.5, 2.0)),
        "controlled": evaluate(world, plan, RolloutChoices(**(known | {"rollouts": 1024}))),
        "open": evaluate(world, plan, RolloutChoices(loop="open", **known), threat_scale=(0.5,)),
    }


def shown(evaluation: Evaluation, width: int, theory: bool = False) -> str:
    return as_text(lambda console: print_report(evaluation_report(evaluation, theory), console), width)


@pytest.mark.parametrize("loop", ["closed", "controlled", "open"])
def test_the_answer_losses_chances_and_time_come_first(loop: str, answers: dict[str, Evaluation]) -> None:
    answer = answers[loop]
    said = shown(answer, 200)
    wanted = [headline(answer), "Chances in %", "time, steps", "Coverage, %", losses_words(answer),
              "accessible,", "makespan", "rollouts,"]  # fmt: skip
    places = [said.index(words) for words in wanted]
    assert places == sorted(places) and places[0] == 0


def test_formulas_are_listed_only_when_asked_for(answers: dict[str, Evaluation]) -> None:
    answer = answers["closed"]
    assert "Theorem 3" not in shown(answer, 200) and "FAILS" not in shown(answer, 200)
    assert "formula" not in shown(answer, 200), "no concern of who asks for coverage"
    assert formulas_words(answer) in shown(answer, 200, theory=True)
    listed = shown(answer, 200, theory=True)
    assert listed.count("Theorem 3") == 4 and "eq. (2) as printed" in listed and "--theory" not in listed


@pytest.mark.parametrize("loop", ["closed", "controlled", "open"])
@pytest.mark.parametrize("width", [80, 200])
def test_tables_fit_and_no_label_is_over_four_lines(loop: str, width: int, answers: dict[str, Evaluation]) -> None:
    said = shown(answers[loop], width, theory=True)
    assert max(map(len, said.splitlines())) <= width
    assert most_lines(said) <= (MOST_LINES if width == 80 else 1), said
    assert "\u2026" not in said


def test_check_can_be_read_at_80_columns(world: World) -> None:
    plan = make_plan(world, place_starts(world, 2)[0])
    checked = check_input(world, plan, RolloutChoices(rollouts=200))
    said = as_text(lambda console: print_report(check_report(checked), console), 80)
    assert max(map(len, said.splitlines())) <= 80
    assert most_lines(said) <= MOST_LINES, said
    assert "\u2026" not in said


def most_lines(said: str) -> int:
    """Lines of the longest label of a table's rows: lines without a number in them that follow one that has some."""
    most = now = 0
    for line in said.splitlines():
        inside = line.startswith("  ")
        if inside and re.search(r"\s{2,}\S+.*\s{2,}\S+", line.strip() and line):
            now = 1
        elif inside and line.strip() and now:
            now += 1
        else:
            now = 0
        most = max(most, now)
    return most


def test_the_longest_label_is_found() -> None:
    assert most_lines("  a     1   2\n  b\n  c\n  d     3   4\n\n  words\n") == 3


def test_notes_come_last_and_the_width_of_a_pipe_can_be_set(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Results on standard output, then on standard error how the map was read."""
    monkeypatch.setenv("COLUMNS", "80")
    World.create(np.full((4, 6), 0.05), source="m").save(tmp_path / "m.npz")
    events: list[str] = []
    monkeypatch.setattr("analysis.cli.deliver.say", lambda lines: events.extend(lines))
    monkeypatch.setattr("analysis.report.answer.print_report", lambda *_, **__: events.append("the answer"))
    words = ["evaluate", str(tmp_path / "m.npz"), "--robots", "25", "--rollouts", "64"]
    assert run(words) == 0
    assert events[0] == "the answer"
    monkeypatch.undo()
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*words, "--theory"]) == 0
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80 and "Theorem 3" in said
