"""Caffe's data: databases of Datums, lists of images, transformations of images. This package does not use torch."""
