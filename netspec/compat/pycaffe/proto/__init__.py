"""Caffe's messages under the name that scripts import: ``from caffe.proto import caffe_pb2``."""

from netspec.compat.pycaffe.proto import caffe_pb2

__all__ = ["caffe_pb2"]
