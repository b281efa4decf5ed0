"""Layers in Python: a data layer, and a loss with its gradient, in a net that learns a line."""

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import netspec.pycaffe as caffe
from netspec.pycaffe import layers as L


class Points(caffe.Layer):
    """Gives x and y = 3 x - 1; ``param_str`` has the size of a batch."""

    def setup(self, bottom, top):
        self.batch = int(self.param_str)
        self.random = np.random.RandomState(1)

    def reshape(self, bottom, top):
        top[0].reshape(self.batch, 1)
        top[1].reshape(self.batch, 1)

    def forward(self, bottom, top):
        top[0].data[...] = self.random.uniform(-1, 1, (self.batch, 1))
        top[1].data[...] = 3 * top[0].data - 1

    def backward(self, top, propagate_down, bottom):
        pass


class SquaredLoss(caffe.Layer):
    """Half of the mean squared difference of two bottoms."""

    def reshape(self, bottom, top):
        self.difference = np.zeros_like(bottom[0].data)
        top[0].reshape(1)

    def forward(self, bottom, top):
        self.difference[...] = bottom[0].data - bottom[1].data
        top[0].data[...] = (self.difference**2).sum() / len(self.difference) / 2

    def backward(self, top, propagate_down, bottom):
        for sign, wanted, blob in zip((1, -1), propagate_down, bottom, strict=True):
            blob.diff[...] = wanted * sign * top[0].diff[0] * self.difference / len(self.difference)


if __name__ == "__main__":
    os.chdir(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp())
    n = caffe.NetSpec()
    n.x, n.y = L.Python(module="python_layers", layer="Points", param_str="32", ntop=2)
    n.line = L.InnerProduct(n.x, num_output=1)
    n.loss = L.Python(n.line, n.y, module="python_layers", layer="SquaredLoss", loss_weight=1)
    Path("net.prototxt").write_text(str(n.to_proto()))
    Path("solver.prototxt").write_text('net: "net.prototxt" base_lr: 0.5 lr_policy: "fixed" snapshot_prefix: "s"\n')
    solver = caffe.SGDSolver("solver.prototxt")
    solver.step(100)
    slope, offset = (float(blob.data.item()) for blob in solver.net.params["line"])
    print(f"y = {slope:.3f} x + {offset:.3f}, loss {float(solver.net.blobs['loss'].data[0]):.1e}")
