"""What is a policy of one's own worth? Judged on the luck of plans, between a random walk and the proven bound."""
