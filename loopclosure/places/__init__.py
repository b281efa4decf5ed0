"""Images, poses and cameras, the ground truth of places, and data sets."""
