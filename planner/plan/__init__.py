"""Plans and the states of missions, as data and as files."""
