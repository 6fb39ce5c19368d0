"""The page of a report: one HTML file beside the pictures, that opens by a double click, offline, and asks nobody.

`document` is the page and its plots, `maps` its maps; `analysis.report.rendering` makes it of a report.
"""
