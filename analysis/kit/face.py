"""What every answer can do, whatever it is the answer to: print itself, say itself as JSON, save itself in a folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from rich.console import Console


class Partial(Protocol):
    """What every answer says of itself."""

    @property
    def partial(self) -> bool:
        """True if it was interrupted."""
        ...


Answer = TypeVar("Answer", bound=Partial)


@dataclass(frozen=True)
class Face(Generic[Answer]):
    """The face of one kind of answer; each room has one, in `face.py`.

    Attributes:
        show: prints it for a person. as_json: JSON types alone.
        save: writes its folder, given the command line that made it for the page; returns the files. None: it has none.
        faults: what makes the command fail (exit status 1).

    An answer that was interrupted and holds what was done says so itself, by `partial`.
    """

    show: Callable[[Answer, Console], None]
    as_json: Callable[[Answer], dict[str, Any]]
    save: Callable[[Answer, Path, str], list[Path]] | None = None
    faults: Callable[[Answer], Sequence[Any]] = lambda answer: ()
