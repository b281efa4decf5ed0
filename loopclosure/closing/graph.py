"""Solves a pose graph by least squares with a robust loss that ignores false loops.

An edge i -> j measures the pose Z of j in the frame of i. Its error is defined as in g2o: the translation of
Z^-1 T_i^-1 T_j, and its rotation as a vector in radians, weighted by an information matrix (6, 6).

The solver is Gauss-Newton with a line search: a step is halved until the loss decreases. Levenberg-Marquardt damping
needs more steps, because it slows down the long, weak bends of a path most, and these are what loops correct. SciPy
factors the normal equations (SuperLU). If GTSAM is installed, it does (multifrontal Cholesky), in about two thirds of
the time.

A loop edge with squared error s has the Geman-McClure loss s / (1 + s / c), which is nearly s for a small error and
never more than c. To allow a start far from the solution, c is at least the largest error at first and is then reduced
(graduated non-convexity: Yang, Antonante, Tzoumas, Carlone, RA-L 2020). Odometry edges have the squared loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation
from scipy.special import gammaincinv  # scipy.stats, which has chi2, takes a quarter of a second to import

Array = NDArray[np.float64]

TRUE_BELOW = 0.99  # probability that the squared error of a true loop is below its limit (chi-squared)
LEAST_KNOWN = 1e-7  # of the largest information: below it a direction is not measured, and the rest is rounding
WIDEST, NARROWER = 1000.0, 10.0  # c at first, as a multiple of that limit, and its divisor from stage to stage
EARLY_STEPS, LAST_STEPS = 2, 50
EARLY_GAIN, LAST_GAIN = 1e-2, 1e-7  # a stage ends when a step reduces the loss by less than this share
DAMPING = 1e-12  # of the diagonal: only a guard against directions that no edge constrains
HALVES = 10  # the most lengths of a step that are tried, each half the one before


@dataclass(frozen=True)
class Edge:
    """Node ``first`` -> ``second``: the pose (7,) of the second in the first, and its information (6, 6)."""

    first: int
    second: int
    pose: Array
    information: Array


@dataclass(frozen=True)
class Solution:
    """Poses (N, 7) of all nodes, and the squared error of each edge there: (S,) odometry, (L,) loops.

    limits  (L,) the largest squared error with which a loop is accepted
    """

    poses: Array
    odometry_squares: Array
    squares: Array
    limits: Array

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """Which loop edges (L,) agree with the rest of the graph."""
        return self.squares <= self.limits


def solve(poses: Array, odometry: Sequence[Edge], loops: Sequence[Edge]) -> Solution:
    """Find the poses (N, 7) that agree best with all edges; some of the loops may be false.

    The search starts from ``poses``. In each connected part of the graph, the first node does not move.
    """
    graph = _Graph(len(poses), [*odometry, *loops])
    state = State(poses[:, :3], Rotation.from_quat(poses[:, 3:]))
    limits = limits_of(loops)

    def worst() -> float:
        return float((graph.squares(state)[len(odometry) :] / limits).max(initial=0))

    factor = max(WIDEST, worst()) if loops else 1.0
    while factor > 1:
        state = _descend(graph, state, _Loss(len(odometry), factor * limits), EARLY_STEPS, EARLY_GAIN)
        factor = min(factor / NARROWER, worst())  # directly to the last stage if no loop is false
    state = _descend(graph, state, _Loss(len(odometry), limits), LAST_STEPS, LAST_GAIN)
    squares = graph.squares(state)
    solved = np.hstack([state.positions, state.turns.as_quat(canonical=True)])
    return Solution(solved, squares[: len(odometry)], squares[len(odometry) :], limits)


def limits_of(loops: Sequence[Edge]) -> Array:
    """Return the largest squared error (L,) of a true loop; it depends on how many numbers the loop measures."""
    values = np.linalg.eigvalsh(np.array([edge.information for edge in loops]).reshape(-1, 6, 6))
    measured = (values > LEAST_KNOWN * values[:, -1:]).sum(axis=1)
    return 2 * gammaincinv(np.maximum(1, measured) / 2, TRUE_BELOW)


def squares_of(poses: Array, edges: Sequence[Edge]) -> Array:
    """Return the squared error (E,) of each edge for poses (N, 7)."""
    return _Graph(len(poses), edges, solved=False).squares(State(poses[:, :3], Rotation.from_quat(poses[:, 3:])))


class State(NamedTuple):
    """Positions (N, 3) and rotations (N) of all nodes."""

    positions: Array
    turns: Rotation


@dataclass(frozen=True)
class _Loss:
    """The squared loss for the first ``odometry`` edges; the Geman-McClure loss with c = ``most`` (L,) for loops."""

    odometry: int
    most: Array

    def __call__(self, squares: Array) -> float:
        loops = squares[self.odometry :]
        return float(squares[: self.odometry].sum() + (loops / (1 + loops / self.most)).sum())

    def weights(self, squares: Array) -> Array:
        """Return the derivative (E,) of the loss with respect to the squared error of each edge."""
        weights = np.ones(len(squares))
        weights[self.odometry :] = (1 + squares[self.odometry :] / self.most) ** -2
        return weights


def _descend(graph: _Graph, state: State, loss: _Loss, most_steps: int, least_gain: float) -> State:
    """Reduce the loss from this state by Gauss-Newton steps, each halved until the loss decreases."""
    squares = graph.squares(state)
    for _ in range(most_steps):
        before = loss(squares)
        roots = np.repeat(np.sqrt(loss.weights(squares)), 6)
        step = least_squares_step(sparse.diags(roots) @ graph.derivatives(state), roots * graph.errors(state))
        for share in 0.5 ** np.arange(HALVES):
            moved = graph.moved(state, share * step)
            squares = graph.squares(moved)
            gain = before - loss(squares)
            if gain >= 0:
                break
        else:
            return state
        state = moved
        if gain <= least_gain * before:
            break
    return state


class _Graph:
    """The errors of all edges and their derivatives. The unknowns are a translation and a rotation per free node."""

    def __init__(self, nodes: int, edges: Sequence[Edge], solved: bool = True) -> None:
        self._first = np.array([edge.first for edge in edges], int)
        self._second = np.array([edge.second for edge in edges], int)
        measured = np.array([edge.pose for edge in edges]).reshape(-1, 7)
        self._steps, self._rotations = measured[:, :3], Rotation.from_quat(measured[:, 3:])
        self._roots = roots_of(edges)
        self._place = _places(nodes, self._first, self._second) if solved else np.full(nodes, -1)
        rows, columns = 6 * np.arange(len(edges)), 6 * self._place[np.stack([self._first, self._second])]
        self._kept = columns >= 0
        six = np.arange(6)
        block_rows = np.broadcast_to(rows[:, None, None] + six[:, None], (2, len(edges), 6, 6))
        block_columns = np.broadcast_to(columns[..., None, None] + six, (2, len(edges), 6, 6))
        self._at = block_rows[self._kept].ravel(), block_columns[self._kept].ravel()
        self._shape = 6 * len(edges), 6 * int(np.count_nonzero(self._place >= 0))

    def moved(self, state: State, x: Array) -> State:
        """Return the state after the free nodes are translated and rotated by x (6 U,), in the world frame."""
        change = np.vstack([x.reshape(-1, 6), np.zeros((1, 6))])[self._place]  # place -1 of held nodes is the last row
        steps = np.linalg.solve(_inverse_left(change[:, 3:]), change[:, :3, None])[..., 0]
        return State(state.positions + steps, Rotation.from_rotvec(change[:, 3:]) * state.turns)

    def errors(self, state: State) -> Array:
        """Return the weighted errors (6 E,)."""
        step, turned = self._unweighted(state)
        return np.einsum("eij,ej->ei", self._roots, np.hstack([step, turned.as_rotvec()])).ravel()

    def squares(self, state: State) -> Array:
        """Return the squared error (E,) of each edge."""
        return np.square(self.errors(state)).reshape(-1, 6).sum(axis=1)

    def derivatives(self, state: State) -> sparse.csr_matrix:
        """Return their derivatives (6 E, 6 U) by x of :meth:`moved` at x = 0."""
        i, j = self._first, self._second
        to_world = state.turns.as_matrix()
        world_to_edge = (to_world[i] @ self._rotations.as_matrix()).transpose(0, 2, 1)
        turned = self._unweighted(state)[1].as_rotvec()
        turning = _inverse_left(-turned) @ to_world[j].transpose(0, 2, 1)
        lever = world_to_edge @ cross_matrices(state.positions[j] - state.positions[i])
        zero = np.zeros_like(lever)
        of_first = np.block([[-world_to_edge, lever], [zero, -turning]])
        of_second = np.block([[world_to_edge, zero], [zero, turning]])
        blocks = self._roots @ np.stack([of_first, of_second])
        return sparse.csr_matrix((blocks[self._kept].ravel(), self._at), self._shape)

    def _unweighted(self, state: State) -> tuple[Array, Rotation]:
        i, j = self._first, self._second
        quaternions = state.turns.as_quat()
        back, there = Rotation.from_quat(quaternions[i]).inv(), Rotation.from_quat(quaternions[j])
        step = self._rotations.inv().apply(back.apply(state.positions[j] - state.positions[i]) - self._steps)
        return step, self._rotations.inv() * back * there


def _places(nodes: int, first: NDArray[np.int_], second: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the place (N,) of each node among the unknowns, -1 for those that stay."""
    ends = sparse.coo_matrix((np.ones(len(first)), (first, second)), (nodes, nodes))
    _, part = csgraph.connected_components(ends, directed=False)
    stays = np.zeros(nodes, bool)
    stays[np.unique(part, return_index=True)[1]] = True
    place = np.full(nodes, -1)
    place[~stays] = np.arange(np.count_nonzero(~stays))
    free = (place[first] >= 0) & (place[second] >= 0)
    place[~stays] = order(int(np.count_nonzero(~stays)), place[first[free]], place[second[free]])
    return place


