"""The closed loop as one JAX program over lanes, and the batches of either engine."""
