"""Writes the files in ``benchmarks/results``, from which the tables of the pages are made.

Each file is a JSON object for one table: ``machine``, ``date``, ``command`` (which measured it) and ``rows``. A row
maps columns to values; all rows have the same columns. Numbers are not rounded, and null means not measured.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

from netspec.files.whole_file import write_whole

FLAGS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "asimd", "bf16")
PACKAGES = ("torch", "numpy", "onnxruntime", "openvino", "opencv-python-headless")


def write(
    path: str | Path,
    rows: Sequence[Mapping[str, Any]],
    words: Sequence[str],
    described: Mapping[str, Any] | None = None,
) -> None:
    """Write a file of figures; ``words``: arguments of ``tools/bench``; ``described``: another machine than this."""
    made = {
        "machine": described or machine(),
        "date": date.today().isoformat(),
        "command": f"tools/bench {shlex.join(words)}",
        "rows": [{name: _short(value) for name, value in row.items()} for row in rows],
    }
    write_whole(path, json.dumps(made, indent=1) + "\n")


def _short(value: Any) -> Any:
    return float(f"{value:.5g}") if isinstance(value, float) else value


def machine(python: str | None = None) -> dict[str, Any]:
    """Describe the machine; ``python``: add the versions of the libraries in that environment."""
    cpu = _cpu()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    described: dict[str, Any] = {
        "processor": cpu.get("model name") or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "flags": [flag for flag in FLAGS if flag in (cpu.get("flags") or cpu.get("Features") or "").split()],
        "memory_gib": round(memory, 1),
        "system": f"{platform.system()} {platform.release().partition('-')[0]}, {' '.join(platform.libc_ver())}",
        "python": platform.python_version(),
        "versions": _versions(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
    }
    if python:
        code = "import json; from benchmarks.results import _versions; print(json.dumps(_versions()))"
        root = str(Path(__file__).resolve().parents[1])
        done = subprocess.run(
            [python, "-c", code], env={**os.environ, "PYTHONPATH": root}, capture_output=True, text=True, check=True
        )
        described["separate_environment"] = json.loads(done.stdout)
    return described


def _cpu() -> dict[str, str]:
    path = Path("/proc/cpuinfo")
    if not path.is_file():
        return {}
    pairs = (line.split(":", 1) for line in path.read_text().partition("\n\n")[0].splitlines() if ":" in line)
    return {key.strip(): value.strip() for key, value in pairs}


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
