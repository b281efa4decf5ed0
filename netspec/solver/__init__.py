"""Training: learning rates, update rules, the training loop, and the files to resume from."""
