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
