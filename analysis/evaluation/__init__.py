"""The evaluation of a plan: coverage, losses and time, with their uncertainty."""
