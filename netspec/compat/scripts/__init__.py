"""Runs programs written for pycaffe, and installs ``caffe`` and Caffe's commands into a Python environment."""
