"""Nets that tell faces apart: their normalization and losses."""
