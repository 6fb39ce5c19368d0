"""Graphs that BOTOHE (SimonEnsemble/BO_ACO_TOHE, src/examples.jl) writes as Julia code, read from a user's checkout.

A function with an instance in it has `SimpleDiGraph(nodes)`, tuples `(i, j, kind)` of edges, which lead both ways, a
`Dict` of chances by kind, and rewards: `if v in [nodes] set_prop!(g, v, :r, reward)`, or a `Dict` of kinds by node and
one of rewards by kind. Node 1 is the base, and worth nothing. Functions that draw at random, or compute, are not read.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from planner.arguments import did_you_mean
from planner.errors import InputError

EXPECTED = "a file of BOTOHE's, as src/examples.jl"
KIND, DECIMAL = r'(?::|")([A-Za-z_]\w*)"?', r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
NUMBER = rf"({DECIMAL}(?:/{DECIMAL})?)(?=[ \t]*(?:[,)\n]|$))"
"""One, or one divided by another, and nothing behind it."""


def read_julia(path: Path, instance: str | None) -> tuple[str, str, dict[str, float], dict[tuple[str, str], float]]:
    """(name, base, rewards by node, chances by arc) of an instance; None: the only one. Raises InputError."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        raise InputError("cannot be read as text", source=path, expected=EXPECTED) from None
    text = re.sub(r"#=.*?=#|#[^\n]*", "", text, flags=re.DOTALL)
    found = {}
    for name, body in re.findall(r"^function (\w+)\(.*?$(.*?)^end", text, re.DOTALL | re.MULTILINE):
        read = _read(body)
        if read is not None:
            found[name] = read
    if instance is None and len(found) == 1:
        instance = next(iter(found))
    if instance is None or instance not in found:
        names = ", ".join(found)
        problem = f"no graph {instance!r} can be read there" if instance else f"holds {len(found)} graphs"
        fix = f"name one as instance: {names}" if names else ""
        raise InputError(problem, source=path, expected=EXPECTED, fix=did_you_mean(instance or "", found) or fix)
    return instance, "1", *found[instance]


def _read(body: str) -> tuple[dict[str, float], dict[tuple[str, str], float]] | None:
    """Rewards and chances of a function's body; None: it is not such a one."""
    count = re.search(r"SimpleDiGraph\((\d{1,5})\)", body)
    edges = re.findall(rf"\(\s*(\d+)\s*,\s*(\d+)\s*,\s*{KIND}\s*\)", body)
    by_kind = [_numbers(rf"{KIND}\s*=>\s*{NUMBER}", one) for one in re.findall(r"Dict\((.*?)\n\s*\)", body, re.DOTALL)]
    chances = next((one for one in by_kind if one and {kind for _, _, kind in edges} <= {*one}), None)
    if count is None or not edges or chances is None:
        return None
    kinds = re.findall(rf"(\d+)\s*=>\s*{KIND}", body)
    worth = next((one for one in by_kind if one and {kind for _, kind in kinds} <= {*one}), {})
    rewards = {node: worth[kind] for node, kind in kinds}
    for nodes, reward in re.findall(rf"if v in \[([\d,\s]+)\]\s*set_prop!\(g, v, :r, {NUMBER}\)", body):
        rewards |= dict.fromkeys(re.findall(r"\d+", nodes), _number(reward))
    every = [str(node) for node in range(1, int(count[1]) + 1)]
    if not rewards or {*rewards} - {*every} or {end for edge in edges for end in edge[:2]} - {*every}:
        return None
    arcs = {way: chances[kind] for tail, head, kind in edges for way in ((tail, head), (head, tail))}
    return {node: rewards.get(node, 0.0) if node != "1" else 0.0 for node in every}, arcs


def _numbers(pattern: str, text: str) -> dict[str, float]:
    return {name: _number(value) for name, value in re.findall(pattern, text)}


def _number(text: str) -> float:
    """What a NUMBER comes to; NaN: it is divided by 0."""
    above, _, below = text.partition("/")
    divisor = float(below or 1)
    return float(above) / divisor if divisor else math.nan
