"""Well-known trained models compared with the stored results of Caffe or OpenCV."""

import itertools

import numpy as np
import pytest
import torch

import netspec
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


@pytest.mark.parametrize("name", MODELS)
def test_trained_model_gives_the_results_of_caffe_or_opencv(name: str):
    for dialect in MODELS[name]:
        netspec.use_dialect(dialect)
    folder = shared("golden", "models", name)
    (prototxt,), (weights,), (reference,) = (list(folder.glob(f"*.{e}")) for e in ("prototxt", "caffemodel", "npz"))
    net = netspec.load_net(prototxt, weights=weights)
    net.keep = "all"
    with np.load(reference) as expected:
        for learns, run in itertools.product((False, True), sorted({key.split("/")[0] for key in expected})):
            with torch.set_grad_enabled(learns):
                net(**{key.split("/", 2)[2]: expected[key] for key in expected if key.startswith(f"{run}/in/")})
            tops = {key.split("/", 2)[2]: expected[key] for key in expected if key.startswith(f"{run}/out/")}
            assert tops
            for blob, value in tops.items():
                found = net.blobs[blob].detach().numpy()
                if name == "wechat_detect":  # nothing is found: SSD then gives one row of -1, OpenCV rows of zeros
                    assert found.ravel().tolist() == [0.0, -1.0, -1.0, -1.0, -1.0, -1.0, -1.0]
                else:
                    np.testing.assert_allclose(found, value, rtol=0, atol=1e-5 * max(1, np.abs(value).max()))
