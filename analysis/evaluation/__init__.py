"""The answer of `evaluate`: how much of this map will this plan cover, and how sure is that?"""
