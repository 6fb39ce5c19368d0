"""Means, intervals and quantiles of integer counts; control variates and differences."""
