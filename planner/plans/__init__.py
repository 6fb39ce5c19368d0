"""Plans: what is in one, its file, its validator and the waypoints to drive it."""
