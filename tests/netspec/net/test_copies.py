"""Nets are copied and pickled; what reads open files says why it is not."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from netspec.load import load_net
from netspec.net.net import Net
from netspec.solver.solver import load_solver

TEXT = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 } } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } } }
"""
COPIES = [copy.copy, copy.deepcopy, lambda what: pickle.loads(pickle.dumps(what))]


@pytest.mark.parametrize("copied", COPIES)
def test_a_net_is_copied_before_and_after_a_pass(net_of: Callable[..., Net], copied: Callable[[Net], Net]) -> None:
    net = net_of(TEXT)
    for _ in range(2):
        with torch.no_grad():
            assert torch.equal(copied(net)(data=torch.ones(2, 3))["ip"], net(data=torch.ones(2, 3))["ip"])


def test_what_reads_open_files_or_trains_is_not_copied(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    solver = load_solver("sgd_step/solver.prototxt")
    net = load_net("sgd_step/train_val.prototxt", "TRAIN")
    for copied in COPIES[1:]:
        with pytest.raises(TypeError, match=r"train_val.prototxt:\d+:\d+: layer .* cannot be copied or pickled"):
            copied(net)
    for copied in COPIES:
        with pytest.raises(TypeError, match=r"a Solver cannot be copied or pickled: take a snapshot\(\)"):
            copied(solver)
    net.close()
    solver.close()
