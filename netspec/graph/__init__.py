"""The passes between a parsed net and a runnable net: NetParameter in, NetParameter or Plan out; nothing is mutated.

Each pass takes ``report``, a function that gets every error. The default raises the first one. A caller that passes a
collecting function gets all errors, and a result in which the wrong parts are unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from netspec.errors import SpecError, Where, did_you_mean

Report = Callable[[SpecError], None]


def raise_fault(fault: SpecError) -> None:
    """Raise the error: the default of every pass."""
    raise fault


def check_blobs(wanted: Iterable[str], known: Iterable[str], file: str) -> None:
    """Raise SpecError for the first of the blobs that a net, read from ``file``, does not have."""
    blobs = list(dict.fromkeys(known))
    for name in wanted:
        if name not in blobs:
            hint = did_you_mean(name, blobs) or ";"
            raise SpecError(f'no blob "{name}" in this net{hint} it has: {", ".join(blobs)}', Where(file))
