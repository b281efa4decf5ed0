"""A process that runs a whole program with one library on request: ``python -m benchmarks.programs TASK``.

It answers as benchmarks/worker.py does. A pass is what a user's program does for its files, from reading them to its
result; nets are loaded before the first pass. ``python -m benchmarks.programs once TASK`` runs one pass and ends.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from typing import Any

import cv2
import numpy as np

from benchmarks.worker import Run, Task, exported, parameter_groups
from benchmarks.worker import main as answer

MEAN, SCALE, BATCH = 128.0, 1 / 128, 10  # of pixels; images in a batch of the classifier
FACTOR, SMALLEST_FACE = 0.709, 20  # of the pyramid: Zhang et al. 2016
PER_SCALE, WINDOWS, FACES, OVERLAP = 60, (100, 40), 20, 0.7  # random weights find no face: the best are kept
Array = np.ndarray
Forward = Callable[[str, Array], Sequence[Array]]  # a net and its blob; scores (N, 2, ...), boxes (N, 4, ...), ...


def cascade(image: Array, forward: Forward) -> Array:
    """Return FACES boxes (x, y, right, bottom, score) with MTCNN's three nets, for an image (H, W, 3)."""
    found = []
    height, width = image.shape[:2]
    scale = 12 / SMALLEST_FACE
    while min(height, width) * scale >= 12:
        small = cv2.resize(image, (int(np.ceil(width * scale)), int(np.ceil(height * scale))))
        scores, offsets = forward("pnet", _blob(small[None]))
        face = scores[0, 1]
        best = np.argsort(-face, axis=None, kind="stable")[:PER_SCALE]
        rows, columns = np.unravel_index(best, face.shape)
        corners = np.stack([2 * columns, 2 * rows, 2 * columns + 12, 2 * rows + 12], 1) / scale
        found.append(_moved(corners, offsets[0][:, rows, columns].T, face[rows, columns]))
        scale *= FACTOR
    boxes = _apart(np.concatenate(found), WINDOWS[0])
    for name, side, count in (("rnet", 24, WINDOWS[1]), ("onet", 48, FACES)):
        windows = np.stack([_window(image, box, side) for box in boxes])
        scores, offsets, *_ = forward(name, _blob(windows))
        boxes = _apart(_moved(boxes[:, :4], offsets.reshape(-1, 4), scores.reshape(-1, 2)[:, 1]), count)
    return boxes


def _blob(images: Array) -> Array:
    return np.ascontiguousarray(((images - np.float32(MEAN)) * np.float32(SCALE)).transpose(0, 3, 1, 2))


def _moved(corners: Array, offsets: Array, scores: Array) -> Array:
    sides = corners[:, 2:] - corners[:, :2]
    moved = corners + np.clip(offsets, -0.2, 0.2) * np.concatenate([sides, sides], 1)
    return np.concatenate([moved, scores[:, None]], 1)


def _apart(boxes: Array, count: int) -> Array:
    """Return the best boxes of which none covers another (non-maximum suppression)."""
    rectangles = np.concatenate([boxes[:, :2], boxes[:, 2:4] - boxes[:, :2]], 1)
    kept = cv2.dnn.NMSBoxes(rectangles.tolist(), boxes[:, 4].tolist(), 0.0, OVERLAP)  # type: ignore[attr-defined]
    return boxes[np.array(kept).reshape(-1)[:count]]


def _window(image: Array, box: Array, side: int) -> Array:
    left, top = np.maximum(box[:2].astype(int), 0)
    right, bottom = np.maximum(box[2:4].astype(int), (left + 1, top + 1))
    part = image[top:bottom, left:right]
    return cv2.resize(part, (side, side)) if part.size else np.zeros((side, side, 3), np.uint8)


def mtcnn_dnn(dnn: Any, task: Task) -> Run:
    """Find faces with cv2.dnn, or with a module that has its names."""
    nets = {name: dnn.readNetFromCaffe(*files) for name, files in task["nets"].items()}

    def forward(name: str, blob: Array) -> Sequence[Array]:
        nets[name].setInput(blob)
        return nets[name].forward(["prob", *task["heads"][name]])

    return lambda: {"faces": cascade(_image(task["image"]), forward)}


def mtcnn_pytorch(task: Task) -> Run:
    """Find faces with PyTorch."""
    torch = _torch(task)
    nets = {name: _exported(task, name) for name in task["nets"]}

    def forward(name: str, blob: Array) -> Sequence[Array]:
        with torch.inference_mode():
            found = nets[name](torch.from_numpy(blob))
        return [found[each].numpy() for each in ("prob", *task["heads"][name])]

    return lambda: {"faces": cascade(_image(task["image"]), forward)}


def ssd_dnn(dnn: Any, task: Task) -> Run:
    """Detect objects on one image, as OpenCV's sample does."""
    net = dnn.readNetFromCaffe(*task["nets"]["ssd300"])

    def run() -> dict[str, Any]:
        net.setInput(dnn.blobFromImage(_image(task["image"]), SCALE, (300, 300), (MEAN,) * 3))
        return {"detections": net.forward()}

    return run


