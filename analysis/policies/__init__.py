"""The answer of `reproduce policies`: what do policies bring over the paper's, and where are they worse?"""
