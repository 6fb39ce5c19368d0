"""A mission that is driven: orders out, reports in."""
