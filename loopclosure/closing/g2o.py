"""Reads, solves and writes pose graphs in g2o files, in 3D and in 2D.

Lines: ``VERTEX_SE3:QUAT id x y z qx qy qz qw``, ``EDGE_SE3:QUAT i j`` with the pose of j in the frame of i and the 21
upper entries of its information matrix; ``VERTEX_SE2 id x y theta``, ``EDGE_SE2 i j x y theta`` with 6 entries;
``FIX id``. Ids may have gaps and be in any order; ``#`` starts a comment. If a file has only edges, the vertices are
computed from them.

A 2D graph is solved as a 3D graph with all poses in a plane; errors and solution are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation

from loopclosure.closing.graph import Edge, Solution, solve, squares_of
from loopclosure.csv_file import write_csv
from loopclosure.detector.export import EDGE, EDGE_2D, PLANE, VERTEX, VERTEX_2D, write_pose_graph
from loopclosure.errors import InputError
from netspec.files.kinds import unreadable

Array = NDArray[np.float64]

# tag: (how many numbers follow it, how many of them are ids)
NUMBERS = {VERTEX: (8, 1), EDGE: (30, 2), VERTEX_2D: (4, 1), EDGE_2D: (11, 2), "FIX": (1, 1)}


@dataclass(frozen=True)
class PoseGraph:
    """A pose graph read from a file.

    ids    (N,) ids of the vertices, ascending
    poses  (N, 7) poses of the vertices
    held   indices into ids of the vertices that stay where they are (FIX)
    steps  edges between vertices with consecutive ids: odometry, which is trusted
    loops  all other edges
    flat   whether the file is a 2D graph
    """

    ids: NDArray[np.int_]
    poses: Array
    steps: list[Edge]
    loops: list[Edge]
    held: list[int]
    flat: bool


def read_pose_graph(path: Path) -> PoseGraph:
    """Read a g2o file. Raises InputError (file:line) if it is not a pose graph."""
    vertices: dict[int, Array] = {}
    edges: list[tuple[int, int, int, Array, Array]] = []  # line, ids, pose, information
    fixed: list[tuple[int, int]] = []  # line, id
    tags = set()
    try:
        with path.open(encoding="utf-8", errors="replace") as stream:
            for line, text in enumerate(stream, 1):
                words = text.partition("#")[0].split()
                if not words:
                    continue
                tag, ids, values = _entry(words, path, line)
                if tag == "FIX":
                    fixed.append((line, ids[0]))
                    continue
                tags.add(tag.endswith("SE2"))
                pose = _in_space(values[:3]) if tag.endswith("SE2") else _with_quaternion(values[:7], path, line)
                if tag in (EDGE, EDGE_2D):
                    edges.append((line, ids[0], ids[1], pose, _information(values, path, line)))
                elif ids[0] in vertices:
                    raise InputError(f"there is a vertex {ids[0]} already", path, line, 1)
                else:
                    vertices[ids[0]] = pose
    except OSError as error:
        raise InputError(unreadable(path, error, "a pose graph (g2o)"), path) from error
    if len(tags) > 1:
        raise InputError("has vertices or edges of two and of three dimensions; expected one kind", path)
    if not edges:
        raise InputError(f"has {len(vertices)} vertices and {len(edges)} edges; expected a pose graph (g2o)", path)
    ids = sorted(vertices or {end for edge in edges for end in edge[1:3]})
    rows = {number: row for row, number in enumerate(ids)}
    steps, loops = [], []
    for line, *ends, pose, information in edges:
        missing = [end for end in ends if end not in rows]
        name = f"the edge {ends[0]} {ends[1]}"
        if missing:
            raise InputError(f"{name} ends at vertex {missing[0]}, which the file does not have", path, line, 1)
        if ends[0] == ends[1]:
            raise InputError(f"{name} joins a vertex with itself", path, line, 1)
        edge = Edge(rows[ends[0]], rows[ends[1]], pose, information)
        (steps if abs(edge.first - edge.second) == 1 else loops).append(edge)
    for line, number in fixed:
        if number not in rows:
            raise InputError(f"fixes vertex {number}, which the file does not have", path, line, 1)
    poses = np.array([vertices[number] for number in ids]) if vertices else _chained(len(ids), [*steps, *loops])
    return PoseGraph(np.array(list(rows)), poses, steps, loops, [rows[number] for _, number in fixed], True in tags)


def _chained(nodes: int, edges: list[Edge]) -> Array:
    """Return poses (N, 7) by chaining edges, starting at the first node of each connected part.

    Edges with a smaller difference of ids are preferred, so odometry comes first.
    """
    joined: dict[tuple[int, int], Edge] = {}
    for edge in edges:
        joined.setdefault((min(edge.first, edge.second), max(edge.first, edge.second)), edge)
    ends = np.array(list(joined))
    gaps = sparse.csr_matrix((ends[:, 1] - ends[:, 0], tuple(ends.T)), (nodes, nodes))
    tree = csgraph.minimum_spanning_tree(gaps)
    poses, known = np.tile([0, 0, 0, 0, 0, 0, 1.0], (nodes, 1)), np.zeros(nodes, bool)
    for start in range(nodes):
        if known[start]:
            continue
        order, before = csgraph.breadth_first_order(tree, start, directed=False)
        known[order] = True
        for node, last in zip(order[1:].tolist(), before[order[1:]].tolist(), strict=True):
            edge, turn = joined[min(node, last), max(node, last)], Rotation.from_quat(poses[last, 3:])
            step, turned = edge.pose[:3], Rotation.from_quat(edge.pose[3:])
            if edge.second == last:
                turned = turned.inv()
                step = -turned.apply(step)
            poses[node] = np.concatenate([poses[last, :3] + turn.apply(step), (turn * turned).as_quat()])
    return poses


def solve_pose_graph(graph: PoseGraph, all_true: bool = False) -> Solution:
    """Find the poses that agree best with all edges; reject loops that contradict the rest, unless ``all_true``."""
    return solve(graph.poses, graph.steps, graph.loops, graph.held, graph.flat, all_true)


def write_solution(out: Path, graph: PoseGraph, solution: Solution) -> None:
    """Write closed.g2o, without the rejected loops, and loops.csv, with each loop and whether it was used."""
    out.mkdir(parents=True, exist_ok=True)
    ids, accepted = graph.ids.tolist(), solution.accepted.tolist()
    kept = [edge for edge, used in zip(graph.loops, accepted, strict=True) if used]
    edges = [(ids[edge.first], ids[edge.second], edge.pose, edge.information) for edge in [*graph.steps, *kept]]
    vertices = dict(zip(ids, solution.poses, strict=True))
    write_pose_graph(out / "closed.g2o", vertices, edges, [ids[row] for row in graph.held], graph.flat)
    rows = [
        (ids[edge.first], ids[edge.second], f"{square:.6g}", "yes" if used else "no")
        for edge, square, used in zip(graph.loops, solution.squares, accepted, strict=True)
    ]
    write_csv(out / "loops.csv", ("first", "second", "chi2", "used"), rows)


def summary(graph: PoseGraph, solution: Solution) -> list[str]:
    """Return sentences that summarize a solved graph."""
    used = int(np.count_nonzero(solution.accepted))
    kept = [edge for edge, accepted in zip(graph.loops, solution.accepted, strict=True) if accepted]
    before = squares_of(graph.poses, [*graph.steps, *kept]).sum()
    after = solution.odometry_squares.sum() + solution.squares[solution.accepted].sum()
    return [
        f"{len(graph.ids)} poses, {len(graph.steps)} edges of odometry: between vertices with consecutive ids",
        f"{used} of {len(graph.loops)} loops used, {len(graph.loops) - used} contradict the others",
        f"chi-squared {before:.6g} before, {after:.6g} after, of the edges that are used",
    ]


def _entry(words: list[str], path: Path, line: int) -> tuple[str, list[int], Array]:
    """Return the tag of a line, its ids and its other numbers."""
    tag = words[0]
    if tag not in NUMBERS:
        known = ", ".join(NUMBERS)
        raise InputError(f"found {tag:.40}; expected {known}: the vertices and edges of a pose graph", path, line, 1)
    count, ids = NUMBERS[tag]
    try:
        if len(words) - 1 != count:
            raise ValueError
        values = np.array(words[1 + ids :], float)
        if not np.all(np.isfinite(values)):
            raise ValueError
        return tag, [int(word) for word in words[1 : 1 + ids]], values
    except ValueError:
        text = f"found {len(words) - 1} words after {tag}; expected {count} numbers, the first {ids} whole"
        raise InputError(text, path, line, 1) from None


def _with_quaternion(pose: Array, path: Path, line: int) -> Array:
    """Return the pose. Raises InputError if its quaternion is 0."""
    if not np.any(pose[3:]):
        raise InputError("the quaternion is 0; expected x y z qx qy qz qw", path, line, 1)
    return pose


def _in_space(pose: Array) -> Array:
    """Return a 2D pose (x, y, theta) as a pose (7,) in 3D."""
    x, y, theta = pose
    return np.array([x, y, 0, 0, 0, np.sin(theta / 2), np.cos(theta / 2)])


def _information(values: Array, path: Path, line: int) -> Array:
    """Return the information (6, 6) of an edge; a 2D edge gets 1 for the other dimensions, where its error is 0."""
    flat = len(values) == 9
    size, pose = (3, 3) if flat else (6, 7)
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = values[pose:]
    matrix += np.triu(matrix, 1).T
    lowest, *_, highest = np.linalg.eigvalsh(matrix)
    if lowest < -1e-6 * max(highest, 1e-300):
        raise InputError(f"the information matrix has a negative eigenvalue, {lowest:.3g}", path, line, 1)
    if not flat:
        return matrix
    lifted = np.eye(6)
    lifted[np.ix_(PLANE, PLANE)] = matrix
    return lifted
