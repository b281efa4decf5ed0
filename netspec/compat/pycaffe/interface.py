"""All names of Caffe's Python interface; importing it loads torch. Caffe: python/caffe/__init__.py."""

from netspec.compat.pycaffe import _caffe, classifier, coord_map, detector, draw, io, logs, net_spec, proto, pycaffe
from netspec.compat.pycaffe._caffe import *  # noqa: F403, the compiled module's names, as in Caffe
from netspec.compat.pycaffe.classifier import Classifier
from netspec.compat.pycaffe.detector import Detector
from netspec.compat.pycaffe.mode import set_exact  # not in Caffe
from netspec.compat.pycaffe.net_spec import NetSpec, layers, params, to_proto
from netspec.layers.utility.pycaffe_shim import TEST, TRAIN
