"""What runs a net: one loop over steps, and the runners that make steps of a plan and its layers. None knows a Net."""
