"""Reads the pose graphs that the program writes, and those of others, as far as tests need them."""

from pathlib import Path

import numpy as np

from loopclosure.closing.graph import Edge

UPPER = np.triu_indices(6)


def read_graph(path: Path) -> tuple[dict[int, np.ndarray], list[Edge]]:
    """Return the vertices, id -> pose (7,), and the edges of a g2o file."""
    lines = [line.split() for line in path.read_text().splitlines()]
    vertices = {int(words[1]): np.array(words[2:], float) for words in lines if words[0] == "VERTEX_SE3:QUAT"}
    edges = []
    for words in (words for words in lines if words[0] == "EDGE_SE3:QUAT"):
        information = np.zeros((6, 6))
        information[UPPER] = np.array(words[10:], float)
        information += np.triu(information, 1).T
        edges.append(Edge(int(words[1]), int(words[2]), np.array(words[3:10], float), information))
    return vertices, edges
