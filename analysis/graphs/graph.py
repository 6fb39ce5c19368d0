"""A world that is a graph: nodes with rewards, arcs that a robot survives or not. Its file; Julia's are in `julia`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from analysis.graphs.julia import read_julia
from planner.arguments import Numbers, whole
from planner.errors import InputError
from planner.files import check_file, read_json
from planner.worlds.keys import Key

EXPECTED = 'a graph, as {"base": "a", "nodes": {"a": 0, "b": 1.5}, "edges": [["a", "b", 0.9]]}'
MOST_BYTES, MOST_NODES = 2**25, 1000
ROBOTS = whole(1, 64, "a whole number of robots")
REWARD, SURVIVAL = Numbers(0, 1e12, "a reward"), Numbers(0, 1, "a chance to survive", above=True)


class GraphError(InputError):
    """A file that holds no graph."""


@dataclass(frozen=True, eq=False)
class Graph:
    """Axes: `V` nodes, `A` arcs.

    Attributes:
        name: of the file, or of the instance in it. names: of the nodes, `V`. base: where robots start and end.
        reward: float64 `[V]`. tail, head: int64 `[A]`; survival: float64 `[A]`, above 0, at most 1.
        visits: shares of a node's reward that its first, second, ... visit by a robot brings; none grows.
    """

    name: str
    names: tuple[str, ...]
    base: int
    reward: NDArray[np.float64]
    tail: NDArray[np.int64]
    head: NDArray[np.int64]
    survival: NDArray[np.float64]
    visits: tuple[float, ...] = (1.0,)

    @property
    def total(self) -> float:
        """What all nodes are worth, visited as often as it pays."""
        return float(self.reward.sum()) * sum(self.visits)

    def hazards(self) -> csr_array[np.float64]:
        """What an arc adds to the cost -log(survival) of a way, `[V, V]`; sparse: one that costs nothing is there."""
        cost = np.maximum(-np.log(self.survival), 1e-12)
        return csr_array((cost, (self.tail, self.head)), shape=(len(self.names),) * 2)

    def chances(self) -> NDArray[np.float64]:
        """Chances `[V, V]` to survive the arc from a node to another; 0: there is none."""
        found = np.zeros((len(self.names),) * 2)
        found[self.tail, self.head] = self.survival
        return found


@dataclass(frozen=True)
class Rules:
    """What robots may do.

    `nodes_once`: each visits a node once, else drives an arc once. `least_home`: its chance to come home, at least.
    """

    nodes_once: bool = False
    least_home: float = 0.0


def read_graph(path: Path, instance: str | None = None) -> Graph:
    """The graph of a file: JSON, or the `instance` of Julia code as `read_julia` reads it. Raises InputError."""
    check_file(path, EXPECTED)
    if path.suffix == ".jl":
        name, start, rewards, chances = read_julia(path, instance)
        said = [*((*one, REWARD) for one in rewards.items()), *((*one, SURVIVAL) for one in chances.items())]
        for whose, value, numbers in said:
            if not numbers.accepts(value):
                raise GraphError(f"{whose} has {value:g}", source=path, expected=numbers.expected)
        return make_graph(name, start, rewards, chances)
    if instance is not None:
        raise GraphError(f"instance {instance!r}: only Julia code has several", source=path, fix="leave it out")
    key = Key(read_json(path, MOST_BYTES, GraphError, EXPECTED), "", path, GraphError)
    keys = key.mapping(("base", "nodes"), ("name", "arcs", "edges", "visits"))
    named = keys["nodes"].value if isinstance(keys["nodes"].value, dict) else ["name: reward"]
    nodes = {node: one.number(REWARD) for node, one in keys["nodes"].mapping((), named).items()}
    arcs = dict[tuple[str, str], float]()
    for kind in ("arcs", "edges"):
        for one in keys[kind].items("arcs", least=0) if kind in keys else ():
            tail, head, chance = _arc(one, nodes)
            for way in ((tail, head), (head, tail))[: 2 if kind == "edges" else 1]:
                if way in arcs:
                    raise one.fault(f"is the second arc from {way[0]} to {way[1]}", "one")
                arcs[way] = chance
    base = keys["base"]
    if base.value not in nodes:
        raise base.wrong("the name of a node")
    visits = (
        [one.number(Numbers(0, 1, "a share")) for one in keys["visits"].items("shares")] if "visits" in keys else [1.0]
    )
    if sorted(visits, reverse=True) != visits:
        raise keys["visits"].wrong("shares, none larger than the one before")
    name = keys["name"].value if "name" in keys else path.stem
    return make_graph(str(name), base.value, nodes, arcs, tuple(visits))


def _arc(key: Key, nodes: dict[str, float]) -> tuple[str, str, float]:
    """The ends of an arc and its chance."""
    ends = key.items("[node, node, chance to survive]", exactly=3)
    for end in ends[:2]:
        if not isinstance(end.value, str) or end.value not in nodes:
            raise end.wrong("the name of a node")
    if ends[0].value == ends[1].value:
        raise key.fault("leads from a node to itself")
    return ends[0].value, ends[1].value, ends[2].number(SURVIVAL)


def make_graph(
    name: str,
    base: str,
    nodes: dict[str, float],
    arcs: dict[tuple[str, str], float],
    visits: tuple[float, ...] = (1.0,),
) -> Graph:
    """The graph of rewards by node and chances by arc. Raises GraphError for one that is too large."""
    if len(nodes) > MOST_NODES:
        raise GraphError(f"{len(nodes)} nodes", source=name, expected=f"at most {MOST_NODES}")
    place = {node: number for number, node in enumerate(nodes)}
    ends = np.array([(place[tail], place[head]) for tail, head in arcs], dtype=np.int64).reshape(-1, 2)
    survival = np.array(list(arcs.values()), dtype=np.float64)
    reward = np.array(list(nodes.values()), dtype=np.float64)
    return Graph(name, tuple(nodes), place[base], reward, ends[:, 0], ends[:, 1], survival, visits)
