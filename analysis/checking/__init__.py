"""The result of `check INPUT`: the formulas that hold on this map."""
