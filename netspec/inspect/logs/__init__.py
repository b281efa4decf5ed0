"""Reads the logs of trainings, Caffe's too: loss, outputs, rate and speed."""
