"""Makes labeled pairs from image sequences, and databases for Data layers from pairs."""
