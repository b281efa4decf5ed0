"""A program that runs the nets in tests/golden/dnn with cv2.dnn of OpenCV 4 or with netspec.dnn.

tests/golden/dnn/make.py records what OpenCV 4.12 gives; tests/netspec/compat/dnn/test_golden.py compares.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

HERE = Path(__file__).parent / "golden" / "dnn"

# Input shapes: as in the prototxt, in a batch, and of another size where the net allows it.
NETS: dict[str, list[list[list[int]]]] = {
    "classify": [[[1, 3, 20, 20]], [[3, 3, 20, 20]]],
    "detect": [[[1, 3, 32, 32]], [[2, 3, 32, 32]], [[1, 3, 24, 40]]],
    "segment": [[[1, 3, 16, 16]], [[1, 3, 20, 28]]],
    "two_inputs": [[[1, 4, 6, 6], [1, 4, 6, 6]], [[2, 4, 6, 6], [2, 4, 6, 6]]],
}


def record(dnn: Any) -> dict[str, np.ndarray]:
    """Return everything that the program finds out with this module."""
    found: dict[str, np.ndarray] = {}
    for name, sizes in NETS.items():
        for key, value in _about(_read(dnn, name), sizes).items():
            found[f"{name}/{key}"] = value
        for i, shapes in enumerate(sizes):
            for key, value in _outputs(dnn, name, shapes, each_layer=i == 0).items():
                found[f"{name}/{i}/{key}"] = value
    found.update({f"models/{key}": value for key, value in _models(dnn).items()})
    found["faults"] = np.array(_faults(dnn))
    return found


def _about(net: Any, sizes: list[list[list[int]]]) -> dict[str, np.ndarray]:
    names = net.getLayerNames()
    shapes = sizes[-1]
    ids, ins, outs = net.getLayersShapes(shapes)
    layers = [net.getLayer(i) for i in range(len(names) + 1)]
    return {
        "names": np.array(names),
        "types": np.array([layer.type for layer in layers]),
        "layer_names": np.array([layer.name for layer in layers]),
        "all_types": np.array(net.getLayerTypes()),
        "unconnected": np.array(net.getUnconnectedOutLayers()),
        "unconnected_names": np.array(net.getUnconnectedOutLayersNames()),
        "numbers": np.array([net.getLayerId(name) for name in (*names, "_input", "no such layer")]),
        "ids": np.array(ids),
        "shapes": np.array(json.dumps([_lists(ins), _lists(outs)])),
        "blobs": np.array(json.dumps([[list(blob.shape) for blob in layer.blobs] for layer in layers])),
        "first_weights": net.getParam(1 if layers[1].blobs else 2, 0),
    }


def _lists(shapes: Any) -> list[list[list[int]]]:
    return [[[int(size) for size in shape] for shape in row] for row in shapes]


def _read(dnn: Any, name: str) -> Any:
    return dnn.readNetFromCaffe(str(HERE / f"{name}.prototxt"), str(HERE / f"{name}.caffemodel"))


def _outputs(dnn: Any, name: str, shapes: list[list[int]], each_layer: bool) -> dict[str, np.ndarray]:
    inputs = [np.random.RandomState(len(shape) + k).rand(*shape).astype(np.float32) for k, shape in enumerate(shapes)]

    def fresh(fusion: bool = True) -> Any:
        """Read the net again for each pass. OpenCV's results are wrong after a pass for other layers."""
        net = _read(dnn, name)
        net.enableFusion(fusion)  # with fusion OpenCV gives the wrong blob for a BatchNorm inside the net
        blobs = [blob for blob in ("data", "a", "b") if net.getLayer(0).outputNameToIndex(blob) != -1]
        for blob, values in zip(blobs, inputs, strict=True):
            net.setInput(values * 100, blob, 0.02, (30, 40, 50) if values.shape[1] == 3 else (25, 25, 25, 25))
        return net

    net = fresh()
    ends = list(net.getUnconnectedOutLayersNames())
    layers = net.getLayerNames() if each_layer else ()
    found = {f"forward/{layer}": fresh(fusion=False).forward(layer) for layer in layers}
    found["forward"] = net.forward()
    found.update({f"together/{layer}": out for layer, out in zip(ends, fresh().forward(ends), strict=True)})
    found.update({f"retrieved/{i}": rows[0] for i, rows in enumerate(fresh().forwardAndRetrieve(ends))})
    return found


