"""The examples in the docstrings of the public names, those that docs/reference/python*.md list, do what they say."""

import doctest
import re
from importlib import import_module
from pathlib import Path

import cv2
import numpy
import pytest
import torch

import netspec
from documents import commands, run
from paths import ROOT

PAGES = sorted((ROOT / "docs" / "reference").glob("python*.md"))
NAMES = [found for page in PAGES for found in re.findall(r"^([\w.]+):(\w+)$", page.read_text(), re.M)]
DATA = 'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 3 dim: 32 dim: 32 } } }\n'
DUMMY = """layer { name: "data" type: "DummyData" top: "data" top: "label"
  dummy_data_param { shape { dim: 2 dim: 3 dim: 32 dim: 32 } shape { dim: 2 } } }
"""
NET = """layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
  convolution_param { num_output: 2 kernel_size: 5 stride: 4 weight_filler { type: "xavier" } } }
layer { name: "feat" type: "InnerProduct" bottom: "conv" top: "feat"
  inner_product_param { num_output: 4 weight_filler { type: "xavier" } } }
"""
PROB = 'layer { name: "prob" type: "Softmax" bottom: "feat" top: "prob" }\n'
LOSS = 'layer { name: "loss" type: "SoftmaxWithLoss" bottom: "feat" bottom: "label" top: "loss" }\n'
SOLVER = (
    'net: "train_val.prototxt" base_lr: 0.01 lr_policy: "fixed" max_iter: 4 solver_mode: CPU snapshot_prefix: "x"\n'
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("deploy.prototxt").write_text(DATA + NET + PROB)
    Path("train_val.prototxt").write_text(DUMMY + NET + LOSS)
    Path("solver.prototxt").write_text(SOLVER)
    netspec.save_weights(netspec.load_net("deploy.prototxt", seed=1), "x.caffemodel")
    for k in range(6):
        cv2.imwrite(f"{k}.png", numpy.full((40, 40, 3), 40 * k, numpy.uint8))
    Path("list.txt").write_text("".join(f"{k}.png {k}\n" for k in range(6)))
    (command,) = commands("lmdb-build imageset ./ list.txt train_lmdb", tmp_path)
    assert run(command, tmp_path / "log") == 0
    return tmp_path


def test_every_public_name_has_its_section() -> None:
    listed = {name for module, name in NAMES if module == "netspec"}
    assert listed == set(netspec.__all__)


@pytest.mark.slow
def test_the_examples(folder: Path) -> None:
    finder, runner, tried = doctest.DocTestFinder(recurse=True), doctest.DocTestRunner(), 0
    for module, name in NAMES:
        found = getattr(import_module(module), name)
        assert found.__doc__, f"{module}.{name} has no docstring"
        given = {"netspec": netspec, "numpy": numpy, "torch": torch, "images": torch.rand(2, 3, 32, 32), name: found}
        for each in finder.find(found, name, globs=given):
            tried += len(each.examples)
            runner.run(each)
    assert runner.summarize().failed == 0
    assert tried > 12
