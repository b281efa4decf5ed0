"""The dialects that can be found, by name, and those that a user added for every net of the process."""

from __future__ import annotations

from functools import cache

from netspec.dialects.files import OF_FILES, known_files, read_dialect
from netspec.dialects.registry import Dialect, declare
from netspec.proto.forks import Additions

# Layers that people ask for and that no dialect has, with their forks
ELSEWHERE = {
    "CReLU": "forks for PVANet and FaceBoxes",
    "DetectNetTransformation": "NVIDIA's Caffe",
    "HardSwish": "forks for MobileNetV3",
    "ImResize": "Convolutional Pose Machines",
    "ImageSegData": "DeepLab",
    "Local": "forks for DeepFace",
    "MatWrite": "DeepLab",
    "Mish": "forks for YOLOv4",
    "MultiStageMeanfield": "CRF-RNN",
    "Nms": "Convolutional Pose Machines",
    "PredictBox": "forks for MTCNN",
    "Region": "caffe-yolo",
    "SpatialTransformer": "forks for spatial transformers",
    "Yolo": "darknet2caffe",
}
_added: dict[str, Dialect] = {}  # for every net of the process


def known() -> Additions:
    """Return what all known dialects add."""
    return _additions(tuple(_added.values()))


def added() -> tuple[str, ...]:
    """Return the names of the dialects that a user added for every net."""
    return tuple(_added)


def dialect(name: str) -> Dialect:
    """Return a known dialect."""
    return _added.get(name) or _found()[name]


def add(given: Dialect) -> None:
    """Add a dialect for every net."""
    _added[given.name] = given


def dialect_of_module(module: str) -> str:
    """Return the name of the dialect with a module; "" if it belongs to none."""
    if module.startswith(OF_FILES):
        return module.removeprefix(OF_FILES)
    return next((name for name, file in known_files().items() if file.module == module), "")


@cache
def _found() -> dict[str, Dialect]:
    """Return netspec's own dialects."""
    found = {name: read_dialect(file) for name, file in known_files().items()}
    for each in found.values():
        declare(each)
    return found


@cache
def _additions(added: tuple[Dialect, ...]) -> Additions:
    found = Additions()
    found.elsewhere = ELSEWHERE
    for name, each in sorted({**_found(), **{one.name: one for one in added}}.items()):
        values = [(*key, value) for key, names in each.values().items() for value in names]
        for table, keys in (
            (found.fields, each.fields()),
            (found.values, values),
            (found.types, each.layer_types),
            (found.messages, each.messages()),
        ):
            table.update({key: (*table.get(key, ()), name) for key in keys})  # type: ignore[arg-type]
    return found
