"""Utilities that know no result: progress, tables, a process pool."""
