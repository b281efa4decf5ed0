"""The committed net of XFeat computes what its ONNX model does, at any size."""

import numpy as np
import torch

import netspec
from golden.xfeat.make import image
from paths import GOLDEN, ROOT

XFEAT = ROOT / "prototxt" / "local_features" / "xfeat"


def outputs(pixels: np.ndarray) -> dict[str, np.ndarray]:
    net = netspec.load_net(XFEAT / "deploy.prototxt", weights=XFEAT / "xfeat.caffemodel")
    net.keep = ["descriptors", "logits", "reliability", "keypoints"]
    with torch.no_grad():
        net(data=torch.from_numpy(pixels)[None, None])
    return {name: net.blobs[name][0].numpy() for name in net.keep}


def test_it_computes_what_the_onnx_model_does_up_to_the_border() -> None:
    found = outputs(image())
    expected = np.load(GOLDEN / "xfeat" / "onnx.npz")
    row, column = expected["cells"].T
    np.testing.assert_allclose(found["descriptors"][:, row, column].T, expected["descriptors"], atol=1e-4)
    np.testing.assert_allclose(found["logits"][:, row, column].T, expected["logits"], atol=1e-4)
    np.testing.assert_allclose(found["reliability"][0, row, column], expected["reliability"], atol=1e-5)
    np.testing.assert_allclose(found["keypoints"].sum(axis=0), 1, atol=1e-5)


def test_a_wide_image_has_the_same_points_where_nothing_else_is_near() -> None:
    one, two = outputs(image()[:320]), outputs(np.hstack([image()[:320]] * 2))
    for name, values in one.items():
        np.testing.assert_allclose(two[name][..., :50], values[..., :50], atol=1e-4)
