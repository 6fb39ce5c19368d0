"""Benchmarks: rates of engines, environments and planning, measured side by side."""
