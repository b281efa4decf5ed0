"""Was loopclosure.baselines.thumbnails."""

from loopclosure.descriptors.thumbnails import Thumbnailer as Thumbnailer
