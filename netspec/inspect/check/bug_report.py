"""The contents of a bug report: versions, the machine, and each file's text and output of ``netspec check``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, suppress
from importlib import metadata
from io import StringIO
from pathlib import Path

from netspec import log
from netspec.errors import SpecError, printable
from netspec.exact.blas import kernels
from netspec.files.environment import environment
from netspec.files.limits import amount, memory
from netspec.inspect.check.check import check_file
from netspec.inspect.stored_weights import stored_layers
from netspec.proto.binary import is_net_binary

PACKAGES = ("netspec-caffe", "protobuf", "scipy", "lmdb", "opencv-python-headless", "h5py", "onnxruntime", "openvino")
VARIABLES = re.compile(r"(OMP|GOMP|KMP|MKL|OPENBLAS|CUDA|GLOG|NETSPEC|OPENCV)_\w*")
LAST_LINES, MOST_LINES, LONGEST = 60, 400, 300  # lines of a log; lines of another text; characters of a line
MOST_TEXT = 2**20  # bytes; a longer file is not a prototxt
_LOG = re.compile(r"^[IWEF]\d{4,8} \d\d:\d\d:", re.M)


def bug_report(paths: list[str]) -> str:
    """Return the report as Markdown. It describes each file, or says why the file cannot be read."""
    parts = ["## Machine", *_block(_machine())]
    for path in paths:
        parts += ["", f"## {printable(path)}", *_about(Path(path))]
    text = "\n".join(parts) + "\n"
    home = os.path.expanduser("~")  # "/" or "~" for a user without a name, as in a container with --user 1234
    return text.replace(home, "~") if len(home) > 1 else text


def _machine() -> Iterator[str]:
    from torch.utils.collect_env import get_pretty_env_info

    for name in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            yield f"{name}: {metadata.version(name)}"
    yield f"BLAS kernels: {', '.join(sorted(kernels())) or 'another BLAS'}"
    yield f"Memory: {amount(memory())}"
    yield from (f"{name}: {os.environ[name]}" for name in sorted(os.environ) if VARIABLES.fullmatch(name))
    with environment({"PIP_DISABLE_PIP_VERSION_CHECK": "1"}):  # torch sets this variable
        versions = get_pretty_env_info()
    yield from versions.splitlines()


def _about(path: Path) -> Iterator[str]:
    """Yield a description of a file without its weights. Only the start of a large file is read, and no device."""
    try:
        size = path.stat().st_size
        if not path.is_file():
            yield "a folder; `netspec data stat` describes a database" if path.is_dir() else "no regular file"
            return
        with path.open("rb") as file:
            data = file.read(MOST_TEXT)
            file.seek(max(file.tell(), size - LAST_LINES * LONGEST))
            end = file.read()
        yield amount(size)
        if b"\0" not in data:
            yield from _text(path, (data + end).decode(errors="replace"), size)
        elif path.name.endswith(".caffemodel") and is_net_binary(path):
            shapes = ((layer, ", ".join(str(blob.shape) for blob in layer.blobs)) for layer in stored_layers(path))
            yield from _block(f"{layer.name} ({layer.type}): {blobs}" for layer, blobs in shapes)
        else:
            yield "neither text nor a .caffemodel"
    except SpecError as fault:
        yield str(fault)
    except OSError as fault:
        yield f"cannot be read: {fault.strerror or fault}"


def _text(path: Path, text: str, size: int) -> Iterator[str]:
    lines = text.splitlines()
    is_log = bool(_LOG.search(text))
    if not is_log and path.suffix not in (".py", ".txt") and size <= MOST_TEXT:
        yield from _checked(path)
    yield from _block(lines[-LAST_LINES:] if is_log else lines[:MOST_LINES])


def _checked(path: Path) -> Iterator[str]:
    """Yield the output of ``netspec check`` for a file, without opening data."""
    with log.silent(), redirect_stderr(StringIO()):
        found = check_file(path)
    faults = dict.fromkeys(str(fault) for part in found for fault in part.faults)
    nets = [
        f"{part.label}: {len(part.net.layers)} layers, {part.net.need}"
        for part in found
        if part.net is not None and not part.faults
    ]
    yield "`netspec check` says:"
    yield from _block([*nets, *faults] or ["nothing"])


def _block(lines: Iterable[str]) -> Iterator[str]:
    yield from ("", "```text", *(printable(line)[:LONGEST].replace("```", "'''") for line in lines), "```")
