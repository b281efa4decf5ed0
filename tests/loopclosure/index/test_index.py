"""Each index finds what comparing with everything finds."""

import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from loopclosure.detector.detector import LoopDetector
from loopclosure.errors import InputError
from loopclosure.index.exact import ExactIndex
from loopclosure.index.index import open_index
from newest import newest

NEEDED = {"exact": "numpy", "faiss": "faiss", "places.db": "milvus_lite"}
NAMES = [
    pytest.param(name, marks=pytest.mark.skipif(find_spec(module) is None, reason=f"not installed: {module}"))
    for name, module in NEEDED.items()
]
ROUNDED = {"exact": 1e-6, "faiss": 1e-3, "places.db": 1e-6}  # FAISS keeps half precision


def directions(count: int, size: int = 32, seed: int = 0) -> np.ndarray:
    rows = np.random.default_rng(seed).standard_normal((count, size), np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def each_index(metrics: tuple[str, ...]) -> list:
    return [pytest.param((*one.values, metric), marks=one.marks) for one in NAMES for metric in metrics]


@pytest.mark.slow
@pytest.mark.parametrize("kind", each_index(("cosine", "euclidean")), ids=str)
def test_the_most_similar_are_found(kind: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    name, metric = kind
    rows, index = directions(700), open_index(name, metric)
    assert len(index) == 0
    for part in np.split(rows, [1, 256, 300, 699]):
        index.add(part)
    assert len(index) == 700
    for query in directions(10, seed=1):
        expected = rows @ query if metric == "cosine" else -np.linalg.norm(rows - query, axis=1)
        best = np.argsort(-expected)[:6]
        numbers, scores = index.search(query, 6)
        assert numbers.tolist() == best.tolist()
        np.testing.assert_allclose(scores, expected[best], atol=ROUNDED[name])
    numbers, scores = index.search(rows[5], 1000)
    assert sorted(numbers.tolist()) == list(range(700))
    assert numbers[0] == 5
    assert scores[0] == pytest.approx(1 if metric == "cosine" else 0, abs=3e-3)
    np.testing.assert_allclose(index.rows(250, 310), rows[250:310], atol=ROUNDED[name])


@pytest.mark.parametrize("name", NAMES)
def test_a_detector_finds_the_same_loops(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    lap = directions(60)
    rows = np.concatenate([lap, lap + 0.01 * directions(60, seed=1)])
    detector = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.5, index=name)
    assert [newest(detector.add_descriptor, row).match for row in rows] == [None] * 60 + list(range(60))
    np.testing.assert_allclose(detector.descriptors, rows, atol=ROUNDED[name])


@pytest.mark.slow
@pytest.mark.skipif(find_spec("faiss") is None, reason="not installed: faiss")
@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
def test_the_index_of_signs_misses_no_match(metric: str) -> None:
    """Of 20,000 rows that vary in 20 directions of 300, seen again with some noise, 1,000 are examined."""
    rng = np.random.default_rng(0)
    ways = rng.standard_normal((20, 300))
    rows = (rng.standard_normal((20_000, 20)) @ ways).astype(np.float32)
    rows /= np.linalg.norm(rows, axis=1, keepdims=True)
    index = open_index("faiss", metric)
    for part in np.split(rows, 20):
        index.add(part)
    numbers = rng.integers(0, len(rows), 100)
    again = rows[numbers] + 0.1 * directions(100, 300)
    found = np.array([index.search(row, 5)[0] for row in again])
    exact = open_index("exact", metric)
    exact.add(rows)
    expected = np.array([exact.search(row, 5)[0] for row in again])
    assert np.mean(found[:, 0] == expected[:, 0]) >= 0.99
    assert np.mean([len({*a} & {*b}) / 5 for a, b in zip(found.tolist(), expected.tolist(), strict=True)]) >= 0.99


@pytest.mark.skipif(find_spec("milvus_lite") is None, reason="not installed: milvus_lite")
def test_a_database_is_kept(tmp_path: Path) -> None:
    name = str(tmp_path / "places.db")
    open_index(name, "cosine").add(directions(20))
    again = open_index(name, "cosine")
    assert len(again) == 20
    assert again.search(directions(20)[7], 1)[0].tolist() == [7]


@pytest.mark.skipif(find_spec("pymilvus") is None, reason="not installed: pymilvus")
def test_a_missing_server_is_reported_in_one_line() -> None:
    with pytest.raises(InputError, match=r"^http://127.0.0.1:9: Milvus: .*server unavailable"):
        open_index("http://127.0.0.1:9", "cosine")


def test_unknown_and_missing_indexes_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r'no index "hnsw"; expected exact, faiss, or Milvus: FILE.db'):
        open_index("hnsw", "cosine")
    monkeypatch.setattr("loopclosure.index.index.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"faiss is not installed; pip install netspec-caffe\[faiss\]"):
        open_index("faiss", "cosine")
    with pytest.raises(InputError, match=r"pymilvus is not installed; pip install netspec-caffe\[milvus\]"):
        open_index("places.db", "cosine")


@pytest.mark.parametrize("in_memory", [None, 1, 300])
@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
def test_of_equal_descriptors_the_earliest_come_first(metric: str, in_memory: int | None) -> None:
    index = open_index("exact", metric, in_memory=in_memory)
    index.add(np.tile(directions(1, 8), (1000, 1)))
    assert index.search(directions(1, 8)[0], 5)[0].tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("far", [0, 10, 1000])
def test_the_nearest_of_descriptors_far_from_the_origin(far: float) -> None:
    rng = np.random.default_rng(1)
    rows = (far + rng.normal(0, 0.01, (500, 256))).astype(np.float32)
    index = open_index("exact", "euclidean")
    index.add(rows)
    for row in rows[:50]:
        query = row + rng.normal(0, 0.002, 256).astype(np.float32)
        distances = np.linalg.norm(rows.astype(np.float64) - query, axis=1)
        assert index.search(query, 3)[0].tolist() == np.argsort(distances)[:3].tolist()


@pytest.mark.parametrize("metric", ["cosine", "euclidean"])
def test_descriptors_on_disk_are_found_as_those_in_memory(metric: str) -> None:
    rows = directions(2000)
    in_memory, on_disk = open_index("exact", metric), open_index("exact", metric, in_memory=300)
    for part in np.split(rows, [1, 255, 256, 700, 1999]):
        in_memory.add(part)
        on_disk.add(part)
    for query in directions(20, seed=1):
        for found, expected in zip(on_disk.search(query, 5), in_memory.search(query, 5), strict=True):
            np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(on_disk.rows(100, 1900), rows[100:1900])
    np.testing.assert_array_equal(on_disk.rows(1999, 2000), rows[1999:])


def test_descriptors_on_disk_need_one_open_file() -> None:
    index, rng = ExactIndex("euclidean", in_memory=100), np.random.default_rng(0)
    rows = rng.standard_normal((2000, 8)).astype(np.float32)
    counts = []
    for row in rows:
        index.add(row[None])
        counts.append(len(os.listdir("/proc/self/fd")))
    assert max(counts[500:]) - min(counts[500:]) <= 1
    np.testing.assert_array_equal(index.rows(100, 1950), rows[100:1950])
    assert index.search(rows[3], 1)[0].tolist() == [3]
