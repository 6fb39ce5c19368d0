"""What else stops robots, beside which nothing can be said of a map (SPEC sections 13, 15, 16, 22)."""

from __future__ import annotations

from planner.errors import WorldError
from planner.worlds.doubt import Hazard, Uncertain
from planner.worlds.world import World


def check_alone(world: World, what: str, over: type[Hazard | Uncertain] | None = None, or_else: str = "") -> None:
    """Raise WorldError for `what` beside another thing that is not known, or beside types of robots.

    `over`: the kind of doubt that it takes the place of. `or_else`: what else may be done, in words.
    """
    doubt = None if over is not None and isinstance(world.doubt, over) else world.doubt
    for other in (doubt, world.knowledge):
        if other is not None:
            problem, fix = f"`{what}` beside another thing that is not known: {other.said}", "leave one of the two out"
            raise WorldError(problem, source=world.source, expected="one known map", fix=fix + or_else)
    if world.types is not None:
        problem, fix = f"`{what}` beside {world.types.said}", "leave one of the two out"
        raise WorldError(problem, source=world.source, expected="one known map for all robots", fix=fix)
