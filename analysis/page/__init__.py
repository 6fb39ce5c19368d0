"""The page of a report: one HTML file beside the pictures, that opens by a double click, offline, and asks nobody.

`markup` (escaping) -> `document` (the page) -> `curves`, `cell_maps`, `strips`, `tables`, `runs` (what stands in it);
`analysis.report.rendering` makes it of a report.
"""
