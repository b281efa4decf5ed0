"""The loops of a whole drive, chosen without settings: what ``loopclosure detect`` does."""

from __future__ import annotations

import numpy as np

from loopclosure.descriptors.feature_file import Features
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.run import Recording, run_detector
from loopclosure.detector.verification import Between, GeometricCheck, Pairs
from loopclosure.errors import InputError
from loopclosure.methods.auto import PRECISION, Answer, answer
from loopclosure.methods.candidates import far_apart
from loopclosure.places.frames import gray, read_gray
from loopclosure.places.truth import Exclusion
from loopclosure.progress import Progress, silent

NOTHING = np.zeros((8, 8), np.uint8)


def whole_drive(
    detector: LoopDetector,
    recording: Recording,
    features: Features | None = None,
    precision: float = PRECISION,
    progress: Progress = silent,
    odometry: np.ndarray | None = None,
    visit: int | None = None,
) -> Answer:
    """Add every frame of a recording to a new detector, then decide with all of them in view which close loops.

    ``odometry`` are poses (frames, 7), NaN where not known; ``visit`` is that of
    :func:`loopclosure.methods.auto.answer`. The detector gets these loops, and for frames to come the
    least threshold that accepts none of this drive's others.
    """
    run_detector(detector, recording, features, progress)
    if recording.unreadable and odometry is not None:
        odometry = np.delete(odometry, recording.unreadable, axis=0)
    recording = recording.readable()
    settings, rows = detector.settings, detector.descriptors
    scores = similarity_matrix(rows, None, settings.metric, settings.views)
    numbers = np.arange(len(rows))
    exclusion = Exclusion(seconds=settings.exclude_seconds)
    allowed = np.tri(len(rows), k=-1, dtype=bool)
    allowed &= ~exclusion.excludes(numbers, numbers, detector.stamps, detector.stamps)
    check, pairs = GeometricCheck(), Pairs(lambda number: _gray_image(recording, number))
    if recording.images is None:
        for number, image, _ in progress(recording.frames(), "local features", len(recording)):
            pairs.put(check, number, check.describe(gray(image)))
    agree = Between(check, pairs, numbers.tolist(), numbers.tolist())
    far = None if odometry is None else far_apart(odometry)
    found = answer(scores, allowed, False, precision, check, agree, progress, far, detector.stamps, visit)
    single = np.where(allowed, scores, -np.inf).max(axis=1)
    others = float(np.max(single[~found.accepted], initial=-np.inf))
    above = single[found.accepted & (single > others)]
    detector.decided([result for result in found.results if result], above.min() if len(above) else None)
    return found


def _gray_image(recording: Recording, number: int) -> np.ndarray:
    """Return an image file as gray values; black where it cannot be read, since its features were there before."""
    assert recording.images is not None
    try:
        return read_gray(recording.images[number])
    except InputError:
        return NOTHING
