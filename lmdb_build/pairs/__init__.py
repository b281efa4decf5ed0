"""Chooses labeled pairs of images, and reads and writes lists of them."""