def files_dnn(dnn: Any, task: Task) -> Run:
    """Classify files one by one."""
    net = dnn.readNetFromCaffe(*task["nets"]["squeezenet"])

    def run() -> dict[str, Any]:
        found = []
        for path in task["files"]:
            net.setInput(dnn.blobFromImage(_image(path), SCALE, (227, 227), (MEAN,) * 3))
            found.append(net.forward().reshape(-1))
        return {"prob": np.stack(found)}

    return run


def files_pytorch(task: Task, batch: int = 1) -> Run:
    """Classify files in batches with PyTorch."""
    torch = _torch(task)
    net = _exported(task, "squeezenet")

    def run() -> dict[str, Any]:
        found = []
        for begin in range(0, len(task["files"]), batch):
            images = [cv2.resize(_image(path), (227, 227)) for path in task["files"][begin : begin + batch]]
            with torch.inference_mode():
                found.append(net(torch.from_numpy(_blob(np.stack(images)))).numpy())
        return {"prob": np.concatenate(found)}

    return run


def classifier_netspec(task: Task) -> Run:
    """Classify files with caffe.Classifier, without its ten crops."""
    caffe = import_module("netspec.pycaffe")
    settings = {"mean": np.full(3, MEAN), "raw_scale": 255, "input_scale": SCALE, "channel_swap": (2, 1, 0)}
    net = caffe.Classifier(*task["nets"]["squeezenet"], **settings)
    net.blobs["data"].reshape(BATCH, 3, 227, 227)

    def run() -> dict[str, Any]:
        images = [caffe.io.load_image(path) for path in task["files"]]
        return {"prob": net.predict(images, oversample=False)}

    return run


def classifier_opencv4(task: Task) -> Run:
    """Classify files in batches with OpenCV 4."""
    net = cv2.dnn.readNetFromCaffe(*task["nets"]["squeezenet"])  # type: ignore[attr-defined]

    def run() -> dict[str, Any]:
        found = []
        for begin in range(0, len(task["files"]), BATCH):
            images = [_image(path) for path in task["files"][begin : begin + BATCH]]
            net.setInput(cv2.dnn.blobFromImages(images, SCALE, (227, 227), (MEAN,) * 3))
            found.append(net.forward().reshape(len(images), -1))
        return {"prob": np.concatenate(found)}

    return run


def lenet_pytorch(task: Task) -> Run:
    """Train LeNet from an LMDB with torch's SGD."""
    torch = _torch(task)
    from netspec.data.database import open_reader
    from netspec.data.datum import datum_to_array, parse_datum

    records, net = open_reader(task["source"]), exported(task["torch"]).train()
    groups = parameter_groups(net, task["rate"], task["decay"])
    optimizer = torch.optim.SGD(groups, lr=task["rate"], momentum=task["momentum"])

    def run() -> dict[str, Any]:
        loss = torch.zeros(())
        for k in range(task["iterations"]):
            numbers = [(k * task["batch"] + i) % len(records) for i in range(task["batch"])]
            read = [parse_datum(record) for record in records.records(numbers)]
            data = (np.stack([datum_to_array(datum) for datum in read]).astype(np.float32) - MEAN) * SCALE
            optimizer.zero_grad()
            loss = net(torch.from_numpy(data.astype(np.float32)), torch.tensor([datum.label for datum in read]))
            loss.backward()
            optimizer.step()
        return {"loss": loss.detach().numpy()}

    return run


def _image(path: str) -> Array:
    image = cv2.imread(path)
    assert image is not None, path
    return image


def _torch(task: Task) -> Any:
    import torch

    torch.set_num_threads(task["threads"])
    return torch


def _exported(task: Task, name: str) -> Any:
    return exported(task["nets"][name][0].replace(".prototxt", ".py"))


def _with_dnn(program: Callable[[Any, Task], Run], module: str, task: Task) -> Run:
    return program(import_module(module), task)


PROGRAMS: dict[str, Callable[[Task], Run]] = {
    "mtcnn/pytorch": mtcnn_pytorch,
    "files/pytorch": files_pytorch,
    "classifier/netspec": classifier_netspec,
    "classifier/pytorch": partial(files_pytorch, batch=BATCH),
    "classifier/opencv4": classifier_opencv4,
    "training/pytorch": lenet_pytorch,
}
for _name, _program in (("mtcnn", mtcnn_dnn), ("ssd300", ssd_dnn), ("files", files_dnn)):
    for _library, _module in (("netspec", "netspec.dnn"), ("opencv4", "cv2.dnn")):
        PROGRAMS[f"{_name}/{_library}"] = partial(_with_dnn, _program, _module)


def main() -> None:
    """Run one pass, or answer requests; the first word or the task says which."""
    once = sys.argv[1] == "once"
    task = json.loads(sys.argv[2 if once else 1])
    cv2.setNumThreads(task["threads"])
    if once:
        PROGRAMS[task["program"]](task)()
    else:
        answer(PROGRAMS)


if __name__ == "__main__":
    main()
