"""Lines and areas cut at longitude 180, as RFC 7946, 3.1.9, asks: no part of them spans the world on a flat map."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from planner.worlds.georeference import TURN, near

Ring = NDArray[np.float64]
"""Corners (longitude, latitude) `[points, 2]`, the last one the first; longitudes go on across 180."""
HALF = TURN / 2
POLE = 90 - 1e-9
"""Latitude from which a corner is at the pole (0.1 mm)."""


def over_a_pole(ring: Ring) -> bool:
    """True for a closed ring around a pole, or through one: every step goes the short way round."""
    steps = near(np.diff(ring[:, 0]), 0.0, TURN)
    through = np.abs(np.abs(steps) - HALF) < 1e-6
    return bool(abs(steps.sum()) > HALF or through.any() or (np.abs(ring[:, 1]) >= POLE).any())


def cut_line(line: Ring) -> list[Ring]:
    """The parts of a line, longitudes in -180..180; one that only touches 180 is not cut."""
    parts: list[list[NDArray[np.float64]]] = []
    turn = None
    for one, other in pairwise(line):
        for start, end in _pieces(one, other):
            own = math.floor(((start[0] + end[0]) / 2 + HALF) / TURN)
            if own != turn:
                parts.append([start - (own * TURN, 0)])
                turn = own
            parts[-1].append(end - (own * TURN, 0))
    return [np.array(part) for part in parts]


def _pieces(
    one: NDArray[np.float64], other: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """A step of a line, cut wherever it crosses a longitude at which a turn ends."""
    low, high = sorted((one[0], other[0]))
    seams = [TURN * n + HALF for n in range(math.floor((low - HALF) / TURN), math.ceil((high - HALF) / TURN) + 1)]
    crossed = sorted((seam for seam in seams if low < seam < high), reverse=bool(one[0] > other[0]))
    ends = [one, *(_crossing(one, other, seam) for seam in crossed), other]
    return list(pairwise(ends))


def _crossing(one: NDArray[np.float64], other: NDArray[np.float64], seam: float) -> NDArray[np.float64]:
    """Where the step is at this longitude; the same from both ends."""
    (x0, y0), (x1, y1) = sorted((tuple(one), tuple(other)))
    return np.array([seam, y0 + (seam - x0) * (y1 - y0) / (x1 - x0)])


def cut_area(rings: list[Ring]) -> list[list[Ring]]:
    """The parts of an area (its outer ring first, then its holes), each as rings, longitudes in -180..180.

    Outer rings are counterclockwise and holes clockwise, before and after.
    """
    low, high = min(ring[:, 0].min() for ring in rings), max(ring[:, 0].max() for ring in rings)
    first, last = math.floor((low + HALF) / TURN), math.ceil((high + HALF) / TURN) - 1
    if last <= first:
        return [[ring - (first * TURN, 0) for ring in rings]]
    parts: list[list[Ring]] = []
    for turn in range(first, last + 1):
        kept = rings
        if turn > first:
            kept = _mirrored(_west_of(_mirrored(kept), HALF - turn * TURN))
        if turn < last:
            kept = _west_of(kept, turn * TURN + HALF)
        parts += _with_holes([ring - (turn * TURN, 0) for ring in kept])
    return parts


def _mirrored(rings: list[Ring]) -> list[Ring]:
    """East and west changed, corners the other way round, so that the inside stays on the left."""
    return [ring[::-1] * (-1, 1) for ring in rings]


def _west_of(rings: list[Ring], seam: float) -> list[Ring]:
    """What of an area, on the left of its rings, lies west of a longitude: rings in the same sense.

    The rings' stretches in the west are joined along the longitude, from where the first one leaves the west, in the
    south, to where the first one enters it, and so on: with the inside on the left, the two take turns.
    """
    whole: list[Ring] = []
    chains: list[list[NDArray[np.float64]]] = []
    for ring in rings:
        corners = ring[:-1]
        west = corners[:, 0] < seam
        if west.all() or not west.any():
            whole += [ring] if west.all() else []
            continue
        first = int(np.flatnonzero(west & ~np.roll(west, 1))[0])
        corners, west = np.roll(corners, -first, axis=0), np.roll(west, -first)
        for at in np.flatnonzero(west):
            if not west[at - 1]:
                chains.append([_crossing(corners[at - 1], corners[at], seam)])
            chains[-1].append(corners[at])
            after = (at + 1) % len(corners)
            if not west[after]:
                chains[-1].append(_crossing(corners[at], corners[after], seam))
    leaves, enters = (sorted(range(len(chains)), key=lambda n: float(chains[n][side][1])) for side in (-1, 0))
    onward = dict(zip(leaves, enters, strict=True))
    while onward:
        points: list[NDArray[np.float64]] = []
        number = next(iter(onward))
        while number in onward:
            points += chains[number]
            number = onward.pop(number)
        whole.append(np.array([*points, points[0]]))
    return whole


def _with_holes(rings: list[Ring]) -> list[list[Ring]]:
    """Outer rings, each with the holes within it; rings without an inside are left out."""
    sizes = [_signed_area(ring) for ring in rings]
    outer = [[ring] for ring, size in zip(rings, sizes, strict=True) if size > 0]
    for ring, size in zip(rings, sizes, strict=True):
        if size < 0:
            middle = (ring[0] + ring[1]) / 2
            next((part for part in outer if _holds(part[0], middle)), outer[0]).append(ring)
    return outer


def _signed_area(ring: Ring) -> float:
    """Above 0: counterclockwise."""
    x, y = (ring - ring[0]).T
    return float((x[:-1] * y[1:] - x[1:] * y[:-1]).sum()) / 2


def _holds(ring: Ring, place: NDArray[np.float64]) -> bool:
    """True if the place lies within the ring (even-odd rule)."""
    (x0, y0), (x1, y1) = ring[:-1].T, ring[1:].T
    crosses = (y0 > place[1]) != (y1 > place[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x0 + (place[1] - y0) * (x1 - x0) / (y1 - y0)
    return bool(np.count_nonzero(crosses & (at > place[0])) % 2)
