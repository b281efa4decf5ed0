"""Visual words, and the methods built on them."""
