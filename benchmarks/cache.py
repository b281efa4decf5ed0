"""Descriptors and verified pairs of images, computed once and stored in a file."""

from __future__ import annotations

import hashlib
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure.detector.describers import load_describe
from loopclosure.detector.verification import Agreement, Pairs
from loopclosure.places.frames import read_bgr, read_gray
from netspec.files.whole_file import whole_file
from netspec.inspect.features import shipped


@dataclass
class Cache:
    """What a file has of a drive or a data set; :meth:`save` writes it again."""

    path: Path
    rows: dict[tuple[str, Path], np.ndarray] = field(default_factory=dict)  # by the net and the image
    agreements: dict[Any, Agreement] = field(default_factory=dict)
    describe: Callable[[np.ndarray], np.ndarray] | None = None

    def __post_init__(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if self.path.exists():  # pickle is safe here: save() wrote the file
            self.rows, self.agreements = pickle.loads(self.path.read_bytes())
        self.pairs = Pairs(read_gray, _found=self.agreements)
        net = shipped.folder(shipped.DEFAULT)
        weights = (net / f"{net.name}.caffemodel").read_bytes()
        self.net = hashlib.sha256((net / "deploy.prototxt").read_bytes() + weights).hexdigest()

    def descriptors(self, images: Sequence[Path]) -> np.ndarray:
        """Return the descriptors (N, D) of images by the net that comes with the package."""
        for image in images:
            if (self.net, image) not in self.rows:
                self.describe = self.describe or load_describe("default")
                self.rows[self.net, image] = np.asarray(self.describe(read_bgr(image)), np.float32).reshape(-1)
        return np.array([self.rows[self.net, image] for image in images])

    def save(self) -> None:
        """Write the file."""
        with whole_file(self.path) as unfinished:
            unfinished.write_bytes(pickle.dumps((self.rows, self.agreements)))
