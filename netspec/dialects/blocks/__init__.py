"""Building blocks that many forks have."""
