"""Every layer case that BVLC Caffe computed: outputs, input gradients, parameter gradients, running statistics."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec
from netspec.exact.blas import adding_to_grad
from paths import GOLDEN
from pretend_gpu import NAME, POSSIBLE, pretended_gpu

CASES = sorted((GOLDEN / "layers").iterdir())
TO_THE_LAST_BIT = (
    "batchnorm_global",
    "batchnorm_scale_inplace",
    "batchnorm_shared_siamese",
    "batchnorm_train",
    "batchnorm_train_maf",
    "conv_1x1",
    "conv_basic",
    "conv_dilated_nobias",
    "conv_repeated",
    "conv_shared_weights",
    "conv_stride_pad",
    "contrastive",
    "contrastive_default",
    "contrastive_legacy",
    "ip",
    "ip_axis2",
    "ip_shared_pair",
    "ip_transpose_nobias",
    "net_residual_block_test",
    "net_residual_block_train",
    "scale_channel",
    "softmax_loss",
)
TOLERANCE = 1e-5  # of the largest element


def assert_close(found: np.ndarray, expected: np.ndarray, what: str) -> None:
    assert found.shape == expected.shape, what
    scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
    worst = float(np.abs(found.astype(np.float64) - expected).max(initial=0)) / scale
    assert worst <= TOLERANCE, f"{what}: off by {worst:.2e} of the largest element"


@pytest.fixture(params=["cpu", "gpu"])
def device(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "cpu":
        yield "cpu"
    elif POSSIBLE:
        with pretended_gpu():
            yield NAME
    else:
        pytest.skip("this torch cannot pretend a GPU")


@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_layer_computes_what_caffe_computed(case: Path, device: str) -> None:
    golden = np.load(case / "golden.npz")
    meta = json.loads(str(golden["meta"]))
    net = netspec.load_net(case / "net.prototxt", phase=meta["phase"], device=device)
    for key in golden.files:
        if key.startswith("param_init/"):
            _, layer, index = key.split("/")
            net.params[layer][int(index)].data.copy_(torch.from_numpy(golden[key]))
    names = [node.name for node in net.plan.nodes]
    inputs = {}
    for name in net.inputs:
        inputs[name] = torch.from_numpy(golden[f"in/{name}"]).to(device).requires_grad_(bool(meta["grad"]))
    for _ in range(meta["warmup"]):
        net(**inputs)
    outputs = net(**inputs)
    expected_outputs = [key[len("out/") :] for key in golden.files if key.startswith("out/")]
    assert list(outputs) == sorted(expected_outputs)
    for name, output in outputs.items():
        assert_close(output.detach().cpu().numpy(), golden[f"out/{name}"], f"output {name}")
    if meta["grad"]:
        # Without force_backward, Caffe leaves the gradients of what is not under a loss at zero. Torch's are real.
        caffe_ran_backward = dict(zip(names, net.backward_plan.layers, strict=True))
        reached = {name: blob for name, blob in outputs.items() if blob.requires_grad and f"topdiff/{name}" in golden}
        diffs = [
            torch.from_numpy(golden[f"topdiff/{name}"]).reshape(blob.shape).to(device) for name, blob in reached.items()
        ]
        torch.autograd.backward(list(reached.values()), diffs)
        for key in golden.files:
            kind, *rest = key.split("/")
            if kind == "indiff":
                assert_close(_gradient(inputs[rest[0]]), golden[key], f"gradient of input {rest[0]}")
            elif kind == "paramdiff" and caffe_ran_backward[rest[0]]:
                assert_close(_gradient(net.params[rest[0]][int(rest[1])]), golden[key], f"gradient of {key}")
    for key in golden.files:
        if key.startswith("param_after/"):
            _, layer, index = key.split("/")
            assert_close(net.params[layer][int(index)].detach().cpu().numpy(), golden[key], key)


@pytest.mark.parametrize("case", [case for case in CASES if case.name in TO_THE_LAST_BIT], ids=lambda path: path.name)
def test_layer_computes_caffes_bits(case: Path, same_blas: bool) -> None:
    if not same_blas:
        pytest.skip("another kind of CPU than Caffe's: its BLAS rounds differently")
    golden = np.load(case / "golden.npz")
    meta = json.loads(str(golden["meta"]))
    net = netspec.load_net(case / "net.prototxt", phase=meta["phase"])
    inputs = {name: torch.from_numpy(golden[f"in/{name}"]).requires_grad_() for name in net.inputs}
    parameters = {}
    for layer, blobs in net.params.items():
        for i, blob in enumerate(blobs):
            blob.data.copy_(torch.from_numpy(golden[f"param_init/{layer}/{i}"]))
            parameters[f"paramdiff/{layer}/{i}"] = blob
    for _ in range(meta["warmup"]):
        net(**inputs)
    with adding_to_grad():
        outputs = net(**inputs)
        torch.autograd.backward(
            list(outputs.values()), [torch.from_numpy(golden[f"topdiff/{name}"]) for name in outputs]
        )
    for name, output in outputs.items():
        np.testing.assert_array_equal(output.detach(), golden[f"out/{name}"])
    for key, leaf in {**{f"indiff/{name}": blob for name, blob in inputs.items()}, **parameters}.items():
        if key in golden:
            np.testing.assert_array_equal(_gradient(leaf), golden[key], key)


def _gradient(tensor: torch.Tensor) -> np.ndarray:
    return np.zeros(tuple(tensor.shape), np.float32) if tensor.grad is None else tensor.grad.cpu().numpy()
