"""Graphs: what trails come to and the front by enumeration, a certificate that no team exceeds, readers, errors."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from analysis.cli.app import run
from analysis.graphs.front import GraphFront, find_front
from analysis.graphs.graph import Graph, read_graph
from analysis.graphs.report import most_reward

Trails = tuple[tuple[int, ...], ...]


def drawn(seed: int, nodes: int = 5, **more: Any) -> dict[str, Any]:
    """A graph with a way round, chords and a one-way arc or two; some arcs cost nothing."""
    rng = np.random.default_rng(seed)
    names = list("abcdef"[:nodes])
    rewards = {name: float(rng.choice([0.0, 1.0, 2.5, 4.0])) for name in names} | {"a": 0.5}
    ends = {(names[i], names[rng.integers(i)]) for i in range(1, nodes)}
    ends |= {tuple(rng.permutation(names)[:2].tolist()) for _ in range(1)}
    both = {tuple(sorted(pair)) for pair in ends}
    draw = lambda: float(rng.choice([0.6, 0.8, 0.9, 0.97, 1.0], p=[0.2, 0.3, 0.2, 0.2, 0.1]))  # noqa: E731
    return {
        "base": "a",
        "nodes": rewards,
        "edges": [[*pair, draw()] for pair in sorted(both)[1:]],
        "arcs": [[*sorted(both)[0], draw()], [*sorted(both)[0][::-1], draw()]],
        **more,
    }


def closed_trails(graph: Graph, nodes_once: bool, least: float) -> list[tuple[tuple[int, ...], float]]:
    """All of them, each with its chance to come home: by going on from every beginning."""
    chance = {(t, h): q for t, h, q in zip(graph.tail.tolist(), graph.head.tolist(), graph.survival, strict=True)}
    found, begun = [], [((graph.base,), 1.0)]
    while begun:
        trail, alive = begun.pop()
        if trail[-1] == graph.base and alive >= least:
            found.append((trail, alive))
        gone = set(itertools.pairwise(trail))
        for (tail, head), q in chance.items():
            again = head in trail and (head != graph.base or trail.count(graph.base) > 1)
            left = len(trail) > 1 and tail == graph.base
            if tail == trail[-1] and (tail, head) not in gone and not (nodes_once and (again or left)):
                begun.append(((*trail, head), alive * float(q)))
    return found


def outcomes(graph: Graph, trail: tuple[int, ...]) -> list[tuple[float, set[int], bool]]:
    """(chance, nodes visited, whether it came home) for every place where a robot may be lost."""
    q = {(t, h): float(s) for t, h, s in zip(graph.tail.tolist(), graph.head.tolist(), graph.survival, strict=True)}
    steps = [q[step] for step in itertools.pairwise(trail)]
    lost = [(prod(steps[:at]) * (1 - steps[at]), set(trail[: at + 1]), False) for at in range(len(steps))]
    return [*lost, (prod(steps), set(trail), True)]


def expected(graph: Graph, trails: Trails) -> tuple[float, float]:
    """(reward, robots home): over all ways in which the robots may be lost."""
    reward = home = 0.0
    for one in itertools.product(*(outcomes(graph, trail) for trail in trails)):
        chance = prod(p for p, _, _ in one)
        visits = Counter(node for _, nodes, _ in one for node in nodes)
        reward += chance * sum(graph.reward[node] * sum(graph.visits[:count]) for node, count in visits.items())
        home += chance * sum(came for _, _, came in one)
    return reward, home


def every_team(graph: Graph, trails: list[tuple[tuple[int, ...], float]]) -> np.ndarray[Any, Any]:
    """(reward, robots home) `[N, 2]` of all teams of two: inclusion and exclusion of their chances to visit."""
    first = np.zeros((len(trails), len(graph.names)))
    for row, (trail, _) in zip(first, trails, strict=True):
        for chance, nodes, _ in outcomes(graph, trail):
            row[list(nodes)] += chance
    one, two = np.triu_indices(len(trails))
    both, shares = first[one] * first[two], [*graph.visits, 0.0][:2]
    reward = (shares[0] * (first[one] + first[two] - both) + shares[1] * both) @ graph.reward
    home = np.array([chance for _, chance in trails])
    return np.stack([reward, home[one] + home[two]], axis=1)


def staircase(teams: np.ndarray[Any, Any], graph: Graph) -> float:
    area, before = 0.0, 0.0
    for reward, home in sorted(teams.tolist(), key=lambda one: (-one[1], one[0])):
        area, before = area + max(0.0, reward - before) * home, max(before, reward)
    return area / (graph.total * 2)


def check_against_all(path: Path, seed: int, nodes_once: bool, least: float, **more: Any) -> tuple[float, GraphFront]:
    """Plans are what enumeration says, within the rules; no team is beyond a half-plane. (exact area, answer)."""
    path.write_text(json.dumps(drawn(seed, **more)))
    graph = read_graph(path)
    answer = find_front(path, 2, nodes_once=nodes_once, least_home=least, places=400)
    trails = closed_trails(graph, nodes_once, least)
    for point in answer.points:
        assert {*point.trails} <= {trail for trail, _ in trails}
        assert expected(graph, point.trails) == pytest.approx((point.reward, point.home))
    teams = every_team(graph, trails)
    for place in np.random.default_rng(seed).integers(len(teams), size=3):
        one, two = (int(found[place]) for found in np.triu_indices(len(trails)))
        assert expected(graph, (trails[one][0], trails[two][0])) == pytest.approx(tuple(teams[place]))
    assert (teams[:, 1] <= answer.most_home(teams[:, 0]) + 1e-9).all()
    exact = staircase(teams, graph)
    assert answer.area <= exact + 1e-9 and exact <= answer.outer_area
    return exact, answer


CASES = [(False, 0.0, {}), (True, 0.0, {}), (False, 0.5, {}), (False, 0.0, {"visits": [0.5, 0.3, 0.2]})]


@pytest.mark.parametrize(("nodes_once", "least", "more"), CASES)
def test_fronts_are_those_of_all_teams(tmp_path: Path, nodes_once: bool, least: float, more: dict[str, Any]) -> None:
    exact, found, outer = 0.0, 0.0, 0.0
    for seed in range(4):
        one, answer = check_against_all(tmp_path / "g.json", seed, nodes_once, least, **more)
        exact, found, outer = exact + one, found + answer.area, outer + answer.outer_area
    assert found > 0.999 * exact
    assert outer < 1.13 * exact


def one_way(seed: int) -> dict[str, Any]:
    """A graph with a round trip and some chords, each in one direction: it has few trails."""
    rng = np.random.default_rng(seed)
    names = list("abcdefg"[: int(rng.integers(5, 8))])
    arcs = {(one, other) for one, other in zip(names, [*names[1:], "a"], strict=True)}
    arcs |= {tuple(rng.choice(names, 2, replace=False).tolist()) for _ in range(5)}
    rewards = {name: float(rng.choice([0.0, 1.0, 2.5, 4.0])) for name in names} | {"b": 1.0}
    return {
        "base": "a",
        "nodes": rewards,
        "arcs": [[*ends, float(rng.choice([0.6, 0.8, 0.9]))] for ends in sorted(arcs)],
    }


@pytest.mark.parametrize("nodes_once", [True, False])
def test_where_there_are_few_trails_all_are_looked_at(tmp_path: Path, nodes_once: bool) -> None:
    for seed in range(20):
        (tmp_path / "g.json").write_text(json.dumps(one_way(seed)))
        graph = read_graph(tmp_path / "g.json")
        teams = every_team(graph, closed_trails(graph, nodes_once, 0.0))
        found = find_front(tmp_path / "g.json", 2, nodes_once=nodes_once, places=400)
        assert found.area > 0.999 * staircase(teams, graph), seed
        assert found.points[0].reward == pytest.approx(teams[:, 0].max())


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 200))
def test_no_team_exceeds_the_certificate(tmp_path: Path, seed: int) -> None:
    nodes_once, least, more = CASES[seed % len(CASES)]
    check_against_all(tmp_path / "g.json", seed, nodes_once, least, **more)


JULIA = """
# an instance as BOTOHE writes them
function house(nb_robots::Int)
    g = MetaDiGraph(SimpleDiGraph(4))
    edge_list = [
        #= ground floor =#
        (1, 2, :h), # hall
        (2, 3, :h),
        (2, 4, :s)
    ]
    ωs = Dict(
        :h => 0.9, # halls
        :s => 0.5
    )
    for (i, j, t) in edge_list
        add_edge!(g, i, j)
    end
    for v = 1:nv(g)
        if v in [1, 3]
            set_prop!(g, v, :r, 2.0/3)
        elseif v in [4]
            set_prop!(g, v, :r, 1.5)
        else
            set_prop!(g, v, :r, 0.0)
        end
    end
