"""Algorithm 2 again, compiled with Numba: state, tables, paths and areas, and whole rollouts."""
