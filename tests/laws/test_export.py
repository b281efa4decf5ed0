"""Every layer type of Caffe and of the forks computes the same in each format, or is refused with a reason."""

import importlib.util
import operator
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from typing_extensions import override

from exported import Arrays, assert_same, here, in_onnxruntime, onnx_model, run_module, source_module, trained
from fresh_dialects import fresh_dialects
from laws.export_cases import CASES, Case
from laws.test_registry import TYPES, folder  # noqa: F401
from netspec import use_dialect
from netspec.dialects.files import known_files
from netspec.dialects.layers import CLASSES
from netspec.errors import SpecError
from netspec.export.engines.model import openvino_runner
from netspec.export.exporter import EXPORTERS, exported
from netspec.export.exporter import refusal as refusal_of
from netspec.export.expression import Expression, Value
from netspec.export.formats.deploy import with_inputs
from netspec.export.formats.module import torch_module
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.layers import Layer, layer_class, layer_types
from netspec.layers.contract.base import Shape
from netspec.layers.contract.data_layer import DataLayer
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST, TRAIN, LayerParameter, PhaseValue
from netspec.proto.text import parse_net_text
from paths import ROOT

fresh = pytest.fixture(fresh_dialects)
ONNX, TORCH = "ONNX", "PyTorch"
BOTH = (ONNX, TORCH)
KINDS = sorted({case.kind for case in CASES.values()})


class Refused(NamedTuple):
    """Layer types that an export refuses, all or ``when`` they are set so; ``reason`` are words of the error."""

    kinds: str
    targets: Sequence[str]
    reason: str
    when: str = ""


REFUSED = [
    Refused("Python", BOTH, "it runs Python code"),
    Refused("HDF5Output", BOTH, "it writes a file"),
    Refused("DummyData", BOTH, "its values are random", "a random filler"),
    Refused("Dropout", (ONNX,), "it draws random numbers in the training phase", "phase TRAIN"),
    Refused("Dropout", (TORCH,), "torch's dropout scales in training", "phase TRAIN, `scale_train: false`"),
    Refused("Pooling", BOTH, "STOCHASTIC pooling draws random numbers", "STOCHASTIC, phase TRAIN"),
    Refused("Pooling", BOTH, "can lie outside the map", "rounding up, a stride larger than the kernel"),
    Refused("Pooling", (ONNX,), "its windows leave out the map's end", "a fork's pads: windows end before the map"),
    Refused("Pooling", (TORCH,), "a pad for each side, or of pixels alone", "a fork's pads or means"),
    Refused("Accuracy", (TORCH,), "without the accuracy of each class", "a second top"),
    Refused("InfogainLoss", (TORCH,), "PyTorch has no loss with an infogain matrix"),
    Refused("SigmoidCrossEntropyLoss", (TORCH,), "cannot ignore a label", "`ignore_label`"),
    Refused("SigmoidCrossEntropyLoss", BOTH, "it is for training", "a fork's balance of edges"),
    Refused("SoftmaxWithLoss", BOTH, "it weighs classes, for training", "a fork's weights of classes"),
    Refused("SmoothL1Loss", (TORCH,), "it is exported for bottoms of one shape", "bottoms of other shapes"),
    Refused("SmoothL1LossOHEM", (ONNX,), "R-FCN's loss is for training"),
    Refused("SmoothL1LossOHEM", (TORCH,), "not as R-FCN's"),
    Refused(
        "rpn.anchor_target_layer.AnchorTargetLayer rpn.proposal_target_layer.ProposalTargetLayer",
        BOTH,
        "it is for training, and chooses at random",
    ),
    Refused(
        "BoxAnnotatorOHEM CTCLoss CenterLoss CtcLoss DiceCoefLoss FocalLoss L1Loss LabelSpecificAdd "
        "LargeMarginInnerProduct MarginInnerProduct RegionLoss SoftmaxWithLossOHEM TripletLoss WarpCTCLoss Yolov3",
        BOTH,
        "it is for training",
    ),
    Refused("ChannelScale", BOTH, "its scale is for training"),
    Refused("MultiBoxLoss", BOTH, "it is a training loss"),
    Refused("LabelsequenceAccuracy SegAccuracy", BOTH, "it is for tests"),
    Refused("DetectionEvaluate", BOTH, "it compares with true boxes"),
    Refused("DetectionOutput", BOTH, "eta must be 1", "`eta` below 1"),
    Refused("DetectionOutput", BOTH, "its priors are refined", "five bottoms"),
    Refused(
        "DetectionOutput",
        (TORCH,),
        "it is exported for code_type: CENTER_SIZE and share_location: true",
        "another `code_type`, or `share_location: false`",
    ),
    Refused("PriorBox", BOTH, "denser_prior_boxes", "`denser_prior_boxes` (ONNX: with free sizes)"),
    Refused("ROIPooling", (TORCH,), "PyTorch has no pooling of regions; torchvision's roi_pool is near to it"),
    Refused("ROIAlign", BOTH, "PyTorch has no reading of regions; torchvision's roi_align is near to it"),
    Refused("PSROIPooling", BOTH, "there is no position-sensitive pooling of regions"),
    Refused("CTCGreedyDecoder", BOTH, "how long a text is follows from the values"),
    Refused("Lstm", BOTH, "its steps are a loop"),
    Refused("DenseBlock", BOTH, "it is a net of its own; write its steps as layers"),
    Refused("NdPooling Pooling3D", BOTH, "it pools volumes"),
    Refused("ConvolutionRistretto DeconvolutionRistretto FcRistretto", BOTH, "its numbers are rounded to few bits"),
    Refused(
        "Accum ChannelNorm Correlation Downsample FlowWarp Resample",
        BOTH,
        "FlowNet's layers have no counterpart there",
    ),
    Refused(
        "Arccos Cosine Flip HardSigmoid Mean MergeCrop NegReLU Proposal Reorg ReverseTime YoloDetectionOutput "
        "Yolov3DetectionOutput rpn.proposal_layer.ProposalLayer",
        BOTH,
        "its class does not support it",
    ),
]
TEST_ONLY = {"ConvolutionRistretto", "DeconvolutionRistretto", "FcRistretto"}
# What OpenVINO cannot run: a part of its error, and of the nets.
OPENVINO_CANNOT = {"OpConversionFailure": "zoom_factor: 2 pad_beg: -1", "top_k >= 1": "keep_top_k: 0"}


