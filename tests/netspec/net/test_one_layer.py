"""netspec.layer, one layer called without a net; and which nets can be copied and pickled."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec
from netspec.load import load_net, load_solver
from netspec.net.net import Net

POOL = 'type: "Pooling" pooling_param { kernel_size: 2 stride: 2 }'


def test_a_layer_computes_its_top_and_gradient_from_tensors_and_arrays() -> None:
    x = torch.arange(16.0).reshape(1, 1, 4, 4).requires_grad_()
    pool = netspec.layer(POOL)
    top = pool(x)
    assert top.tolist() == [[[[5, 7], [13, 15]]]]
    top.sum().backward()
    assert x.grad is not None
    assert x.grad.sum() == 4
    assert pool(np.ones((2, 3, 6, 8))).shape == (2, 3, 3, 4)


def test_several_tops_are_returned_as_a_tuple() -> None:
    first, second = netspec.layer('type: "Slice" slice_param { slice_point: 1 }', tops=2)(np.ones((1, 3, 2)))
    assert (first.shape, second.shape) == ((1, 1, 2), (1, 2, 2))
    named = 'type: "Slice" bottom: "x" top: "a" top: "b" slice_param { slice_point: 1 }'
    assert len(netspec.layer(named)(np.ones((1, 3, 2)))) == 2
    split = netspec.layer('type: "Split"', tops=3)
    assert len(split(np.ones(2))) == 3
    assert netspec.layer('type: "Silence"')(np.ones(2)) == ()


def test_blobs_exist_before_the_first_call_if_shapes_are_given() -> None:
    text = 'type: "InnerProduct" inner_product_param { num_output: 2 weight_filler { type: "xavier" } }'
    product = netspec.layer(text, (1, 3))
    assert product.layer is not None
    weights, bias = product.layer.blobs
    torch.testing.assert_close(product(np.eye(3)), weights.T + bias)
    again = netspec.layer(text, (1, 3), seed=0).layer
    assert again is not None
    assert torch.equal(again.blobs[0], weights)
    assert netspec.layer(text).layer is None


def test_layers_without_bottoms_losses_and_the_training_phase() -> None:
    made = netspec.layer('type: "DummyData" dummy_data_param { shape { dim: 2 } data_filler { value: 3 } }')()
    assert made.tolist() == [3, 3]
    assert netspec.layer('type: "EuclideanLoss"')(np.ones((1, 2)), np.zeros((1, 2))).item() == 1
    dropped = netspec.layer('type: "Dropout"', phase="TRAIN")(np.ones(1000))
    assert set(dropped.tolist()) == {0, 2}


def test_exact_selects_the_arithmetic() -> None:
    x = torch.randn(2, 3, requires_grad=True)

    assert netspec.layer('type: "Sigmoid"', exact="all")(x).grad_fn.name() == "PointwiseBackward"  # the C library's
    assert netspec.layer('type: "Sigmoid"', exact="none")(x).grad_fn.name() != "PointwiseBackward"
    assert netspec.layer('type: "Sigmoid"')(x).grad_fn.name() != "PointwiseBackward"
    with pytest.raises(ValueError, match="found exact 'some', expected 'none', 'small', 'all'"):
        netspec.layer('type: "Sigmoid"', exact="some")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('type: "Poolin"', r'^<layer>:1:1: layer "" \(Poolin\): unknown layer type "Poolin"; did you mean "Pooling"'),
        ('type: "Pooling"\npool_param { }', r'^<layer>:2:1: layer "" \(Pooling\): LayerParameter has no field "pool_p'),
        ('type: "Pooling"\npooling_param { pad: 1 }', r'^<layer>:2:1: layer "" \(Pooling\): '),
        ('type: "Concat"', r"found 0 bottom blob\(s\), expected at least 1"),
    ],
    ids=["unknown_type", "unknown_field", "missing_kernel_size", "no_bottom"],
)
def test_errors_contain_their_place(text: str, message: str) -> None:
    with pytest.raises(netspec.SpecError, match=message):
        netspec.layer(text)(*[] if "Concat" in text else [np.ones((1, 1, 4, 4))])


def test_phase_is_given_by_name_in_any_case_or_number() -> None:
    for phase in ("TRAIN", "train", 0):
        assert 0 in netspec.layer('type: "Dropout"', phase=phase)(np.ones(1000))
    with pytest.raises(netspec.SpecError, match="found phase 'deploy', expected TRAIN or TEST"):
        netspec.layer('type: "Dropout"', phase="deploy")


# Nets can be copied and pickled, unless they have open files
TEXT = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } } }
"""
COPIES = [copy.copy, copy.deepcopy, lambda what: pickle.loads(pickle.dumps(what))]


@pytest.mark.parametrize("copied", COPIES, ids=["copy", "deepcopy", "pickle"])
def test_a_net_is_copied_before_and_after_a_pass(net_of: Callable[..., Net], copied: Callable[[Net], Net]) -> None:
    net = net_of(TEXT)
    for _ in range(2):
        with torch.no_grad():
            assert torch.equal(copied(net)(data=torch.ones(2, 3))["ip"], net(data=torch.ones(2, 3))["ip"])


def test_nets_with_open_files_and_solvers_cannot_be_copied(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt")
    net = load_net("sgd_step/train_val.prototxt", "TRAIN")
    for copied in COPIES[1:]:
        with pytest.raises(TypeError, match=r"train_val.prototxt:\d+:\d+: layer .* cannot be copied or pickled"):
            copied(net)
    for copied in COPIES:
        with pytest.raises(TypeError, match=r"a Solver cannot be copied or pickled; use snapshot\(\)"):
            copied(solver)
    net.close()
    solver.close()
