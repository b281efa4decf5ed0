"""Each net has its own dialects; other nets of the process have Caffe's own layers."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import netspec
from netspec import use_dialect
from netspec.errors import Code, SpecError
from netspec.graph.options import BuildOptions
from netspec.layers.vision.convolution import Convolution
from netspec.net.net import Net
from netspec.net.weights import load_weights
from netspec.proto.forks import forks
from netspec.proto.schema import NetParameter
from netspec.proto.text import parse_net_text

PLAIN = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1 dim: 9 dim: 9 } } }
layer { name: "conv" type: "Convolution" bottom: "data" top: "conv" convolution_param { num_output: 2 kernel_size: 3 } }
"""
FORK = PLAIN.replace("kernel_size: 3", "kernel_size: 3 hole: 2")


def test_a_replacement_of_caffes_layer_applies_to_nets_of_its_dialect(net_of: Callable[..., Net]) -> None:
    fork, plain = net_of(FORK), net_of(PLAIN)
    assert type(plain.layers[1]) is Convolution
    assert type(fork.layers[1]).__module__ == "netspec.dialects.blocks.filters"
    assert (fork.options.dialects, plain.options.dialects) == (("filters",), ())
    values = torch.randn(1, 1, 9, 9)
    assert fork(values)["conv"].shape == (1, 2, 5, 5)
    assert plain(values)["conv"].shape == (1, 2, 7, 7)


def test_a_requested_dialect_applies_to_every_net(net_of: Callable[..., Net]) -> None:
    use_dialect("filters")
    assert net_of(PLAIN).options.dialects == ("filters",)
    assert net_of(PLAIN.replace('"conv"', '"other"')).layers[1].__class__ is not Convolution


def test_a_layer_type_of_one_dialect_activates_it_and_one_of_several_does_not(net_of: Callable[..., Net]) -> None:
    sure = (
        'layer { name: "n" type: "CropCenter" bottom: "data" top: "n" crop_center_param { crop_size: [0, 0, 1, 1] } }'
    )
    assert net_of(PLAIN + sure).options.dialects == ("layout",)
    assert net_of(PLAIN + NORMALIZE).options.dialects == ()


NORMALIZE = 'layer { name: "n" type: "Normalize" bottom: "data" top: "n" }'
INTERP = 'layer { name: "v" type: "Interp" bottom: "n" top: "v" interp_param { zoom_factor: 2 } }'
BN = 'layer { name: "n" type: "BN" bottom: "data" top: "n" }'
SIGMOID = 'layer { name: "n" type: "SigmoidCrossEntropyLoss" bottom: "data" bottom: "data" top: "n" }'
VIDEOS = ("ssd_video", "tsn")
SMOOTH = 'layer { name: "n" type: "SmoothL1Loss" bottom: "data" bottom: "data" top: "n" %s }'
FOCAL = """layer { name: "l" type: "DummyData" top: "l" dummy_data_param { shape { dim: [1, 7, 7] } } }
layer { name: "n" type: "FocalLoss" bottom: "conv" bottom: "l" top: "n" focal_loss_param { %s } }"""
TWO_TOPS = NORMALIZE.replace('top: "n"', 'top: "n" top: "l"')


OF_SEVERAL_FORKS = {
    "Normalize": (NORMALIZE, '"ssd" (a learned scale'),
    "Normalize_with_comment": ("# dialect: happynear\n" + NORMALIZE, ""),
    "Normalize_with_two_tops": (TWO_TOPS, ""),
    "BN": (BN, '"blocks" (of PSPNet and TSN'),
    "BN_with_comment": ("  # dialect: tsn\n" + BN, ""),
    "BN_with_Interp": (BN + INTERP, ""),
    "BN_with_bn_mode": (BN.replace("}", "bn_param { bn_mode: LEARN } }"), ""),
    "SmoothL1Loss": (SMOOTH % "loss_weight: 1", '"rcnn" (divided by N;'),
    "FocalLoss_alpha": (FOCAL % "alpha: 0.25", '"happynear" ((alpha - p)^gamma), not of "rcnn"'),
    "FocalLoss_alpha_1": (FOCAL % "alpha: 1", ""),
    "FocalLoss_with_comment": ("# dialect: rcnn\n" + FOCAL % "alpha: 0.25", ""),
    "SmoothL1Loss_with_sigma": (SMOOTH % "loss_weight: 1 smooth_l1_loss_param { sigma: 1 }", ""),
    "SmoothL1Loss_with_normalization": (SMOOTH % "loss_weight: 1 loss_param { normalization: NONE }", ""),
}


@pytest.mark.parametrize(("text", "others"), OF_SEVERAL_FORKS.values(), ids=OF_SEVERAL_FORKS)
def test_a_layer_of_several_forks_gets_a_warning_unless_the_file_shows_the_fork(
    net_of: Callable[..., Net], caplog: pytest.LogCaptureFixture, text: str, others: str
) -> None:
    net_of(PLAIN + text)
    said = [
        record.getMessage()
        for record in caplog.records
        if "several forks define this layer type" in record.getMessage()
    ]
    assert len(said) == bool(others)
    assert all(others in line and "# dialect: " in line and "--plugin" in line for line in said)


