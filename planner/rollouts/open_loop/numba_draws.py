"""Draws of the Numba open loop: the row of every group of robots in every rollout of a tile."""

from __future__ import annotations

import numpy as np

from planner.jit import rare_kernel
from planner.kernels.bits import leading_zeros
from planner.kernels.luck import as_it_is, threefry, tolerance
from planner.rollouts.open_loop.kernels import wide_vectors
from planner.tolerance import unworn


@rare_kernel
def drawn_once_rows(key, first, draw, words, rows):  # type: ignore[no-untyped-def]
    """Rows int32 `[G, L]` of the rollouts from id `first` on, by inverse survival of one word a slot.

    `draw`: see `draw_arguments`; `words`: uint32 `[L]`, room for the words of one slot.
    """
    members, first_row, stride, counter, second, mantissa, bisections, table, threshold = draw
    for group in range(rows.shape[0]):
        rows[group, :] = first_row[group]
        for member in range(members):
            slot = group * members + member
            _words(key[0], key[1], first, counter[slot], second, words)
            step = np.int32(stride[group, member])
            if bisections == 0:
                _add_packed(words, table[slot], np.uint32(31 - mantissa), step, rows[group])
            else:
                _add_bisected(
                    words, table[slot], threshold[slot], np.uint32(31 - mantissa), bisections, step, rows[group]
                )


@rare_kernel
def _words(key0, key1, first, counter, second, words):  # type: ignore[no-untyped-def]
    """The first words of the counters, or the second ones where all bits of `second` are set."""
    wide_vectors()
    for lane in range(words.shape[0]):
        x0, x1 = threefry(key0, key1, np.uint32(first + np.uint32(lane)), counter)
        words[lane] = np.uint32(x0 ^ np.uint32(np.uint32(x0 ^ x1) & second))


@rare_kernel
def _add_packed(words, table, low_bits, step, rows):  # type: ignore[no-untyped-def]
    """Adds step * outcome to the rows, by one read of the guide (its formula: `guide.Guide`)."""
    wide_vectors()
    low = np.uint32(np.uint32(1) << low_bits) - np.uint32(1)
    for lane in range(words.shape[0]):
        zeros = leading_zeros(np.uint32(words[lane] | np.uint32(1)))
        normal = np.uint32(words[lane] << zeros)
        octave = np.uint32(np.uint32(31) - zeros)
        bucket = np.uint32(np.uint32(normal >> low_bits) + np.uint32(octave << np.uint32(np.uint32(31) - low_bits)))
        found = table[bucket]
        above = np.int32(np.uint32(normal & np.uint32(low)) < np.uint32(found & np.uint32(low)))
        rows[lane] += np.int32(np.int32(np.int32(found >> low_bits) + above) * step)


@rare_kernel
def _add_bisected(words, table, threshold, low_bits, bisections, step, rows):  # type: ignore[no-untyped-def]
    """The same where buckets hold several thresholds."""
    for lane in range(words.shape[0]):
        zeros = leading_zeros(np.uint32(words[lane] | np.uint32(1)))
        octave = np.uint32(np.uint32(31) - zeros)
        bucket = (np.uint32(words[lane] << zeros) >> low_bits) + (octave << np.uint32(np.uint32(31) - low_bits))
        outcome = np.int64(table[bucket])
        half = 1 << (bisections - 1)
        while half > 0:
            if words[lane] < threshold[outcome + half]:
                outcome += half
            half >>= 1
        rows[lane] += np.int32(outcome * step)


@rare_kernel
def joint_rows(key, own, first, size, draw, alive, borne, spent, rows):  # type: ignore[no-untyped-def]
    """Rows `[G, L]` of `size` rollouts from id `first` on, entry by entry of all robots (`joint_draws`).

    `alive`, `borne`, `spent`: bool and int64 `[S]`, bool `[cells]`, room for one rollout; no cells: none is spent.
    """
    members, first_row, stride, entry, table, exposure, doses, (robot, nodes, times), last = draw
    slots, places, counters, own_counters, theres, bounds, columns, spots = entry
    for lane in range(size):
        rollout = np.uint32(first + np.uint32(lane))
        alive[:], spent[:], borne[:] = True, False, 0
        for group in range(rows.shape[0]):
            rows[group, lane] = first_row[group]
            for member in range(members):
                rows[group, lane] += np.int32(stride[group, member] * last[group * members + member])
        for number in range(len(slots)):
            slot = slots[number]
            # In the order of the run: what an earlier robot hit may be gone.
            if not alive[slot] or (len(spent) > 0 and spent[spots[number]]):
                continue
            word = np.int64(threefry(own[0], own[1], rollout, own_counters[number])[0] >> np.uint32(8))
            if len(exposure) > 0:
                borne[slot] += as_it_is(exposure, doses, theres, columns, number, word)
                reached = unworn(borne[slot], nodes, times[slot])
                hit = reached >= tolerance(threefry(key[0], key[1], rollout, robot[slot])[0])
            else:
                bound = as_it_is(bounds, table, theres, columns, number, word)
                hit = threefry(key[0], key[1], rollout, counters[number])[0] >> np.uint32(8) < bound
            if hit:
                alive[slot] = False
                group, member = slot // members, slot % members
                rows[group, lane] -= np.int32(stride[group, member] * (last[slot] - places[number]))
                if len(spent) > 0:
                    spent[spots[number]] = True
