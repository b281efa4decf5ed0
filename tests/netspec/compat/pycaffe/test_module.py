"""The module itself: layer types, modes, seeds, the log (Caffe: test_layer_type_list)."""

import importlib
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import forked
import netspec.pycaffe as caffe
from netspec.compat.pycaffe import mode
from pycaffe_nets import SMALL

pytestmark = pytest.mark.slow


def test_layer_types() -> None:
    types = caffe.layer_type_list()
    for name in ("Data", "Convolution", "InnerProduct", "Python", "SoftmaxWithLoss"):
        assert name in types


@pytest.mark.parametrize("name", ["_caffe", "pycaffe"])
def test_submodules_have_the_same_names(name: str) -> None:
    module = importlib.import_module(f"netspec.compat.pycaffe.{name}")
    assert module.Net is caffe.Net
    assert module.SGDSolver is caffe.SGDSolver
    assert getattr(caffe, name) is module


def test_values_of_params_have_the_type_of_the_compiled_module(net_of: Callable[..., caffe.Net]) -> None:
    assert {type(blobs) for blobs in net_of(SMALL).params.values()} == {caffe._caffe.BlobVec}


def test_the_class_net_has_caffes_attributes() -> None:
    for name in ("blobs", "params", "layer_dict", "inputs", "outputs", "top_names", "bottom_names"):
        assert isinstance(getattr(caffe.Net, name), property)
    assert caffe.Net._set_input_arrays is caffe.Net.set_input_arrays


def test_paths_can_be_bytes(write: Callable[..., str], tmp_path: Path) -> None:
    path = write(SMALL).encode()
    net = caffe.Net(path, caffe.TEST)
    for save in (net.save, net.save_hdf5):
        save(bytes(tmp_path / "w"))
        assert caffe.Net(path, bytes(tmp_path / "w"), caffe.TEST).params.keys() == net.params.keys()
    solver = write('net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed"', "solver.prototxt").encode()
    with pytest.raises(RuntimeError, match="Could not open file nowhere"):
        caffe.Net(b"nowhere", caffe.TEST)
    assert caffe.get_solver(solver).iter == 0


def test_equal_seeds_give_equal_nets(net_of: Callable[..., caffe.Net], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mode._mode, "seed", None)
    nets = []
    for _ in range(2):
        caffe.set_random_seed(5)
        nets.append([net_of(SMALL), net_of(SMALL)])
    weights = [[net.params["filters"][0].data for net in row] for row in nets]
    assert np.array_equal(weights[0][0], weights[1][0])
    assert np.array_equal(weights[0][1], weights[1][1])
    assert not np.array_equal(weights[0][0], weights[0][1])
    caffe.set_random_seed(6)
    nets[0][0].forward()
    first = nets[0][0].blobs["data"].data.copy()
    caffe.set_random_seed(6)
    nets[0][0].forward()
    assert np.array_equal(first, nets[0][0].blobs["data"].data)


def test_a_missing_gpu_is_reported_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(mode._mode, "warned", False)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    caffe.set_mode_gpu()
    caffe.set_device(0)
    caffe.set_mode_gpu()
    assert [record.getMessage() for record in caplog.records] == [
        "set_mode_gpu: torch finds no GPU here; nets run on the CPU"
    ]
    assert mode.device().type == "cpu"
    caffe.set_mode_cpu()


def script(code: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return forked.run(forked.snippet, code, folder=folder, **environment)


@pytest.mark.slow
def test_the_log_has_glogs_format(write: Callable[..., str], tmp_path: Path) -> None:
    write(SMALL)
    code = "import netspec.pycaffe as caffe; caffe.log('hello'); caffe.Net('net.prototxt', caffe.TEST)"
    loud = script(code, tmp_path)
    assert loud.returncode == 0, loud.stderr
    lines = loud.stderr.splitlines()
    assert lines[0].split(maxsplit=3)[3].partition("] ")[2] == "hello"
    assert lines[0][0] == "I"
    assert any("Setting up filters" in line for line in lines)
    assert loud.stdout == ""
    quiet = script(code, tmp_path, GLOG_minloglevel="2")
    assert quiet.stderr == ""
    later = script(f"import os; os.environ['GLOG_minloglevel'] = '3'; {code}", tmp_path)
    assert later.stderr == ""
    assert script(f"{code}; caffe.init_log(2); caffe.log('not this')", tmp_path).stderr.count("not this") == 0


@pytest.mark.slow
def test_a_program_can_handle_the_log(tmp_path: Path) -> None:
    code = "import logging, netspec.pycaffe as caffe\ncaffe.logs.stop()\n"
    code += "logging.basicConfig(level='INFO', format='own %(message)s')\ncaffe.log('hello')"
    assert script(code, tmp_path).stderr == "own hello\n"
