"""Descriptors of images: their files and their similarity."""
