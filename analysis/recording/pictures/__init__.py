"""A recording drawn: a picture of a run, an animation."""
