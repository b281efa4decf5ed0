"""Segmentation and edges: a label for each pixel."""
