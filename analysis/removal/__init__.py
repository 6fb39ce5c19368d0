"""The answer of `clear`: which threat is worth removing first, for robots that know of it and for those that do not?"""
