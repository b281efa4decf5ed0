"""Descriptors from the user's own function, for example a pre-trained net: ``describe`` on the command line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from loopclosure.descriptors.similarity import METRICS, check_metric
from loopclosure.detector.describers import load_describe
from loopclosure.errors import InputError
from loopclosure.methods.base import Images, Method, MethodContext, MethodResult, compared
from loopclosure.methods.settings import configure
from loopclosure.places.frames import read_bgr
from loopclosure.progress import Progress, timed


@dataclass
class DescribedMethod:
    """Descriptors by ``MODULE|FILE.py:FUNCTION``, which maps an image (H, W, 3) BGR to (D,), compared by one metric."""

    function: str
    metric: str = METRICS[0]

    @property
    def name(self) -> str:
        """The function, and the metric."""
        return f"{self.function} ({self.metric})"

    def score(self, images: Images, progress: Progress) -> MethodResult:
        """Score as :class:`loopclosure.methods.base.Method` says."""
        seconds: dict[str, float] = {}
        with timed(seconds, "loading"):
            describe = load_describe(self.function, {})
        rows: list[np.ndarray] = []
        for path in progress(images.tested, "descriptors", len(images.tested)):
            with timed(seconds, "descriptors"):
                rows.append(np.asarray(describe(read_bgr(path)), np.float32).reshape(-1))
            if len(rows[-1]) != len(rows[0]):
                raise InputError(f"{self.function} gave {len(rows[-1])} numbers, and {len(rows[0])} before", path)
        result = compared(rows, images, self.metric, seconds, getattr(describe, "views", 1))
        return replace(result, training_stages=("loading",))


def described(settings: Mapping[str, str], context: MethodContext, inner: Method | None) -> DescribedMethod:
    """Build ``describe:NAME|MODULE:FUNCTION|FILE.py:FUNCTION``; ``metric``: euclidean or cosine."""
    (method,) = configure("describe", settings, DescribedMethod(""))
    function = method.function
    if not re.fullmatch(r"[\w-]+|.+:\w+", function):
        raise InputError(f'"describe:{function}": expected describe:NAME, describe:FILE.py:FUNCTION or MODULE:FUNCTION')
    check_metric(method.metric)
    return method
