"""An answer, stated once: its room's `report.py` says it as a tree of blocks, which every medium shows in its own way.

A terminal prints it; a folder holds it as a page, text, JSON, pictures and what else it names; a console and a notebook
show its headline and rows. A medium knows blocks, and no answer.
"""
