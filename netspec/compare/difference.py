"""One difference, as a line of text."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from netspec.errors import Where, printable


@dataclass(frozen=True)
class Difference:
    """What is otherwise in the second file than in the first.

    ``where`` is the place, ``other`` the place in the first file where there is one in both.
    """

    where: Where
    message: str
    other: Where | None = None

    def __str__(self) -> str:
        place = f" ({_short(self.other)})" if self.other else ""
        return printable(f"{self.where}: {self.message}{place}")


def _short(where: Where) -> str:
    return f"{where.file}:{where.line}:{where.column}" if where.line else where.file


Differences = Iterator[Difference]