OF_TWO_FORKS = {
    "a_layer_with_both": (
        TWO_TOPS.replace('top: "l"', 'top: "l" norm_param { }'),
        "Normalize",
        ("ssd", "happynear"),
    ),
    "a_net_with_both": (
        'layer { name: "p" type: "Flip" bottom: "data" top: "p" }'
        'layer { name: "v" type: "Interp" bottom: "p" top: "v" interp_param { zoom_factor: 2 } }' + BN,
        "BN",
        ("blocks", "happynear"),
    ),
    "both_named": ("# dialect: ssd\n# dialect: tsn\n" + NORMALIZE, "Normalize", ("ssd", "tsn")),
    "both_named_for_caffes": (
        "# dialect: hed\n# dialect: rcf\n" + SIGMOID,
        "SigmoidCrossEntropyLoss",
        ("hed", "rcf"),
    ),
}


@pytest.mark.parametrize(("text", "kind", "names"), OF_TWO_FORKS.values(), ids=OF_TWO_FORKS)
def test_a_layer_of_two_forks_at_once_is_refused_with_the_line_that_chooses(
    net_of: Callable[..., Net], text: str, kind: str, names: tuple[str, str]
) -> None:
    with pytest.raises(SpecError) as caught:
        net_of(PLAIN + text)
    assert caught.value.where is not None
    assert caught.value.where.type == kind
    assert all(f'"{name}"' in caught.value.message for name in names)
    assert f"# dialect: {names[0]}" in caught.value.message
    if "# dialect" not in text:
        net_of(f"# dialect: {names[0]}\n" + PLAIN + text.replace('top: "l"', ""))


@pytest.mark.parametrize(
    ("layer", "named"),
    [(NORMALIZE, ("ssd", "tsn")), (SIGMOID, ("hed", "rcf")), (NORMALIZE.replace("Normalize", "VideoData"), VIDEOS)],
    ids=["Normalize", "of_Caffe", "of_two_classes"],
)
def test_two_forks_are_reported_once(net_of: Callable[..., Net], layer: str, named: tuple[str, str]) -> None:
    faults: list[SpecError] = []
    net_of("".join(f"# dialect: {name}\n" for name in named) + PLAIN + layer, report=faults.append)
    assert ["# dialect: " in fault.message for fault in faults[:1]] == [True]
    assert not [fault for fault in faults if fault.code is Code.UNKNOWN_TYPE]


def test_dialects_that_solvers_name_are_those_of_the_nets_inside(tmp_path: Path) -> None:
    text = (
        f'# dialect: tsn\nbase_lr: 1 lr_policy: "fixed" snapshot_prefix: "x" train_net_param {{ {PLAIN} {NORMALIZE} }}'
    )
    (tmp_path / "solver.prototxt").write_text(text)
    assert netspec.load_solver(tmp_path / "solver.prototxt").net.options.dialects == ("tsn",)


def test_a_comment_with_an_unknown_dialect_is_refused(net_of: Callable[..., Net]) -> None:
    with pytest.raises(SpecError, match=r':2:1: unknown dialect "hd"; did you mean "hed"'):
        net_of("\n# dialect: hd\n" + PLAIN)


def conv(pad: int) -> str:
    """Return a net of a convolution and a Crop without crop_param."""
    kernel = f"num_output: 1 kernel_size: 3 pad: {pad}"
    return PLAIN.replace("num_output: 2 kernel_size: 3", kernel) + (
        'layer { name: "crop" type: "Crop" bottom: "conv" bottom: "data" top: "crop" }'
    )


@pytest.mark.parametrize(
    ("text", "offset", "said"),
    [
        (conv(1), 0, ""),
        (conv(2), 0, "cuts from the corner, as in Caffe; HED's branch aligns its bottoms, by 1 and 1"),
        ("# dialect: hed\n" + conv(2), 1, ""),
        (conv(35), 0, "cuts from the corner, as in Caffe; HED's branch aligns its bottoms, by 34 and 34"),
        ("# dialect: hed\n" + conv(35), 34, ""),
        (conv(35).replace('"crop" }', '"crop" crop_param { offset: 0 } }'), 0, ""),
    ],
    ids=["pad_1", "pad_2", "pad_2_hed", "pad_35", "pad_35_hed", "pad_35_with_offset"],
)
def test_crop_without_offsets_aligns_its_bottoms_in_hed_only(
    net_of: Callable[..., Net], caplog: pytest.LogCaptureFixture, text: str, offset: int, said: str
) -> None:
    if "crop_param" in text:
        text = text.replace("offset: 0", "axis: 2 offset: 0")
    assert net_of(text).layers[-1].window[2:] == [slice(offset, offset + 9)] * 2
    lines = [record.getMessage() for record in caplog.records if "without crop_param" in record.getMessage()]
    assert len(lines) == bool(said)
    assert all(said in line for line in lines)


