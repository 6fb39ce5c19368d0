"""The command `mrac-jax graph`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from analysis.cli.console import check_folder
from analysis.cli.deliver import deliver
from analysis.cli.options import TEAM, Json, Number, OutPath, Text, Whole, path


def graph(
    file: Annotated[Path, Parameter(converter=path)],
    /,
    *,
    instance: Text = None,
    robots: Annotated[Whole, Parameter(group=TEAM)] = None,
    nodes_once: Annotated[bool, Parameter(group=TEAM, negative="")] = False,
    least_home: Annotated[Number, Parameter(group=TEAM)] = None,
    places: Whole = None,
    out: OutPath = None,
    as_json: Json = False,
) -> int:
    """On a graph: what robots fetch against how many come home, and what no team exceeds.

    Arcs are survived with a chance, a node's reward is fetched by who reaches it first, robots return to the base on
    trails decided in advance. Plans by local search; an outer polygon of their front, certified.

    Args:
        file: A graph (.json), or the Julia code of BOTOHE's instances (src/examples.jl).
        instance: The function in Julia code that makes the instance, as art_museum.
        robots: How many robots (default: 1).
        nodes_once: A robot may visit a node once, not only drive an arc once.
        least_home: The chance to come home that each robot has to keep (default: 0).
        places: Numbers of robots home that the search tells apart (default: 3000); 1: the most reward alone.
        out: Write the page, the text and JSON to this folder.
    """
    from analysis.graphs.front import USUAL_PLACES, find_front
    from analysis.kit.progress import show_progress

    check_folder(out)
    with show_progress() as progress:
        answer = find_front(
            file, 1 if robots is None else robots, instance, nodes_once, least_home or 0.0,
            USUAL_PLACES if places is None else places, progress.doing,
        )  # fmt: skip
    return deliver(answer, out=out, as_json=as_json, beside=(file,))
