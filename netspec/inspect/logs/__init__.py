"""Trainings, as their logs tell them (Caffe's logs too): loss, outputs, rate and speed."""
