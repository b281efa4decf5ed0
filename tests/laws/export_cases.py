"""Nets of one or two layers for the exports: an example of each layer type, of Caffe and of the forks, and variants."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from google.protobuf import text_format

from case_files import read_cases
from dialect_numbers import NUMBERS
from laws.examples import EXAMPLES

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Case:
    """A net, the layer type that it is about, and values of its inputs; others are normal numbers."""

    kind: str
    text: str
    inputs: Mapping[str, np.ndarray]
    dialect: str = ""


def given(name: str, *sizes: int) -> str:
    dims = " ".join(f"dim: {size}" for size in sizes)
    return f'layer {{ name: "{name}" type: "Input" top: "{name}" input_param {{ shape {{ {dims} }} }} }}\n'


def layer(kind: str, bottoms: str, tops: str, settings: str = "", shared: str = "") -> str:
    ends = " ".join([*(f'bottom: "{b}"' for b in bottoms.split()), *(f'top: "{t}"' for t in tops.split())])
    params = " ".join(f'param {{ name: "{name}" }}' for name in shared.split())
    return f'layer {{ name: "{kind} {tops}" type: "{kind}" {ends} {params} {settings} }}\n'


def _of_example(kind: str) -> Case:
    example = EXAMPLES[kind]
    param = type(example.param)()
    param.CopyFrom(example.param)
    param.ClearField("phase")
    inputs = "".join(given(blob, *shape) for blob, shape in zip(param.bottom, example.shapes, strict=True))
    values = {blob: x.float().numpy() for blob, x in zip(param.bottom, example.bottoms(), strict=True)}
    return Case(kind, f"{inputs}layer {{ {text_format.MessageToString(param)} }}\n", values)


def _of_dialects() -> dict[str, Case]:
    """Return the examples of the forks' layers: every pass of dialect_numbers."""
    found = {}
    for i, case in enumerate(NUMBERS):
        bottoms = case.arrays(np.random.default_rng(5))
        values = {f"x{k}": np.asarray(x, np.float32) for k, x in enumerate(bottoms)}
        inputs = "".join(given(name, *x.shape) for name, x in values.items())
        tops = 0 if " top:" in case.layer else case.tops
        ends = " ".join([*(f'bottom: "{name}"' for name in values), *(f'top: "y{k}"' for k in range(tops))])
        text = f'{inputs}layer {{ name: "it" {ends} {case.layer} }}\n'
        found[f"{case.type_name} {i}"] = Case(case.type_name, text, values, case.dialect)
    return found


TOPS = {
    "BoxAnnotatorOHEM": 2,
    "rpn.anchor_target_layer.AnchorTargetLayer": 4,
    "rpn.proposal_target_layer.ProposalTargetLayer": 5,
}
# Layers without a case in dialect_numbers: dialect, type, shapes of the bottoms, settings.
OF_FORKS = """
blocks     SegAccuracy x=2,4,4,5 label=2,1,4,5
faces      CenterLoss x=3,5 label=3 center_loss_param { num_output: 4 }
faces      MarginInnerProduct x=3,5 label=3 margin_inner_product_param { num_output: 4 type: QUADRUPLE iteration: 0 }
flownet    Accum x=1,2,3,4 z=1,1,6,8 accum_param { }
flownet    Downsample x=1,2,8,6 downsample_param { top_height: 4 top_width: 3 }
flownet    L1Loss x=2,2,3,4 z=2,2,3,4
flownet    Mean x=1,2,3,4 mean_param { operation: SUBTRACT value: 1 value: 2 }
flownet    NegReLU x=2,3
happynear  Arccos x=2,3
happynear  ChannelScale x=2,3,4,5 z=2,1,4,5
happynear  Cosine x=2,3
happynear  Flip x=2,3,4,5
happynear  LabelSpecificAdd x=3,4 label=3 label_specific_add_param { bias: -0.5 }
happynear  LargeMarginInnerProduct x=3,5 label=3 largemargin_inner_product_param { num_output: 4 }
happynear  TripletLoss x=3,4 z=3,4 w=3,4
layout     MergeCrop x=1,2,3,4 z=1,3,5,6
rcnn       Proposal s=1,18,4,5 x=1,36,4,5 z=1,3
rcnn       rpn.anchor_target_layer.AnchorTargetLayer s=1,18,14,14 boxes=2,5 z=1,3 x=1,3,224,224
rcnn       rpn.proposal_target_layer.ProposalTargetLayer x=4,5 boxes=2,5
rcnn       rpn.proposal_layer.ProposalLayer s=1,18,4,5 x=1,36,4,5 z=1,3
rfcn       BoxAnnotatorOHEM boxes=4,5 x=4,1,1,1 label=4 w=4,8 box_annotator_ohem_param { roi_per_img: 2 }
ristretto  ConvolutionRistretto x=1,2,5,5 convolution_param { num_output: 2 kernel_size: 3 }
ristretto  DeconvolutionRistretto x=1,2,5,5 convolution_param { num_output: 2 kernel_size: 3 }
ristretto  FcRistretto x=2,5 inner_product_param { num_output: 2 }
ssd        DetectionEvaluate x=1,1,2,7 z=1,1,2,8 detection_evaluate_param { num_classes: 3 }
text       ContinuationIndicator continuation_indicator_param { time_step: 3 batch_size: 2 }
text       CTCGreedyDecoder x=5,2,4
text       CtcLoss x=5,2,4 label=2,3 ctc_loss_param { alphabet_size: 4 time_step: 5 blank_label: 0 }
text       LabelsequenceAccuracy x=2,5,4 label=2,3
text       ReverseTime x=5,2,4 label=2
text       WarpCTCLoss x=5,2,4 label=2,3
yolo       HardSigmoid x=2,3
"""


