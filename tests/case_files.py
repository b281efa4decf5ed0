"""Files of cases: texts, and what is expected of each.

A line ``=== NAME`` begins a case, and a line ``--- PART`` one of its parts; the lines below are the text of that part.
"""

import re
from pathlib import Path

_FOLDER = Path(__file__).parent


def read_cases(path: str) -> dict[str, dict[str, str]]:
    """Return the parts of each case of a file below tests/; a text has no end of line behind its last line."""
    text = (_FOLDER / path).read_text(encoding="utf-8")
    cases: dict[str, dict[str, str]] = {}
    for name, parts in re.findall(r"^=== (.*)\n((?:(?!=== ).*\n)*)", text, re.M):
        assert name not in cases, f"{path}: found the name {name} twice"
        found = re.findall(r"^--- (.*)\n((?:(?!--- ).*\n)*?)(?=--- |\Z)", parts, re.M)
        cases[name] = {part: text[:-1] for part, text in found}
    return cases


def read_table(path: str) -> list[dict[str, str]]:
    """Return the rows of a table in a file below tests/: columns between ``|``, named by the first; ``-`` is ""."""
    lines = [line for line in (_FOLDER / path).read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    names = [name.strip() for name in lines[0].split("|")]
    rows = [[cell.strip() for cell in line.split("|", len(names) - 1)] for line in lines[1:]]
    return [{name: "" if cell == "-" else cell for name, cell in zip(names, row, strict=True)} for row in rows]


def sizes(text: str) -> list[tuple[int, ...]]:
    """Return the shapes of ``2x3 4x5x6``; ``()`` is a shape without axes."""
    return [() if shape == "()" else tuple(map(int, shape.split("x"))) for shape in text.split()]
