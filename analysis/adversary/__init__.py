"""The answer of `attack`: where would an adversary place threats, if robots know of them and if they do not?"""
