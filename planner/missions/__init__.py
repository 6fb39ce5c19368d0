"""A mission that is driven: orders out, reports in (`Mission`); how it is kept in a file, and what may happen to it."""
