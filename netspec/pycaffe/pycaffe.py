"""The names of ``caffe.pycaffe``."""

from netspec.pycaffe.net import Net
from netspec.pycaffe.parallel import NCCL, Timer
from netspec.pycaffe.solver import (
    AdaDeltaSolver,
    AdaGradSolver,
    AdamSolver,
    NesterovSolver,
    RMSPropSolver,
    SGDSolver,
)
