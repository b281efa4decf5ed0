"""The passes between a parsed net and a runnable one: NetParameter in, NetParameter or Plan out; nothing is mutated.

Each pass takes ``report``, which is called with every fault. By default the first one is raised; a caller that passes
a collecting function gets them all, and a result in which the faulty parts are left as they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from netspec.errors import SpecError, Where, did_you_mean

Report = Callable[[SpecError], None]


def raise_fault(fault: SpecError) -> None:
    """Raise the fault: the default of every pass."""
    raise fault


def check_blobs(wanted: Iterable[str], known: Iterable[str], file: str) -> None:
    """Raise SpecError for the first wanted blob that a net, read from ``file``, does not have."""
    blobs = list(dict.fromkeys(known))
    for name in wanted:
        if name not in blobs:
            hint = did_you_mean(name, blobs) or ";"
            raise SpecError(f'no blob "{name}" in this net{hint} it has: {", ".join(blobs)}', Where(file))
