"""Training: the rate of an iteration, the update rules, the loop, and the files it can go on from."""
