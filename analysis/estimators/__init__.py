"""Estimates of a plan, exact or sampled, and the best of many settings on common random numbers."""
