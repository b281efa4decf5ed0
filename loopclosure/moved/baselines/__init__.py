"""Was loopclosure.baselines."""
