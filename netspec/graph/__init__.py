"""The passes between a parsed net and a runnable net: NetParameter in, NetParameter or Plan out; nothing is mutated.

Every error goes to ``source.report``, which raises the first one by default. With a map that collects errors
(``SourceMap.telling``), a caller gets all of them, and a result in which the wrong parts are unchanged.
"""

from __future__ import annotations

from collections.abc import Iterable

from netspec.errors import SpecError, Where, did_you_mean


def check_blobs(wanted: Iterable[str], known: Iterable[str], file: str) -> None:
    """Raise SpecError for the first of the blobs that a net, read from ``file``, does not have."""
    blobs = list(dict.fromkeys(known))
    for name in wanted:
        if name not in blobs:
            hint = did_you_mean(name, blobs) or ";"
            raise SpecError(f'no blob "{name}" in this net{hint} it has: {", ".join(blobs)}', Where(file))
