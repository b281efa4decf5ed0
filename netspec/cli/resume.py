"""Finds the snapshot from which ``netspec train --resume`` continues."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from netspec import log
from netspec.errors import SpecError, Where
from netspec.solver.extra import check_pair, read_extra
from netspec.solver.snapshot import find_learned_net, read_state


def newest_pair(prefix: str) -> Path | None:
    """Return the newest state with a prefix that is complete, together with its weights.

    The log names incomplete snapshots. Returns None if there is no snapshot. Raises SpecError if there are
    snapshots but none is complete, since a new training would overwrite them silently.
    """
    passed = 0
    for state in _newest_first(prefix):
        try:
            found = find_learned_net(read_state(state), state)
            extra = read_extra(state)
            if extra is not None:
                check_pair(state, found, extra)
            return state
        except (SpecError, OSError) as fault:
            log.logger.warning(f"skipped: {fault}")
            passed += 1
    if passed:
        found = f'none of the {passed} snapshots with the prefix "{prefix}" is complete'
        message = f"{found}; move them away to start from the beginning"
        raise SpecError(f"{message}, or give one with --snapshot", Where(prefix))
    return None


def _newest_first(prefix: str) -> Iterator[Path]:
    start = Path(f"{prefix}_iter_")
    pattern = re.compile(re.escape(start.name) + r"(\d+)\.solverstate(\.h5)?")
    found = [(match, path) for path in start.parent.glob("*") if (match := pattern.fullmatch(path.name))]
    for _, path in sorted(found, key=lambda pair: (int(pair[0][1]), pair[1].name), reverse=True):
        yield path
