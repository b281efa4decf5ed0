"""Solves a pose graph that grows: each solution starts from the factors of the one before (ISAM2, by GTSAM).

Kaess, Johannsson, Roberts, Ila, Leonard, Dellaert, IJRR 2012. The loops have the loss of ``graph.solve``, and also here
it is wide at first and then reduced, but only for the new loops and the last ones that are not used: other loops keep
the narrow loss. So a new loop is used even if the path has drifted far, and is ignored if it contradicts the others.
A loop that is not used for long is taken out, until it agrees with the path again.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from loopclosure.closing.graph import NARROWER, Array, Edge, Solution, limits_of, roots_of, squares_of

FIRST_SIGMA, NEXT_SIGMA = 1e-4, 1e3  # meters and radians: the first node does not move; a later drive starts anywhere
RELINEARIZED = 0.01  # meters and radians: a node that moves farther gets new derivatives
AGAIN = 20  # so many of the last loops are tried again if they are not used: together, loops may overrule the odometry
MOST_UPDATES, SETTLED = 20, 1e-3  # updates of one solution; it ends when no position moves farther, in meters


def installed() -> bool:
    """Return whether GTSAM is installed."""
    return find_spec("gtsam") is not None


class IncrementalSolver:
    """Solves a graph again and again as nodes and edges are appended to it."""

    def __init__(self) -> None:
        self._gtsam: Any = import_module("gtsam")  # optional, and without types
        self._begin()

    def _begin(self) -> None:
        parameters = self._gtsam.ISAM2Params()
        parameters.relinearizeSkip = 1
        parameters.setRelinearizeThreshold(RELINEARIZED)
        parameters.setFactorization("QR")  # directions with hardly any information are no error
        self._isam = self._gtsam.ISAM2(parameters)
        self._nodes = self._steps = 0
        # Of the loops so far: limits, places of their factors in ISAM2 (-1: taken out), and whether they are used.
        self._limits, self._places, self._used = np.zeros(0), np.zeros(0, int), np.zeros(0, bool)

    def solve(self, poses: Array, odometry: Sequence[Edge], loops: Sequence[Edge]) -> Solution:
        """Find the poses as ``graph.solve`` does; nodes and edges of earlier calls come first, in the same order.

        ``poses`` (N, 7) are the start of new nodes. If GTSAM fails, the next call begins again with all edges.
        """
        try:
            found = self._updated(poses, odometry, loops)
        except Exception:
            self._begin()
            raise
        squares = squares_of(found, [*odometry, *loops])
        solution = Solution(found, squares[: len(odometry)], squares[len(odometry) :], self._limits)
        self._used = solution.accepted
        return solution

    def _updated(self, poses: Array, odometry: Sequence[Edge], loops: Sequence[Edge]) -> Array:
        gtsam, added = self._gtsam, self._gtsam.NonlinearFactorGraph()
        values = gtsam.Values()
        steps, new = odometry[self._steps :], loops[len(self._limits) :]
        joined = {step.second for step in steps}
        for node in range(self._nodes, len(poses)):
            values.insert(node, self._pose(poses[node]))
            if node not in joined:
                free = gtsam.noiseModel.Isotropic.Sigma(6, NEXT_SIGMA if node else FIRST_SIGMA)
                added.add(gtsam.PriorFactorPose3(node, self._pose(poses[node]), free))
        for step, root in zip(steps, roots_of(steps), strict=True):
            added.add(self._factor(step, root))
        self._nodes, self._steps = len(poses), len(odometry)
        self._limits = np.append(self._limits, limits_of(new))
        late, inside = np.arange(len(self._places)) >= len(self._places) - AGAIN, self._places >= 0
        # Factors of false loops join distant nodes and make each update slow, so old ones are taken out.
        old, retried = inside & ~self._used & ~late, np.where(late, ~self._used, self._used & ~inside)
        removed = self._places[inside & (old | retried)]
        self._places[old] = -1
        tried = np.append(np.flatnonzero(retried), np.arange(len(self._places), len(loops)))
        edges, limits = [loops[k] for k in tried.tolist()], self._limits[tried]
        roots = roots_of(edges)
        self._places = np.append(self._places, np.zeros(len(new), int))
        path, factors = poses, np.maximum(1, squares_of(poses, edges) / limits)
        for _ in range(MOST_UPDATES):
            for edge, root, most in zip(edges, roots, factors * limits, strict=True):
                added.add(self._factor(edge, root, most))
            indices = self._isam.update(added, values, removed.tolist()).getNewFactorsIndices()
            self._places[tried] = removed = np.array(indices[len(indices) - len(edges) :], int)
            before, path = path, self._path()
            if factors.max(initial=1) == 1 and np.abs(path - before)[:, :3].max() < SETTLED:
                break
            factors = np.maximum(1, np.minimum(factors / NARROWER, squares_of(path, edges) / limits))
            added, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        return path

    def _factor(self, edge: Edge, root: Array, most: float | None = None) -> Any:
        models = self._gtsam.noiseModel
        model = models.Gaussian.SqrtInformation(np.roll(root, 3, axis=1), False)  # GTSAM has the rotation first
        if most is not None:
            model = models.Robust.Create(models.mEstimator.GemanMcClure.Create(float(np.sqrt(most))), model)
        return self._gtsam.BetweenFactorPose3(edge.first, edge.second, self._pose(edge.pose), model)

    def _pose(self, pose: Array) -> Any:
        return self._gtsam.Pose3(self._gtsam.Rot3(Rotation.from_quat(pose[3:]).as_matrix()), pose[:3])

    def _path(self) -> Array:
        rows = self._gtsam.utilities.extractPose3(self._isam.calculateEstimate())
        turns = Rotation.from_matrix(rows[:, :9].reshape(-1, 3, 3))
        return np.hstack([rows[:, 9:], turns.as_quat(canonical=True)])
