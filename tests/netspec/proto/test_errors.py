"""Every fault of a text file is one line: where, what was found, what was expected, what to do."""

from pathlib import Path

import pytest

from netspec.errors import SpecError
from netspec.proto.text import parse_net_text, parse_solver_text, read_net, read_solver

FAULTS = {
    "typo in a field": (
        'layer {\n  name: "c"\n  type: "Convolution"\n  convolution_param { kernal_size: 3 }\n}',
        'f:4:23: layer "c" (Convolution): ConvolutionParameter has no field "kernal_size"; did you mean "kernel_size"?',
    ),
    "field of a parameter in the layer": (
        "layer {\n  kernel_size: 3\n}",
        'f:2:3: LayerParameter has no field "kernel_size"; it belongs in convolution_param or pooling_param',
    ),
    "brace missing": (
        'layer {\n  name: "a"\n  pooling_param {\n    stride: 2\n}\nlayer {\n}',
        'f:6:1: layer "a": LayerParameter has no field "layer", but NetParameter has; '
        'is a "}" missing for "layer" of line 1?',
    ),
    "file ends early": (
        "layer {\n  pooling_param {\n  }\n",
        'f:4:1: the file ends inside "layer" of line 1; is a "}" missing?',
    ),
    "one brace too many": (
        "layer {\n}\n}",
        'f:3:1: expected a field name, found "}"; is there one "}" too many?',
    ),
    "brackets of two kinds": ("layer {\n>", 'f:2:1: expected a field name, found ">"'),
    "a solver for a net": (
        "# solver\nbase_lr: 0.1",
        'f:2:1: NetParameter has no field "base_lr", but SolverParameter has; is this file a solver?',
    ),
    "unknown enum value": (
        "layer { pooling_param { pool: AVG } }",
        'f:1:31: "pool" has no value "AVG"; did you mean "AVE"?',
    ),
    "hexadecimal without digits": (
        "state { phase: 0x }",
        'f:1:17: NetState has no field "x"',
    ),
    "enum in lower case": (
        "state { phase: test }",
        'f:1:16: "phase" has no value "test"; did you mean "TEST"?',
    ),
    "enum value with no likeness": (
        "state { phase: DEPLOY }",
        'f:1:16: "phase" has no value "DEPLOY"; it is one of TRAIN, TEST',
    ),
    "enum in quotes": (
        'state { phase: "TEST" }',
        'f:1:16: expected a name such as TEST for "phase", found the string "TEST"; leave out the quotes',
    ),
    "unknown enum number": ("state { phase: -1 }", 'f:1:16: "phase" has no value of number -1'),
    "old layers with a new type": (
        'layers {\n  type: "ReLU"\n}',
        'f:2:9: expected a name such as THRESHOLD for "type", found the string "ReLU"; '
        'a layer whose type is in quotes begins with "layer", not "layers"',
    ),
    "new layer with an old type": (
        "layer {\n  type: RELU\n}",
        'f:2:9: expected a string for "type", found "RELU"; '
        'a layer whose type is not in quotes begins with "layers", the older format',
    ),
    "given twice": (
        'name: "a"\n\nname: "b"',
        'f:3:1: "name" was already given in line 1; it can be given only once',
    ),
    "message given twice": (
        "state {}\nstate {}",
        'f:2:1: "state" was already given in line 1; it can be given only once',
    ),
    "ceil_mode and round_mode": (
        "layer { pooling_param { round_mode: CEIL\nceil_mode: true } }",
        'f:2:1: "round_mode" was already given in line 1; it can be given only once',
    ),
    "string without quotes": ("name: net", 'f:1:7: expected a string for "name", found "net"; put it in quotes'),
    "string for an integer": (
        'input_dim: "3"',
        'f:1:12: expected an integer for "input_dim", found the string "3"',
    ),
    "fraction for an integer": ("input_dim: 3.5", 'f:1:12: expected an integer for "input_dim", found "3.5"'),
    "no value": ("input_dim:", 'f:1:11: expected an integer for "input_dim", found the end of the file'),
    "too large": (
        "input_dim: 2147483648",
        'f:1:12: 2147483648 is out of range for "input_dim", which takes -2147483648 to 2147483647',
    ),
    "negative": (
        "layer { pooling_param { pad: -1 } }",
        'f:1:30: -1 is out of range for "pad", which takes 0 to 4294967295',
    ),
    "octal by mistake": ("input_dim: 08", 'f:1:12: "08": a number that begins with 0 is octal'),
    "octal for a real number": (
        "layer { loss_weight: 01 }",
        'f:1:22: expected a decimal number for "loss_weight", found "01"',
    ),
    "word for a number": (
        "layer { loss_weight: one }",
        'f:1:22: expected a number for "loss_weight", found "one"',
    ),
    "word for a boolean": ("force_backward: yes", 'f:1:17: expected true or false, found "yes"'),
    "number for a boolean": ("force_backward: 2", 'f:1:17: expected true or false, found "2"'),
    "no colon": ('name "a"', 'f:1:6: expected ":" after "name", found the string "a"'),
    "no brace": ("layer: 3", 'f:1:8: expected "{" after "layer", found "3"'),
    "list without commas": ("input_dim: [1 2]", 'f:1:15: expected "," or "]" in the list of "input_dim", found "2"'),
    "list for one value": ('name: ["a"]', 'f:1:7: expected a string for "name", found "["'),
    "required field": (
        'layer {\n  name: "c"\n  clip_param {\n    min: 0\n  }\n}',
        'f:3:3: layer "c": ClipParameter lacks the required field "max"',
    ),
    "no closing quote": ('name: "net\n', "f:1:7: string without a closing quote"),
    "no closing quote, seen at the next string": (
        'layer {\n  name: "a\n  type: "ReLU"\n}',
        "f:3:14: string without a closing quote; is a closing quote missing for the string that begins in line 2?",
    ),
    "no closing quote, noticed after the next string": (
        'layer {\n  name: "a\n  type: "ReLU"\n  top: "b"\n}',
        'f:3:10: LayerParameter has no field "ReLU"; is a closing quote missing for the string that begins in line 2?',
    ),
    "unknown escape": (r'name: "C:\data"', "f:1:10: unknown escape '\\\\d' in a string; a backslash itself is \\\\"),
    "half a surrogate pair": (r'name: "a\ud800"', r"f:1:9: \ud800 is not a character of Unicode"),
    "bytes in a string": (r'name: "\377"', 'f:1:7: the string for "name" is not UTF-8'),
    "stray character": ("name = 3", 'f:1:6: unexpected character "="'),
    "binary": ("\x0a\x03net\x00", "f:2:1: unexpected character 0x03; is this a text file?"),
}


