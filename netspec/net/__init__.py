"""Builds nets from text, runs them, and reads and writes their weights."""
