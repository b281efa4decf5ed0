"""The implementation of :class:`netspec.graph.speed.Speed`.

Its methods import what they need. So a command whose net is run by another engine does not load torch.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from netspec.data.sources import AtOnce
    from netspec.fast.prepared import Prepared
    from netspec.fast.training import TrainingStep
    from netspec.layers.contract.base import Layer
    from netspec.run.eager import Eager


@dataclass(frozen=True)
class Fast:
    """Gives nets the runners and kernels of this package."""

    def prepared(self, eager: Eager, passes: Collection[str]) -> Prepared:
        """Return the runner for passes without gradients."""
        from netspec.fast.prepared import Prepared

        return Prepared(eager.plan, eager.layers, eager.losses, eager.exact, passes)

    def trainer(self, eager: Eager) -> TrainingStep | str:
        """Return the prepared training step of a net, or the reason why it has none."""
        from netspec.fast.training import TrainingStep, obstacle
        from netspec.run.walk import weighted_sum

        parts = eager.parts()
        if why := obstacle(eager.plan, parts):
            return why
        weighted = partial(weighted_sum, exact=eager.exact)
        return TrainingStep(eager.plan, parts, eager.losses, eager.overwritten, weighted)

    def reads_at_once(self, decode: Callable[[Any], np.ndarray]) -> AtOnce:
        """Return a function that reads many raw Datums at once; ``decode`` returns the numbers of one."""
        from netspec.fast.stacked import Stacker

        return Stacker(decode)

    def is_fresh(self, layer: Layer) -> bool:
        """Return whether the top of a prepared layer has memory of its own, not that of a bottom."""
        from netspec.fast.table import is_fresh

        return is_fresh(layer)
