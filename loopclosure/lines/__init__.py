"""Lines of similar pairs in a matrix of scores: what finding loops afterwards and online have in common."""
