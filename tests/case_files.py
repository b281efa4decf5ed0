"""Files of cases: texts that would take more lines in Python than they have, beside what is expected of each.

A case begins with a line ``=== NAME``, each of its parts with ``--- PART``; the lines below are the part's text. Texts
that need no parts begin with ``=== NAME`` each.
"""

import re
from pathlib import Path

_FOLDER = Path(__file__).parent


def read_cases(path: str) -> dict[str, dict[str, str]]:
    """Return the parts of each case of a file below tests/; a text has no end of line behind its last line."""
    cases: dict[str, dict[str, str]] = {}
    for name, parts in read_texts(path).items():
        found = re.findall(r"^--- (.*)\n((?:(?!--- ).*\n)*?)(?=--- |\Z)", parts, re.M)
        cases[name] = {part: text[:-1] for part, text in found}
    return cases


def read_texts(path: str) -> dict[str, str]:
    """Return the texts of a file below tests/ by their names, each with the end of its last line."""
    text = (_FOLDER / path).read_text(encoding="utf-8")
    texts = re.findall(r"^=== (.*)\n((?:(?!=== ).*\n)*)", text, re.M)
    assert len(dict(texts)) == len(texts), f"{path}: found a name twice"
    return dict(texts)
