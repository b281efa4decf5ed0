"""The names of ``caffe.pycaffe``."""

from netspec.compat.pycaffe.net import Net
from netspec.compat.pycaffe.solver import (
    AdaDeltaSolver,
    AdaGradSolver,
    AdamSolver,
    NesterovSolver,
    RMSPropSolver,
    SGDSolver,
)