def _image() -> np.ndarray:
    blocks = np.random.RandomState(8).randint(0, 256, (6, 8, 3)).astype(np.uint8)
    return np.ascontiguousarray(np.kron(blocks, np.ones((10, 10, 1), np.uint8)))


def _models(dnn: Any) -> dict[str, np.ndarray]:
    files = {name: (str(HERE / f"{name}.caffemodel"), str(HERE / f"{name}.prototxt")) for name in NETS}
    image = _image()
    detect = dnn.DetectionModel(*files["detect"])
    detect.setInputParams(scale=1 / 64, size=(32, 32), mean=(100, 110, 120), swapRB=True)
    classes, confidences, boxes = detect.detect(image, confThreshold=0.3)
    nothing = detect.detect(image, confThreshold=2.0)
    classify = dnn.ClassificationModel(dnn.readNet(*reversed(files["classify"])))
    classify.setInputSize((20, 20))
    classify.setInputScale((0.01, 0.02, 0.03))
    classify.setInputMean((100, 110, 120))
    classify.setInputCrop(True)
    plain = classify.classify(image)
    classify.setEnableSoftmaxPostProcessing(True)
    segment = dnn.SegmentationModel(*files["segment"])
    segment.setInputParams(0.02, (16, 16), (90, 90, 90), False, False)
    model = dnn.Model(*files["segment"])
    return {
        "classes": np.array(classes),
        "confidences": np.array(confidences),
        "boxes": np.array(boxes),
        "nothing": np.array([len(part) for part in nothing]),
        "classify": np.array([*plain, *classify.classify(image)]),
        "segment": segment.segment(image),
        "predict": model.predict(cv2.resize(image, (16, 16)))[0],
    }


def _faults(dnn: Any) -> list[bool]:
    """Return which of these raise cv2.error."""
    net = dnn.readNetFromCaffe(str(HERE / "classify.prototxt"), str(HERE / "classify.caffemodel"))
    data = np.zeros((1, 3, 20, 20), np.float32)
    weights = (HERE / "classify.caffemodel").read_bytes()
    text = (HERE / "classify.prototxt").read_bytes()
    as_given = dnn.readNetFromCaffe(bytearray(text), bytearray(weights))

    def wrong_channels() -> None:
        net.setInput(data[:, :2])
        net.forward()

    def without_weights() -> None:
        unlearned = dnn.readNetFromCaffe(str(HERE / "classify.prototxt"))
        unlearned.setInput(data)
        unlearned.forward()

    attempts = [
        net.forward,  # without input
        lambda: net.setInput(data, "no such input"),
        lambda: net.setInput("words"),
        lambda: net.setInput(data),
        lambda: net.forward("no such layer"),
        lambda: net.forward(["fc", "no such layer"]),
        lambda: net.getLayer("no such layer"),
        lambda: net.getLayer(99),
        lambda: net.getParam(1, 7),
        lambda: net.getParam("no such layer"),
        wrong_channels,
        without_weights,
        lambda: dnn.Net().forward(),
        lambda: dnn.readNetFromCaffe("no such file", str(HERE / "classify.caffemodel")),
        lambda: dnn.readNetFromCaffe(str(HERE / "classify.caffemodel"), str(HERE / "classify.prototxt")),
        lambda: dnn.readNetFromCaffe(bytearray(b"layer {"), bytearray(weights)),
        lambda: dnn.readNet("no such file.caffemodel", "no such file.prototxt"),
        lambda: dnn.DetectionModel(as_given).detect(_image()),
        lambda: as_given.setInput(data, scalefactor=0.5, mean=3),
        lambda: as_given.forward(),
    ]
    return [_raises(attempt) for attempt in attempts]


def _raises(attempt: Any) -> bool:
    try:
        attempt()
    except cv2.error:
        return True
    return False
