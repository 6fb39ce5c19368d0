"""The generator in jnp and Numba against the published vectors and the NumPy one."""

from __future__ import annotations

import numpy as np
import pytest

from planner.threefry import key_of, threefry2x32, uniform

# Random123 1.09, tests/kat_vectors: threefry2x32 with 20 rounds; counter, key, words.
PUBLISHED = [
    ((0x00000000, 0x00000000), (0x00000000, 0x00000000), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
    ((0x243F6A88, 0x85A308D3), (0x13198A2E, 0x03707344), (0xC4923A9C, 0x483DF7A0)),
]


@pytest.mark.parametrize(("counter", "key", "words"), PUBLISHED)
def test_published_vectors(counter: tuple[int, int], key: tuple[int, int], words: tuple[int, int]) -> None:
    import jax.numpy as jnp

    from mrac_jax.threefry import threefry2x32 as jax_threefry
    from planner.kernels.luck import threefry

    of_jax = jax_threefry(jnp.array(key, jnp.uint32), jnp.uint32(counter[0]), jnp.uint32(counter[1]))
    of_numba = threefry(*(np.uint32(word) for word in (*key, *counter)))
    of_numpy = threefry2x32(key, *counter)
    for found in (of_jax, of_numba, of_numpy):
        assert tuple(int(word) for word in found) == words


def test_equal_to_numpy_on_many_counters() -> None:
    import jax
    import jax.numpy as jnp

    from mrac_jax.threefry import threefry2x32 as jax_threefry
    from planner.jit import program
    from planner.rollouts.open_loop.numba_draws import _words

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


def test_uniform_of_the_fixtures() -> None:
    assert uniform(1, 3, 17, 5) == np.float32(0.9260450601577759)
    assert uniform(7 * 2**32 + 5, 2, 3, 4) == np.float32(0.15028107166290283)
