"""The MRAC planner: worlds and threats in, plans out; the classical simulator; never imports JAX."""
