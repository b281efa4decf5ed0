"""The pages and the metadata of a release: commands, links, numbers, named tests, versions."""

import argparse
import ast
import json
import re
import shlex
from collections.abc import Sequence
from pathlib import Path

import pytest

import benchmarks.cli
import benchmarks.pages
import lmdb_build.cli
import loopclosure.cli
import netspec
import netspec.cli
from documents import DOCUMENTS, PROGRAMS, blocks, commands
from netspec.cli import run_script
from paths import GOLDEN, ROOT

PARSERS = {
    "netspec": netspec.cli.parser,
    "lmdb-build": lmdb_build.cli.parser,
    "loopclosure": loopclosure.cli.parser,
    "tools/bench": benchmarks.cli.parser,
}
BLOCKS = {block.where: block for document in DOCUMENTS for block in blocks(document)}
SHELL = [where for where, block in BLOCKS.items() if not block.language]
PYTHON = [where for where, block in BLOCKS.items() if block.language == "python"]


def parse(words: Sequence[str]) -> argparse.Namespace | None:
    """Parse a command with the parser of its program. Raises SystemExit for wrong usage."""
    program, *arguments = words
    if program == "torchrun":
        program, *arguments = arguments[arguments.index("-m") + 1 :]
    if program not in PARSERS:
        return None
    if (program, arguments[:1]) == ("netspec", ["run"]):
        arguments, script = run_script.split(arguments)  # whose own words are not parsed here
        assert script
    return PARSERS[program]().parse_args(arguments)


@pytest.mark.slow
@pytest.mark.parametrize("where", SHELL)
def test_every_command_is_accepted_by_its_parser(where: str, tmp_path: Path) -> None:
    found = commands(BLOCKS[where].text, tmp_path)
    assert found, "a block without a language is a list of commands"
    for command in found:
        try:
            parse(command.words)
        except SystemExit as end:
            if end.code:  # --help ends with 0
                pytest.fail(shlex.join(command.words))


def unknown_words(line: str) -> list[str]:
    """Return the command and the options that a program does not have, of a line that may leave out the rest."""
    program, *words = line.split()
    parser = PARSERS[program]()
    while commands_of := [a.choices for a in parser._actions if isinstance(a, argparse._SubParsersAction)]:
        if not words or words[0].startswith("-"):
            break
        if words[0] not in commands_of[0]:
            return words[:1]
        parser = commands_of[0][words.pop(0)]
    if line.startswith("netspec run"):
        return []  # what follows are the script's own words
    known = {option for action in parser._actions for option in action.option_strings}
    return [word for word in words if word.startswith("--") and word.partition("=")[0] not in known]


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS)
def test_commands_in_sentences_use_existing_commands_and_options(document: str) -> None:
    text = re.sub(r"^```.*?^```$", "", (ROOT / document).read_text(), flags=re.M | re.S)
    for line in re.findall(r"`([^`]+)`", text):
        if line.partition(" ")[0] in PARSERS:
            assert not unknown_words(line), line


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_block_has_a_known_language(document: str) -> None:
    text = (ROOT / document).read_text()
    assert len(re.findall(r"^\s*(?:```|~~~)", text, re.M)) == 2 * len(blocks(document)), "a block begins a line: ```"
    for block in blocks(document):
        assert re.fullmatch(r"|python|prototxt|text|\{\w+\}.*", block.language), block.where
        if block.language == "text":  # is neither run nor parsed
            first = [line.split()[0] for line in block.text.splitlines() if line.strip()]
            assert not PROGRAMS.keys() & set(first), f"{block.where}: commands stand in a block without a language"


@pytest.mark.parametrize("where", PYTHON)
def test_python_blocks_use_names_that_exist(where: str) -> None:
    for node in ast.walk(ast.parse(BLOCKS[where].text)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "netspec":
            assert hasattr(netspec, node.attr), node.attr


@pytest.mark.parametrize("document", DOCUMENTS)
def test_links_lead_to_existing_files(document: str) -> None:
    path = ROOT / document
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text()):
        assert "://" in target or (path.parent / target).exists(), target


@pytest.mark.parametrize("page", [path.relative_to(ROOT).as_posix() for path in benchmarks.pages.PAGES])
def test_numbers_on_pages_equal_the_result_files(page: str) -> None:
    text = (ROOT / page).read_text()
    assert benchmarks.pages.updated(text) == text, "tools/bench pages writes them"


def test_the_counts_of_faithful_json_equal_the_golden_folders() -> None:
    rows = json.loads((benchmarks.pages.RESULTS / "faithful.json").read_text())["rows"]
    folders = {"layers": "layers", "trainings": "train", "examples": "examples/runs"}
    counts = {what: len(list((GOLDEN / folder).iterdir())) for what, folder in folders.items()}
    assert {row["what"]: row["to the last bit"] for row in rows} == {what: f"{n} of {n}" for what, n in counts.items()}


# Every difference from Caffe in the documentation names tests that exist
CAFFE_PAGE = ROOT / "docs" / "coming-from-caffe.md"
DIFFERENCES = [
    line for line in CAFFE_PAGE.read_text().splitlines() if line.startswith("| ") and not line.startswith("| Caffe ")
]
TESTS = {
    name
    for path in ROOT.glob("tests/**/test_*.py")
    for name in re.findall(r"^def (test_\w+)\(", path.read_text(), re.MULTILINE)
}


@pytest.mark.parametrize("row", DIFFERENCES, ids=lambda row: row.split("|")[1].strip()[:50])
def test_each_difference_from_caffe_names_existing_tests(row: str) -> None:
    assert len(re.findall(r"(?<!\\)\|", row)) == 4, "expected three columns"
    named = re.findall(r"\btest_\w+", row[row.index("<!--") :])
    assert named
    assert set(named) <= TESTS


# The version, changelog, citation and issue template of a release
VERSION = re.search(r'^version = "(.+?)"', (ROOT / "pyproject.toml").read_text(), re.M)


def test_changelog_and_citation_have_this_version() -> None:
    assert VERSION is not None
    changes = (ROOT / "CHANGELOG.md").read_text()
    citation = (ROOT / "CITATION.cff").read_text()
    newest = re.search(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", changes, re.M)
    assert newest is not None
    assert newest[1] == VERSION[1]
    assert f"\nversion: {VERSION[1]}\n" in citation
    assert f'\ndate-released: "{newest[2]}"\n' in citation
