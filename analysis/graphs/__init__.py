"""What can a team fetch from a graph whose arcs are dangerous, how many come home, and what does no team exceed?"""
