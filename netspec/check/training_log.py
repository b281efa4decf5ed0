"""Reading Caffe's log back: which test scores a training met (Caffe: tools/extra/parse_log.py)."""

from __future__ import annotations

import re
from pathlib import Path

from netspec.errors import SpecError, Where

_TESTING = re.compile(r"\] Iteration (\d+), Testing net \(#(\d+)\)")
_SCORE = re.compile(r"\]\s+Test net output #\d+: (\S+) = (\S+)")


def read_test_scores(path: str | Path, output: str, net: int = 0) -> list[tuple[int, float]]:
    """Return (iteration, value) of one output of test net ``net``, in the order of the log.

    Where the log holds several runs (a resumed training), the last value of an iteration counts.
    """
    try:
        lines = Path(path).read_text(errors="replace").splitlines()
    except OSError as fault:
        raise SpecError(f"cannot be read: {fault.strerror}", Where(str(path))) from None
    scores: dict[int, float] = {}
    iteration = None
    for line in lines:
        if match := _TESTING.search(line):
            iteration = int(match[1]) if int(match[2]) == net else None
        elif iteration is not None and (match := _SCORE.search(line)) and match[1] == output:
            scores[iteration] = float(match[2])
    return sorted(scores.items())
