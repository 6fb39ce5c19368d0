"""The generator in jnp and Numba against the published vectors and the NumPy one."""

from __future__ import annotations

import numpy as np
import pytest
from test_planner_threefry import KNOWN

from planner.failure_model import key_of, threefry2x32


@pytest.mark.parametrize(("counter", "key", "words"), KNOWN)
def test_published_vectors(counter: tuple[int, int], key: tuple[int, int], words: tuple[int, int]) -> None:
    import jax.numpy as jnp

    from mrac_jax.arrays import threefry2x32 as jax_threefry
    from planner.simulator.failure_sampling import threefry

    of_jax = jax_threefry(jnp.array(key, jnp.uint32), jnp.uint32(counter[0]), jnp.uint32(counter[1]))
    of_numba = threefry(*(np.uint32(word) for word in (*key, *counter)))
    for found in (of_jax, of_numba):
        assert tuple(int(word) for word in found) == words


def test_equal_to_numpy_on_many_counters() -> None:
    import jax
    import jax.numpy as jnp

    from mrac_jax.arrays import threefry2x32 as jax_threefry
    from planner.jit import program
    from planner.rollouts.open_loop_numba import _words

    key = key_of(0x0123456789ABCDEF)
    counters = np.arange(2**32 - 500, 2**32 + 500, dtype=np.uint64).astype(np.uint32)
    expected = threefry2x32(key, counters, 77)
    found = jax.vmap(jax_threefry, in_axes=(None, 0, None))(jnp.array(key, jnp.uint32), counters, jnp.uint32(77))
    assert np.array_equal(found[0], expected[0]) and np.array_equal(found[1], expected[1])
    words = np.zeros(1000, np.uint32)

    @program
    def draw(*of):  # type: ignore[no-untyped-def]
        _words(*of)

    draw(np.uint32(key[0]), np.uint32(key[1]), counters[0], np.uint32(77), np.uint32(0), words)
    assert np.array_equal(words, expected[0])
