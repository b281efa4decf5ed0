"""``netspec check`` reports all errors at which ``netspec train`` stops before its first iteration, in its words."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import lmdb
import numpy as np
import pytest

import netspec
from case_files import read_cases
from lmdb_build.mean import write_mean
from netspec.data.blobs import from_array
from netspec.data.database import Writer
from netspec.data.datum import array_to_datum

Run = Callable[..., Any]  # the fixture of conftest.py

SOLVER = (Path(__file__).parent / "nets" / "solver.prototxt").read_text()
NET = (Path(__file__).parent / "nets" / "faults.prototxt").read_text()
READS = """layer { name: "d" type: "Data" top: "data" top: "label"
  data_param { source: "%s" backend: LMDB batch_size: 2 } }
layer { name: "hush" type: "Silence" bottom: "data" bottom: "label" }
"""
# A case has the files that differ from the two above, and the beginnings of the lines that report their errors.
CASES = read_cases("netspec/inspect/check/cases/faults.txt")
FOUND_IN_DATA = read_cases("netspec/inspect/check/cases/faults_in_data.txt")


NAMED = read_cases("netspec/inspect/check/cases/named.txt")  # of a net in phase TEST, each line whole


@pytest.mark.parametrize("case", NAMED.values(), ids=NAMED)
def test_check_reports_each_error_of_a_net_once(run: Run, case: dict[str, str]) -> None:
    faults = write_case(case)
    assert without_warnings(run("check", "net.prototxt").err) == faults


@pytest.fixture
def files(run: Run) -> None:
    """Write small data files, valid and invalid, into the working directory."""
    lmdb.open("empty_lmdb").close()
    with Writer("db") as writer:
        for i in range(3):
            writer.put(b"%d" % i, array_to_datum(np.zeros((3, 6, 8), np.uint8)).SerializeToString())
    write_mean("mean.binaryproto", np.zeros((3, 9, 9), np.float32))
    cv2.imwrite("0.png", np.zeros((6, 8, 3), np.uint8))
    Path("empty.txt").write_text("\n")
    Path("names.txt").write_text("0.png\n")
    Path("nix.txt").write_text("nix.png 0\n0.png 0\n")
    Path("rows.txt").write_text("rows.h5\n")
    with h5py.File("rows.h5", "w") as file:
        file["data"] = np.zeros((3, 2))
    other = netspec.proto.schema.NetParameter()
    layer = other.layer.add(name="ip")
    layer.blobs.extend([from_array(np.zeros((3, 5), np.float32)), from_array(np.zeros(3, np.float32))])
    Path("other.caffemodel").write_bytes(other.SerializeToString())
    with h5py.File("other.caffemodel.h5", "w") as file:
        file["data/ip/0"], file["data/ip/1"] = np.zeros((3, 5)), np.zeros(3)
    Path("cut.caffemodel.h5").write_bytes(Path("other.caffemodel.h5").read_bytes()[:1000])


def write(**files: str) -> None:
    for name, text in {"s.prototxt": SOLVER, "net.prototxt": NET, **files}.items():
        Path(name).write_text(text)


def write_case(case: dict[str, str]) -> list[str]:
    """Write the files of a case; return the beginnings of the lines expected for it."""
    write(**{name: text for name, text in case.items() if name != "faults"})
    return case["faults"].splitlines()


def without_warnings(text: str) -> list[str]:
    return [line for line in text.splitlines() if not line.startswith("warning: ")]


def begin_with(lines: list[str], beginnings: list[str]) -> bool:
    return len(lines) == len(beginnings) and all(map(str.startswith, lines, beginnings))


@pytest.mark.slow
@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("case", [*CASES.values(), *FOUND_IN_DATA.values()], ids=[*CASES, *FOUND_IN_DATA])
def test_check_reports_the_errors_of_train(run: Run, case: dict[str, str]) -> None:
    faults = write_case(case)
    before = sorted(Path().rglob("*"))
    found = run("check", "s.prototxt", "--data")
    lines = without_warnings(found.err)
    assert (found.status, found.out) == (1, "")
    assert begin_with(lines, faults), found.err
    assert sorted(Path().rglob("*")) == before
    trained = run("train", "s.prototxt")
    assert trained.fault in lines
    assert not any(message.startswith("Iteration ") for message in trained.messages)


FILLED_BY_SCRIPT = {
    "Input": (
        'layer { name: "in" type: "Input" top: "data" input_param { shape { dim: 4 dim: 3 } } }',
        'layer "in" (Input): nothing fills "data" during training; use a layer that reads data',
    ),
    "MemoryData": (
        'layer { name: "in" type: "MemoryData" top: "data" top: "label"'
        " memory_data_param { batch_size: 2 channels: 1 height: 1 width: 3 } }",
        'layer "in" (MemoryData): has no data yet; call set_input_arrays',
    ),
}


@pytest.mark.parametrize(("net", "message"), FILLED_BY_SCRIPT.values(), ids=FILLED_BY_SCRIPT)
def test_a_training_net_with_inputs_gets_a_warning_and_is_refused_by_train(run: Run, net: str, message: str) -> None:
    """Scripts of Caffe train such nets; ``netspec train`` refuses them."""
    write(
        **{
            "net.prototxt": net + ' layer { name: "ip" type: "InnerProduct" bottom: "data" top: "ip" '
            "inner_product_param { num_output: 2 } }"
        }
    )
    checked = run("check", "s.prototxt")
    assert checked.status == 0
    (line,) = [line for line in checked.err.splitlines() if line.endswith("[filled-by-script]")]
    assert line.startswith(f"warning: net.prototxt:1:1: {message}")
    assert message in run("train", "s.prototxt").fault


def test_a_test_net_of_other_shapes_is_reported(run: Run) -> None:
    test = NET.replace("num_output: 2", "num_output: 3")
    assert test != NET
    settings = 'test_net: "test.prototxt" test_iter: 1 test_interval: 1'
    write(**{"s.prototxt": SOLVER + settings, "test.prototxt": test})
    expected = 'layer "ip" (InnerProduct): cannot share weights with the training net: shapes'
    assert expected in run("check", "s.prototxt").err


SHAPES = {
    "HDF5Data": ["--shape", "data=1,2", "--shape", "label=1"],
    "Data": ["--shape", "data=1,3,6,8"],
    "ImageData": ["--shape", "data=1,3,6,8"],
}


@pytest.mark.usefixtures("files")
@pytest.mark.parametrize("name", FOUND_IN_DATA)
def test_check_opens_data_only_on_request(run: Run, name: str) -> None:
    write_case(FOUND_IN_DATA[name])
    shutil.rmtree("db")
    words = next((words for kind, words in SHAPES.items() if f'type: "{kind}"' in Path("net.prototxt").read_text()), [])
    if name != "a shape that does not suit the net":
        assert run("check", "s.prototxt", *words).status == 0


def test_weights_can_be_checked_against_a_net_or_a_solver(run: Run, files: None) -> None:
    write()
    for file in ("net.prototxt", "s.prototxt"):
        assert run("check", file).status == 0
        lines = run("check", file, "--weights", "other.caffemodel,gone.caffemodel").err.splitlines()
        lines = [line for line in lines if not line.startswith("warning:")]
        assert [line.partition(" ")[0] for line in lines] == ["other.caffemodel:"] * 2 + ["gone.caffemodel:"]
    Path("s.prototxt").write_text(SOLVER + 'weights: "gone.caffemodel"')
    assert "other.caffemodel:" not in run("check", "s.prototxt").err
    assert "gone" not in run("check", "s.prototxt", "--weights", "other.caffemodel").err  # as train --weights


def test_a_given_shape_replaces_data(run: Run, files: None) -> None:
    write(**{"net.prototxt": READS % "gone"})
    assert run("check", "s.prototxt", "--data").status == 1
    assert run("check", "s.prototxt", "--data", "--shape", "data=2,3,6,8").status == 0


def test_shapes_are_read_from_data_with_data(run: Run, files: None) -> None:
    write(**{"net.prototxt": READS % "db"})
    result = run("check", "net.prototxt", "--data")
    assert result.status == 0
    assert "2x3x6x8, 2" in result.out
