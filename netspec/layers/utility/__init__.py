"""Layers that compute between blobs, move numbers, or run Python code."""
