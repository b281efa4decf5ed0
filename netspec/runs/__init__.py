"""Trainings, as their logs tell them: curves of loss, outputs, rate and speed. Caffe's logs and netspec's alike."""
