"""The MRAC algorithm, readable: areas, costs, METIS splits, Algorithms 1 to 3, and the plan that comes of them."""
