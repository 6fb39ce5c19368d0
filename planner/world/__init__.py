"""Worlds: maps, threats and what changes them; files and arrays in, a `World` out."""
