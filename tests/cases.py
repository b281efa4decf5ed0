"""Files of cases: texts that would take more lines in Python than they have, beside what is expected of each.

A case begins with a line ``=== NAME``, each of its parts with ``--- PART``; the lines below are the part's text.
"""

from pathlib import Path

_FOLDER = Path(__file__).parent


def read_cases(path: str) -> dict[str, dict[str, str]]:
    """Return the parts of each case of a file below tests/; a text has no end of line behind its last line."""
    cases: dict[str, dict[str, list[str]]] = {}
    for line in (_FOLDER / path).read_text(encoding="utf-8").split("\n")[:-1]:
        if line.startswith("=== "):
            assert line[4:] not in cases, line
            case = cases[line[4:]] = {}
        elif line.startswith("--- "):
            assert line[4:] not in case, line
            text = case[line[4:]] = []
        else:
            text.append(line)
    return {name: {part: "\n".join(lines) for part, lines in case.items()} for name, case in cases.items()}
