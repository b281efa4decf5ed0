"""The methods for ``--method``."""
