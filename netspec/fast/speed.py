"""What a net is given to run faster."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import partial

from netspec.fast.prepared import Prepared
from netspec.fast.training import LARGEST, TrainingStep, obstacle
from netspec.run.eager import Eager
from netspec.run.walk import weighted_sum


@dataclass(frozen=True)
class Fast:
    """The speed of this folder (:class:`netspec.run.speed.Speed`)."""

    def prepared(self, eager: Eager, passes: Collection[str]) -> Prepared:
        """Return the runner of passes without gradients."""
        return Prepared(eager.plan, eager.layers, eager.loss_weights, eager.exact, passes)

    def trainer(self, eager: Eager, largest: float | None) -> TrainingStep | str:
        """Return the prepared kernels that train a net, or the reason why it has none."""
        parts = eager.parts()
        if why := obstacle(eager.plan, parts, LARGEST if largest is None else largest):
            return why
        weighted = partial(weighted_sum, exact=eager.exact)
        return TrainingStep(eager.plan, parts, eager.loss_weights, eager.overwritten, weighted)