def _of_forks() -> dict[str, Case]:
    found = {}
    for line in OF_FORKS.strip().splitlines():
        dialect, kind, *words = line.split()
        shapes = [word.partition("=") for word in words if re.fullmatch(r"\w+=[\d,]+", word)]
        rng = np.random.default_rng(1)
        values = {}
        for name, _, sizes in shapes:
            shape = tuple(map(int, sizes.split(",")))
            values[name] = rng.integers(0, 3, shape) if name == "label" else rng.uniform(-1, 1, shape)
        settings = " ".join(words[len(shapes) :])
        if "." in kind:
            module, _, name = kind.rpartition(".")
            given_by = "feat_stride: 16" if len(values) > 2 else "num_classes: 3"
            settings = f'python_param {{ module: "{module}" layer: "{name}" param_str: "{given_by}" }}'
        tops = " ".join(f"y{k}" for k in range(TOPS.get(kind, 1)))
        net = layer("Python" if "." in kind else kind, " ".join(values), tops, settings)
        found[kind] = _case(kind, "".join(given(name, *x.shape) for name, x in values.items()) + net, dialect, **values)
    return found


def _case(kind: str, text: str, dialect: str = "", **values: np.ndarray) -> Case:
    return Case(kind, text, {name: np.asarray(x, np.float32) for name, x in values.items()}, dialect)


RNG = np.random.default_rng(2)
VECTORS, MAPS = RNG.standard_normal((2, 4)), RNG.standard_normal((2, 4, 3, 3))
SCORES, LABELS = RNG.standard_normal((2, 3, 3)), RNG.integers(0, 3, (2, 3))
OF_SCORES = given("x", 2, 3, 3) + given("y", 2, 3)


def _shared(kind: str, field: str, settings: str, *second: str, shape: Sequence[int] = (2, 4)) -> str:
    """Return two layers that share their blobs, w and b; the second one has other settings too, or other names."""
    other, names = (*second, "", "")[:2]
    first = layer(kind, "x", "a", f"{field} {{ {settings} }}", "w b")
    return given("x", *shape) + first + layer(kind, "a", "c", f"{field} {{ {settings} {other} }}", names or "w b")


