"""Closing the loops: odometry and loops become a pose graph, which is solved so that false loops do no harm."""