end

function plant(nb_robots::Int; seed::Int=3)
    g = MetaDiGraph(SimpleDiGraph(3))
    edge_list = [(1, 2, "m"), (2, 3, "f")]
    found = Dict(
        2=>"g",
        3=>"s"
    )
    ωs = Dict(
        "m" => 0.98,
        "f" => 0.8
    )
    worth = Dict(
        "g" => 0.15,
        "s" => 0.50
    )
end

function drawn(nb_robots::Int)
    g = MetaDiGraph(SimpleDiGraph(3))
    edge_list = [(1, 2, 2), (2, 3, 1)]
end
"""


def test_julia_code_is_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "examples.jl"
    path.write_text(JULIA)
    house, plant = read_graph(path, "house"), read_graph(path, "plant")
    assert house.reward.tolist() == [0, 0, 2 / 3, 1.5] and plant.reward.tolist() == [0, 0.15, 0.5]
    arcs = {(1, 2): 0.9, (2, 3): 0.9, (2, 4): 0.5}
    both = arcs | {(head, tail): q for (tail, head), q in arcs.items()}
    assert dict(zip(zip(house.tail + 1, house.head + 1, strict=True), house.survival, strict=True)) == both
    assert plant.survival.tolist() == [0.98, 0.98, 0.8, 0.8]
    for words, said in (([], "holds 2 graphs"), (["--instance", "drawn"], "no graph 'drawn'")):
        assert run(["graph", str(path), *words]) == 2
        told = capfd.readouterr().err
        assert said in told and "house, plant" in told and told.count("\n") == 1


@pytest.mark.parametrize(
    ("written", "said"),
    [
        *((computed, "no graph 'house'") for computed in ("1 - 0.1", "1.2.3", "sqrt(2)", "1/")),
        *((chance, "('1', '2') has ") for chance in ("7.5", "0", "1/0", "1/00.0")),
        *((chance, "") for chance in ("9e-1", ".9", "1.8/2.", "9/10")),
    ],
)
def test_julia_numbers_are_read_whole_and_checked(
    written: str, said: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "examples.jl"
    assert JULIA.count("0.9") == 2
    path.write_text(JULIA.replace("0.9,", written + ",", 1))
    if not said:
        assert read_graph(path, "house").survival[0] == 0.9
        return
    assert run(["graph", str(path), "--instance", "house"]) == 2
    told = capfd.readouterr().err
    assert said in told and str(path) in told and told.count("\n") == 1


def test_an_instance_is_of_julia_code(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "g.json"
    path.write_text(json.dumps(drawn(1)))
    assert run(["graph", str(path), "--instance", "house"]) == 2
    assert "instance 'house'" in capfd.readouterr().err


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "g.json"
    path.write_text(json.dumps(drawn(1)))
    words = ["graph", str(path), "--robots", "2", "--places", "400"]
    assert run([*words, "--json", "--out", str(tmp_path / "out")]) == 0
    said = json.loads(capsys.readouterr().out)
    answer = find_front(path, 2, places=400)
    assert said == json.loads(json.dumps(answer.to_json()))
    assert said["area"] == answer.area and len(said["points"]) == len(answer.points) > 5
    assert {trail[0] for point in said["points"] for trail in point["trails"]} == {"a"}
    assert said["answer"] in (tmp_path / "out" / "index.html").read_text()
    assert run(words) == 0
    assert f"{answer.outer_area:.3f}" in capsys.readouterr().out


def test_the_table_knows_the_team_that_stays_at_a_base_with_a_reward(tmp_path: Path) -> None:
    path = tmp_path / "g.json"
    path.write_text('{"base": "a", "nodes": {"a": 1, "b": 1.5}, "edges": [["a", "b", 0.5]]}')
    answer = find_front(path, 2)
    assert (answer.points[-1].reward, answer.points[-1].home) == (1, 2)
    for point in answer.points:
        assert most_reward(answer, point.home) == pytest.approx(point.reward) and most_reward(answer, point.home) >= 1


@pytest.mark.parametrize(
    ("changed", "words", "said"),
    [
        ({"base": "z"}, [], "`base` is 'z'; expected the name of a node"),
        ({"nodes": {"a": -1}}, [], "`nodes.a` is -1; expected a reward"),
        ({"edges": [["a", "b", 0.0]]}, [], "`edges[0][2]` is 0.0; expected a chance to survive above 0, at most 1"),
        ({"edges": [["a", "q", 0.5]]}, [], "`edges[0][1]` is 'q'; expected the name of a node"),
        ({"edges": [["a", "b", 0.5], ["b", "a", 0.5]]}, [], "`edges[1]` is the second arc from b to a"),
        ({"visits": [0.2, 0.5]}, [], "`visits` is [0.2, 0.5]; expected shares, none larger than the one before"),
        ({"egdes": []}, [], "unknown key `egdes`"),
        (
            {"nodes": dict.fromkeys("abcde", 0)},
            ["--robots", "2"],
            "no visit of a node brings a reward; expected a node with",
        ),
        ({"visits": [0]}, [], "no visit of a node brings a reward; expected a node with"),
        ({}, ["--robots", "0"], "--robots 0; expected a whole number of robots, 1 to 64"),
        ({}, ["--least-home", "1"], "--least-home 1; expected a chance"),
    ],
)
def test_wrong_input(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], changed: dict[str, Any], words: list[str], said: str
) -> None:
    path = tmp_path / "g.json"
    path.write_text(json.dumps(drawn(1) | ({"arcs": []} if changed else {}) | changed))
    assert run(["graph", str(path), *words, "--out", str(tmp_path / "out")]) == 2
    told = capfd.readouterr().err
    assert said in told and told.count("\n") == 1 and not (tmp_path / "out").exists()
