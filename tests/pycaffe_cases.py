"""Runs golden cases with caffe.Net, which has its own passes."""

import numpy as np

import netspec.pycaffe as caffe
from golden_cases import LayerCase
from netspec.proto.schema import PHASES


def compute(case: LayerCase) -> dict[str, np.ndarray]:
    """Return the contents of the blobs after the passes, under Caffe's keys."""
    golden, meta = case.golden, case.meta
    net = caffe.Net(str(case.folder / "net.prototxt"), PHASES[meta["phase"]])
    for key, array in golden.items():
        kind, _, name = key.partition("/")
        if kind == "param_init":
            layer, _, index = name.rpartition("/")
            net.params[layer][int(index)].data[...] = array
        elif kind == "in":
            net.blobs[name].data[...] = array
    for _ in range(meta["warmup"] + 1):
        outputs = net.forward()
    if meta["grad"]:
        for key, array in golden.items():
            if key.startswith("topdiff/"):
                net.blobs[key.partition("/")[2]].diff[...] = array
        net.backward()
    found = {f"out/{name}": array for name, array in outputs.items()}
    for key in golden:
        kind, _, name = key.partition("/")
        if kind == "indiff":
            found[key] = net.blobs[name].diff
        elif kind in ("paramdiff", "param_after"):
            layer, _, index = name.rpartition("/")
            blob = net.params[layer][int(index)]
            found[key] = blob.diff if kind == "paramdiff" else blob.data
    return found
