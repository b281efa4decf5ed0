"""All names of Caffe's Python interface; with them torch is loaded. Caffe: python/caffe/__init__.py."""

import sys

from netspec.layers import layer_types as layer_type_list
from netspec.layers.utility import pycaffe_shim
from netspec.layers.utility.pycaffe_shim import TEST, TRAIN, Layer
from netspec.pycaffe import _caffe, classifier, coord_map, detector, draw, io, logs, net_spec, proto, pycaffe
from netspec.pycaffe.classifier import Classifier
from netspec.pycaffe.detector import Detector
from netspec.pycaffe.logs import init_log
from netspec.pycaffe.logs import log_message as log
from netspec.pycaffe.mode import (
    set_device,
    set_mode_cpu,
    set_mode_gpu,
    set_multiprocess,
    set_random_seed,
    set_solver_count,
    set_solver_rank,
    solver_count,
    solver_rank,
)
from netspec.pycaffe.net import Net
from netspec.pycaffe.net_spec import NetSpec, layers, params, to_proto
from netspec.pycaffe.parallel import NCCL, Timer, has_nccl
from netspec.pycaffe.solver import (
    AdaDeltaSolver,
    AdaGradSolver,
    AdamSolver,
    NesterovSolver,
    RMSPropSolver,
    SGDSolver,
    get_solver,
)

pycaffe_shim.offer(sys.modules[__name__.rpartition(".")[0]])