def net_of(case: Case, phase: PhaseValue) -> Net:
    message, source = parse_net_text(f"force_backward: false\n{case.text}", "net.prototxt")
    message = with_state(message, phase)
    if issubclass(layer_class(case.kind) or object, DataLayer):
        message, source = with_inputs(message, source, BuildOptions(given_shapes={"data": (3, 2, 9, 9)}))
    net = build_net(message, source, BuildOptions(seed=0, allow_python=not case.dialect))
    return trained(net) if case.dialect else net


def inputs_of(case: Case, net: Net) -> dict[str, np.ndarray]:
    """Return the inputs of a case; those that it does not give are normal numbers."""
    rng = np.random.default_rng(0)
    drawn = {blob: rng.standard_normal(net.shapes[blob]).astype(np.float32) for blob in net.inputs}
    return {blob: case.inputs.get(blob, drawn[blob]) for blob in net.inputs}


def in_torch(net: Net, inputs: Arrays) -> list[Arrays]:
    """Return the outputs of the source, and of the module that computes the same without source."""
    modules = [source_module(net), torch_module(net)]
    with torch.device("meta"):  # where tensors are that are made without regard to the device of the inputs
        return [run_module(module, net, inputs) for module in modules]


def in_engines(net: Net, inputs: Arrays, text: str) -> list[Arrays]:
    """Return the outputs of onnxruntime and of OpenVINO for the ONNX model, except what an engine cannot run."""
    model, _ = onnx_model(net)
    if not net.outputs or not model.graph.node:  # onnxruntime opens no graph without nodes
        return []
    found: list[Arrays] = [in_onnxruntime(model, inputs)]
    if importlib.util.find_spec("openvino") is None:
        return found
    with tempfile.TemporaryDirectory() as temporary:
        path = Path(temporary) / "net.onnx"
        path.write_bytes(model.SerializeToString())
        run = openvino_runner(path, "fp32")
        if reason := next((words for words, part in OPENVINO_CANNOT.items() if part in text), ""):
            with pytest.raises(RuntimeError, match=reason):
                run(inputs)
        else:
            found.append(run(inputs))
    return [{name: each[name] for name in net.outputs} for each in found]


def is_of(refusal: Refused, kind: str) -> bool:
    return kind in refusal.kinds.split()


