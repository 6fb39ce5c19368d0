"""Exports of plans to ground stations, robots and GIS."""
