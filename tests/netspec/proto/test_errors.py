"""Every error in a text file is one line: place, found, expected, advice."""

from pathlib import Path

import pytest

from case_files import read_cases
from netspec.errors import SpecError
from netspec.proto.text import parse_net_text, parse_solver_text, read_net

FAULTS = read_cases("netspec/proto/cases/errors.txt")


@pytest.mark.parametrize("case", FAULTS.values(), ids=FAULTS)
def test_fault_of_a_text(case: dict[str, str]) -> None:
    with pytest.raises(SpecError) as caught:
        parse_net_text(case["text"], "f")
    assert str(caught.value) == case["fault"]


def test_a_binary_file() -> None:
    with pytest.raises(SpecError, match=r"^f:2:1: unexpected character 0x03; is this a text file\?$"):
        parse_net_text("\x0a\x03net\x00", "f")


@pytest.mark.parametrize("comment", ["// a", "/* a */", "<!-- a -->", "-- a", "% a"])
@pytest.mark.parametrize("before", ["", 'name: "n" '])
def test_comments_of_other_languages_are_named(comment: str, before: str) -> None:
    with pytest.raises(SpecError, match=rf"^f:1:{len(before) + 1}: .*; a comment begins with #$"):
        parse_net_text(f"{before}{comment}", "f")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\xa0", "no-break space (0xa0); replace it with an ordinary space"),
        ("\u3000", "ideographic space (0x3000); replace it with an ordinary space"),
        ("\u200b", "zero width space (0x200b); replace it with an ordinary space"),
        ("\u201cn\u201d", 'quotation mark \u201c; write strings in straight quotes: "text"'),
    ],
    ids=["no_break", "ideographic", "zero_width", "quotes"],
)
def test_characters_of_word_processors_are_named(text: str, said: str) -> None:
    with pytest.raises(SpecError) as caught:
        parse_net_text(f"name: {text}", "f")
    assert str(caught.value) == f"f:1:7: unexpected {said}"


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
    with pytest.raises(SpecError, match=r"a number of [\d,]+ digits is out of range") as caught:
        parse_solver_text(f"{field}: {number}", "solver.prototxt")
    assert len(str(caught.value)) < 100