def refused(kind: str, target: str, fault: SpecError) -> Refused:
    """Return the refusal that an error is."""
    head, _, reason = str(fault).partition(f": cannot be exported to {target}: ")
    assert re.fullmatch(r"net\.prototxt:\d+:1: layer \".*\" \([\w.]+\)", head), fault
    found = [each for each in REFUSED if is_of(each, kind) and target in each.targets and each.reason in reason]
    assert len(found) == 1, fault
    return found[0]


def try_case(case: Case, phase: PhaseValue) -> tuple[set[Refused], set[str]]:
    """Run a net as each target has it, and compare; return the refusals, and the other targets."""
    refusals, worked = set(), set()
    net = net_of(case, phase)
    inputs = inputs_of(case, net)
    found = []
    for target in BOTH if importlib.util.find_spec("onnxruntime") else (TORCH,):
        try:
            found += in_torch(net, inputs) if target == TORCH else in_engines(net, inputs, case.text)
            worked.add(target)
        except SpecError as fault:
            refusals.add(refused(case.kind, target, fault))
    if found:
        # An exported Dropout drops only after .train().
        expected = here(net_of(case, TEST) if case.kind == "Dropout" else net, inputs)
        for each in found:
            assert_same(each, expected)
    net.close()
    return refusals, worked


@contextmanager
def fork_of(case: Case) -> Iterator[None]:
    """Use the dialect of a case, if it has one; two dialects may have types of the same names."""
    if not case.dialect:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        fresh_dialects(patch)
        use_dialect(case.dialect)
        yield


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_layer_computes_the_same_in_each_format_or_is_refused(
    kind: str,
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    refusals, worked = set(), set()
    for case in (case for case in CASES.values() if case.kind == kind):
        with fork_of(case):
            for phase in (TEST, TRAIN)[: 1 if kind in TEST_ONLY else 2]:
                found = try_case(case, phase)
                refusals |= found[0]
                worked |= found[1]
    if importlib.util.find_spec("onnxruntime"):
        expected = {each for each in REFUSED if is_of(each, kind)}
        assert refusals == expected
        assert not [each for each in expected if not each.when and worked & set(each.targets)]


def test_every_layer_of_caffe_has_a_case() -> None:
    assert set(TYPES) <= set(KINDS)


@pytest.mark.usefixtures("fresh")
def test_every_layer_of_a_fork_has_a_case_or_reads_data() -> None:
    for dialect in known_files():
        use_dialect(dialect)
    rest = [kind for kind in layer_types() if kind not in KINDS]
    assert not [kind for kind in rest if not all(issubclass(cls, DataLayer) for cls in CLASSES[kind].values())]


def test_exporters_are_registered_for_existing_classes() -> None:
    for path in EXPORTERS:
        module, _, cls = path.rpartition(".")
        assert f"class {cls}(" in (ROOT / module.replace(".", "/")).with_suffix(".py").read_text(), path


def test_a_class_outside_netspec_defines_its_own_export() -> None:
    class Doubled(Layer):
        @override
        def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
            return bottom_shapes

        @override
        def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
            return 2 * bottoms[0]

        def to_torch(self, code: object, x: Expression) -> Expression:
            return 2 * x

    layer = Doubled(LayerParameter(name="it", bottom=["x"], top=["y"]), [(1, 2)])
    made = exported(layer, "to_torch")(None, Value(0))
    assert (made.function, made.args[0]) == (operator.mul, 2)
    assert exported(layer, "to_onnx") is exported(layer, "onnx_op") is None
    assert str(refusal_of(layer, "ONNX")).endswith("cannot be exported to ONNX: its class does not support it")


@pytest.mark.parametrize(("shift", "power"), [(3, 2), (0, -1), (-2, 0.5)], ids=["finite", "infinite", "NaN"])
def test_a_power_that_does_not_depend_on_its_bottom_is_exported(shift: float, power: float) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "y" type: "Power" bottom: "x" top: "y" power_param {{ scale: 0 shift: {shift} power: {power} }} }}"""
    net = build_net(*parse_net_text(text, "net.prototxt"))
    inputs = {"x": np.ones((2, 3), np.float32)}
    expected = here(net, inputs)["y"]
    found = [run_module(module, net, inputs)["y"] for module in (source_module(net), torch_module(net))]
    if importlib.util.find_spec("onnxruntime"):
        found.append(in_onnxruntime(onnx_model(net)[0], inputs)["y"])
    for y in found:
        np.testing.assert_allclose(y, expected, rtol=1e-6)
