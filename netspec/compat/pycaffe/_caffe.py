"""The names of Caffe's compiled module, ``caffe._caffe``."""

from netspec.compat.pycaffe.logs import init_log
from netspec.compat.pycaffe.logs import log_message as log
from netspec.compat.pycaffe.mode import (
    set_device,
    set_mode_cpu,
    set_mode_gpu,
    set_random_seed,
)
from netspec.compat.pycaffe.net import Net
from netspec.compat.pycaffe.solver import (
    AdaDeltaSolver,
    AdaGradSolver,
    AdamSolver,
    NesterovSolver,
    RMSPropSolver,
    SGDSolver,
    Solver,
    get_solver,
)
from netspec.compat.pycaffe.version import __version__
from netspec.layers import layer_types as layer_type_list
from netspec.layers.utility.live_blobs import Blob, BlobVec
from netspec.layers.utility.pycaffe_shim import Layer

RawBlobVec = BlobVec  # its name in the Caffe of 2015, which layers in Python import
