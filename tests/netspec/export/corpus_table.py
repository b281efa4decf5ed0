"""Which public deploy nets are exported, and whether they compute the same.

    PYTHONPATH=.:tests python tests/netspec/export/corpus_table.py

Each net of the corpus that starts from inputs gets random weights and one random input of its own size; ONNX is run by
onnxruntime and by OpenCV 5, the PyTorch source by PyTorch, the folded net here. A number is the largest difference as a
part of the largest element of an output. "Rounding" is that of the net here in single precision from the same net in
double precision: other programs, which round otherwise, cannot be nearer. Words after the command choose nets by a part
of their names.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import netspec
import netspec.proto.text
from exported import (
    Arrays,
    calibrated,
    here,
    in_onnxruntime,
    in_opencv,
    onnx_model,
    random_inputs,
    run_module,
    source_module,
    trained,
)
from netspec.dialects import use_dialect
from netspec.export.formats.deploy import fold, write_caffe
from netspec.net.net import Net
from paths import SHARED

CORPUS = SHARED / "corpus"
COLUMNS = ("free", "rounding", "onnxruntime", "OpenCV 5", "PyTorch", "folded")


def difference(found: Arrays, expected: Arrays) -> str:
    """Return the largest difference as a part of the largest element, over all outputs."""
    worst = 0.0
    for name, wanted in expected.items():
        if found[name].shape != wanted.shape:
            return f"{name} has shape {found[name].shape}, not {wanted.shape}"
        worst = max(worst, float(np.abs(found[name] - wanted).max()) / max(float(np.abs(wanted).max()), 1e-30))
    return f"{worst:.1e}"


def attempt(run: Callable[[], Arrays], expected: Arrays) -> str:
    """Return the difference, or the reason why there is none."""
    try:
        return difference(run(), expected)
    except Exception as fault:  # any error becomes a row of the table
        return " ".join(str(fault).split())[-160:]


def free_sizes(model: object) -> str:
    """Return which sizes of the inputs are free."""
    sizes = [d.dim_param for i in model.graph.input for d in i.type.tensor_type.shape.dim]  # type: ignore[attr-defined]
    return " ".join(dict.fromkeys(filter(None, sizes))) or "none"


def row(net: Net) -> Mapping[str, str]:
    """Return the result of a net for each target."""
    inputs = random_inputs(net)
    expected = here(calibrated(net, inputs), inputs)
    found: dict[str, str] = {}
    try:
        model, _ = onnx_model(net)
        found["free"] = free_sizes(model)
        found["onnxruntime"] = attempt(lambda: in_onnxruntime(model, inputs), expected)
        found["OpenCV 5"] = attempt(lambda: in_opencv(model, inputs), expected)
    except netspec.SpecError as fault:
        found["onnxruntime"] = str(fault)
    found["PyTorch"] = attempt(lambda: run_module(source_module(net), net, inputs), expected)
    with TemporaryDirectory() as folder:
        prototxt, weights = write_caffe(fold(net), Path(folder) / "folded")
        found["folded"] = attempt(lambda: here(netspec.load_net(prototxt, weights=weights), inputs), expected)
    exact = here(net.double(), {name: values.astype(np.float64) for name, values in inputs.items()})
    return {**found, "rounding": difference(expected, exact)}


def is_deploy(path: Path) -> bool:
    """Return whether a file is a net with inputs and without data layers."""
    try:
        types = [layer.type for layer in netspec.proto.text.read_net(path).layer]
    except netspec.SpecError:  # a solver
        return False
    return "Input" in types and not any("Data" in name for name in types)


def is_close(found: str) -> bool:
    """Return whether a difference is below 1e-5."""
    return bool(re.fullmatch(r"\d\.\de[-+]\d\d", found)) and float(found) < 1e-5


def main(words: list[str]) -> None:
    """Print the table, and below how many nets are below 1e-5 in each column."""
    use_dialect("blocks")
    names = sorted(str(path.relative_to(CORPUS)) for path in CORPUS.rglob("*.prototxt") if is_deploy(path))
    rows = []
    print("| net |", " | ".join(COLUMNS), "|\n|" + "---|" * (1 + len(COLUMNS)))
    for name in names:
        if not words or any(word in name for word in words):
            found = row(trained(netspec.load_net(CORPUS / name, seed=0)))
            rows.append([found.get(column, "") for column in COLUMNS])
            print(f"| {name.replace('+', '/', 1)} |", " | ".join(rows[-1]), "|", flush=True)
    close = [str(sum(map(is_close, column))) for column in zip(*rows, strict=True)]
    print(f"| below 1e-5, of {len(rows)} | |", " | ".join(close[1:]), "|")


if __name__ == "__main__":
    main(sys.argv[1:])
