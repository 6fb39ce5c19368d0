"""Plans rolled out: what an engine is, both loops compiled to arrays, the Numba engines; others by name."""
