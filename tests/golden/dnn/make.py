"""Makes the files of this folder, in two steps, since OpenCV 4 reads no prototxt with netspec's help.

python tests/golden/dnn/make.py weights     # with netspec: *.caffemodel of random weights
python tests/golden/dnn/make.py results     # in an environment with opencv-python-headless==4.12.*: opencv.npz
"""

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE.parents[2]), str(HERE.parents[1])]  # the project, then tests


def write_weights() -> None:
    """Write a .caffemodel beside each prototxt."""
    import torch

    import netspec

    for path in sorted(HERE.glob("*.prototxt")):
        net = netspec.load_net(path, seed=1)
        draw = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for layer in net.layers:
                for j, blob in enumerate(layer.blobs):
                    if layer.type == "BatchNorm":
                        blob.copy_(torch.rand(blob.shape, generator=draw) + 0.5 if j < 2 else torch.tensor([2.0]))
                    elif layer.type in ("Convolution", "Deconvolution", "InnerProduct"):
                        width = max(blob[0].numel(), 1) ** 0.5 if j == 0 else 1
                        blob.copy_(torch.randn(blob.shape, generator=draw) * (1.5 / width))
                    else:
                        blob.copy_(torch.rand(blob.shape, generator=draw) + 0.5)
        netspec.save_weights(net, path.with_suffix(".caffemodel"))


def write_results() -> None:
    """Write what OpenCV makes of the nets."""
    from typing import Any

    import cv2
    import numpy as np

    from dnn_program import record

    assert cv2.__version__.startswith("4.12."), cv2.__version__
    results: dict[str, Any] = record(cv2.dnn)
    np.savez_compressed(HERE / "opencv.npz", **results)


if __name__ == "__main__":
    {"weights": write_weights, "results": write_results}[sys.argv[1]]()
