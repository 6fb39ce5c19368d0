"""The command line: one file a command; options, groups, console, progress."""
