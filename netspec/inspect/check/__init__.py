"""Checks, comparisons and measurements of nets and solvers: shapes, costs, errors, likely mistakes, differences."""
