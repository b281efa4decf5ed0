"""What a net or a solver builds and measures, and what is likely wrong with it."""
