"""Plans for a team that cannot talk: paths whose expected coverage without reallocation is searched for.

Every robot plans the whole map for itself (`per_cell`, alone); then each in turn answers the others: given the chances
`S_j(c)` that the others get to a cell, a path is worth `sum_c S_i(c) prod_{j != i} (1 - S_j(c))`, exactly what it adds
to the team's expected coverage `sum_c 1 - prod_j (1 - S_j(c))` (the closed form of SPEC section 6). Simulated annealing
over the order of its targets looks for a better one.

The expected coverage is a monotone submodular function of the set of paths, so answering in turn from nothing with an
optimal path each time covers at least half of the best (a factor alpha from the optimal path: alpha / (1 + alpha);
Jorgensen, Chen, Milam, Pavone: The Team Surviving Orienteers Problem, arXiv 1612.03232). The paths found here are not
known to be optimal ones, so that says why answering in turn is sound, not how good the result is.
"""
