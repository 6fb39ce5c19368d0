"""The shipped examples (package data)."""
