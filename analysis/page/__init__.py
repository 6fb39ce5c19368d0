"""The page of a report: one HTML file with its pictures embedded, which works offline and makes no requests.

`document` renders the page and its plots, `maps` its maps; `analysis.report.rendering` makes it from a report.
"""
