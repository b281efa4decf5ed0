"""SSD, the single shot detector (weiliu89/caffe, branch ssd)."""
