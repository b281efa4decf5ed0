"""Trained models that people use, against what real Caffe or OpenCV make of them."""

import subprocess
import sys

import numpy as np
import pytest

from paths import shared

pytestmark = pytest.mark.slow

MODELS = {
    "hyperlpr_fine_v2": (),
    "mtcnn_kp_det1": (),
    "mtcnn_kp_det2": (),
    "mtcnn_kp_det3": (),
    "ultraface_slim320": ("ssd",),
    "wechat_detect": ("ssd",),
    "wechat_sr": ("blocks",),
}

# In a process of its own, since a dialect stays on: prints, for each reference, its blob and the largest difference.
RUN = """
import sys
from pathlib import Path
import numpy as np
import torch
import netspec

folder, *dialects = sys.argv[1:]
for dialect in dialects:
    netspec.use_dialect(dialect)
(prototxt,), (weights,), (reference,) = (list(Path(folder).glob("*." + e)) for e in ("prototxt", "caffemodel", "npz"))
net = netspec.load_net(prototxt, weights=weights)
net.keep = "all"
expected = np.load(reference)
for run in sorted({key.split("/")[0] for key in expected}) * 2:
    torch.set_grad_enabled(not torch.is_grad_enabled())
    net(**{key.split("/", 2)[2]: expected[key] for key in expected if key.startswith(f"{run}/in/")})
    for key in expected:
        if key.startswith(f"{run}/out/"):
            found = net.blobs[key.split("/", 2)[2]].detach().numpy()
            difference = np.abs(found - expected[key]).max() if found.shape == expected[key].shape else np.inf
            print(difference / max(1, np.abs(expected[key]).max()), found.ravel()[:7].tolist(), sep="\\t")
"""


@pytest.mark.parametrize("name", MODELS)
def test_a_trained_model_gives_what_its_own_program_gives(name: str):
    words = [sys.executable, "-c", RUN, shared("golden", "models", name), *MODELS[name]]
    lines = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines
    if name == "wechat_detect":  # nothing is found: SSD then gives one row of -1, OpenCV rows of zeros
        assert lines == ["inf\t[0.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0]"] * 2
        return
    differences = [float(line.split("\t")[0]) for line in lines]
    np.testing.assert_array_less(differences, 1e-5)
