"""The mission as an environment for learning policies."""
