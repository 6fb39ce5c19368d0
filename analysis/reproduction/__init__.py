"""The answer of `reproduce`: which statements of the paper hold?"""
