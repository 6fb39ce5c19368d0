"""The store of a sweep: blocks of counts that survive kills, damage and power cuts."""
