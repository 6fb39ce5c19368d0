"""How does the plan get to the robots, and the answer onto a map? Ways out to ground stations, nav2 and GIS."""
