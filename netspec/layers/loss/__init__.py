"""Losses, and the accuracy that is measured like one."""
