"""What does a policy of one's own make of this world? The mission as an environment that policies are learned in."""
