"""A training in the terminal, drawn again as its log grows."""
