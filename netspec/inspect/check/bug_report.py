"""What a report of a fault needs: versions, the machine, and the files' shapes without their weights or images."""

from __future__ import annotations

import hashlib
import os
import platform
import re
from collections.abc import Iterator
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path

import h5py
import numpy as np

from netspec import log
from netspec.data.records import open_records
from netspec.data.stored_weights import stored_layers
from netspec.errors import SpecError, printable
from netspec.exact.blas import kernels
from netspec.files.arrays import read_npz
from netspec.files.limits import amount, memory
from netspec.inspect.check.check import check_file
from netspec.proto.binary import is_net_binary
from netspec.terminal.version import UNKNOWN, version

PACKAGES = (
    "netspec-caffe", "torch", "numpy", "scipy", "protobuf", "lmdb", "opencv-python-headless", "h5py", "matplotlib",
    "scikit-learn", "threadpoolctl", "safetensors", "plyvel", "onnx", "onnxruntime", "openvino", "tensorboard",
)  # fmt: skip
VARIABLES = re.compile(r"(OMP|GOMP|KMP|MKL|OPENBLAS|CUDA|GLOG|NETSPEC|OPENCV)_\w*")
LAST_LINES, MOST_LINES = 60, 400  # of a log; of another text
LONGEST = 300  # characters of a line: longer ones hold data
_LOG = re.compile(r"^[IWEF]\d{4,8} \d\d:\d\d:", re.M)


def bug_report(paths: list[str]) -> str:
    """Return the report as Markdown; of each path what it is and its shape, or why it cannot be read."""
    parts = ["## Versions", *_table(_versions()), "", "## Machine", *_table(_machine())]
    for path in paths:
        parts += ["", f"## {printable(path)}", *_about(Path(path))]
    return "\n".join(parts).replace(str(Path.home()), "~") + "\n"


def _table(rows: Iterator[tuple[str, str]]) -> list[str]:
    return ["", "| what | found |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]


def _versions() -> Iterator[tuple[str, str]]:
    yield "Python", f"{platform.python_implementation()} {platform.python_version()}"
    for name in PACKAGES:
        found = version(name)
        if found != UNKNOWN:
            yield name, found


def _machine() -> Iterator[tuple[str, str]]:
    import torch

    yield "system", platform.platform()
    yield "processor", f"{_processor()}, {os.cpu_count()} threads"
    yield "memory", amount(memory())
    yield "BLAS kernels", ", ".join(sorted(kernels())) or "another BLAS"
    yield "torch", f"CUDA {torch.version.cuda or 'none'}, {torch.get_num_threads()} threads"
    for k in range(torch.cuda.device_count()):
        yield f"GPU {k}", torch.cuda.get_device_name(k)
    for name in sorted(os.environ):
        if VARIABLES.fullmatch(name):
            yield name, printable(os.environ[name])


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:  # not Linux
        return platform.processor() or platform.machine()
    found = re.search(r"^model name\s*: (.*)$", text, re.M)
    wide = [name for name in ("avx2", "avx512f", "amx_bf16") if re.search(rf"\b{name}\b", text)]
    return f"{found[1] if found else platform.machine()} ({', '.join(wide) or 'no AVX2'})"


def _about(path: Path) -> Iterator[str]:
    try:
        if path.is_dir():
            yield from _database(path)
            return
        data = path.read_bytes()
        yield f"{amount(len(data))}, SHA-256 {hashlib.sha256(data).hexdigest()}"
        yield ""
        if h5py.is_hdf5(path):
            yield from _hdf5(path)
        elif is_net_binary(path):
            yield from _weights(path)
        elif data.startswith(b"PK"):
            yield from _arrays(path)
        elif b"\0" in data:
            yield "no text, and no file of weights"
        else:
            yield from _text(path, data.decode(errors="replace"))
    except SpecError as fault:
        yield str(fault)
    except OSError as fault:
        yield f"cannot be read: {fault.strerror or fault}"


def _database(path: Path) -> Iterator[str]:
    records = open_records(path)
    first = records[0]
    shape = "" if first.values is None else f", {first.values.dtype} {first.values.shape}"
    yield f"a database of {len(records)} records; the first: {first.kind}, {first.size} bytes{shape}{first.fault}"


def _hdf5(path: Path) -> Iterator[str]:
    lines: list[str] = []

    def visit(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset):
            lines.append(f"{name}: {item.dtype} {item.shape}")

    with h5py.File(path, "r") as file:
        file.visititems(visit)
    yield from _block(lines)


def _weights(path: Path) -> Iterator[str]:
    lines = []
    for layer in stored_layers(path):
        blobs = ", ".join(f"{blob.dtype} {blob.shape}{_not_finite(blob)}" for blob in layer.blobs)
        lines.append(f"{layer.name} ({layer.type}): {blobs}")
    yield from _block(lines)
    yield from _checked(path)


def _not_finite(blob: np.ndarray) -> str:
    bad = int((~np.isfinite(blob)).sum())
    return f" with {bad} NaN or infinite" if bad else ""


def _arrays(path: Path) -> Iterator[str]:
    arrays = read_npz(path, "an archive of arrays")
    yield from _block([f"{name}: {array.dtype} {array.shape}" for name, array in arrays.items()])


def _text(path: Path, text: str) -> Iterator[str]:
    lines = [printable(line) for line in text.splitlines()]
    if _LOG.search(text):
        yield f"a log; its last lines, of {len(lines)}:"
        yield from _block(lines[-LAST_LINES:])
        return
    if path.suffix not in (".py", ".txt"):
        yield from _checked(path)
    yield from _block(lines[:MOST_LINES])


def _checked(path: Path) -> Iterator[str]:
    """Yield what ``netspec check`` says of a file, without opening data."""
    hidden = StringIO()
    with log.silent(), redirect_stderr(hidden):
        found = check_file(path)
    faults = dict.fromkeys(str(fault) for part in found for fault in part.faults)
    nets = [
        f"{part.label}: {len(part.net.layers)} layers, {part.net.need}"
        for part in found
        if part.net is not None and not part.faults
    ]
    yield "`netspec check` says:"
    yield from _block([*nets, *faults] or ["nothing"])


def _block(lines: list[str]) -> Iterator[str]:
    yield from ("", "```text", *(line[:LONGEST].replace("```", "'''") for line in lines), "```")
