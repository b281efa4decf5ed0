"""Layers for face recognition: normalization and losses."""
