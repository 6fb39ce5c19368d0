"""Sets of rollout ids as ranges."""

from __future__ import annotations

from collections.abc import Iterable

Ranges = tuple[tuple[int, int], ...]
"""Rollout ids: sorted, disjoint `(start, stop)`, stop excluded."""


def joined(ids: Iterable[Iterable[int]]) -> Ranges:
    """Ranges of ids sorted, overlapping and touching ones as one."""
    merged: list[tuple[int, int]] = []
    for start, stop in sorted((int(start), int(stop)) for start, stop in ids):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return tuple(merged)


def cut(ids: Ranges, size: int) -> list[tuple[int, int]]:
    """The ids in parts `(start, stop)`, cut at multiples of `size`."""
    parts = []
    for start, stop in ids:
        while start < stop:
            end = min(stop, (start // size + 1) * size)
            parts.append((start, end))
            start = end
    return parts


def without(ids: Ranges, taken: Ranges) -> Ranges:
    """The ids that are not taken; both sorted and disjoint."""
    left = []
    for start, stop in ids:
        for begin, end in taken:
            if begin >= stop or end <= start:
                continue
            if start < begin:
                left.append((start, begin))
            start = max(start, end)
        if start < stop:
            left.append((start, stop))
    return tuple(left)
