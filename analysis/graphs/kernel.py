"""The search for teams, compiled: changes of one robot's trail, each kept where it is the best of its number home.

An archive has a place for each so many expected robots home: the plan with the largest reward that was met there.
Every new plan has all changes of one trail looked at: another node by the safest ways, a shorter way, a part the other
way round, two parts in the other order, and a trail from another place; on small graphs every trail there is. A changed
trail costs what comes after the change: a robot's reward is linear in its chances to visit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from planner.jit import compiled

SPAN = 12
"""Arcs of a part of a trail that is replaced or moved; a way home within a node, however long."""
NEAR = 1e-9
"""Rewards that differ by less are the same."""
STRIDE = 8
"""One in so many places is asked for its trails in a round."""


@compiled
def _weigh(robot: int, visit: Any, reward: Any, shares: Any, weight: Any) -> float:
    """`weight[v]`: what one more sure visit of v brings beside the other robots; returns what theirs bring.

    `visit`: chances `[K, V]` of the robots to visit the nodes.
    """
    total = 0.0
    chance = np.zeros(len(shares) + 1)
    for node in range(len(reward)):
        weight[node] = 0.0
        if reward[node] == 0.0:
            continue
        chance[:] = 0.0
        chance[0] = 1.0
        for other in range(len(visit)):
            p = visit[other, node]
            if other != robot and p > 0.0:
                for count in range(len(shares), 0, -1):
                    chance[count] = chance[count] * (1.0 - p) + chance[count - 1] * p
                chance[0] *= 1.0 - p
        left = 1.0
        for count in range(len(shares)):
            weight[node] += reward[node] * shares[count] * chance[count]
            left -= chance[count]
            total += reward[node] * shares[count] * max(left, 0.0)
    return total


@compiled
def _way(ahead: Any, source: int, target: int, trail: Any, length: int) -> int:
    """The trail goes on from `source` by the safest way to `target`; returns its length."""
    while source != target and length < len(trail):
        source = ahead[source, target]
        if source < 0:
            return len(trail)
        trail[length] = source
        length += 1
    return length


@compiled
def _part(old: Any, start: int, stop: int, step: int, trail: Any, length: int) -> int:
    """The trail goes on as `old[start:stop:step]`."""
    for place in range(start, stop, step):
        if length == len(trail):
            break
        trail[length] = old[place]
        length += 1
    return length


@compiled
def _worth(trail: Any, length: int, same: int, alive: float, chances: Any, weight: Any, rule: Any, marks: Any) -> Any:
    """(what the places after `same` bring, the chance to come home) of a trail; a chance of -1: it breaks a rule.

    `alive`: at the place `same`, up to which it is the old one. `rule`: (the base, whether nodes are visited once, the
    least chance to come home). `marks`: (of each node and of each arc its first place in the old trail, the same of the
    numbers of trails looked at, that number).
    """
    base, nodes_once, least = rule
    first, used, seen, crossed, number = marks
    number[0] += 1
    gain = 0.0
    if nodes_once and same > 0 and trail[same] == base and length > same + 1:
        return 0.0, -1.0
    for place in range(same + 1, length):
        tail, head = trail[place - 1], trail[place]
        if chances[tail, head] == 0.0 or used[tail, head] < same or crossed[tail, head] == number[0]:
            return 0.0, -1.0
        crossed[tail, head] = number[0]
        alive *= chances[tail, head]
        if alive < least:
            return 0.0, -1.0
        new = first[head] > same and seen[head] != number[0]
        if nodes_once and not new and not (head == base and place == length - 1):
            return 0.0, -1.0
        if new:
            seen[head] = number[0]
            gain += weight[head] * alive
    return gain, alive


@compiled
def visit_chances(trail: Any, length: int, chances: Any, visit: Any) -> float:
    """`visit[v]`: the chance to visit v; returns the chance to come home."""
    visit[:] = 0.0
    visit[trail[0]] = 1.0
    alive = 1.0
    for place in range(1, length):
        alive *= chances[trail[place - 1], trail[place]]
        if visit[trail[place]] == 0.0:
            visit[trail[place]] = alive
    return alive


@compiled
def _offer(archive: Any, place: int, robot: int, trail: Any, length: int, gained: float, home: float) -> int:
    """Keep the plan of `place` with another trail of a robot, if it is the best of its number home; 1: it was."""
    trails, lengths, reward, homes, fresh = archive
    places, robots = lengths.shape
    to = min(int(home * places / robots), places - 1)
    if gained <= reward[to] + NEAR:
        return 0
    if to != place:
        trails[to] = trails[place]
        lengths[to] = lengths[place]
    trails[to, robot, :length] = trail[:length]
    lengths[to, robot] = length
    reward[to], homes[to], fresh[to] = gained, home, True
    return 1


@compiled
def _try(same: int, alive: float, before: float, trail: Any, length: int, team: Any, marks: Any) -> int:
    """Offer a trail that is the old one up to the place `same`, if it fits and breaks no rule; 1: it is kept.

    `alive`: at that place; `before`: what the other robots and this one up to there bring. `team`: (the archive, the
    plan's place in it, the robot, expected others home, and chances, weight and rule of `_worth`).
    """
    archive, place, robot, others_home, chances, weight, rule = team
    if length >= len(trail):
        return 0
    gain, chance = _worth(trail, length, same, alive, chances, weight, rule, marks)
    return 0 if chance < 0.0 else _offer(archive, place, robot, trail, length, before + gain, others_home + chance)


@compiled
def explore(place: int, turn: int, graph: Any, rule: Any, archive: Any, known: Any) -> int:
    """Offer all changes of one trail of the plan at `place`; returns how many were kept.

    `graph`: (chances `[V, V]`, the next node `[V, V]` on the safest way, rewards `[V]`, shares of visits).
    `known`: (trails `[T, L]`, lengths `[T]`) that are offered whole.
    """
    chances, ahead, reward, shares = graph
    trails, lengths, _, _, _ = archive
    count, robots, most = len(reward), lengths.shape[1], trails.shape[2]
    visit, home, weight = np.zeros((robots, count)), np.zeros(robots), np.zeros(count)
    first, used = np.zeros(count, np.int64), np.zeros((count, count), np.int64)
    marks = (first, used, np.zeros(count, np.int64), np.zeros((count, count), np.int64), np.zeros(1, np.int64))
    gained, alive, new, kept = np.zeros(most), np.zeros(most), np.zeros(most, np.int16), 0
    for robot in range(robots):
        for one in range(robots):
            home[one] = visit_chances(trails[place, one], lengths[place, one], chances, visit[one])
        others = _weigh(robot, visit, reward, shares, weight)
        team = (archive, place, robot, home.sum() - home[robot], chances, weight, rule)
        old, length = trails[place, robot].copy(), lengths[place, robot]
        first[:], used[:] = most, most
        first[old[0]], alive[0], gained[0] = 0, 1.0, weight[old[0]]
        for at in range(1, length):
            used[old[at - 1], old[at]] = at - 1
            alive[at] = alive[at - 1] * chances[old[at - 1], old[at]]
            gained[at] = gained[at - 1]
            if first[old[at]] == most:
                first[old[at]] = at
                gained[at] += weight[old[at]] * alive[at]
        for begin in range(length):
            new[: begin + 1] = old[: begin + 1]
            for end in range(begin, length):
                near = end - begin <= SPAN
                for node in range(count):  # to a node and back to the trail; to the place itself: the safest way
                    direct = node == old[end] and end > begin
                    if direct or (near and weight[node] > 0.0 and first[node] > begin):
                        size = _way(ahead, old[begin], node, new, begin + 1)
                        size = _part(old, end + 1, length, 1, new, _way(ahead, node, old[end], new, size))
                        kept += _try(begin, alive[begin], others + gained[begin], new, size, team, marks)
                if end + 1 == length or end == begin:
                    continue
                size = _part(old, end - 1, begin, -1, new, _way(ahead, old[begin], old[end], new, begin + 1))
                size = _part(old, end + 2, length, 1, new, _way(ahead, old[begin + 1], old[end + 1], new, size))
                kept += _try(begin, alive[begin], others + gained[begin], new, size, team, marks)
                for last in range(end + 1, length - 1):
                    if (near and last - end <= SPAN) or (old[begin] == old[end] and old[end] == old[last]):
                        size = _way(ahead, old[begin], old[end + 1], new, begin + 1)
                        size = _way(ahead, old[last], old[begin + 1], new, _part(old, end + 2, last + 1, 1, new, size))
                        size = _way(ahead, old[end], old[last + 1], new, _part(old, begin + 2, end + 1, 1, new, size))
                        size = _part(old, last + 2, length, 1, new, size)
                        kept += _try(begin, alive[begin], others + gained[begin], new, size, team, marks)
        first[:], used[:] = most, most
        first[old[0]] = 0
        for other in range((place + turn) % STRIDE, len(lengths), STRIDE):
            for one in range(robots):
                if other != place and lengths[other, one] > 0:
                    size = lengths[other, one]
                    new[:size] = trails[other, one, :size]
                    kept += _try(0, 1.0, others + weight[old[0]], new, size, team, marks)
        for one in range(len(known[1])):
            kept += _try(0, 1.0, others + weight[old[0]], known[0][one], known[1][one], team, marks)
    return kept
