"""The answer of `front`: what does more coverage cost in robots, and with which policy is it cheapest?"""
