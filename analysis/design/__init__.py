"""The answers that choose: how many robots are enough?"""
