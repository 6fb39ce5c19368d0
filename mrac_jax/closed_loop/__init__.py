"""The closed loop in JAX: a book of decisions, and lanes that jump from one to the next (README.md)."""
