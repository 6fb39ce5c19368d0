"""What every answer can do, whatever it is the answer to: print itself, say itself as JSON, save itself in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from rich.console import Console

from analysis.kit.frames import frame_of
from planner.errors import UsageError
from planner.shown import Rows, html_of, text_of

if TYPE_CHECKING:  # NumPy comes with it, and `--help` with this file
    from planner.files import Json


class Answer:
    """What every answer is: printed in a console and a notebook as its room's face says, in `face.py` beside it."""

    partial: bool
    """It was interrupted, and holds what was done."""
    listed: ClassVar[str] = ""
    """What its JSON object lists, a row each of `to_dataframe`; "": the object itself is the one row."""

    def to_json(self) -> Json:
        """The JSON object that the command prints."""
        return face_of(self).as_json(self)

    def to_dataframe(self) -> Any:
        """What it lists as a pandas DataFrame (the extra `pandas`), with columns as its JSON object names them."""
        said = self.to_json()
        rows = said[self.listed] if self.listed else [said]
        return frame_of([{"figure": name, **row} for name, row in rows.items()] if isinstance(rows, dict) else rows)

    def save(self, folder: str | Path) -> list[Path]:
        """Write what the command's `--out` writes; returns the files. Raises UsageError where it writes none."""
        save = face_of(self).save
        if save is None:
            raise UsageError(f"{type(self).__name__} has no folder of its own", fix="use to_json()")
        return save(self, Path(folder), "")

    def __repr__(self) -> str:
        return text_of(*face_of(self).brief(self))

    def _repr_html_(self) -> str:
        return html_of(*face_of(self).brief(self))


Kind = TypeVar("Kind", bound=Answer)


def json_end(answer: Answer, notes: Sequence[str] = ()) -> Json:
    """What an answer's JSON object ends with: the version, whether it is partial, notes if there are any."""
    partial: Json = {"partial": True} if answer.partial else {}
    return {"version": version("mrac-jax")} | partial | ({"notes": list(notes)} if notes else {})


@dataclass(frozen=True)
class Face(Generic[Kind]):
    """The face of one kind of answer.

    Attributes:
        show: prints it for a person. as_json: JSON types alone.
        headline: the answer in a sentence. rows: names and figures that stand below it in a console or a notebook.
        save: writes its folder, given the command line that made it for the page; returns the files. None: it has none.
        faults: what makes the command fail (exit status 1).
    """

    show: Callable[[Kind, Console], None]
    as_json: Callable[[Kind], Json]
    headline: Callable[[Kind], str]
    save: Callable[[Kind, Path, str], list[Path]] | None = None
    rows: Callable[[Kind], Rows] = lambda answer: ()
    faults: Callable[[Kind], Sequence[Any]] = lambda answer: ()

    def brief(self, answer: Kind) -> tuple[str, Rows]:
        """What a console or a notebook shows of an answer: a screen at most."""
        return f"{type(answer).__name__}: {self.headline(answer)}", self.rows(answer)


def face_of(answer: Answer) -> Face[Any]:
    """The face in the room that the answer's type comes from: of its report, where it has one."""
    room = type(answer).__module__.rpartition(".")[0]
    said = "report" if find_spec(f"{room}.report") else "face"
    face: Face[Any] = import_module(f"{room}.{said}").FACE
    return face
