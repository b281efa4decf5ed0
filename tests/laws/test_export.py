"""Every layer type of Caffe and of the forks computes the same in each format, or is refused with a reason."""

import importlib.util
import operator
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from typing_extensions import override

from exported import (
    ONNX_EXTRA,
    Arrays,
    assert_same,
    here,
    in_onnxruntime,
    onnx_model,
    run_module,
    source_module,
    trained,
)
from fresh_dialects import fresh_dialects
from laws.export_cases import CASES, Case
from laws.test_registry import TYPES, folder  # noqa: F401
from netspec import use_dialect
from netspec.dialects.files import known_files
from netspec.dialects.layers import CLASSES
from netspec.errors import SpecError
from netspec.export.engines.model import openvino_runner
from netspec.export.exporter import EXPORTERS, exporter_of
from netspec.export.expression import Expression, Value
from netspec.export.formats.deploy import with_inputs
from netspec.export.formats.onnx import onnx_definition
from netspec.export.formats.shapes import settled
from netspec.export.formats.torch_code import write_definition
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.layers import Layer, layer_class, layer_types
from netspec.layers.contract.base import Shape
from netspec.layers.contract.data_layer import DataLayer
from netspec.layers.contract.learned import blobs_of
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
    Refused("Dropout", BOTH, "torch's dropout scales in training", "phase TRAIN, `scale_train: false`"),
    Refused("Pooling", BOTH, "STOCHASTIC pooling draws random numbers", "STOCHASTIC, phase TRAIN"),
    Refused("Pooling", BOTH, "can lie outside the map", "rounding up, a stride larger than the kernel"),
    Refused("SigmoidCrossEntropyLoss", BOTH, "it is for training", "a fork's balance of edges"),
    Refused("SoftmaxWithLoss", BOTH, "it weighs classes, for training", "a fork's weights of classes"),
    Refused("SmoothL1LossOHEM", BOTH, "R-FCN's loss is for training"),
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
    Refused("PriorBox", BOTH, "denser_prior_boxes", "`denser_prior_boxes` with free sizes"),
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
        "Mean MergeCrop Proposal ReverseTime YoloDetectionOutput Yolov3DetectionOutput "
        "rpn.proposal_layer.ProposalLayer",
        BOTH,
        "its class does not say how",
    ),
]
TEST_ONLY = {"ConvolutionRistretto", "DeconvolutionRistretto", "FcRistretto"}


def is_data(kind: str) -> bool:
    return issubclass(layer_class(kind) or object, DataLayer)


def net_of(case: Case, phase: PhaseValue) -> Net:
    message, source = parse_net_text(f"force_backward: false\n{case.text}", "net.prototxt")
    message = with_state(message, phase)
    if is_data(case.kind):
        message, source = with_inputs(message, source, BuildOptions(given_shapes={"data": (3, 2, 9, 9)}))
    net = build_net(message, source, BuildOptions(seed=0, allow_python=not case.dialect))
    return trained(net) if case.dialect else net


def inputs_of(case: Case, net: Net) -> dict[str, np.ndarray]:
    """Return the inputs of a case; those that it does not give are normal numbers."""
    rng = np.random.default_rng(0)
    drawn = {blob: rng.standard_normal(net.shapes[blob]).astype(np.float32) for blob in net.inputs}
    return {blob: case.inputs.get(blob, drawn[blob]) for blob in net.inputs}


def in_torch(net: Net, inputs: Arrays) -> Arrays:
    """Return the outputs of the source."""
    module = source_module(net)
    with torch.device("meta"):  # where tensors are that are made without regard to the device of the inputs
        return run_module(module, net, inputs)


def joined(cases: Sequence[Case]) -> Case:
    """Return the nets of some cases as one net, because each export to ONNX takes a second."""
    names = re.compile(r'\b(name|bottom|top): "([^"]+)"')
    texts = [names.sub(rf'\1: "\2_{i}"', case.text) for i, case in enumerate(cases)]
    inputs = {f"{blob}_{i}": x for i, case in enumerate(cases) for blob, x in case.inputs.items()}
    return replace(cases[0], text="".join(texts), inputs=inputs)


def in_engines(net: Net, inputs: Arrays) -> list[Arrays]:
    """Return the outputs of onnxruntime and of OpenVINO for the ONNX model."""
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
        found.append(run(inputs))
    return [{name: each[name] for name in net.outputs} for each in found]


def assert_same_gradients(net: Net, inputs: Arrays) -> None:
    """Compare the gradients of a weighted sum of the outputs with those of the exported module, in training."""
    module = source_module(net).train()
    given = [{name: torch.from_numpy(x.copy()).requires_grad_() for name, x in inputs.items()} for _ in range(2)]
    there = module(*(given[1][name] for name in net.inputs))
    outputs = (net(**given[0]), there if isinstance(there, dict) else dict(zip(net.outputs, [there], strict=True)))
    for found in outputs:
        rng = torch.Generator().manual_seed(3)
        total = torch.zeros(())
        for x in (found[name] for name in net.outputs):
            total = total + (x * torch.randn(x.shape, generator=rng)).sum()
        if total.requires_grad:
            total.backward()
    expected = {f"of {name}": x.grad for name, x in given[0].items() if x.grad is not None}
    got = {f"of {name}": given[1][name].grad for name in inputs if f"of {name}" in expected}
    definition, _ = settled(net, lambda shapes: write_definition(net, shapes))
    for i, blob in enumerate(blobs_of(net.layers)()):
        if blob.grad is None or blob.numel() == 0:
            continue
        expected[f"of parameter {i}"], total = blob.grad, torch.zeros_like(blob)
        for stored, name in definition.attributes.items():
            for role, tensor in stored.tensors(name).items():
                if tensor.untyped_storage().data_ptr() == blob.untyped_storage().data_ptr():  # reshaped, or transposed
                    found = dict(module.named_parameters())[role].grad
                    total.as_strided(tensor.shape, tensor.stride()).add_(0 if found is None else found)
        got[f"of parameter {i}"] = total
    zero = {name: torch.zeros_like(x) for name, x in expected.items()}
    there, here = (
        {name: (zero[name] if x is None else x).detach().numpy() for name, x in each.items()}
        for each in (got, expected)
    )
    assert_same(there, here)


