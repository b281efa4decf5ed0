"""Joins images with the odometry by their stamps, as messages of a robot come: in any order, and some of them late."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np

from loopclosure.closing.online import ANOTHER_DRIVE_S
from loopclosure.places.trajectory import GAP_S, at
from netspec import log

KEPT_POSES, KEPT_IMAGES = 1000, 30


class Synchronizer:
    """Gives each image the pose of the robot when it was taken, between two poses of the odometry.

    gap_s  no pose is taken between two that are further apart than so many seconds
    warn   gets a sentence for each image that has no pose
    """

    def __init__(self, gap_s: float = GAP_S, warn: Callable[[str], None] = log.logger.warning) -> None:
        self.gap_s, self.warn = gap_s, warn
        self._stamps: list[float] = []
        self._poses: list[np.ndarray] = []
        self._images: deque[tuple[float, Any]] = deque(maxlen=KEPT_IMAGES)

    def odometry(self, stamp: float, pose: np.ndarray) -> None:
        """Add the pose (7,) of the robot at ``stamp`` seconds. A pose that comes late is left out.

        If the time goes back, as where a recording starts again, the poses and the images before are forgotten.
        """
        if self._stamps and stamp < self._stamps[-1] - ANOTHER_DRIVE_S:
            self._stamps, self._poses = [], []
            near = [pair for pair in self._images if abs(pair[0] - stamp) < ANOTHER_DRIVE_S]
            self._images = deque(near, KEPT_IMAGES)
        if not self._stamps or stamp > self._stamps[-1]:
            self._stamps.append(stamp)
            self._poses.append(np.asarray(pose, np.float64))
        if len(self._stamps) > 2 * KEPT_POSES:
            del self._stamps[:KEPT_POSES], self._poses[:KEPT_POSES]

    def image(self, stamp: float, image: Any) -> None:
        """Add an image, of any type, that was taken at ``stamp`` seconds."""
        self._images.append((stamp, image))

    def newest(self) -> tuple[float, Any, np.ndarray] | None:
        """Return the stamp, image and pose of the newest image whose pose is known by now, and drop those before it."""
        if not self._stamps:
            return None
        ready = [pair for pair in self._images if pair[0] <= self._stamps[-1]]
        if not ready:
            return None
        self._images = deque((pair for pair in self._images if pair[0] > self._stamps[-1]), KEPT_IMAGES)
        stamp, image = ready[-1]
        known = np.array(self._stamps[-KEPT_POSES:]), np.array(self._poses[-KEPT_POSES:])
        pose = at(*known, np.array([stamp]), self.gap_s)[0]
        if np.isnan(pose).any():
            self.warn(f"the image at {stamp:.6f} has no odometry within {self.gap_s:g} s; it is left out")
            return None
        return stamp, image, pose
