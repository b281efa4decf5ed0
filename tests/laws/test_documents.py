"""The Markdown files: the real parsers take every command in them, and every link leads to a file."""

import argparse
import ast
import re
import shlex
from collections.abc import Iterator

import pytest

import benchmarks.cli
import lmdb_build.cli
import loopclosure.cli
import netspec
import netspec.cli
from netspec.cli import run_script
from paths import ROOT

DOCUMENTS = [ROOT / "README.md", *sorted(ROOT.glob("*/README.md")), *sorted((ROOT / "docs").glob("*.md"))]
PARSERS = {
    "netspec": netspec.cli.parser,
    "lmdb-build": lmdb_build.cli.parser,
    "loopclosure": loopclosure.cli.parser,
    "benchmarks": benchmarks.cli.parser,
}
OTHERS = {"source", "cd", "pip", "benchmarks/gpu_steps"}  # programs that are not ours
BLOCKS = {
    (f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, found.start()) + 2}", found[1]): found[2]
    for path in DOCUMENTS
    for text in [path.read_text()]
    for found in re.finditer(r"^```([^\n`]*)\n(.*?)^```$", text, re.M | re.S)
}
SHELL = {where: text for (where, language), text in BLOCKS.items() if language in ("", "bash")}
PYTHON = {where: text for (where, language), text in BLOCKS.items() if language == "python"}


def commands(text: str) -> Iterator[list[str]]:
    """Yield the words of each command of a shell block: variables are replaced, a loop's body is one command."""
    variables: dict[str, str] = {}
    for line in text.replace("\\\n", " ").splitlines():
        line = re.sub(r"(^|\s)#.*", "", line)
        line = re.sub(r"\bfor (\w+) in (\S+)[^;]*; do (.*); done", r"\1=\2; \3", line)
        for part in re.split(r"&&|;", line):
            for _ in range(2):  # a variable may hold another
                part = re.sub(r"\$\{?(\w+)\}?", lambda found: variables.get(found[1], found[0]), part)
            words = shlex.split(part)
            if words and (assigned := re.fullmatch(r"(\w+)=(.*)", words[0])):
                variables[assigned[1]] = assigned[2]
            elif words:
                yield words


def parse(words: list[str]) -> argparse.Namespace | None:
    """Parse a command with the parser of its program. Raises SystemExit for wrong usage."""
    program, *arguments = words
    if program == "torchrun":
        program, *arguments = arguments[arguments.index("-m") + 1 :]
    if program in OTHERS:
        return None
    if program.startswith("tools/"):
        script = ROOT / program
        door = re.search(r'run\("(\w+)\.cli"((?:, "\w+")*)\)', script.read_text())
        if not door:
            return None  # a shell script
        program, arguments = door[1].replace("_", "-"), [*re.findall(r"\w+", door[2]), *arguments]
    if (program, arguments[:1]) == ("netspec", ["run"]):
        arguments, script = run_script.split(arguments)  # whose own words are not parsed here
        assert script
    return PARSERS[program]().parse_args(arguments)


@pytest.mark.parametrize("where", SHELL)
def test_every_command_is_one_that_its_parser_takes(where: str) -> None:
    found = list(commands(SHELL[where]))
    assert found, "a block without a language is a list of commands"
    for words in found:
        try:
            parse(words)
        except SystemExit as end:
            if end.code:  # --help ends with 0
                pytest.fail(shlex.join(words))


@pytest.mark.parametrize(
    "words", [["netspec", "chekc"], ["loopclosure", "detect"], ["tools/train.py", "--no-such-flag"]]
)
def test_a_wrong_command_would_be_found(words: list[str]) -> None:
    with pytest.raises(SystemExit):
        parse(words)


def test_shell_blocks_are_read_as_the_shell_reads_them() -> None:
    text = 'W=a/b\nE="run $W/c"  # why\nfor s in train val; do $E \\\n  --of ${s}; done\nsource x && cd y\n'
    assert list(commands(text)) == [["run", "a/b/c", "--of", "train"], ["source", "x"], ["cd", "y"]]


@pytest.mark.parametrize("where", PYTHON)
def test_python_blocks_use_names_that_exist(where: str) -> None:
    for node in ast.walk(ast.parse(PYTHON[where])):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "netspec":
            assert hasattr(netspec, node.attr), node.attr


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_to_files(document) -> None:
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", document.read_text()):
        assert "://" in target or (document.parent / target).exists(), target
