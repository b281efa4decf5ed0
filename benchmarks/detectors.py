"""Prototxts of two detectors: the nets of MTCNN with all their heads, and SSD-300."""

from __future__ import annotations

from benchmarks import zoo
from netspec.proto.schema import NetParameter
from netspec.proto.text import write_text

HEADS = {"pnet": (4,), "rnet": (4,), "onet": (4, 10)}  # numbers beside the two scores: the box, five points
SIDES = {"pnet": 12, "rnet": 24, "onet": 48}  # of a window, in pixels
CLASSES = 21  # of PASCAL VOC, with the background
SOURCES = (  # blob, priors at a place, side of the smallest prior and of the next source's, aspect ratios, step
    ("conv4_3_norm", 4, 30, 60, (2,), 8),
    ("fc7", 6, 60, 111, (2, 3), 16),
    ("conv6_2", 6, 111, 162, (2, 3), 32),
    ("conv7_2", 6, 162, 213, (2, 3), 64),
    ("conv8_2", 4, 213, 264, (2,), 100),
    ("conv9_2", 4, 264, 315, (2,), 300),
)


def mtcnn(name: str) -> str:
    """Return one of MTCNN's nets (Zhang et al. 2016) as text: ``prob``, and a head of 4 or of 4 and 10 numbers."""
    message = zoo.deploy(name)
    message.ClearField("name")
    scores = message.layer[-2]
    for k, width in enumerate(HEADS[name], 2):
        head = message.layer.add()
        head.CopyFrom(scores)
        head.name, head.top[0] = f"head{k}", f"head{k}"
        param = head.convolution_param if head.type == "Convolution" else head.inner_product_param
        param.num_output = width
    return write_text(message)


def ssd300() -> str:
    """Return SSD-300 (Liu et al. 2016) on VGG-16 as text; its layers are those of the public file."""
    n = NetParameter(name="ssd300")
    zoo.add(n, "Input", "data", input_param={"shape": [{"dim": [1, 3, 300, 300]}]})
    top = "data"
    for stage, (width, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)), 1):
        for k in range(1, count + 1):
            top = zoo.relu(n, f"relu{stage}_{k}", zoo.conv(n, f"conv{stage}_{k}", top, width, 3, pad=1))
        top = zoo.pool(n, f"pool{stage}", top, *((2, 2) if stage < 5 else (3, 1, 1)))
    top = zoo.relu(n, "relu6", zoo.conv(n, "fc6", top, 1024, 3, pad=6, dilation=6))
    top = zoo.relu(n, "relu7", zoo.conv(n, "fc7", top, 1024, 1))
    for stage, width, more in ((6, 256, (2, 1)), (7, 128, (2, 1)), (8, 128, (1, 0)), (9, 128, (1, 0))):
        top = zoo.relu(n, f"conv{stage}_1_relu", zoo.conv(n, f"conv{stage}_1", top, width, 1))
        stride, pad = more
        top = zoo.conv(n, f"conv{stage}_2", top, 2 * width, 3, stride=stride, pad=pad)
        top = zoo.relu(n, f"conv{stage}_2_relu", top)
    return write_text(n) + NORM + "".join(_heads(*source) for source in SOURCES) + _end()


NORM = """
layer { name: "conv4_3_norm" type: "Normalize" bottom: "conv4_3" top: "conv4_3_norm"
  norm_param { across_spatial: false channel_shared: false scale_filler { type: "constant" value: 20 } } }
"""
HEAD = """
layer {{ name: "{name}" type: "Convolution" bottom: "{source}" top: "{name}"
  convolution_param {{ num_output: {width} kernel_size: 3 pad: 1 weight_filler {{ type: "msra" }} }} }}
layer {{ name: "{name}_perm" type: "Permute" bottom: "{name}" top: "{name}_perm"
  permute_param {{ order: 0 order: 2 order: 3 order: 1 }} }}
layer {{ name: "{name}_flat" type: "Flatten" bottom: "{name}_perm" top: "{name}_flat" flatten_param {{ axis: 1 }} }}
"""
PRIORS = """
layer {{ name: "{source}_priors" type: "PriorBox" bottom: "{source}" bottom: "data" top: "{source}_priors"
  prior_box_param {{ min_size: {low} max_size: {high} {ratios} flip: true clip: false
    variance: 0.1 variance: 0.1 variance: 0.2 variance: 0.2 step: {step} offset: 0.5 }} }}
"""
END = """
layer { name: "scores" type: "Reshape" bottom: "conf" top: "scores"
  reshape_param { shape { dim: 0 dim: -1 dim: 21 } } }
layer { name: "softmax" type: "Softmax" bottom: "scores" top: "softmax" softmax_param { axis: 2 } }
layer { name: "flat" type: "Flatten" bottom: "softmax" top: "flat" flatten_param { axis: 1 } }
layer { name: "detections" type: "DetectionOutput" bottom: "loc" bottom: "flat" bottom: "priors" top: "detections"
  detection_output_param { num_classes: 21 share_location: true background_label_id: 0
    nms_param { nms_threshold: 0.45 top_k: 400 } code_type: CENTER_SIZE keep_top_k: 200 confidence_threshold: 0.01 } }
"""


def _heads(source: str, priors: int, low: int, high: int, ratios: tuple[int, ...], step: int) -> str:
    heads = (("loc", 4 * priors), ("conf", CLASSES * priors))
    made = [HEAD.format(name=f"{source}_{kind}", source=source, width=width) for kind, width in heads]
    words = " ".join(f"aspect_ratio: {ratio}" for ratio in ratios)
    return "".join(made) + PRIORS.format(source=source, low=low, high=high, ratios=words, step=step)


def _end() -> str:
    joined = ""
    for name, ending, axis in (("loc", "loc_flat", 1), ("conf", "conf_flat", 1), ("priors", "priors", 2)):
        bottoms = " ".join(f'bottom: "{source}_{ending}"' for source, *_ in SOURCES)
        joined += f'layer {{ name: "{name}" type: "Concat" {bottoms} top: "{name}" concat_param {{ axis: {axis} }} }}\n'
    return joined + END
