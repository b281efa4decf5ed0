"""The linear part of a pose graph: a least-squares step, and the order of nodes in which it costs little.

SciPy factors the normal equations (SuperLU). Where GTSAM is installed, it does so (multifrontal Cholesky): the same
step in about two thirds of the time.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]

DAMPING = 1e-12  # of the diagonal: only a guard against directions that no edge constrains


def least_squares_step(derivatives: sparse.csr_matrix, errors: Array, gtsam: bool | None = None) -> Array:
    """Return the x (6 U,) with the least \\|derivatives x + errors\\|; rows (6 E) in blocks of six, one to an edge.

    ``gtsam``: whether GTSAM factors; None: where it is installed. Steps along directions that no edge constrains are 0.
    """
    if find_spec("gtsam") is not None if gtsam is None else gtsam:
        try:
            return _by_gtsam(derivatives, errors)
        except RuntimeError:  # indeterminate: some direction of some node has no information
            pass
    normal = (derivatives.T @ derivatives).tocsc()
    guarded = normal + sparse.diags(DAMPING * normal.diagonal() + DAMPING)
    options = {"SymmetricMode": True}
    # The unknowns are in a good order already; narrow panels suit blocks of six.
    factored = splu(guarded.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0, relax=1, panel_size=8, options=options)
    return factored.solve(-(derivatives.T @ errors))


def _by_gtsam(derivatives: sparse.csr_matrix, errors: Array) -> Array:
    gtsam = import_module("gtsam")  # optional, and without types

    blocks, shape = derivatives.tobsr((6, 6)), derivatives.shape
    assert shape is not None  # SciPy's types leave that open
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
    """Return the place (N,) of each node in an order that fills in little: minimum degree, one number to a node."""
    if not nodes:
        return np.zeros(0, int)
    ends = sparse.coo_matrix((np.ones(len(first)), (first, second)), (nodes, nodes))
    joined = (ends + ends.T).tocsr()
    # Diagonally dominant, so that any order can be factored.
    dominant = sparse.diags(np.asarray(joined.sum(axis=1)).ravel() + 1) - joined
    options = {"SymmetricMode": True}
    return np.asarray(splu(dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0, options=options).perm_c)
