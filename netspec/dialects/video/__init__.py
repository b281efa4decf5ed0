"""Video: optical flow, and stacks of frames."""
