"""Reads the logs of trainings by netspec and Caffe: loss, outputs and rate."""
