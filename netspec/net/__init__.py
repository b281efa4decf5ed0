"""Runnable nets: building them from text, running them, and reading and writing weights."""
