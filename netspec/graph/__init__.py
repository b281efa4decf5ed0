"""The passes between a parsed net and a runnable one: NetParameter in, NetParameter or Plan out; nothing is mutated.

Each pass takes ``report``, which is called with every fault. By default the first one is raised; a caller that passes
a collecting function gets them all, and a result in which the faulty parts are left as they are.
"""

from __future__ import annotations

from collections.abc import Callable

from netspec.errors import SpecError

Report = Callable[[SpecError], None]


def raise_fault(fault: SpecError) -> None:
    """Raise the fault: the default of every pass."""
    raise fault
