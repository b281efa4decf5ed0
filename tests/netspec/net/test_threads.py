"""Threads that share a net, or a net of pycaffe, get their own results."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

import netspec.pycaffe as caffe
from netspec.net.net import Net

TEXT = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 dim: 12 dim: 12 } } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
  convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "gaussian" std: 0.3 } } }
layer { name: "relu" type: "ReLU" bottom: "conv" top: "conv" }
layer { name: "feat" type: "InnerProduct" bottom: "conv" top: "feat"
  inner_product_param { num_output: 5 weight_filler { type: "gaussian" std: 0.3 } } }
"""
COUNT = 200


def inputs(k: int) -> np.ndarray:
    return np.random.default_rng(k).standard_normal((1 + k % 3, 3, 12, 12), np.float32)


def in_threads(run: Callable[[int], None]) -> None:
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(run, range(COUNT)))


@pytest.mark.slow
@pytest.mark.parametrize("gradients", [False, True], ids=["no_grad", "grad"])
def test_threads_that_share_a_net_get_their_own_results(net_of: Callable[..., Net], gradients: bool) -> None:
    net = net_of(TEXT)
    net.keep = "conv"
    with torch.no_grad():
        expected = [(net(data=inputs(k))["feat"], net.blobs["conv"]) for k in range(COUNT)]

    def run(k: int) -> None:
        with torch.set_grad_enabled(gradients):
            feat = net(data=inputs(k))["feat"].detach()
            for found, wanted in zip((feat, net.blobs["conv"].detach()), expected[k], strict=True):
                torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-5)

    in_threads(run)


def test_threads_that_share_a_pycaffe_net_get_their_own_results(tmp_path) -> None:
    (tmp_path / "net.prototxt").write_text(TEXT)
    net = caffe.Net(str(tmp_path / "net.prototxt"), caffe.TEST)
    images = [inputs(3 * k + 1) for k in range(COUNT)]
    expected = [net.forward(data=image)["feat"].copy() for image in images]

    def run(k: int) -> None:
        found = net.forward(data=images[k])["feat"]
        for _ in range(3):
            np.testing.assert_array_equal(found, expected[k])

    in_threads(run)


def test_a_backward_pass_after_that_of_another_thread_is_refused(tmp_path) -> None:
    (tmp_path / "net.prototxt").write_text(TEXT.replace("dim: 2", "dim: 1", 1) + "force_backward: true")
    net = caffe.Net(str(tmp_path / "net.prototxt"), caffe.TEST)
    net.forward(data=inputs(0))
    with ThreadPoolExecutor(1) as pool:
        pool.submit(net.forward, data=inputs(3)).result()
        with pytest.raises(RuntimeError, match="another thread has run this net since"):
            net.backward()
        net.forward(data=inputs(0))
        net.backward()
