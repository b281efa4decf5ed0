"""R-CNN: regions of interest, and what Faster R-CNN and R-FCN have in Python."""
