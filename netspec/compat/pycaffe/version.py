"""The version of Caffe that this interface follows."""

__version__ = "1.0.0"
