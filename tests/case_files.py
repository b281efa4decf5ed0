"""Files of cases: texts that would take more lines in Python than they have, beside what is expected of each.

A case begins with a line ``=== NAME``, each of its parts with ``--- PART``; the lines below are the part's text.
"""

import re
from pathlib import Path

_FOLDER = Path(__file__).parent


def read_cases(path: str) -> dict[str, dict[str, str]]:
    """Return the parts of each case of a file below tests/; a text has no end of line behind its last line."""
    text = (_FOLDER / path).read_text(encoding="utf-8")
    cases: dict[str, dict[str, str]] = {}
    for name, parts in re.findall(r"^=== (.*)\n((?:(?!=== ).*\n)*)", text, re.M):
        assert name not in cases, f"{path}: found {name} twice"
        cases[name] = dict(re.findall(r"^--- (.*)\n((?:(?!--- ).*\n)*?)(?=--- |\Z)", parts, re.M))
    return {name: {part: text[:-1] for part, text in case.items()} for name, case in cases.items()}
