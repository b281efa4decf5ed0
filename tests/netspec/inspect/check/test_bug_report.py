"""``netspec bug-report``: what helps to find a fault is there, weights and images are not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import netspec
from netspec.inspect.check.bug_report import bug_report
from netspec.terminal.version import UNKNOWN, version
from paths import GOLDEN

WEIGHTS = GOLDEN / "snapshot" / "ref_iter_40.caffemodel"
Run = Callable[..., Any]


def test_versions_and_the_machine() -> None:
    text = bug_report([])
    for name in ("netspec-caffe", "torch", "numpy", "protobuf"):
        assert f"| {name} | {version(name)} |" in text
    assert "| processor | " in text
    assert "| BLAS kernels | " in text


def test_the_home_folder_is_not_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NETSPEC_SHARED", f"{Path.home()}/x")
    assert "| NETSPEC_SHARED | ~/x |" in bug_report([])


@pytest.mark.parametrize("name", ["ref_iter_40.caffemodel", "h5_iter_10.caffemodel.h5"])
def test_of_weights_the_shapes_are_told_and_no_value(name: str) -> None:
    text = bug_report([str(GOLDEN / "snapshot" / name)])
    assert "(6, 1, 5, 5)" in text
    assert "conv1" in text
    assert len(text) < 6000


def test_weights_that_are_no_numbers_are_counted(tmp_path: Path) -> None:
    (tmp_path / "net.prototxt").write_text(
        'layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 2 } } }\n'
        'layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" inner_product_param { num_output: 3 } }\n'
    )
    net = netspec.load_net(tmp_path / "net.prototxt")
    net.params["ip"][0].detach()[0] = float("nan")
    netspec.save_weights(net, tmp_path / "x.caffemodel")
    assert "ip (InnerProduct): float32 (3, 2) with 2 NaN or infinite, float32 (3,)" in bug_report(
        [str(tmp_path / "x.caffemodel")]
    )


def test_a_prototxt_comes_with_what_check_says(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text('layer { name: "a" type: "ReLU" bottom: "x" top: "a" }\n# ```' + "x" * 1000)
    text = bug_report([str(path)])
    assert 'layer "a" (ReLU): unknown bottom blob "x"' in text
    assert 'type: "ReLU"' in text
    assert "x" * 400 not in text
    assert text.count("```") % 2 == 0


def test_databases_logs_arrays_and_what_is_missing(tmp_path: Path) -> None:
    np.savez(tmp_path / "f.npz", feat=np.zeros((3, 2), np.float32))
    (tmp_path / "junk").write_bytes(b"\0\1\2" * 9)
    text = bug_report([str(GOLDEN / "pairs" / "test_lmdb"), str(GOLDEN / "log" / "caffe_train.log"),
                       str(tmp_path / "f.npz"), str(tmp_path / "junk"), str(tmp_path / "nothing")])  # fmt: skip
    for said in (
        "a database of 200 records; the first: raw bytes, 1579 bytes, uint8 (2, 28, 28)",
        "a log; its last lines, of 988:",
        "Optimization Done.",
        "feat: float32 (3, 2)",
        "no text, and no file of weights",
        "cannot be read: No such file or directory",
    ):
        assert said in text
    assert "Initializing solver" not in text


def test_the_command_prints_or_writes(run: Run) -> None:
    printed = run("bug-report", "sgd_step/solver.prototxt")
    assert (printed.status, printed.err) == (0, "")
    assert 'net: "sgd_step/train_val.prototxt"' in printed.out
    written = run("bug-report", "sgd_step/solver.prototxt", "--out", "report.md")
    assert written.out.startswith("report.md: read it before you send it")
    assert 'net: "sgd_step/train_val.prototxt"' in Path("report.md").read_text()


def test_the_version(run: Run) -> None:
    assert version() != UNKNOWN
    assert netspec.__version__ == version()
    assert version("no-such-distribution") == UNKNOWN
    assert run("--version").out == f"netspec {version()}\n"


def test_a_damaged_archive_and_a_name_that_is_not_utf8_are_told(tmp_path: Path) -> None:
    np.savez(tmp_path / "whole.npz", x=np.zeros(3))
    path = tmp_path / "caf\udce9.npz"
    path.write_bytes((tmp_path / "whole.npz").read_bytes()[:100])
    text = bug_report([str(path)])
    assert "expected an archive of arrays" in text
    assert "caf\\udce9.npz" in text
    text.encode()
