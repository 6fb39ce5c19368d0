"""A picture and an animation of a recorded rollout as files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from analysis.recording.viewers.topics import Stage
from planner.files import atomic_write
from planner.trace import Trace


def save_pictures(trace: Trace, stage: Stage, picture: Path | None, animation: Path | None) -> Iterator[Path]:
    """Write those that have a name, whole or not at all; each is told once it is there. Raises MapError."""
    from analysis.recording.pictures.animation import animation_gif, picture_png

    for path, draw in ((picture, picture_png), (animation, animation_gif)):
        if path is not None:
            with atomic_write(path, "wb") as out:
                out.write(draw(trace, stage))
            yield path
