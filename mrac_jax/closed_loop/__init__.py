"""The closed loop in JAX: a table of decisions (the book), and rollouts (lanes) that jump between them (README.md)."""
