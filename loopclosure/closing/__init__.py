"""Corrects a path by its loops: builds a pose graph of odometry and loops, and solves it despite false loops."""
