"""A net as the ``describe`` callable of a loop-closure detector, from an image to its descriptor."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from netspec.export.engines.choice import Choice
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.inspect.features.images import ImageInput, ImageNet
from netspec.inspect.features.scaling import Steps, read_zooms
from netspec.proto.binary import split_paths


class Describer:
    """A callable that returns the blob ``blob`` of a net for an image, which is its blob ``input``.

    The net is the part of the prototxt ``model`` in phase TEST that computes the blob. ``weights`` are one file, or
    several separated by commas. The pixels are scaled by the data layer's transform_param or, if any of
    these is given, by ``swap``, ``raw_scale``, ``mean`` and ``scale``, in this order
    (:class:`netspec.inspect.features.scaling.Steps`), which can be texts, as on the command line.
    ``zooms``, such as "1,0.7", describes several views of each image; ``views`` is their number. ``engine`` and
    ``precision`` choose what runs the net (docs/engines.md), and ``cache`` the folder for its model. Raises SpecError
    for errors in the files.

        >>> describe = Describer("deploy.prototxt", "x.caffemodel", blob="feat")
        >>> describe(numpy.zeros((48, 64, 3), numpy.uint8)).shape
        (4,)
    """

    def __init__(
        self,
        model: str | Path,
        weights: str | Path,
        blob: str = "feat",
        input: str = "data",
        device: str = "cpu",
        zooms: str | float = "1",
        mean: str | float | Sequence[float] | np.ndarray | None = None,
        scale: str | float = 1.0,
        raw_scale: str | float = 1.0,
        swap: str | bool = False,
        engine: str = "torch",
        precision: str = "fp32",
        cache: str | Path | None = None,
    ) -> None:
        steps = Steps.of(mean, scale, raw_scale, swap)
        choice = Choice.of(engine, precision, cache)
        views = read_zooms(zooms)
        self.image_net = ImageNet(
            model,
            split_paths(weights),
            blob,
            ImageInput(input, zooms=views, steps=steps),
            choice,
            BuildOptions(str(device), speed=speed()),
        )
        self.views = len(self.image_net.zooms)

    @property
    def engine(self) -> str:
        """The engine that runs the net: the chosen one, or torch if that one cannot."""
        return self.image_net.engine

    @property
    def fingerprint(self) -> str:
        """16 hexadecimal digits that identify the net, its weights and its scaling, but not the engine."""
        return self.image_net.fingerprint

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Return the descriptor (views D,) float32 of an image (H, W, 3) or (H, W), uint8, BGR, of any size."""
        return self.image_net([image])[0]
