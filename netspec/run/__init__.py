"""Runs a net: a loop over steps, and runners that make these steps from a Plan and its layers, without a Net."""