def roots_of(edges: Sequence[Edge]) -> Array:
    """Return W (E, 6, 6) with W^T W = information of each edge; a direction without information has weight 0."""
    values, vectors = np.linalg.eigh(np.array([edge.information for edge in edges]).reshape(-1, 6, 6))
    return np.sqrt(np.maximum(values, 0))[..., None] * vectors.transpose(0, 2, 1)


def cross_matrices(vectors: Array) -> Array:
    """Return the matrices (N, 3, 3) of the cross product with vectors (N, 3)."""
    x, y, z = vectors.T
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(-1, 3, 3)


def _inverse_left(turns: Array) -> Array:
    """Return the inverse left Jacobians (N, 3, 3) of SO(3) at rotation vectors (N, 3), shorter than 2 pi.

    Barfoot, State Estimation for Robotics, section 7.1.
    """
    angles = np.linalg.norm(turns, axis=1)
    cross = cross_matrices(turns)
    safe = np.where(angles < 1e-3, 1.0, angles)
    factor = np.where(angles < 1e-3, 1 / 12, 1 / safe**2 - 0.5 / (safe * np.tan(0.5 * safe)))
    return np.eye(3) - 0.5 * cross + factor[:, None, None] * (cross @ cross)


def least_squares_step(derivatives: sparse.csr_matrix, errors: Array, gtsam: bool | None = None) -> Array:
    """Return the x (6 U,) with the least \\|derivatives x + errors\\|; rows (6 E) in blocks of six, one to an edge.

    ``gtsam``: whether to use GTSAM; None: if it is installed. Directions that no edge constrains get steps of 0.
    """
    if find_spec("gtsam") is not None if gtsam is None else gtsam:
        try:
            return _by_gtsam(derivatives, errors)
        except RuntimeError:  # indeterminate: some direction of some node has no information
            pass
    normal = (derivatives.T @ derivatives).tocsc()
    guarded = normal + sparse.diags(DAMPING * normal.diagonal() + DAMPING)
    options = {"SymmetricMode": True}
    # The unknowns are in a good order already; narrow panels are fastest with blocks of six.
    factored = splu(guarded.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0, relax=1, panel_size=8, options=options)
    return factored.solve(-(derivatives.T @ errors))


