"""The closed loop, compiled with Numba: arrays in, arrays out."""