def is_of(refusal: Refused, kind: str) -> bool:
    return kind in refusal.kinds.split()


def refused(kind: str, target: str, fault: SpecError) -> Refused:
    """Return the refusal that an error is."""
    head, _, reason = str(fault).partition(": cannot be exported: ")
    assert re.fullmatch(r"net\.prototxt:\d+:1: layer \".*\" \([\w.]+\)", head), fault
    found = [each for each in REFUSED if is_of(each, kind) and target in each.targets and each.reason in reason]
    assert len(found) == 1, fault
    return found[0]


def try_case(case: Case, phase: PhaseValue) -> tuple[set[Refused], set[str]]:
    """Run a net as exported to PyTorch, and compare; return the refusals, and the other targets."""
    refusals, worked = set(), set()
    net = net_of(case, phase)
    inputs = inputs_of(case, net)
    try:
        # An exported Dropout drops only after .train().
        assert_same(in_torch(net, inputs), here(net_of(case, TEST) if case.kind == "Dropout" else net, inputs))
        worked.add(TORCH)
    except SpecError as fault:
        refusals.add(refused(case.kind, TORCH, fault))
    try:
        onnx_definition(net)
        worked.add(ONNX)
    except SpecError as fault:
        refusals.add(refused(case.kind, ONNX, fault))
    net.close()
    if phase == TRAIN and TORCH in worked and case.kind != "Dropout":
        net = net_of(case, phase)
        assert_same_gradients(net, inputs)
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
    expected = {each for each in REFUSED if is_of(each, kind)}
    assert refusals == expected
    assert not [each for each in expected if not each.when and worked & set(each.targets)]


def together() -> Iterator[list[Case]]:
    """Yield cases of one dialect that become one ONNX model; data layers have no nodes."""
    cases = [case for case in CASES.values() if not (is_data(case.kind) or case.kind in TEST_ONLY)]
    for dialect in dict.fromkeys(case.dialect for case in cases):
        of_dialect = [case for case in cases if case.dialect == dialect]
        yield from (of_dialect[i : i + 8] for i in range(0, len(of_dialect), 8))  # more would take longer


def statements(case: Case, phase: PhaseValue) -> str:
    """Return what the ONNX model of a case is made from; "" if it cannot be exported."""
    net = net_of(case, phase)
    try:
        return str(onnx_definition(net)[0].statements)
    except SpecError:
        return ""
    finally:
        net.close()


@pytest.mark.slow
@pytest.mark.parametrize("cases", list(together()), ids=lambda cases: f"{cases[0].dialect} {cases[0].kind}".strip())
def test_onnx_models_of_layers_compute_the_same(
    cases: Sequence[Case],
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pytest.importorskip("onnxruntime", reason=ONNX_EXTRA)
    monkeypatch.chdir(folder)
    with fork_of(cases[0]):
        made = {phase: [statements(case, phase) for case in cases] for phase in (TEST, TRAIN)}
        for phase in (TEST, TRAIN):
            others = made[TEST] if phase == TRAIN else [""] * len(cases)
            new = [case for case, x, y in zip(cases, made[phase], others, strict=True) if x not in ("", y)]
            if new:
                net = net_of(case := joined(new), phase)
                inputs = inputs_of(case, net)
                expected = here(net, inputs)
                for found in in_engines(net, inputs):
                    assert_same(found, expected)
                net.close()


def test_the_page_names_every_layer_that_is_not_exported() -> None:
    words = set(re.findall(r"\w+", (ROOT / "docs" / "export.md").read_text(encoding="utf-8")))
    assert {kind.rpartition(".")[2] for each in REFUSED for kind in each.kinds.split()} <= words


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
    made = exporter_of(layer)(None, Value(0))
    assert (made.function, made.args[0]) == (operator.mul, 2)

    class Other(Doubled):
        @override
        def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
            return 3 * bottoms[0]

    layer = Other(layer.param, [(1, 2)])
    with pytest.raises(SpecError, match="cannot be exported: its class does not say how"):
        exporter_of(layer)


@pytest.mark.parametrize(("shift", "power"), [(3, 2), (0, -1), (-2, 0.5)], ids=["finite", "infinite", "NaN"])
def test_a_power_that_does_not_depend_on_its_bottom_is_exported(shift: float, power: float) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "y" type: "Power" bottom: "x" top: "y" power_param {{ scale: 0 shift: {shift} power: {power} }} }}"""
    net = build_net(*parse_net_text(text, "net.prototxt"))
    inputs = {"x": np.ones((2, 3), np.float32)}
    expected = here(net, inputs)["y"]
    found = [run_module(source_module(net), net, inputs)["y"]]
    if importlib.util.find_spec("onnxruntime"):
        found.append(in_onnxruntime(onnx_model(net)[0], inputs)["y"])
    for y in found:
        np.testing.assert_allclose(y, expected, rtol=1e-6)
