"""Upgrades of nets and solvers from all older formats to the current one."""
