"""Exported PyTorch source: its results, the form of the source, and torch.compile."""

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import netspec
from exported import assert_same, golden_net, here, other_inputs, random_inputs, run_module, source_module, trained
from netspec.export.formats.shapes import settled
from netspec.export.formats.torch import export_torch, torch_source
from netspec.export.formats.torch_code import write_definition
from netspec.net.net import Net
from netspec.proto.schema import TRAIN
from paths import GOLDEN, ROOT

pytestmark = pytest.mark.slow

CASES = sorted((GOLDEN / "layers").iterdir())


def is_formatted(text: str) -> bool:
    ruff = shutil.which("ruff") or str(Path(sys.executable).with_name("ruff"))
    command = [ruff, "format", "--isolated", "--check", "--stdin-filename", "net.py", "-"]
    return subprocess.run(command, input=text, text=True, capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize("case", CASES, ids=lambda path: path.name)
def test_source_of_a_golden_layer_computes_the_same(case: Path) -> None:
    net, inputs = golden_net(case)
    module = source_module(net)
    again, _ = golden_net(case)  # a recurrent net remembers what it saw
    assert_same(run_module(module, net, inputs), here(again, inputs))
    assert is_formatted(torch_source(net)[0])
    inputs = other_inputs(net, settled(net, lambda shapes: write_definition(net, shapes))[1], inputs)
    again, _ = golden_net(case)
    assert_same(run_module(module, net, inputs), here(again, inputs))


def test_the_module_runs_without_netspec(tmp_path: Path) -> None:
    net = trained(netspec.load_net(ROOT / "prototxt" / "small" / "siamese_resnet27_256" / "deploy.prototxt", seed=0))
    inputs = random_inputs(net)
    export_torch(net, tmp_path / "net.py", "deploy.prototxt")
    np.save(tmp_path / "data.npy", inputs["data"])
    program = (
        "import runpy, sys, numpy, torch, net\n"
        "assert not any(name.startswith('netspec') for name in sys.modules)\n"
        "with torch.no_grad():\n"
        "    found = net.load()(torch.from_numpy(numpy.load('data.npy')))\n"
        "numpy.save('found.npy', found.numpy())\n"
        "runpy.run_path('net.py', run_name='__main__')\n"
        "assert not any(name.startswith('netspec') for name in sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, check=True, capture_output=True)
    assert_same({net.outputs[0]: np.load(tmp_path / "found.npy")}, here(net, inputs))


SMALL = (Path(__file__).parent / "nets" / "small.prototxt").read_text()
PAIRS = (Path(__file__).parent / "nets" / "pairs.prototxt").read_text()


def test_source_equals_the_expected_program(net_of: Callable[..., Net]) -> None:
    text, state, _ = torch_source(trained(net_of(SMALL)), "small.prototxt")
    assert text == (Path(__file__).parent / "programs" / "small.py").read_text()
    assert list(state)[:3] == ["conv1.weight", "conv1.bias", "bn1.weight"]


TOWERS = """name: "Towers"
layer { name: "data" type: "Input" top: "data" top: "other" input_param { shape { dim: 2 dim: 6 } } }
""" + "".join(
    f"""layer {{ name: "{layer}{end}" type: "InnerProduct" bottom: "{bottom}" top: "{layer}{end}"
  param {{ name: "{layer}_w" }} param {{ name: "{layer}_b" }}
  inner_product_param {{ num_output: 6 weight_filler {{ type: "xavier" }} }} }}
layer {{ name: "relu_{layer}{end}" type: "ReLU" bottom: "{layer}{end}" top: "{layer}{end}" }}
"""
    for end, first in (("", "data"), ("_p", "other"))
    for layer, bottom in (("ip1", first), ("ip2", f"ip1{end}"), ("ip3", f"ip2{end}"), ("ip4", f"ip3{end}"))
)


def test_towers_that_share_weights_are_one_module(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(TOWERS))
    text, state, _ = torch_source(net)
    assert len(state) == 8
    assert text.count("self.ip2(") == 2  # once for each tower
    assert_same(run_module(source_module(net), net, random_inputs(net)), here(net, random_inputs(net)))


def test_deconvolution_with_a_filter_larger_than_the_map_computes_the_same(net_of: Callable[..., Net]) -> None:
    text = """layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 2 dim: 3 dim: 4 } } }
    layer { name: "up" type: "Deconvolution" bottom: "data" top: "up"
      convolution_param { num_output: 2 kernel_size: 5 stride: 2 } }"""
    net = trained(net_of(text))
    assert_same(run_module(source_module(net), net, random_inputs(net)), here(net, random_inputs(net)))


def test_dropout_of_a_net_in_phase_train_drops_and_scales(net_of: Callable[..., Net]) -> None:
    text = """layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 4 dim: 200 } } }
    layer { name: "drop" type: "Dropout" bottom: "x" top: "y" dropout_param { dropout_ratio: 0.2 } }"""
    net = net_of(text, phase=TRAIN)
    dropped = source_module(net).train()(torch.ones(4, 200))
    assert set(dropped.unique().tolist()) == {0.0, 1.25}
    assert 0.1 < float((dropped == 0).float().mean()) < 0.3
    assert torch.equal(source_module(net)(torch.ones(4, 200)), torch.ones(4, 200))


def test_torch_export_archives_the_source_for_other_batches_and_sizes(
    net_of: Callable[..., Net], tmp_path: Path
) -> None:
    net = trained(net_of(SMALL))
    free = dict.fromkeys((0, 2, 3), torch.export.Dim.AUTO)
    program = torch.export.export(source_module(net), (torch.zeros(2, 3, 16, 16),), dynamic_shapes=(free,))
    torch.export.save(program, tmp_path / "small.pt2")
    inputs = {"data": np.random.default_rng(0).standard_normal((3, 3, 20, 17)).astype(np.float32)}
    assert_same(run_module(torch.export.load(tmp_path / "small.pt2").module(), net, inputs), here(net, inputs))


def test_inputs_of_other_sizes_are_refused(net_of: Callable[..., Net]) -> None:
    net = trained(net_of(PAIRS))
    module = source_module(net)
    image, label, other = torch.zeros(3, 1, 6, 6), torch.zeros(3), torch.zeros(5, 4)
    module(image, image, label, other)
    for wrong in (
        (torch.zeros(3, 1, 4, 9), image, label, other),  # as many numbers
        (torch.zeros(3, 1, 12, 3), image, label, other),
        (torch.zeros(1, 1, 6, 6), image, label, other),  # torch would use it three times
        (image, image, label[:, None], other),
    ):
        with pytest.raises(ValueError, match="expected"):
            module(*wrong)
    with pytest.raises(ValueError, match=re.escape("b has shape (4, 1, 6, 6), expected (3, 1, 6, 6)")):
        source_module(net)(image, torch.zeros(4, 1, 6, 6), label, other)


@pytest.mark.parametrize("backend", ["eager", "aot_eager"])  # "inductor" compiles the graph of the latter
def test_compiled_source_computes_the_same(backend: str, net_of: Callable[..., Net]) -> None:
    net = trained(net_of(SMALL))
    compiled: Any = torch.compile(source_module(net), backend=backend, fullgraph=True)
    assert_same(run_module(compiled, net, random_inputs(net)), here(net, random_inputs(net)))
