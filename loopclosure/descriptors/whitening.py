"""PCA whitening of descriptors, so that directions with a large variance do not dominate the similarity.

From Jegou and Chum, "Negative evidences and co-occurences in image retrieval: the benefit of PCA and whitening" (ECCV
2012): center the descriptors, project them on their strongest principal directions, scale these to equal variance, and
normalize to length 1. It is learned from images of other places.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loopclosure.errors import InputError

COMPONENTS = 512


@dataclass(frozen=True)
class Whitening:
    """A whitening transform; call it with descriptors.

    mean        (D,) float32, mean of the training descriptors
    projection  (D, K) float32: the principal directions, strongest first, divided by their standard deviation ** power
    images      number of training descriptors
    power       1 makes the variances of the K directions equal, 0 leaves them as they are
    source      the file of the training descriptors, for notes and errors
    """

    mean: np.ndarray
    projection: np.ndarray
    images: int
    power: float
    source: str = ""

    def __str__(self) -> str:
        size = f"{self.images} images, {self.projection.shape[1]} components, power {self.power:g}"
        return f"whitened by {self.source or 'other descriptors'}: {size}"

    def check(self, descriptors: np.ndarray) -> None:
        """Raise InputError if descriptors (N, D) have another D than the training descriptors."""
        if descriptors.shape[1] != len(self.mean):
            raise InputError(
                f"has descriptors of {len(self.mean)} dimensions, those to be whitened have {descriptors.shape[1]}; "
                "both must come from the same net",
                self.source,
            )

    def project(self, descriptors: np.ndarray) -> np.ndarray:
        """Whiten descriptors (N, D) without normalizing them: (N, K) float32."""
        self.check(descriptors)
        return (descriptors.astype(np.float32) - self.mean) @ self.projection

    def __call__(self, descriptors: np.ndarray) -> np.ndarray:
        """Whiten descriptors (N, D) and normalize them to length 1: (N, K) float32; zero for the mean itself."""
        rows = self.project(descriptors)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        return np.divide(rows, lengths, out=np.zeros_like(rows), where=lengths > 0)

    def of_views(self, descriptors: np.ndarray, views: int) -> np.ndarray:
        """Whiten each view of descriptors (N, views D): (N, views K)."""
        return np.hstack([self(view) for view in np.split(descriptors, views, axis=1)])


def learn_whitening(
    descriptors: np.ndarray, components: int = COMPONENTS, power: float = 1.0, source: str = ""
) -> Whitening:
    """Learn a whitening from descriptors (N, D) of other images, N >= 2.

    At most ``components`` directions are kept, and no more than the rank of the centered descriptors, which is at most
    min(N - 1, D). Raises InputError, naming ``source``, for unusable descriptors and for settings out of range.
    """
    if components < 1:
        raise InputError(f"components is {components}; expected 1 or more")
    if not 0 <= power <= 1:
        raise InputError(f"power is {power:g}; expected 0 (variances as they are) to 1 (all equal)")
    if len(descriptors) < 2:
        raise InputError(f"has {len(descriptors)} descriptors; a whitening is learned from at least 2", source)
    if not np.all(np.isfinite(descriptors)):
        raise InputError("has a descriptor with a NaN or an infinity; did the net diverge?", source)
    values = descriptors.astype(np.float64)
    mean = values.mean(axis=0)
    _, singular, directions = np.linalg.svd(values - mean, full_matrices=False)
    # Below this floor, a direction is only float32 rounding, and dividing by it would amplify the rounding. The floor
    # is relative to the descriptors, not to their differences, because their mean is rounded too.
    floor = np.finfo(np.float32).eps * np.linalg.norm(values)
    kept = min(components, len(values) - 1, int(np.count_nonzero(singular > floor)))
    if not kept:
        raise InputError(
            f"has {len(values)} descriptors that are all the same; nothing can be learned from them", source
        )
    deviations = singular[:kept] / np.sqrt(len(values) - 1)
    projection = directions[:kept].T / deviations**power
    return Whitening(mean.astype(np.float32), projection.astype(np.float32), len(values), power, source)