def _by_gtsam(derivatives: sparse.csr_matrix, errors: Array) -> Array:
    gtsam = import_module("gtsam")  # optional, and without types

    blocks, shape = derivatives.tobsr((6, 6)), derivatives.shape
    assert shape is not None  # in SciPy's types it may be None
    starts, nodes, values = blocks.indptr.tolist(), blocks.indices.tolist(), np.asarray(blocks.data)
    unit = gtsam.noiseModel.Unit.Create(6)
    factors = gtsam.GaussianFactorGraph()
    for row, measured in enumerate(-errors.reshape(-1, 6)):
        at = range(starts[row], starts[row + 1])
        if at:
            factors.add(gtsam.JacobianFactor(*(part for k in at for part in (nodes[k], values[k])), measured, unit))
    found = factors.optimize(gtsam.Ordering.NaturalGaussianFactorGraph(factors))
    return np.asarray(found.vector(gtsam.KeyVector(range(shape[1] // 6))))


def order(nodes: int, first: NDArray[np.int_], second: NDArray[np.int_]) -> NDArray[np.int_]:
    """Return the place (N,) of each node in a minimum-degree order, which keeps the factor sparse."""
    if not nodes:
        return np.zeros(0, int)
    ends = sparse.coo_matrix((np.ones(len(first)), (first, second)), (nodes, nodes))
    joined = (ends + ends.T).tocsr()
    # Diagonally dominant, so that any order can be factored.
    dominant = sparse.diags(np.asarray(joined.sum(axis=1)).ravel() + 1) - joined
    options = {"SymmetricMode": True}
    return np.asarray(splu(dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options).perm_c)
