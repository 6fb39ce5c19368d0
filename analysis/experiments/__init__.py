"""The paper's experiments, and studies of policies and of map knowledge on many random maps."""
