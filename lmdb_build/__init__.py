"""From image sequences to labeled pairs, and from pairs to databases for Data layers."""
