"""The closed loop in JAX: a book of decisions, and lanes that jump from one to the next.

Read `book` first (what robots do between two decisions), then `lanes` (a rollout's state), `events` (the next
decision), `sharing` and `returning` (parts of it), `start` (the first step), `engine` (batches, devices), `counting`
(counts from the walks that lanes log), and `pure` (pure functions of pytrees).
"""
