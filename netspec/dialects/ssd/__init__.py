"""SSD: detection by boxes over many maps (weiliu89/caffe, branch ssd)."""
