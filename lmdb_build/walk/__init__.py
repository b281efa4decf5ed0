"""A synthetic walk through a house, drawn from a seed."""