def test_a_net_is_not_changed_by_its_forks() -> None:
    net, source = parse_net_text("# dialect: hed\n" + conv(2), "f")
    first, second = (forks().meaning(net, source, BuildOptions()) for _ in range(2))
    assert [layer.HasField("crop_param") for layer in (net.layer[-1], first.net.layer[-1])] == [False, True]
    assert first.net == second.net


def test_crop_offsets_of_hed_equal_those_of_coord_map(net_of: Callable[..., Net]) -> None:
    last, text = "c", conv(35).partition('layer { name: "crop"')[0].replace('"conv"', '"c"')
    for step in range(5):
        if step:
            text += f'layer {{ name: "p{step}" type: "Pooling" bottom: "{last}" top: "p{step}" '
            text += "pooling_param { kernel_size: 2 stride: 2 } }"
            last = f"p{step}"
        factor = 2**step
        text += f'layer {{ name: "u{step}" type: "Deconvolution" bottom: "{last}" top: "u{step}" '
        text += f"convolution_param {{ num_output: 1 kernel_size: {2 * factor if step else 1} stride: {factor} }} }}"
        text += f'layer {{ name: "o{step}" type: "Crop" bottom: "u{step}" bottom: "data" top: "o{step}" }}'
    crops = [layer for layer in net_of("# dialect: hed\n" + text).layers if layer.type == "Crop"]
    assert [crop.window[2].start for crop in crops] == [34, 35, 36, 38, 42]  # by BVLC's coord_map


@pytest.mark.parametrize(
    ("fields", "weight"), [("smooth_l1_loss_param { sigma: 3 }", 0), ("loss_weight: 2", 2)], ids=["without", "with"]
)
def test_smooth_l1_loss_of_fast_rcnn_counts_with_a_loss_weight_only(
    net_of: Callable[..., Net], fields: str, weight: float
) -> None:
    assert net_of(PLAIN + SMOOTH % fields).loss_weights[-1] == [weight]
    assert net_of("# dialect: ssd\n" + PLAIN + SMOOTH % "").loss_weights[-1] == [1]


def test_bn_blobs_of_two_axes_in_a_file_are_loaded(net_of: Callable[..., Net], tmp_path: Path) -> None:
    message = NetParameter()
    blobs = message.layer.add(name="n", type="BN").blobs
    for _ in range(4):
        blobs.add(shape={"dim": [1, 1]}, data=[0.5])
    (tmp_path / "w.caffemodel").write_bytes(message.SerializeToString())
    net = net_of("# dialect: happynear\n" + PLAIN + BN)
    load_weights(net, [tmp_path / "w.caffemodel"])
    assert [blob.item() for blob in net.params["n"]] == [0.5] * 4
    x = torch.randn(1, 1, 9, 9)
    torch.testing.assert_close(net(data=x)["n"], (x - 0.5) * 0.5 * 0.5 + 0.5)


OHEM = """
layer { name: "in" type: "Input" top: "scores" top: "labels" top: "boxes" top: "targets" top: "weights" top: "rois"
        input_param { shape { dim: [6, 3] } shape { dim: [6, 1, 1, 1] } shape { dim: [6, 8] } shape { dim: [6, 8] }
                      shape { dim: [6, 8] } shape { dim: [6, 5] } } }
layer { name: "cls" type: "SoftmaxWithLoss" bottom: "scores" bottom: "labels" top: "a" top: "p" top: "each_cls"
        loss_weight: 0 loss_weight: 0 loss_weight: 0 }
layer { name: "box" type: "SmoothL1Loss" bottom: "boxes" bottom: "targets" bottom: "weights" top: "b" top: "each_box"
        loss_weight: 0 loss_weight: 0 }
layer { name: "each" type: "Eltwise" bottom: "each_cls" bottom: "each_box" top: "each" }
layer { name: "hard" type: "BoxAnnotatorOHEM" bottom: "rois" bottom: "each" bottom: "labels" bottom: "weights"
        top: "hard" top: "hard_weights" box_annotator_ohem_param { roi_per_img: 2 } }
layer { name: "loss" type: "SmoothL1Loss" bottom: "boxes" bottom: "targets" bottom: "hard_weights" top: "loss"
        loss_weight: 1 loss_param { normalization: PRE_FIXED pre_fixed_normalizer: 2 } }
"""


def test_losses_of_rfcn_have_a_top_with_the_loss_of_each_region(net_of: Callable[..., Net]) -> None:
    net = net_of(OHEM)
    shapes = [(6, 3), (6, 1, 1, 1), (6, 8), (6, 8), (6, 8), (6, 5)]
    given = dict(zip(net.inputs, (torch.randn(shape) for shape in shapes), strict=True))
    given.update(labels=torch.zeros(6, 1, 1, 1), weights=torch.ones(6, 8), rois=torch.zeros(6, 5))
    tops = net(**given)
    d = (given["boxes"] - given["targets"]).abs()
    of_boxes = torch.where(d < 1, d * d / 2, d - 0.5).sum(1)
    of_classes = -given["scores"].log_softmax(1)[:, 0]
    hardest = (of_boxes + of_classes).topk(2).indices
    torch.testing.assert_close(tops["loss"], of_boxes[hardest].sum() / 2)
