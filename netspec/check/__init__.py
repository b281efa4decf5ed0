"""Checks and measurements of a net or a solver: shapes, costs, errors, likely mistakes."""
