"""``netspec export`` and ``netspec fold``: what they write, what they say, what they refuse."""

import errno
import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file

import netspec
from exported import ONNX_EXTRA, assert_same, here, in_onnxruntime, random_inputs, run_module
from netspec.net.net import Net

Run = Callable[..., Any]  # the fixture of conftest.py
MODEL, WEIGHTS = "deploy.prototxt", "deploy.caffemodel"
TEXT = """name: "Cli"
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 dim: 8 dim: 8 } } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv"
  convolution_param { num_output: 4 kernel_size: 3 weight_filler { type: "xavier" } } }
layer { name: "bn" type: "BatchNorm" bottom: "conv" top: "bn" }
layer { name: "relu" type: "ReLU" bottom: "bn" top: "bn" }
"""


@pytest.fixture
def onnx() -> Any:
    """The onnx library."""
    return pytest.importorskip("onnx", reason=ONNX_EXTRA)


@pytest.fixture
def net(run: Run) -> Net:
    """A net, whose files are in the working directory."""
    Path(MODEL).write_text(TEXT)
    net = netspec.load_net(MODEL, seed=1)
    for blob in net.params["bn"]:
        blob.data.fill_(2)
    netspec.save_weights(net, WEIGHTS)
    return net


def test_onnx(onnx: Any, net: Net, run: Run) -> None:
    result = run("export", MODEL, "--weights", WEIGHTS, "--to", "onnx", "--out", "net.onnx")
    assert (result.status, result.err) == (0, "")
    assert re.fullmatch(r"net\.onnx: an ONNX model, [\d.]+ KiB\n", result.out)
    inputs = random_inputs(net)
    model = onnx.load("net.onnx")
    assert_same(in_onnxruntime(model, inputs), here(net, inputs))
    props = {each.key: each.value for each in model.metadata_props}
    assert props["netspec.prototxt"] == MODEL
    assert props["netspec.weights"] == WEIGHTS
    assert len(props["netspec.weights.sha256"]) == 64
    assert props["netspec.phase"] == "TEST"


def test_torch(net: Net, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    result = run("export", MODEL, "--weights", WEIGHTS, "--to", "torch", "--out", "exported_cli.py")
    assert result.status == 0
    assert result.err == "note: the weights are in exported_cli.safetensors, next to the module\n"
    monkeypatch.syspath_prepend(".")
    import exported_cli  # type: ignore

    inputs = random_inputs(net)
    assert_same(run_module(exported_cli.load(), net, inputs), here(net, inputs))
    del sys.modules["exported_cli"]


def test_safetensors(net: Net, run: Run) -> None:
    assert run("export", MODEL, "--weights", WEIGHTS, "--to", "safetensors", "--out", "net.safetensors").status == 0
    found = load_file("net.safetensors")
    assert sorted(found) == ["bn.0", "bn.1", "bn.2", "conv.0", "conv.1"]
    np.testing.assert_array_equal(found["conv.0"], net.params["conv"][0].detach().numpy())


@pytest.mark.slow
@pytest.mark.parametrize("form", ["onnx", "torch", "safetensors"])
def test_exports_are_reproducible(form: str, net: Net, run: Run) -> None:
    """Twelve hash tables have the order of their metadata by chance only; a file that is read back has all of it."""
    if form == "onnx":
        pytest.importorskip("onnx", reason=ONNX_EXTRA)
    out = Path({"onnx": "net.onnx", "torch": "net.py", "safetensors": "net.safetensors"}[form])
    written = set()
    for _ in range(12 if form == "safetensors" else 2):
        assert run("export", MODEL, "--weights", WEIGHTS, "--to", form, "--out", str(out)).status == 0
        written.add(b"".join(path.read_bytes() for path in sorted(Path().glob("net.*"))))
    assert len(written) == 1
    if form == "safetensors":
        with safe_open(out, "np") as file:
            assert set(file.metadata()) >= {"phase", "prototxt", "weights"}
            assert sorted(file.keys()) == ["bn.0", "bn.1", "bn.2", "conv.0", "conv.1"]


def test_fold(net: Net, run: Run) -> None:
    result = run("fold", MODEL, "--weights", WEIGHTS, "--out", "small")
    assert result.status == 0
    assert result.out == "small.prototxt and small.caffemodel: 3 layers of 4\n"
    small = netspec.load_net("small.prototxt", weights="small.caffemodel")
    assert [layer.type for layer in small.layers] == ["Input", "Convolution", "ReLU"]
    inputs = random_inputs(net)
    assert_same(here(small, inputs), here(net, inputs))


def test_a_training_net_is_exported_with_its_loss(onnx: Any, run: Run) -> None:
    words = "export sgd_step/train_val.prototxt --weights sgd_step/init.caffemodel --to onnx --out net.onnx".split()
    assert "known only from its data; give --shape pair_data=" in run(*words).fault
    assert run(*words, "--shape", "pair_data=2,2,28,28").status == 0
    model = onnx.load("net.onnx")
    assert [each.name for each in model.graph.input] == ["pair_data", "sim"]
    assert [each.name for each in model.graph.output] == ["loss"]


def test_part_of_a_net(onnx: Any, net: Net, run: Run) -> None:
    words = ("export", MODEL, "--weights", WEIGHTS, "--to", "onnx", "--out", "net.onnx", "--blob")
    assert run(*words, "conv").status == 0
    assert [node.op_type for node in onnx.load("net.onnx").graph.node] == ["Conv"]
    assert 'no blob "conf" in this net; did you mean "conv"?' in run(*words, "conf").fault


@pytest.mark.parametrize("command", ["export --to torch --out part.py", "fold --out part"])
def test_layers_behind_the_blobs_of_a_part_are_not_built(command: str, net: Net, run: Run) -> None:
    after = 'layer { name: "py" type: "Python" bottom: "bn" top: "py" python_param { module: "none" layer: "None" } }'
    Path(MODEL).write_text(TEXT + after)
    name, *words = command.split()
    assert run(name, MODEL, "--weights", WEIGHTS, *words).status != 0
    assert run(name, MODEL, "--weights", WEIGHTS, *words, "--blob", "bn").status == 0


def test_preprocessing_is_exported(onnx: Any, net: Net, run: Run) -> None:
    words = ("export", MODEL, "--weights", WEIGHTS, "--to", "onnx", "--out", "net.onnx", "--mean", "1,2,3", "--swap")
    assert run(*words, "--scale", "0.5").status == 0
    inputs = random_inputs(net)
    done = (inputs["data"][:, ::-1] - np.array([1, 2, 3], np.float32).reshape(-1, 1, 1)) * np.float32(0.5)
    expected = here(net, {"data": np.ascontiguousarray(done)})
    assert_same(in_onnxruntime(onnx.load("net.onnx"), inputs), expected)


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("no/net.onnx: cannot be written: No such file or directory", "--to onnx --out no/net.onnx"),
        ("--out net.txt: expected a name that ends in .py", "--to torch --out net.txt"),
        ('no data layer has a top "dat"; did you mean "data"?', "--to onnx --out n.onnx --shape dat=1,3,8,8"),
        ("no.npy: no such file; expected an array of a mean", "--to onnx --out n.onnx --mean no.npy"),
        ('no input "x" in this net; it has: data', "--to onnx --out n.onnx --swap --input x"),
    ],
)
def test_errors_are_reported_in_one_line(words: str, fault: str, onnx: Any, net: Net, run: Run) -> None:
    assert fault in run("export", MODEL, "--weights", WEIGHTS, *words.split()).fault
    assert not list(Path().glob("n.onnx"))


