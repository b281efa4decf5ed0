"""What an editor is told about a text: faults, what stands at a place, where a blob is made, what may be written."""

from pathlib import Path

import pytest

from case_files import read_texts
from netspec.inspect.editor.answers import ERROR, HINT, WARNING, completion, definition, file_faults, hover, text_faults

(NET,) = read_texts("netspec/inspect/editor/answers.txt").values()


def at(mark: str, text: str = NET) -> tuple[str, int]:
    """Return a text and the offset of the ``|`` in ``mark``, which stands in the text without it."""
    assert text.count(mark.replace("|", "")) == 1, mark
    return text, text.index(mark.replace("|", "")) + mark.index("|")


def words(before: str, after: str = "") -> list[str]:
    """Return what may be written behind ``before``."""
    return [choice.text for choice in completion(before + after, len(before))]


@pytest.mark.parametrize(
    ("mark", "said"),
    [
        ('type: "Conv|olution"\n  bottom', "**Convolution**\n```text\nCross-correlate"),
        ('bottom: "|x"\n', "blob **x**: 1×3×8×8 or 2×3×8×8"),
        ('top: "p|"', "blob **p**: shape not known"),
        ("ker|nel_size: 3 weight", "**kernel_size** (repeated uint32), field of ConvolutionParameter"),
        ("po|ol: MAX", "**pool** (PoolMethod), field of PoolingParameter\n\none of MAX, AVE, STOCHASTIC\n\ndefault: M"),
        ("num|_output: 2 kernel_size: 3 we", "**num_output** (uint32), field of ConvolutionParameter\n\ndefault: 0"),
        ('type: "xa|vier"', ""),
        ("# a| net", ""),
    ],
)
def test_hover(mark: str, said: str) -> None:
    assert hover(*at(mark), {"x": ((1, 3, 8, 8), (2, 3, 8, 8))}).startswith(said)
    assert said or hover(*at(mark), {}) == ""


@pytest.mark.parametrize(
    ("mark", "line"),
    [
        ('bottom: "x|"\n', 2),
        ('type: "ReLU" bottom: "c|"', 3),
        ('"ReLU" bottom: "c" top: "|c"', 3),
        ('type: "Pooling" bottom: "|c"', 11),
        ('top: "|d"', 13),
        ('top: "d" param { name: "|w"', 3),
        ('type: "Pool|ing"', None),
        ("num|_output: 2 kernel_size: 3 weight", None),
    ],
)
def test_definition(mark: str, line: int | None) -> None:
    where = definition(*at(mark))
    assert (where and where.line) == line


def test_definition_in_a_text_that_cannot_be_read() -> None:
    assert definition(*at('bottom: "x|"\n', NET + "layer {")) is None


def test_completion_of_fields() -> None:
    assert {"layer", "name", "input"} <= set(words('name: "n"\n'))
    assert {"name", "bottom", "convolution_param"} <= set(words("layer {\n  "))
    assert {"kernel_size", "pool"} <= set(words("layer { pooling_param { ke", " }\n}"))
    assert {"base_lr", "net"} <= set(words('net: "x" max_iter: 3\n'))
    assert words("layer { nonsense { ") == []
    assert words("# lay") == []
    assert {"type", "value"} <= set(words('layer { type: "Convolution" convolution_param { weight_filler { '))


def test_completion_of_values() -> None:
    assert "Convolution" in words('layer { type: "Con', '"\n}')
    assert '"Convolution"' in words("layer { type: ")
    assert words("layer { pooling_param { pool: ") == ["MAX", "AVE", "STOCHASTIC"]
    assert words("layer { include { phase: T") == ["TRAIN", "TEST"]
    assert words("layer { convolution_param { bias_term: ") == ["true", "false"]
    assert words(NET + 'layer { bottom: "') == ["x", "c", "p", "d"]
    assert words("layer { pooling_param { kernel_size: ") == []
    assert words('layer { name: "') == []
    assert words('type: "') == []


def test_faults_of_a_text_that_is_being_written() -> None:
    assert text_faults(NET, "f") == []
    (fault,) = text_faults(NET + "layer {", "f")
    assert (fault.where.line, fault.severity) == (15, ERROR)
    found = text_faults("layer { nam: 1 typ: 2 }\nlayer { nome: 3 }", "f")
    assert [each.where.line for each in found] == [1, 1, 2]
    assert text_faults("net: 'x' base_lr: 1", "f") == []
    assert "base_lr" in text_faults("net: 'x' base_lr: 'y'", "f")[0].message


def test_faults_findings_and_shapes_of_a_saved_file(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text(NET)
    found, shapes = file_faults(str(path))
    assert found == []
    assert shapes["c"] == ((1, 2, 6, 6),)
    norm = 'layer { name: "n" type: "BatchNorm" bottom: "p" top: "n" }\n'
    path.write_text(NET + norm + norm.replace('"p"', '"q"').replace('top: "n"', 'top: "m"'))
    found, _ = file_faults(str(path))
    assert [(each.severity, each.where.line, each.rule) for each in found] == [
        (ERROR, 16, ""),
        (WARNING, 15, "batchnorm-without-scale"),
        (WARNING, 16, "batchnorm-without-scale"),
    ]
    path.write_text('layer { name: "d" type: "Data" top: "x" data_param { source: "no" batch_size: 2 } }')
    assert [each.severity for each in file_faults(str(path))[0]] == [HINT]
