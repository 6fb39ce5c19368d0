"""The answer of `check --worlds`: how often does each formula hold on random maps?"""
