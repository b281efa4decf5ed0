"""Unknown fields, and fields of forks with errors, are reported all at once by `netspec check`."""

from pathlib import Path

import pytest

from netspec.inspect.check.check import check_file

INPUT = 'layer { name: "in" type: "Input" top: "a" input_param { shape { dim: 1 dim: 4 dim: 4 dim: 4 } } }\n'
PERMUTE = """layer { name: "p%d" type: "Permute" bottom: "a" top: "p%d"
  permute_param { order: 0 order: 2 order: [3, 1] deeper { x: "}" 'y' } } }
"""
NORM = """layer { name: "n" type: "Normalize" bottom: "a" top: "n"
  norm_param < across_spatial: false scale_filler { type: "constant" value: -20 } > }
"""
SHUFFLE = 'layer { name: "s" type: "ShuffleChannel" bottom: "a" top: "s" shuffle_channel_param { group: 2 } }\n'
STRANGE = 'layer { name: "s" type: "Strange" bottom: "a" top: "s" strange_param { group: 2 } }\n'
OWN = " docs/layer.md shows how to add one with --plugin FILE.py"
POOL = (
    'layer { name: "k" type: "Pooling" bottom: "a" top: "k" pooling_param { kernal: -3, pool: MAX kernel_size: 2 } }\n'
)


def lines(path: str) -> list[str]:
    return [str(fault) for part in check_file(path) for fault in part.faults]


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_errors_in_fields_of_forks_are_found():
    Path("net.prototxt").write_text(INPUT + PERMUTE % (1, 1) + NORM + SHUFFLE)
    assert lines("net.prototxt") == [
        'net.prototxt:3:51: layer "p1" (Permute): PermuteParameter has no field "deeper";' + OWN
    ]


def test_an_unknown_field_is_reported_once_with_its_lines():
    layer = 'layer { name: "c" type: "ReLU" bottom: "a" top: "a" quantize: true }\n'
    Path("net.prototxt").write_text(INPUT + POOL + layer * 12)
    assert lines("net.prototxt") == [
        'net.prototxt:2:72: layer "k" (Pooling): PoolingParameter has no field "kernal"; did you mean "kernel_w"?'
        + OWN,
        'net.prototxt:3:53: layer "c" (ReLU): LayerParameter has no field "quantize";'
        f"{OWN} (also in lines 4, 5, 6, 7, 8, 9, 10, 11 and more)",
    ]


def test_errors_before_a_fatal_error_are_reported():
    Path("net.prototxt").write_text(POOL + STRANGE + 'layer { odd { a: [1, 2] b { c: 1 }\n  top: "x" \n')
    found = lines("net.prototxt")
    assert [line.partition(" ")[0] for line in found] == [
        f"net.prototxt:{place}:" for place in ("1:72", "2:56", "3:9", "5:1")
    ]
    assert found[3] == 'net.prototxt:5:1: the file ends inside "odd" of line 3; is a "}" missing?'
    Path("net.prototxt").write_text("odd: }\nlayer { even 3 }")
    assert lines("net.prototxt")[-1] == 'net.prototxt:1:6: expected a value for "odd", found "}"'
    Path("net.prototxt").write_text("layer { even 3 }")
    assert lines("net.prototxt")[-1] == 'net.prototxt:1:14: expected ":" or "{" after "even", found "3"'


def test_an_unknown_field_hides_no_other_errors():
    """Errors in the same layer that may follow from it are not reported: here, that kernel_size is missing."""
    conv = (
        'layer { name: "c" type: "Convolution" bottom: "a" top: "c" convolution_param { num_output: 4 kernal: 3 } }\n'
    )
    strange = STRANGE.replace('bottom: "a"', 'bottom: "b"')
    python = 'layer { name: "p" type: "Python" bottom: "s" top: "p" python_param { module: "m" layer: "L" } }\n'
    relu = 'layer { name: "r" type: "ReLU" bottom: "cc" top: "r" }\n'
    pool = 'layer { name: "k" type: "Pooling" bottom: "a" top: "k" }\n'
    Path("net.prototxt").write_text(INPUT + conv + strange + python + relu + pool)
    found = lines("net.prototxt")
    expected = ("2:kernal", "3:strange_param", "3:Strange", "3:unknown bottom", "4:--allow-python", "5:cc", "6:kernel")
    assert len(found) == len(expected)
    for line, word in (pair.split(":") for pair in expected):
        assert any(fault.startswith(f"net.prototxt:{line}:") and word in fault for fault in found), word
    Path("solver.prototxt").write_text('net: "net.prototxt" base_lr: 1 lr_policy: "fixed" fast: true')
    messages = lines("solver.prototxt")
    assert any('SolverParameter has no field "fast"' in fault for fault in messages)
    assert set(found) <= set(messages)


def test_a_similar_field_is_suggested_only_if_the_message_fits():
    for field, meant in (("spatial_wta_param", ""), ("pooling_parm", "pooling_param"), ("pool_param", "pooling_param")):
        Path("net.prototxt").write_text(f'{INPUT}layer {{ name: "s" type: "ReLU" {field} {{ }} }}')
        assert ("did you mean" in lines("net.prototxt")[0], meant in lines("net.prototxt")[0]) == (bool(meant), True)


def test_solvers_given_as_nets_and_missing_files_are_reported():
    Path("solver.prototxt").write_text("lr_policies: 1\nbase_lr: 0.1\nbase_lr: 0.2\n")
    assert lines("solver.prototxt")[-1].startswith('solver.prototxt:3:1: "base_lr" was already given')
    (line,) = lines("nowhere.prototxt")
    assert line.startswith("nowhere.prototxt: cannot be read: No such file or directory; ")
