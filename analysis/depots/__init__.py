"""The answer of `starts`: where should the robots start, all at one depot or each at a place of its own?"""
