"""Means, intervals and quantiles of integer counts; the control variate; paired differences."""
