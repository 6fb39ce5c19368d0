"""The matplotlib kit: colours, maps, robots; knows no answer."""
