"""``netspec fmt``: the form of a text, whose meaning and comments it keeps."""

import io
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from netspec.cli import main
from netspec.errors import SpecError
from netspec.inspect.check.format import WIDTH, format_text
from netspec.proto.lexer import END, STRING, SYMBOL, Lexer
from netspec.proto.text import parse_net_text, parse_solver_text, text_of
from paths import GOLDEN, ROOT, SHARED, last_parts, nets_as_found

NETS = Path(__file__).parent / "nets"
OWN = sorted((ROOT / "prototxt").rglob("*.prototxt"))


def test_an_unformatted_net_becomes_the_formatted_file() -> None:
    typed, formed = [(NETS / f"{name}.prototxt").read_text() for name in ("unformatted", "formatted")]
    assert format_text(typed, "f") == formed


SMALL_TEXTS = {
    "empty": ("", ""),
    "comment_only": ("\n\n# only this\n\n", "# only this\n"),
    "windows_lines": ("a:1\r\nb:2\r\n", "a: 1\nb: 2\n"),
    "quotes": ("a: 'say \"no\"' 'x'", 'a: \'say "no"\' "x"\n'),
    "comment_in_a_number": ("a: - # minus\n 1", "# minus\na: -1\n"),
    "comments_everywhere": (
        "a # one\n : # two\n 1 # three\n ; # four\nb: 2",
        "# one\n# two\n# three\na: 1  # four\nb: 2\n",
    ),
    "comment_after_brace": ("a { # open\n b: 1 }", "a {  # open\n  b: 1\n}\n"),
    "list_of_messages": ("a: [ {b: 1}, {b: 2} ]", "a { b: 1 }\na { b: 2 }\n"),
    "empty_list": ("a: []", "a: []\n"),
    "empty_message": ("a {}", "a { }\n"),
    "nested_messages": ("a { b { c: 1\n } d: 2 }", "a {\n  b {\n    c: 1\n  }\n  d: 2\n}\n"),
    "not_utf8": ("a: 1 # é\udcff\n", "a: 1  # é\udcff\n"),
}


@pytest.mark.parametrize(("text", "formed"), SMALL_TEXTS.values(), ids=SMALL_TEXTS)
def test_format_text_of_small_texts(text: str, formed: str) -> None:
    assert format_text(text, "f") == formed
    assert format_text(formed, "f") == formed


def test_long_lines_are_broken() -> None:
    long = "a { " + " ".join(f"field_{k}: {k}" for k in range(12)) + " }"
    assert len(format_text(long, "f").splitlines()) == 14
    numbers = format_text(f"a: [{', '.join(map(str, range(100)))}]", "f")
    assert max(map(len, numbers.splitlines())) <= WIDTH
    assert format_text(numbers, "f") == numbers


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a 1", 'f:1:3: expected ":" or "{", found \'1\''),
        ("a {\n b: 1\n", "f:3:1: expected a field name, found the end of the file"),
        ("a: [1 2]", 'f:1:7: expected "," or "]", found \'2\''),
        ("a: [1, {b: 2}]", "f:1:1: found messages and other values in one list"),
        ("}", "f:1:1: expected a field name, found '}'"),
        ("a {" * 101, "f:1:303: messages are nested more than 100 deep"),
    ],
    ids=["no_colon", "no_closing_brace", "no_comma", "mixed_list", "closing_brace_only", "too_deep"],
)
def test_invalid_text_is_refused(text: str, message: str) -> None:
    with pytest.raises(SpecError) as raised:
        format_text(text, "f")
    assert str(raised.value) == message


def meaning(text: str) -> list[str]:
    """Return the tokens, strings unquoted, without punctuation."""
    tokens = [token for token in Lexer(text, "f") if token.kind != END]
    return [
        Lexer(t.text, "f").unquote(type(t)(STRING, t.text, 0)).decode() if t.kind == STRING else t.text
        for t in tokens
        if t.kind != SYMBOL or t.text == "-"
    ]


SPACE = st.sampled_from([" ", "  ", "\n", "\n\n\n", " # one\n", "\n# two\n\n", "\t#three\n#four\n"])
VALUE = st.sampled_from(["1", "-2.5", "- 3", '"s"', "'t' \"u\"", "MAX", "[1,2]", "[]"])


@st.composite
def texts(draw: st.DrawFn, depth: int = 0) -> str:
    text = draw(SPACE)
    for _ in range(draw(st.integers(0, 4))):
        spaces = [draw(SPACE) for _ in range(5)]
        if depth < 3 and draw(st.booleans()):
            inner = draw(texts(depth + 1))
            opening, closing = draw(st.sampled_from(["{}", "<>"]))
            value = f"{draw(st.sampled_from(['', ':']))}{spaces[0]}{opening}{inner}{closing}"
        else:
            value = f"{spaces[1]}:{spaces[0]}{draw(VALUE)}"
        text += f"{spaces[2]}f{value}{spaces[3]}{draw(st.sampled_from(['', ';', ',']))}{spaces[4]}"
    return text


@pytest.mark.slow
@given(texts())
@example(" # one\nf:1 # two\n ;# three\n")
def test_formatting_keeps_tokens_and_comments_and_is_idempotent(text: str) -> None:
    formed = format_text(text, "f")
    assert format_text(formed, "f") == formed
    assert meaning(formed) == meaning(text)
    assert sorted(filter(None, comments(formed))) == sorted(filter(None, comments(text)))


def comments(text: str) -> list[str]:
    return [line.partition("#")[2].strip() for line in text.split("\n")]


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [*nets_as_found(), *sorted(GOLDEN.rglob("*.prototxt")), *sorted(SHARED.glob("golden/**/*.prototxt"))],
    ids=last_parts,
)
def test_published_files_keep_their_meaning_when_formatted(path: Path) -> None:
    text = text_of(path)
    formed = format_text(text, str(path))
    assert format_text(formed, str(path)) == formed
    assert meaning(formed) == meaning(text)
    for parse in (parse_net_text, parse_solver_text):
        try:
            before = parse(text, str(path))[0]
        except SpecError:
            continue
        assert parse(formed, str(path))[0] == before


@pytest.mark.slow
@pytest.mark.parametrize("path", OWN, ids=last_parts)
def test_the_projects_files_are_formatted(path: Path) -> None:
    assert format_text(text_of(path), str(path)) == text_of(path)


def test_fmt_formats_files_links_and_standard_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("good").write_text('name: "x"\n')
    Path("other").write_text('name: "x"\nlayer{name:"y"}')
    Path("link").symlink_to("other")
    assert main(["fmt", "--check", "good"]) == 0
    assert main(["fmt", "--check", "good", "link"]) == 1
    assert capsys.readouterr().out == "link:2:1: netspec fmt would change this line, the first of them\n"
    assert main(["fmt", "good", "link"]) == 0
    assert Path("link").is_symlink()
    assert Path("other").read_text() == 'name: "x"\nlayer { name: "y" }\n'
    assert capsys.readouterr().out == "good: already formatted\nlink: formatted\n"
    Path("bad").write_text("name")
    assert main(["fmt", "bad", "none", "good"]) == 1
    assert main(["fmt", "--check", "bad", "other"]) == 2
    assert "bad:1:5: expected" in capsys.readouterr().err
    monkeypatch.setattr("sys.stdin", io.StringIO("a:1"))
    assert main(["fmt", "-"]) == 0
    assert capsys.readouterr().out == "a: 1\n"
