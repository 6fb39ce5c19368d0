"""Means, intervals and quantiles of integer counts; the control by luck, and differences."""
