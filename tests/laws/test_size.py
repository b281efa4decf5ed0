"""The size of the project. A limit is lowered when something goes, or raised in a commit that says why."""

import ast
import subprocess
from collections.abc import Sequence

from paths import ROOT

PRODUCT = ("netspec/*.py", "loopclosure/*.py", "lmdb_build/*.py")
PRODUCT_LINES, TEST_LINES, WORDS_OF_PAGES = 62600, 41000, 27700
LONGEST_FUNCTION = 60  # lines
LONGER = {"make_server"}  # one inner function for each message of the protocol


def files(*patterns: str, without: Sequence[str] = ()) -> list[str]:
    names = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in names.splitlines() if not name.startswith(tuple(without)) and (ROOT / name).is_file()]


def lines(names: list[str]) -> int:
    return sum((ROOT / name).read_bytes().count(b"\n") for name in names)


def test_lines_of_the_product() -> None:
    assert lines(files(*PRODUCT)) <= PRODUCT_LINES


def test_lines_of_the_tests() -> None:
    assert lines(files("tests/*.py")) <= TEST_LINES


def test_words_of_the_pages() -> None:
    pages = files("*.md", without=("tests/", "benchmarks/notes/"))
    assert sum(len((ROOT / name).read_text("utf-8").split()) for name in pages) <= WORDS_OF_PAGES


def test_functions_are_short() -> None:
    long = []
    for name in files(*PRODUCT):
        for node in ast.walk(ast.parse((ROOT / name).read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= LONGEST_FUNCTION:
                long.append(node.name)
    assert set(long) == LONGER
