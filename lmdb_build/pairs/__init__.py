"""Labeled pairs of images: which ones, and the lists that name them."""
