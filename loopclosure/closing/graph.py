"""A pose graph, and its solution by SciPy's least_squares with a loss that gives up on false loops.

An edge i -> j measures the pose Z of j in the frame of i. Its error is that of g2o: the translation of Z^-1 T_i^-1 T_j,
and its rotation as a vector in radians, weighted by an information matrix (6, 6).

False loops: the loss of an edge with squared error s is that of Geman and McClure, s / (1 + s / c), which is nearly s
for a small error and never more than c. To start far from the solution, c is large at first, at least as large as the
greatest error, and then made smaller (graduated non-convexity: Yang, Antonante, Tzoumas, Carlone, RA-L 2020). Odometry
edges keep the square.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, sparse
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

# A true edge of six numbers is below this in 99 of 100 cases (chi-squared).
ACCEPTED_SQUARE = 16.8
WIDEST, NARROWER = 1000.0, 10.0  # the loss at first, in units of that square; and from one stage to the next
STEPS_PER_STAGE = 20


@dataclass(frozen=True)
class Edge:
    """Node ``first`` -> ``second``: the pose (7,) of the second in the first, and its information (6, 6)."""

    first: int
    second: int
    pose: Array
    information: Array


@dataclass(frozen=True)
class Solution:
    """Poses (N, 7) of all nodes, and the squared error (L,) of each loop edge there."""

    poses: Array
    squares: Array

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Which loop edges (L,) agree with the rest of the graph."""
        return self.squares <= ACCEPTED_SQUARE


def solve(poses: Array, odometry: Sequence[Edge], loops: Sequence[Edge]) -> Solution:
    """Find the poses (N, 7) that agree best with all edges; the first stays where it is.

    ``poses`` are those to start from. Some of the loops may be false.
    """
    graph = _Graph(poses, [*odometry, *loops])
    x = np.zeros(6 * (len(poses) - 1))
    solver: Any = optimize.least_squares  # its stubs know no function for jac and loss
    worst = np.square(graph.errors(x).reshape(-1, 6)).sum(axis=1)[len(odometry) :].max(initial=0)
    factor = max(WIDEST, float(worst) / ACCEPTED_SQUARE) if loops else 0.0
    while factor:
        loss = _loss(6 * len(odometry), factor * ACCEPTED_SQUARE)
        x = solver(
            graph.errors,
            x,
            graph.derivatives,
            loss=loss,
            x_scale="jac",
            tr_solver="lsmr",
            tr_options={"maxiter": 3000, "atol": 1e-8, "btol": 1e-8},
            max_nfev=STEPS_PER_STAGE,
        ).x
        factor = max(1.0, factor / NARROWER) if factor > 1 else 0.0
    squares = np.square(graph.errors(x).reshape(-1, 6)).sum(axis=1)[len(odometry) :]
    positions, turns, _ = graph.state(x)
    return Solution(np.hstack([positions, turns.as_quat(canonical=True)]), squares)


def _loss(odometry: int, most: float) -> Callable[[Array], Array]:
    """Return the loss for ``least_squares``: squares of the first numbers, Geman and McClure's of each six others."""

    def loss(z: Array) -> Array:
        squares = z[odometry:].reshape(-1, 6).sum(axis=1)
        share = 1 / (1 + squares / most)
        rho = np.stack([z, np.ones_like(z), np.zeros_like(z)])
        rho[0, odometry:] = np.repeat(squares * share / 6, 6)
        rho[1, odometry:] = np.repeat(share**2, 6)
        return rho

    return loss


