"""The interface through which a net gets faster code. netspec/fast implements it. Results must not change.

This file imports nothing, because netspec/__init__.py imports it.
"""

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Sequence
    from typing import Any, Protocol

    class Speed(Protocol):
        """Makes faster runners for a net, of ``eager``, its runner with autograd (netspec/run/eager.py).

        netspec/fast/speed.py has more, which netspec/compat/pycaffe asks for.
        """

        def prepared(self, eager: Any, passes: Collection[str]) -> Any:
            """Return a Runner without gradients. ``passes`` are the allowed ones of netspec/graph/options.py."""
            ...

        def trainer(self, eager: Any) -> Any:
            """Return a Trainer (netspec/run/walk.py), or the reason, a string, why there is none."""
            ...

        def reads_at_once(self, decode: Callable[[Any], Any]) -> Callable[[Sequence[bytes]], Any]:
            """Return a function that reads many raw Datums together. ``decode`` returns the array (C, H, W) of one.

            See :class:`netspec.data.sources.DatabaseSource`.
            """
            ...


find: "Callable[[], Speed | None]" = lambda: None  # noqa: E731  # set by netspec/__init__.py


def speed() -> "Speed | None":
    """Return netspec/fast for ``BuildOptions.speed``; None if it is missing."""
    return find()
