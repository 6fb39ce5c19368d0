"""Plans compiled to fixed-shape arrays, and their open-loop rollouts in JAX and in Numba."""
