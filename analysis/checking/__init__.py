"""The answer of `check INPUT`: which formulas hold on this map?"""
