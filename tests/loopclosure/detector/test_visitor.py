"""Sessions: of the detector itself, and of visitors, which leave it as it is."""

from typing import Any

import numpy as np
import pytest

from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.detector.visitor import Visitor
from loopclosure.errors import InputError

LAP = np.random.default_rng(0).normal(size=(40, 16)).astype(np.float32)


def near(rows: np.ndarray, seed: int) -> np.ndarray:
    return rows + 0.02 * np.random.default_rng(seed).normal(size=rows.shape).astype(np.float32)


def filled(**settings: Any) -> LoopDetector:
    detector = LoopDetector(threshold=-0.5, **settings)
    for i, row in enumerate(LAP):
        detector.add_descriptor(row, float(i))
    return detector


@pytest.mark.parametrize("views", [1, 2])
def test_a_visitor_finds_every_frame_and_adds_none(views: int, tmp_path) -> None:
    detector = filled(exclude_recent=30, views=views)
    detector.save(tmp_path / "before.npz")
    visitors = [Visitor(detector), Visitor(detector)]
    for i, row in enumerate(near(LAP, 1)):
        for visitor in visitors:
            result = visitor.add_descriptor(row, float(i))
            assert (result.query_id, result.accepted) == (i, i)
    assert len(detector) == 40
    detector.save(tmp_path / "after.npz")
    assert (tmp_path / "after.npz").read_bytes() == (tmp_path / "before.npz").read_bytes()


def test_consistency_is_that_of_each_visitor() -> None:
    detector = filled(exclude_recent=5, consistency=2)
    one, other = Visitor(detector), Visitor(detector)
    verdicts = [one.add_descriptor(row).verdict for row in near(LAP[:4], 1)]
    assert verdicts == ["not consistent", "not consistent", "accepted", "accepted"]
    assert other.add_descriptor(LAP[4]).verdict == "not consistent"


def test_in_a_new_session_no_earlier_frame_is_recent(tmp_path) -> None:
    first = filled(exclude_recent=30, exclude_seconds=5)
    first.begin_session()
    first.save(tmp_path / "first.npz")
    for detector in (first, LoopDetector.load(tmp_path / "first.npz")):
        found = [detector.add_descriptor(row, float(i)).accepted for i, row in enumerate(near(LAP[20:], 1))]
        assert found == list(range(20, 40))
        found = [detector.add_descriptor(row, 100.0 + i).accepted for i, row in enumerate(near(LAP[:20], 2))]
        assert found == list(range(20))
    assert len(first) == 80
    detector.save(tmp_path / "second.npz")
    again = LoopDetector.load(tmp_path / "second.npz")
    assert again._steps == detector._steps
    assert len(again._steps) == 78  # none from one session to the next


def test_a_visitor_is_checked_by_geometry_and_needs_images() -> None:
    detector = LoopDetector(lambda image: image[0, 0].astype(float) + 1, check=GeometricCheck(), exclude_recent=0)
    rng = np.random.default_rng(0)
    walls = [np.kron(rng.integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8) for _ in range(3)]
    for wall in walls:
        detector.add(wall)
    visitor = Visitor(detector)
    assert [visitor.add(np.roll(wall, 3, 1)).accepted for wall in walls] == [0, 1, 2]
    assert visitor.add(np.full((240, 320, 3), 7, np.uint8)).verdict == "not verified"
    with pytest.raises(InputError, match="needs the images"):
        visitor.add_descriptor(np.ones(3))
    with pytest.raises(InputError, match="no describe function"):
        Visitor(LoopDetector()).add(walls[0])


def test_sessions_of_a_damaged_file(tmp_path) -> None:
    import json

    detector = filled()
    detector.save(tmp_path / "x.npz")
    with np.load(tmp_path / "x.npz") as archive:
        arrays = dict(archive)
    for starts in ([], [1], [0, 50], [0, 5, 3], "no"):
        about = json.loads(str(arrays["about"])) | {"sessions": starts}
        np.savez(tmp_path / "y.npz", **{**arrays, "about": np.array(json.dumps(about))})
        with pytest.raises(InputError, match=r"expected a file that LoopDetector.save wrote"):
            LoopDetector.load(tmp_path / "y.npz")
