"""What every answer can do, whatever it is the answer to: show itself, say itself as JSON, save itself in a folder."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from analysis.kit.frames import frame_of
from analysis.report.face import json_of, rows_of, save_report
from planner.shown import Rows, html_of, text_of

if TYPE_CHECKING:  # NumPy comes with it, and `--help` with this file
    from analysis.report.blocks import Report
    from planner.files import Json


MOST_SENTENCES = 6
"""Of a report's findings that a console or a notebook shows."""


class Answer:
    """What every answer is: stated by the function that `reported_by` names."""

    reported_by: ClassVar[str]
    """The function that makes its `Report`, as "module:function": reports load what answers do without."""

    partial: bool
    """It was interrupted, and holds what was done."""
    listed: ClassVar[str] = ""
    """What its JSON object lists, a row each of `to_dataframe`; "": the object itself is the one row."""

    def to_json(self) -> Json:
        """The JSON object that the command prints."""
        said: Json = json_of(report_of(self))
        return said

    def to_dataframe(self) -> Any:
        """What it lists as a pandas DataFrame (the extra `pandas`), with columns as its JSON object names them."""
        said = self.to_json()
        rows = said[self.listed] if self.listed else [said]
        return frame_of([{"figure": name, **row} for name, row in rows.items()] if isinstance(rows, dict) else rows)

    def save(self, folder: str | Path, *, force: bool = False) -> list[Path]:
        """Write what the command's `--out` writes; returns the files.

        `force`: replace files that are there already; without it that is a UsageError, and nothing is written.
        """
        return save_report(report_of(self), Path(folder), "", force=force)

    def _brief(self) -> tuple[str, Sequence[str], Rows]:
        """What a console or a notebook shows of an answer, a screen at most: the answer, sentences, key figures."""
        said = report_of(self)
        return f"{type(self).__name__}: {said.headline}", said.findings[:MOST_SENTENCES], rows_of(said)

    def __repr__(self) -> str:
        title, sentences, rows = self._brief()
        return text_of("\n".join([title, *sentences]), rows)

    def _repr_html_(self) -> str:
        title, sentences, rows = self._brief()
        said = "".join(f"<p>{escape(sentence)}</p>" for sentence in sentences)
        return html_of(title, rows).replace("<table>", f"{said}<table>", 1)


def report_of(answer: Answer) -> Report:
    """The report of an answer, by the function that its type names."""
    module, _, function = answer.reported_by.partition(":")
    said: Report = getattr(import_module(module), function)(answer)
    return said


def json_end(answer: Answer, notes: Sequence[str] = ()) -> Json:
    """What an answer's JSON object ends with: the version, whether it is partial, notes if there are any."""
    partial: Json = {"partial": True} if answer.partial else {}
    return {"version": version("mrac-jax")} | partial | ({"notes": list(notes)} if notes else {})
