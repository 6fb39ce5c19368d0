"""The report of a result: a tree of sections and elements, stated once in its package's `report.py`.

Each medium renders the tree: a terminal prints it; a folder holds a page, text, JSON, pictures and other files; a
console and a notebook show its summary and rows. A medium depends on the elements, not on the result.
"""