def _variants() -> dict[str, Case]:
    """Return layers that share weights, losses over other axes, and settings with an export of their own."""
    ip, scale, filters = "inner_product_param", "scale_param", "convolution_param"
    turned = "num_output: 4 transpose: true"
    wide = "num_output: 4 kernel_size: 3 pad: 2"
    norm = "batch_norm_param { use_global_stats: true }"
    towers = given("x", 2, 4, 3, 3) + given("z", 2, 4, 3, 3)
    for end, bottom in (("a", "x"), ("c", "z")):
        towers += layer("BatchNorm", bottom, f"n{end}", norm, "m v f")
        towers += layer("Scale", f"n{end}", f"s{end}", "scale_param { bias_term: true }", "g h")
    pool = "pooling_param { kernel_h: 5 kernel_w: 3 pad_h: 3 pad_w: 1 stride: 2 }"
    losses = {
        "axis 2": "softmax_param { axis: 2 }",
        "axis -1 by items": "softmax_param { axis: -1 } loss_param { normalization: BATCH_SIZE }",
        "axis 2, ignoring": "softmax_param { axis: 2 } loss_param { ignore_label: 1 }",
        "ignoring": "loss_param { ignore_label: 2 normalization: FULL }",
        "unnormalized": "loss_param { normalization: NONE }",
    }
    scored = {"x": SCORES, "y": LABELS}
    found = {
        "InnerProduct shared": _case("InnerProduct", _shared("InnerProduct", ip, "num_output: 4"), x=VECTORS),
        "InnerProduct shared, transposed": _case(
            "InnerProduct", _shared("InnerProduct", ip, "num_output: 4", "transpose: true"), x=VECTORS
        ),
        "InnerProduct shared, both transposed": _case("InnerProduct", _shared("InnerProduct", ip, turned), x=VECTORS),
        "Scale shared": _case("Scale", _shared("Scale", scale, "bias_term: true", shape=(2, 4, 3, 3)), x=MAPS),
        "Scale shared crosswise": _case(
            "Scale", _shared("Scale", scale, "bias_term: true", "", "b w", shape=(2, 4, 3, 3)), x=MAPS
        ),
        "Convolution shared": _case("Convolution", _shared("Convolution", filters, wide, shape=(2, 4, 3, 3)), x=MAPS),
        "Convolution shared, dilated": _case(
            "Convolution",
            _shared("Convolution", filters, wide, "dilation: 2", shape=(2, 4, 3, 3)),
            x=MAPS,
        ),
        "BatchNorm and Scale shared": _case("BatchNorm", towers, x=MAPS, z=MAPS[::-1]),
        "Pooling with much padding": _case(
            "Pooling",
            given("x", 1, 2, 6, 7) + layer("Pooling", "x", "top mask", pool),
            x=RNG.standard_normal((1, 2, 6, 7)),
        ),
        "SoftmaxWithLoss axis 0": _case(
            "SoftmaxWithLoss",
            given("x", 3, 3) + given("y", 3) + layer("SoftmaxWithLoss", "x y", "loss", "softmax_param { axis: 0 }"),
            x=SCORES[0],
            y=LABELS[0],
        ),
        "SoftmaxWithLoss without a top": _case(
            "SoftmaxWithLoss",
            OF_SCORES + layer("SoftmaxWithLoss", "x y", "") + layer("Accuracy", "x y", "share"),
            **scored,
        ),
        "Accuracy axis 2": _case(
            "Accuracy", OF_SCORES + layer("Accuracy", "x y", "share", "accuracy_param { axis: 2 top_k: 2 }"), **scored
        ),
        "Accuracy ignoring": _case(
            "Accuracy", OF_SCORES + layer("Accuracy", "x y", "share", "accuracy_param { ignore_label: 1 }"), **scored
        ),
        "SigmoidCrossEntropyLoss ignoring": _case(
            "SigmoidCrossEntropyLoss",
            given("x", 2, 3)
            + given("y", 2, 3)
            + layer("SigmoidCrossEntropyLoss", "x y", "loss", "loss_param { ignore_label: 0 }"),
            x=SCORES[0][:2],
            y=LABELS % 2,
        ),
        "InfogainLoss axis 2": _case(
            "InfogainLoss",
            OF_SCORES + given("h", 3, 3) + layer("InfogainLoss", "x y h", "loss", "infogain_loss_param { axis: 2 }"),
            **scored,
            h=RNG.uniform(0, 1, (3, 3)),
        ),
        "Interp, zoom and shrink": _case(
            "Interp",
            given("x", 2, 4, 3, 3) + layer("Interp", "x", "y", "interp_param { zoom_factor: 3 shrink_factor: 2 }"),
            "blocks",
            x=MAPS,
        ),
        "LRN with k": _case(
            "LRN",
            given("x", 2, 4, 3, 3) + layer("LRN", "x", "y", "lrn_param { alpha: 0.5 k: 1.5 local_size: 3 }"),
            x=MAPS,
        ),
        "Pooling, windows beyond the map": _case(
            "Pooling",
            given("x", 2, 4, 3, 3) + layer("Pooling", "x", "y", "pooling_param { kernel_size: 1 stride: 3 }"),
            x=MAPS,
        ),
        "Pooling, stochastic": _case(
            "Pooling",
            given("x", 2, 4, 3, 3) + layer("Pooling", "x", "y", "pooling_param { pool: STOCHASTIC kernel_size: 2 }"),
            x=abs(MAPS),
        ),
        "DummyData, constant": _case(
            "DummyData", layer("DummyData", "", "y", "dummy_data_param { shape { dim: 2 } data_filler { value: 3 } }")
        ),
    }
    # Values at which a formula has a limit of Caffe's, or its gradient is not a number.
    flat, tie = np.ones((2, 4, 3, 3)), given("x", 2, 4) + given("z", 2, 4)
    maps = given("x", 2, 4, 3, 3)
    found |= {
        "BatchNorm of one axis": _case("BatchNorm", given("x", 4) + layer("BatchNorm", "x", "y")),
        "Convolution of no spatial axis": _case(
            "Convolution",
            given("x", 2, 4) + layer("Convolution", "x", "y", "convolution_param { num_output: 3 kernel_size: 1 }"),
        ),
        "ArgMax of one axis": _case("ArgMax", given("x", 4) + layer("ArgMax", "x", "y")),
        "BatchNorm of six axes": _case("BatchNorm", given("x", 2, 2, 1, 2, 1, 2) + layer("BatchNorm", "x", "y")),
        "BatchNorm of one value": _case("BatchNorm", given("x", 1, 4) + layer("BatchNorm", "x", "y")),
        "BatchNorm of nearly equal values": _case(
            "BatchNorm",
            maps + layer("BatchNorm", "x", "y", "batch_norm_param { scale_bias: true eps: 1e-9 }"),
            "nvidia",
            x=1e-4 * MAPS,
        ),
        "MVN of a constant": _case("MVN", maps + layer("MVN", "x", "y"), x=flat),
        "Eltwise MAX of equal values": _case(
            "Eltwise", tie + layer("Eltwise", "x z", "y", "eltwise_param { operation: MAX }"), x=VECTORS, z=VECTORS
        ),
        "ContrastiveLoss of equal values": _case(
            "ContrastiveLoss",
            tie + given("y", 2) + layer("ContrastiveLoss", "x z y", "loss"),
            x=VECTORS,
            z=VECTORS,
            y=np.zeros(2),
        ),
        "SoftmaxWithLoss of a probability of 0": _case(
            "SoftmaxWithLoss",
            given("x", 1, 2) + given("y", 1) + layer("SoftmaxWithLoss", "x y", "loss"),
            x=np.array([[0, -200]]),
            y=np.ones(1),
        ),
        "Normalize with lengths": _case(
            "Normalize", given("x", 2, 4) + layer("Normalize", "x", "y length"), "happynear", x=VECTORS
        ),
    }
    for name, settings in losses.items():
        text = OF_SCORES + layer("SoftmaxWithLoss", "x y", "loss p", settings)
        found[f"SoftmaxWithLoss {name}"] = _case("SoftmaxWithLoss", text, **scored)
    return found


def _of_file() -> dict[str, Case]:
    """Return the layers of forks that test_dialects exports at other sizes too."""
    found = {}
    for name, case in read_cases("netspec/export/cases/dialects.txt").items():
        match = re.search(r"name: \"it\" type: '(\w+)'", case["net"])
        assert match
        found[f"{name} of {case['dialect']}"] = Case(match[1], case["net"], {}, case["dialect"])
    return found


CASES: dict[str, Case] = {
    **{kind: _of_example(kind) for kind in EXAMPLES},
    **_of_dialects(),
    **_of_forks(),
    **_of_file(),
    **_variants(),
}
