"""Former name of loopclosure.descriptors.thumbnails."""

from loopclosure.descriptors.thumbnails import Thumbnailer as Thumbnailer
