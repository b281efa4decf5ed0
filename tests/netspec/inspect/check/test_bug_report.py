"""``netspec bug-report``: versions, the machine and files, without weights, images and the home folder."""

import os
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest

import netspec
from netspec.inspect.check.bug_report import bug_report
from paths import GOLDEN

WEIGHTS = GOLDEN / "snapshot" / "ref_iter_40.caffemodel"
Run = Callable[..., Any]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """The real function takes seconds."""
    monkeypatch.setattr("torch.utils.collect_env.get_pretty_env_info", lambda: "PyTorch version: x\nCPU: y")


def test_the_report_contains_versions_and_the_machine() -> None:
    text = bug_report([])
    for said in (f"netspec-caffe: {netspec.__version__}", "BLAS kernels: ", "Memory: ", "PyTorch version: x"):
        assert f"\n{said}" in text


@pytest.mark.parametrize("before", [None, "0"], ids=["unset", "set"])
def test_torchs_environment_variable_is_removed(before: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    def torchs() -> str:
        os.environ["PIP_DISABLE_PIP_VERSION_CHECK"] = "1"
        return "PyTorch version: x"

    monkeypatch.delenv("PIP_DISABLE_PIP_VERSION_CHECK", raising=False)
    if before:
        monkeypatch.setenv("PIP_DISABLE_PIP_VERSION_CHECK", before)
    monkeypatch.setattr("torch.utils.collect_env.get_pretty_env_info", torchs)
    bug_report([])
    assert os.environ.get("PIP_DISABLE_PIP_VERSION_CHECK") == before


def test_the_home_folder_is_not_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NETSPEC_SHARED", f"{Path.home()}/x")
    assert "NETSPEC_SHARED: ~/x\n" in bug_report([])


def test_a_prototxt_is_reported_with_the_output_of_check(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text('layer { name: "a" type: "ReLU" bottom: "x" top: "a" }\n# ```\x1b[2J' + "x" * 1000)
    text = bug_report([str(path)])
    assert 'layer "a" (ReLU): unknown bottom blob "x"' in text
    assert 'type: "ReLU"' in text
    assert "x" * 400 not in text
    assert "\x1b" not in text
    assert text.count("```") % 2 == 0


def test_other_kinds_of_files_are_described(tmp_path: Path) -> None:
    (tmp_path / "junk").write_bytes(b"\0\1\2" * 9)
    (tmp_path / "caf\udce9").write_bytes(b"\0")
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large.log").open("wb") as file:
        file.truncate(3 * 2**30)  # sparse
    log, database = GOLDEN / "log" / "caffe_train.log", GOLDEN / "pairs" / "test_lmdb"
    files = [WEIGHTS, log, database, *(tmp_path / name for name in ("junk", "pipe", "large.log", "caf\udce9", "none"))]
    text = bug_report([str(file) for file in files])
    for said in (
        "conv1 (Convolution): (6, 1, 5, 5), (6,)\n",
        "Optimization Done.",
        "a folder; `netspec data stat` describes a database",
        "27 bytes\nneither text nor a .caffemodel",
        "no regular file",
        "3 GiB\nneither text",
        "caf\\udce9",
        "cannot be read: No such file or directory",
    ):
        assert said in text, said
    assert "Initializing solver" not in text
    assert len(text) < 20_000
    text.encode()


def test_bug_report_is_printed_or_written_with_out(run: Run) -> None:
    printed = run("bug-report", "sgd_step/solver.prototxt")
    assert (printed.status, printed.err) == (0, "")
    assert 'net: "sgd_step/train_val.prototxt"' in printed.out
    written = run("bug-report", "sgd_step/solver.prototxt", "--out", "report.md")
    assert written.out.startswith("report.md: read it before you send it")
    assert 'net: "sgd_step/train_val.prototxt"' in Path("report.md").read_text()


def test_version_is_that_of_the_package_or_unknown(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(distribution: str) -> str:
        raise metadata.PackageNotFoundError(distribution)

    assert netspec.__version__ != "unknown"
    assert netspec.__version__ == metadata.version("netspec-caffe")
    assert run("--version").out == f"netspec {netspec.__version__}\n"
    monkeypatch.setattr(metadata, "version", missing)
    assert netspec.__version__ == "unknown"
