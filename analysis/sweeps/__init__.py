"""Sweeps: many maps, teams, planners and models, run on processes or a cluster, kept in a store that survives."""
