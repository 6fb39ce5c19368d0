"""The open loop: plans compiled to fixed-shape arrays, rolled out in JAX and in Numba."""
