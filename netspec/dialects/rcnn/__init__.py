"""R-CNN: layers for regions of interest, and the Python layers of Faster R-CNN and R-FCN."""
