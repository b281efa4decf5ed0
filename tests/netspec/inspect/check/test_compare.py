"""``netspec diff``: differences in meaning are reported with both places, other spellings are not."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from case_files import read_cases
from netspec.cli import main
from netspec.data.blobs import from_array
from netspec.errors import SpecError
from netspec.inspect.check.diff import compare_files
from netspec.proto.schema import BlobProto, NetParameter
from netspec.proto.text import parse_net, write_text
from paths import last_parts, nets_as_found

NET = """name: "n"
layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 dim: 8 dim: 8 } } }
layer { name: "a" type: "Convolution" bottom: "x" top: "a" convolution_param { num_output: 2 kernel_size: 3 } }
layer { name: "r" type: "ReLU" bottom: "a" top: "a" }
layer { name: "b" type: "Convolution" bottom: "a" top: "b" convolution_param { num_output: 2 kernel_size: 3 } }
layer { name: "s" type: "Eltwise" bottom: "b" bottom: "b" top: "s" }
"""
SOLVER = 'net: "net"\nbase_lr: 0.1\nlr_policy: "fixed"\nmax_iter: 9\nsnapshot_prefix: "p"\n'
CASES = read_cases("netspec/inspect/check/cases/differences.txt")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def diff(first: str, second: str) -> list[str]:
    Path("A").write_text(first)
    Path("B").write_text(second)
    return [str(each) for each in compare_files("A", "B")]


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_differences_have_both_places_and_spellings_are_ignored(case: dict[str, str]) -> None:
    assert diff(NET, case["second"] + "\n") == case["lines"].splitlines()


def test_an_old_format_equals_its_current_form() -> None:
    old = """input: "x" input_dim: 1 input_dim: 3 input_dim: 8 input_dim: 8
    layers { name: "a" type: CONVOLUTION bottom: "x" top: "a" blobs_lr: 1 blobs_lr: 2
    convolution_param { num_output: 2 kernel_size: 3 } }"""
    new = NET.splitlines()[1].replace('"in"', '"input"') + NET.splitlines()[2].replace(
        'top: "a"', 'top: "a" param { } param { lr_mult: 2 }'
    )
    assert diff(old, new) == []


def test_an_absent_field_differs_if_its_default_means_something_else() -> None:
    norm = 'layer { name: "n" type: "BatchNorm" bottom: "a" top: "a" batch_norm_param { %s } }\n'
    assert diff(NET + norm % "", NET + norm % "eps: 1e-5") == []
    assert diff(NET + norm % "", NET + norm % "use_global_stats: false") == [
        'B:7:77: layer "n" (BatchNorm): batch_norm_param.use_global_stats is false, was absent (A:7:58)'
    ]
    concat = 'layer { name: "c" type: "Concat" bottom: "a" bottom: "b" top: "c" concat_param { %s } }\n'
    assert diff(NET + concat % "axis: 2", NET + concat % "concat_dim: 2") == []
    assert len(diff(NET + concat % "axis: 2", NET + concat % "concat_dim: 3")) == 1


def test_loss_weight_is_compared_with_its_default_of_one() -> None:
    loss = 'layer { name: "l" type: "EuclideanLoss" bottom: "a" bottom: "b" top: "l" %s }\n'
    assert diff(NET + loss % "", NET + loss % "loss_weight: 1") == []
    assert diff(NET + loss % "", NET + loss % "loss_weight: 2") == [
        'B:7:74: layer "l" (EuclideanLoss): loss_weight is 2, was 1 (A:7:1)'
    ]


def test_solvers_are_compared_with_their_nets() -> None:
    Path("net").write_text(NET)
    Path("same").write_text(NET.replace(" {", "  {"))
    Path("other").write_text(NET.replace("num_output: 2", "num_output: 3", 1))
    assert diff(SOLVER, SOLVER + 'type: "SGD" momentum: 0') == []
    assert diff(SOLVER, SOLVER.replace('"net"', '"same"')) == []
    assert diff(SOLVER, SOLVER.replace("0.1", "0.2").replace('"net"', '"other"')) == [
        "B:2:1: base_lr is 0.2, was 0.1 (A:2:1)",
        'other:3:80: layer "a" (Convolution): train net: convolution_param.num_output is 3, was 2 (net:3:80)',
    ]
    with pytest.raises(SpecError, match=r'^B:1:1: net "gone" is not a file'):
        diff(SOLVER, SOLVER.replace('"net"', '"gone"'))
    assert diff(SOLVER + "solver_type: ADAM", SOLVER + 'type: "Adam"') == []


def write_weights(path: str, **layers: list[np.ndarray]) -> None:
    net = NetParameter(name="w")
    for name, arrays in layers.items():
        net.layer.add(name=name, type="InnerProduct").blobs.extend([from_array(each) for each in arrays])
    Path(path).write_bytes(net.SerializeToString())


def test_weights_are_compared_blob_by_blob() -> None:
    values = np.arange(6, dtype=np.float32).reshape(2, 3)
    moved = values.copy()
    moved[0] += 0.25
    write_weights("a.caffemodel", one=[values, values[0]], two=[values], three=[values])
    write_weights("b.caffemodel", one=[moved, values[0]], two=[values.reshape(1, 1, 2, 3)], four=[values])
    assert [str(each) for each in compare_files("a.caffemodel", "b.caffemodel")] == [
        'a.caffemodel: layer "three": is only here, not in the second file',
        'b.caffemodel: layer "four": is only here, not in the first file',
        'b.caffemodel: layer "one": blob 0: 3 of 6 values differ, by 0.25 at most',
    ]
    assert len(list(compare_files("a.caffemodel", "b.caffemodel", tolerance=0.25))) == 2


def test_weights_of_both_formats_nan_shapes_and_damaged_files() -> None:
    values = np.array([1, np.nan, np.inf], np.float32)
    write_weights("a.caffemodel", **{"x/y": [values]})
    with h5py.File("a.caffemodel.h5", "w") as file:
        file.create_dataset("data/x/y/0", data=values)
    assert list(compare_files("a.caffemodel", "a.caffemodel.h5")) == []
    write_weights("b.caffemodel", **{"x/y": [np.array([1, 0, np.inf], np.float32)]})
    (line,) = compare_files("a.caffemodel", "b.caffemodel")
    assert "1 of 3 values differ, by inf" in str(line)
    write_weights("c.caffemodel", **{"x/y": [values.reshape(3, 1)]})
    (line,) = compare_files("a.caffemodel", "c.caffemodel")
    assert str(line).endswith("blob 0: shape is 3x1, was 3")
    net = NetParameter(name="w")
    net.layer.add(name="z").blobs.append(BlobProto(data=[1.0], num=2))
    Path("d.caffemodel").write_bytes(net.SerializeToString())
    with pytest.raises(SpecError, match=r'd\.caffemodel: layer "z": found 1 numbers'):
        list(compare_files("a.caffemodel", "d.caffemodel"))
    Path("cut.caffemodel").write_bytes(Path("a.caffemodel").read_bytes()[:-5])
    with pytest.raises(SpecError, match=r"cut\.caffemodel: expected .* its first .* bytes only: it was truncated"):
        list(compare_files("a.caffemodel", "cut.caffemodel"))


def test_diff_has_status_0_1_or_2(capsys: pytest.CaptureFixture[str]) -> None:
    Path("A").write_text(NET)
    Path("B").write_text(NET.replace('"n"', '"m"'))
    Path("S").write_text(SOLVER)
    assert main(["diff", "A", "A"]) == 0
    assert main(["diff", "A", "B"]) == 1
    assert capsys.readouterr() == ('B:1:1: name is "m", was "n" (A:1:1)\n', "")
    assert main(["diff", "A", "S"]) == 2
    assert capsys.readouterr() == ("", "S: is a solver, and A is a net; expected two files of the same kind\n")
    assert main(["diff", "A", "gone"]) == 2


@pytest.mark.slow
@pytest.mark.parametrize("path", nets_as_found(), ids=last_parts)
def test_published_nets_equal_their_rewritten_files(path: Path) -> None:
    upgraded = write_text(parse_net(path)[0])
    Path("written").write_text(upgraded)
    assert [str(each) for each in compare_files(path, "written")] == []
    Path("other").write_text(upgraded.replace("num_output: ", "num_output: 1", 1))
    found = [str(each) for each in compare_files("written", "other")]
    assert all("num_output is 1" in line for line in found)
    assert len(found) == ("num_output: " in upgraded)