class _Graph:
    """Errors of all edges and their derivatives; unknown: a step and a turn in the world of all nodes but the first."""

    def __init__(self, poses: Array, edges: Sequence[Edge]) -> None:
        self._positions, self._turns = poses[:, :3], Rotation.from_quat(poses[:, 3:])
        self._first = np.array([edge.first for edge in edges], int)
        self._second = np.array([edge.second for edge in edges], int)
        measured = np.array([edge.pose for edge in edges]).reshape(-1, 7)
        self._steps, self._rotations = measured[:, :3], Rotation.from_quat(measured[:, 3:])
        self._roots = np.stack([_root(edge.information) for edge in edges])
        rows, columns = 6 * np.arange(len(edges)), 6 * (np.stack([self._first, self._second]) - 1)
        self._kept = columns >= 0
        six = np.arange(6)
        block_rows = np.broadcast_to(rows[:, None, None] + six[:, None], (2, len(edges), 6, 6))
        block_columns = np.broadcast_to(columns[..., None, None] + six, (2, len(edges), 6, 6))
        self._places = block_rows[self._kept].ravel(), block_columns[self._kept].ravel()
        self._shape = 6 * len(edges), 6 * (len(poses) - 1)

    def state(self, x: Array) -> tuple[Array, Rotation, Array]:
        """Return positions (N, 3), rotations (N) and the turns (N, 3) that made them."""
        change = np.vstack([np.zeros((1, 6)), x.reshape(-1, 6)])
        return self._positions + change[:, :3], Rotation.from_rotvec(change[:, 3:]) * self._turns, change[:, 3:]

    def errors(self, x: Array) -> Array:
        """Return the weighted errors (6 E,)."""
        positions, turns, _ = self.state(x)
        step, turned = self._unweighted(positions, turns)
        return np.einsum("eij,ej->ei", self._roots, np.hstack([step, turned.as_rotvec()])).ravel()

    def derivatives(self, x: Array) -> sparse.csr_matrix:
        """Return their derivatives (6 E, 6 (N - 1))."""
        positions, turns, change = self.state(x)
        i, j = self._first, self._second
        to_world = turns.as_matrix()
        world_to_edge = (to_world[i] @ self._rotations.as_matrix()).transpose(0, 2, 1)
        left = np.linalg.inv(_inverse_left(change))  # a change of the turn's vector -> a turn in the world
        turned = self._unweighted(positions, turns)[1].as_rotvec()
        turning = _inverse_left(-turned) @ to_world[j].transpose(0, 2, 1)
        lever = world_to_edge @ _cross(positions[j] - positions[i])
        zero = np.zeros_like(lever)
        of_first = np.block([[-world_to_edge, lever @ left[i]], [zero, -turning @ left[i]]])
        of_second = np.block([[world_to_edge, zero], [zero, turning @ left[j]]])
        blocks = self._roots @ np.stack([of_first, of_second])
        return sparse.csr_matrix((blocks[self._kept].ravel(), self._places), self._shape)

    def _unweighted(self, positions: Array, turns: Rotation) -> tuple[Array, Rotation]:
        i, j = self._first, self._second
        quaternions = turns.as_quat()
        back, there = Rotation.from_quat(quaternions[i]).inv(), Rotation.from_quat(quaternions[j])
        step = self._rotations.inv().apply(back.apply(positions[j] - positions[i]) - self._steps)
        return step, self._rotations.inv() * back * there


def _root(information: Array) -> Array:
    """Return W with W^T W = information; a direction without information has weight 0."""
    values, vectors = np.linalg.eigh(information)
    return np.sqrt(np.maximum(values, 0))[:, None] * vectors.T


def _cross(vectors: Array) -> Array:
    """Return the matrices (N, 3, 3) of the cross product with vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def _inverse_left(turns: Array) -> Array:
    """Return the inverse left Jacobians (N, 3, 3) of SO(3) at rotation vectors (N, 3), shorter than 2 pi.

    Barfoot, State Estimation for Robotics, section 7.1.
    """
    angles = np.linalg.norm(turns, axis=1)
    cross = _cross(turns)
    safe = np.where(angles < 1e-3, 1.0, angles)
    factor = np.where(angles < 1e-3, 1 / 12, 1 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)))
    return np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross)
