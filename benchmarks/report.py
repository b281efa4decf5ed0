"""What is printed and kept of a benchmark: tables, JSON, and which machine it was."""

from __future__ import annotations

import importlib.metadata
import json
import math
import os
import platform
import statistics
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

FLAGS = ("avx2", "avx512f", "avx512_bf16", "amx_bf16", "asimd", "bf16")
PACKAGES = ("torch", "numpy", "onnxruntime", "openvino", "opencv-python-headless")
REFERENCES = ("pytorch", "opencv4", "caffe")


@dataclass(frozen=True)
class Row:
    """How one way ran one net.

    ``seconds`` and ``computing`` have each round: the time of a pass, and that of all its threads together; ``ratios``
    and ``spent`` are those of the one and of the other to the references'. ``peak`` is the most memory that the
    process had, in MB.
    """

    net: str
    batch: int
    threads: int
    name: str
    seconds: list[float]
    computing: list[float]
    ratios: Mapping[str, float]
    difference: float | None
    fault: str = ""
    spent: Mapping[str, float] = field(default_factory=dict)
    peak: float | None = None


def table(rows: Sequence[Row]) -> str:
    """Return rows as a Markdown table."""
    references = [name for name in REFERENCES if any(name in row.ratios for row in rows)]
    head = [
        "net",
        "batch",
        "threads",
        "run by",
        "ms",
        "best",
        "CPU ms",
        *(f"/ {name}" for name in references),
        *(f"CPU / {name}" for name in references),
        "MB",
        "off by",
    ]
    lines = [head, ["---"] * len(head)]
    for row in rows:
        where = [row.net, str(row.batch), str(row.threads), row.name]
        if row.fault:
            lines.append([*where, *["-"] * (len(head) - 4)])
            continue
        found = (statistics.median(row.seconds), min(row.seconds), statistics.median(row.computing))
        times = ["-" if math.isnan(value) else f"{1e3 * value:.2f}" for value in found]
        ratios = [f"{of[name]:.2f}" if name in of else "-" for of in (row.ratios, row.spent) for name in references]
        memory = "-" if row.peak is None else f"{row.peak:.0f}"
        lines.append([*where, *times, *ratios, memory, "-" if row.difference is None else f"{row.difference:.0e}"])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def draw(path: str | Path, rows: Sequence[Row], way: str = "netspec") -> None:
    """Draw the CPU time of one way of running, divided by that of each reference: a row for each net and batch.

    The picture is a PNG or an SVG, as its name ends. Rows of which no ratio is known are left out.
    """
    from matplotlib.figure import Figure

    from netspec.draw.style import COLORS, GRID, PALE, write_figure

    shown = [row for row in rows if row.name == way and row.spent]
    figure = Figure(figsize=(7.2, 1.0 + 0.21 * max(1, len(shown))), layout="constrained")
    axis = figure.add_subplot()
    for name, color, mark in zip(REFERENCES, COLORS, "oD^", strict=False):
        found = [(row.spent[name], k) for k, row in enumerate(shown) if name in row.spent]
        if found:
            axis.plot(*zip(*found, strict=True), mark, color=color, label=f"CPU time / {name}'s", clip_on=False)
    axis.axvline(1, color=PALE, linewidth=1)
    several = len({row.threads for row in shown}) > 1
    labels = [f"{row.net}, batch {row.batch}{f', {row.threads} threads' if several else ''}" for row in shown]
    axis.set_yticks(range(len(shown)), labels, fontsize=8)
    axis.set(xscale="log", ylim=(len(shown) - 0.5, -0.5))
    ticks = [tick for tick in (0.1, 0.2, 0.5, 1, 2, 5, 10) if axis.get_xlim()[0] <= tick <= axis.get_xlim()[1]]
    axis.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axis.minorticks_off()
    axis.grid(axis="y", color=GRID)
    axis.set_axisbelow(True)
    axis.set_title(f"{way}: left of 1 is faster", fontsize=9, loc="left")
    figure.legend(fontsize=8, frameon=False, loc="outside lower center", ncols=3)
    write_figure(figure, path)


def machine(python: str | None = None) -> dict[str, Any]:
    """Describe the machine; ``python`` is that of the yardsticks, whose versions are added."""
    cpu = _cpu()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    described: dict[str, Any] = {
        "processor": cpu.get("model name") or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "flags": [flag for flag in FLAGS if flag in (cpu.get("flags") or cpu.get("Features") or "").split()],
        "memory_gib": round(memory, 1),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": _versions(),
        "load_average": [round(load, 2) for load in os.getloadavg()],
    }
    if python:
        code = "import json; from benchmarks.report import _versions; print(json.dumps(_versions()))"
        root = str(Path(__file__).resolve().parents[1])
        done = subprocess.run(
            [python, "-c", code], env={**os.environ, "PYTHONPATH": root}, capture_output=True, text=True, check=True
        )
        described["yardsticks"] = json.loads(done.stdout)
    return described


def write_json(path: str | Path, rows: Sequence[Row | dict[str, float]], described: Mapping[str, Any]) -> None:
    """Write all there is to know."""
    Path(path).write_text(
        json.dumps(
            {"machine": described, "rows": [row if isinstance(row, dict) else asdict(row) for row in rows]}, indent=1
        )
        + "\n"
    )


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
