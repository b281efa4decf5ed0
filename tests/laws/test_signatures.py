"""Public functions accept a single string in place of a list of one, and refuse unknown choices."""

import inspect
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netspec
import netspec.pycaffe as caffe
from loopclosure import LoopDetector
from loopclosure.detector.decision import DetectorSettings
from netspec.inspect.features.describer import Describer
from netspec.net.net import Net
from netspec.solver.solver import Solver

NET = """
layer { name: "data" type: "HDF5Data" top: "data" top: "label" hdf5_data_param { source: "list" batch_size: 1 } }
layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param { num_output: 2 } }
layer { name: "staged" type: "ReLU" bottom: "ip" top: "staged" include { stage: "deploy" } }
layer { name: "letters" type: "ReLU" bottom: "ip" top: "letters" include { stage: "d" } }
"""
WEIGHTS = "w.caffemodel"

# A call of each public function that works, to which one parameter is added.
CALLS: dict[Callable[..., Any], Callable[..., Any]] = {
    netspec.load_net: lambda **given: netspec.load_net("net.prototxt", **given),
    netspec.load_solver: lambda **given: netspec.load_solver("solver.prototxt", **given),
    netspec.load_weights: lambda path=WEIGHTS: netspec.load_weights(netspec.load_net("net.prototxt"), path),
    netspec.save_weights: lambda path="x": netspec.save_weights(netspec.load_net("net.prototxt"), path),
    netspec.layer: lambda **given: netspec.layer('type: "ReLU"', **given)(np.zeros((1, 2))),
    netspec.use_dialect: netspec.use_dialect,
    Describer: lambda **given: Describer("image.prototxt", WEIGHTS, **given)(np.zeros((4, 4, 3), np.uint8)),
    LoopDetector: LoopDetector,
    DetectorSettings: DetectorSettings,
    caffe.Net: lambda **given: caffe.Net("net.prototxt", caffe.TEST, **given),
    caffe.Net.forward: lambda **given: caffe.Net("net.prototxt", caffe.TEST).forward(**given),
    caffe.Net.backward: lambda **given: caffe.Net("net.prototxt", caffe.TEST).backward(**given),
}  # fmt: skip
# Texts that may be anything: names of files, layers and blobs, and what is parsed.
FREE = {
    "path", "model", "snapshot", "text", "name", "blob", "input", "cache", "zooms",
    "mean", "scale", "raw_scale", "swap",
}  # fmt: skip
ONE_OF_SEVERAL = {
    "stages": "deploy", "passes": "fold", "weights": WEIGHTS, "path": WEIGHTS, "device": "cpu",
    "blobs": "ip", "diffs": "ip",
}  # fmt: skip
CHOICES = {"phase", "exact", "engine", "precision", "nan", "passes", "device", "metric", "index", "describe"}


def parameters(*words: str) -> list[Any]:
    """Return the functions and parameters that have one of these words in their annotation."""
    return [
        pytest.param(function, name, id=f"{function.__qualname__}({name})")
        for function in CALLS
        for name, parameter in inspect.signature(function).parameters.items()
        if any(word in str(parameter.annotation) for word in words) and "Callable" not in str(parameter.annotation)
    ]


@pytest.fixture(scope="module", autouse=True)
def _files(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    import h5py

    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("signatures"))
    Path("net.prototxt").write_text(NET)
    Path("list").write_text("rows.h5\n")
    with h5py.File("rows.h5", "w") as file:
        file["data"], file["label"] = np.zeros((2, 3), np.float32), np.zeros(2, np.float32)
    Path("solver.prototxt").write_text(
        'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" max_iter: 1 solver_mode: CPU'
    )
    Path("image.prototxt").write_text(
        'input: "data" input_shape { dim: 1 dim: 3 dim: 4 dim: 4 } '
        'layer { name: "conv" type: "Convolution" bottom: "data" top: "feat" '
        "convolution_param { num_output: 2 kernel_size: 4 } }"
    )
    for model in ("net", "image"):
        netspec.save_weights(netspec.load_net(f"{model}.prototxt"), WEIGHTS if model == "net" else "image.caffemodel")
    yield
    os.chdir(before)


def test_every_public_function_is_called_here() -> None:
    public = {getattr(netspec, name) for name in netspec.__all__} | {Describer, LoopDetector}
    assert {each for each in public if each not in (Net, Solver, netspec.SpecError)} <= set(CALLS)


@pytest.mark.parametrize(("function", "name"), parameters("Iterable[str", "Collection[str", "Sequence[str"))
def test_one_string_equals_a_list_of_one(function: Callable[..., Any], name: str) -> None:
    one = ONE_OF_SEVERAL[name]
    assert reported(CALLS[function](**{name: one})) == reported(CALLS[function](**{name: [one]}))


@pytest.mark.parametrize(("function", "name"), parameters("str"))
def test_an_unknown_choice_is_refused(function: Callable[..., Any], name: str) -> None:
    if name in CHOICES:
        with pytest.raises(ValueError, match="nonsense") as fault:
            CALLS[function](**{name: "nonsense"})
        assert "\n" not in str(fault.value)
    else:
        assert name in FREE | set(ONE_OF_SEVERAL), "say whether any text will do"


def test_an_unknown_phase_number_is_refused() -> None:
    with pytest.raises(netspec.SpecError, match="found phase 7, expected TRAIN or TEST"):
        netspec.load_net("net.prototxt", phase=7)


def reported(result: Any) -> Any:
    """Return what one can compare of a result."""
    if isinstance(result, Solver):
        return reported(result.net), list(result.param.weights), result.options.devices
    if isinstance(result, Net):
        return [node.name for node in result.plan.nodes], result.options.stages, result.options.passes
    if isinstance(result, caffe.Net):
        return list(result._layer_names)
    return sorted(result) if isinstance(result, dict) else result
