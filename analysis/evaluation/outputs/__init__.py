"""What `evaluate` finds out only if it is asked to: a file each, and a line each in `table.py`."""
