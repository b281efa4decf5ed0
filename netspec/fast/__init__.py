"""Faster code for nets, with the same results. It is optional: without this folder, nets run by ``forward``."""
