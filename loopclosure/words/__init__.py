"""Visual words, and the methods that are built on them."""
