"""The formats that nets are exported to."""