def test_missing_weights_are_reported(onnx: Any, net: Net, run: Run) -> None:
    words = ("export", MODEL, "--to", "onnx", "--out", "n.onnx")
    assert "no.caffemodel: cannot be read: No such file or directory" in run(*words, "--weights", "no.caffemodel").fault
    assert run(*words).err == "warning: no --weights given: the weights are random\n"


def test_the_onnx_library_is_an_extra(net: Net, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    words = ("export", MODEL, "--weights", WEIGHTS, "--to", "onnx", "--out", "n.onnx")
    assert run(*words).fault == "--to onnx needs the onnx library: pip install 'netspec-caffe[onnx]'"


@pytest.mark.slow
@pytest.mark.parametrize(("target", "out"), [("torch", "n.py"), ("safetensors", "n.safetensors"), ("fold", "n")])
def test_an_error_keeps_old_files(target: str, out: str, net: Net, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("fold", MODEL) if target == "fold" else ("export", MODEL, "--to", target)
    words = (*words, "--weights", WEIGHTS, "--out", out)
    assert run(*words).status == 0
    before = {path: path.read_bytes() for path in Path().glob("n*")}

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "")

    monkeypatch.setattr(os, "fsync", full)
    assert run(*words).fault.endswith("cannot be written: No space left on device")
    assert {path: path.read_bytes() for path in Path().iterdir() if path.name.lstrip(".")[:1] == "n"} == before


def test_folding_needs_weights(net: Net, run: Run) -> None:
    assert run("fold", MODEL, "--out", "n").status == 2


def test_steps_for_images_are_for_onnx(net: Net, run: Run) -> None:
    result = run("export", MODEL, "--weights", WEIGHTS, "--to", "torch", "--out", "n.py", "--swap")
    assert result.status == 2
    assert "--swap needs --to onnx" in result.err
    result = run("export", MODEL, "--weights", WEIGHTS, "--to", "onnx", "--out", "n.onnx", "--input", "data")
    assert result.status == 2
    assert "--input names the input of --crop, --swap" in result.err
