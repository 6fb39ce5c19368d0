"""Exact values, the paper's formulas, and bounds. This package imports no simulator."""
