"""Worlds: every kind of map and threat file in; the grid, its graph, its levels and the paper's random maps."""