@pytest.mark.parametrize(("text", "message"), FAULTS.values(), ids=FAULTS.keys())
def test_fault_of_a_text(text: str, message: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse_net_text(text, "f")
    assert str(caught.value) == message


def test_a_net_for_a_solver() -> None:
    with pytest.raises(SpecError, match=r'^f:1:1: SolverParameter has no field "layer", .* is this file a net\?$'):
        parse_solver_text("layer {}", "f")


def test_places_count_characters_not_bytes() -> None:
    with pytest.raises(SpecError, match=r"^f:3:3: "):
        parse_net_text('# é\r\nname: "回環"\r\n\t layr {}', "f")
    with pytest.raises(SpecError, match=r"^f:1:12: "):
        parse_net_text('name: "回環" layr {}', "f")


def test_a_string_over_several_lines_is_suspected_only_near_by() -> None:
    with pytest.raises(SpecError) as caught:
        parse_net_text("name: 'two\nlines'\n\n\nlayr {}", "f")
    assert "closing quote" not in str(caught.value)


@pytest.mark.parametrize("read", [read_net, read_solver])
def test_files_that_cannot_be_read(read: object, tmp_path: Path) -> None:
    assert callable(read)
    with pytest.raises(SpecError, match=r"absent\.prototxt: cannot be read: No such file or directory$"):
        read(tmp_path / "absent.prototxt")
    with pytest.raises(SpecError, match=r"cannot be read: Is a directory$"):
        read(tmp_path)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b'name: "caf\xe9"', ":1:11: byte 0xe9 is not UTF-8; save the file as UTF-8 text"),
        (b"# fine: \xe9\nnam\xe9: 3", ":2:4: byte 0xe9 is not UTF-8; save the file as UTF-8 text"),
        ('name: "n"'.encode("utf-16"), ":1:1: byte 0xff is not UTF-8; save the file as UTF-8 text"),
    ],
)
def test_files_that_are_not_utf8(data: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_bytes(data)
    with pytest.raises(SpecError) as caught:
        read_net(path)
    assert str(caught.value) == f"{path}{message}"


@pytest.mark.parametrize("number", ["1" * 5000, "-" + "9" * 101, "0" + "7" * 5000, "0x" + "f" * 5000])
@pytest.mark.parametrize("field", ["max_iter", "random_seed", "solver_mode"])
def test_a_number_of_very_many_digits(field: str, number: str) -> None:
    """Python itself refuses to read one of 5,000 digits."""
    with pytest.raises(SpecError, match=r"a number of [\d,]+ digits is out of every range") as caught:
        parse_solver_text(f"{field}: {number}", "solver.prototxt")
    assert len(str(caught.value)) < 100
