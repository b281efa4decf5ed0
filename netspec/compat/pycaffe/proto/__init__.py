"""Caffe's messages, where scripts look for them: ``from caffe.proto import caffe_pb2``."""

from netspec.compat.pycaffe.proto import caffe_pb2

__all__ = ["caffe_pb2"]
