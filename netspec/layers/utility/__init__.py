"""Layers for arithmetic between blobs, for rearranging values, and for Python code."""
