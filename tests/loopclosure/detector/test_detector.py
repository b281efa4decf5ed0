"""The detector: what it accepts, that saving loses nothing, and that adding frames is cheap."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from loopclosure.decision.decider import Decider
from loopclosure.descriptors.similarity import similarity_matrix
from loopclosure.detector.detector import DetectorSettings, LoopDetector
from loopclosure.detector.frames import FIRST_CAPACITY
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures
from loopclosure.detector.visitor import Visitor
from loopclosure.errors import InputError
from netspec.errors import SpecError
from newest import newest


def two_laps(places=60, dimensions=16, noise=0.02, seed=0):
    """Descriptors of a lap of places, and of a second lap of the same ones."""
    rng = np.random.default_rng(seed)
    lap = rng.normal(size=(places, dimensions))
    return np.concatenate([lap, lap + noise * rng.normal(size=lap.shape)]).astype(np.float32)


def run(detector, descriptors, **more):
    return [newest(detector.add_descriptor, row, **more) for row in descriptors]


def test_only_the_second_lap_closes_loops():
    detector = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.5)
    results = run(detector, two_laps())
    assert [r.match for r in results] == [None] * 60 + list(range(60))
    assert [loop.query for loop in detector.loops] == list(range(60, 120))
    assert results[0].verdict == "no candidate"
    assert results[20].verdict == "below threshold"
    assert len(detector) == 120


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
def test_candidates_are_the_most_similar_earlier_frames(metric):
    descriptors = np.random.default_rng(1).normal(2.0, 1.0, (FIRST_CAPACITY + 40, 8)).astype(np.float32)
    detector = LoopDetector(None, check=None, metric=metric, exclude_recent=7, top_k=4)
    results = run(detector, descriptors)
    for query, scores in enumerate(similarity_matrix(descriptors, None, metric)):
        best = np.argsort(-scores[: max(0, query - 7)], kind="stable")[:4]
        assert [number for number, _ in results[query].candidates] == best.tolist()
        np.testing.assert_allclose([score for _, score in results[query].candidates], scores[best], atol=1e-4)


@pytest.mark.parametrize("metric", ["euclidean", "cosine"])
def test_the_most_similar_two_views_decide(metric, tmp_path):
    descriptors = np.random.default_rng(1).normal(2.0, 1.0, (60, 24)).astype(np.float32)
    expected = similarity_matrix(descriptors, None, metric, views=3)
    detector = LoopDetector(None, check=None, metric=metric, views=3, exclude_recent=7, top_k=4)
    results = run(detector, descriptors[:30])
    detector.save(tmp_path / "detector.npz")
    results += run(LoopDetector.load(tmp_path / "detector.npz"), descriptors[30:])
    for i, result in enumerate(results):
        scores = expected[i, : max(0, i - 7)]
        assert [number for number, _ in result.candidates] == np.argsort(-scores)[:4].tolist()
        np.testing.assert_allclose([score for _, score in result.candidates], np.sort(scores)[::-1][:4], atol=1e-3)
    with pytest.raises(InputError, match="25 dimensions, not of 3 views"):
        LoopDetector(None, check=None, views=3).add_descriptor(np.ones(25))


def test_frames_can_be_excluded_by_time():
    detector = LoopDetector(None, check=None, exclude_recent=0, exclude_seconds=2.0, top_k=9)
    for stamp in (0.0, 1.0, 1.5, 3.0, 3.5):
        result = newest(detector.add_descriptor, np.ones(3), stamp)
    assert sorted(number for number, _ in result.candidates) == [0, 1, 2]
    with pytest.raises(InputError, match="frame 5 has no stamp"):
        detector.add_descriptor(np.ones(3))
    with pytest.raises(InputError, match="earlier than the one before"):
        detector.add_descriptor(np.ones(3), 1.0)


@pytest.mark.parametrize(
    ("settings", "loops"),
    [({"exclude_seconds": 10.0}, 15), ({"exclude_seconds": 10.0, "exclude_recent": 35}, 0), ({}, 15)],
)
def test_frames_are_excluded_by_number_only_if_nothing_says_how_old_they_must_be(settings, loops):
    """45 key frames, one a second, around a room of 30 places."""
    places = np.random.default_rng(1).normal(size=(30, 16))
    detector = LoopDetector(None, check=None, threshold=-0.1, **settings)
    assert sum(bool(newest(detector.add_descriptor, places[k % 30], float(k))) for k in range(45)) == loops


@pytest.mark.parametrize(
    ("settings", "turns", "everywhere", "accepted"),
    [
        ({}, False, False, False),
        ({}, True, False, True),
        ({"exclude_recent": 50}, False, False, True),
        ({"exclude_seconds": 5.0}, False, False, False),
        ({}, True, True, False),
    ],
)
def test_a_loop_online_is_a_place_that_was_left(settings, turns, everywhere, accepted, monkeypatch):
    """After a town, the same hills are seen along a straight road; that is a loop only after a turn.

    It is none if the same points are seen everywhere, as those of the towers of a bridge.
    """
    if not everywhere:
        monkeypatch.setattr(Decider, "_learn", lambda *_: None)  # unlike pairs have no points in common
    monkeypatch.setattr(GeometricCheck, "agreement", lambda *_: Agreement(60, 52, 20))
    monkeypatch.setattr(GeometricCheck, "describe", lambda *_: LocalFeatures(np.zeros((0, 2)), np.zeros((0, 128))))
    rng = np.random.default_rng(0)
    town, straight = rng.normal(size=(100, 16)), rng.normal(size=16) + 0.1 * rng.normal(size=(60, 16))
    rows = np.concatenate([town, straight, rng.normal(size=(10 * turns, 16)), straight[:1]])
    image = np.zeros((2, 2), np.uint8)
    detector = LoopDetector(None, check=GeometricCheck(), top_k=1, **settings)
    results = [newest(detector.add_descriptor, row, float(number), image=image) for number, row in enumerate(rows)]
    assert ((results[-1].match or 0) >= 100) == accepted


def test_consistency_requires_earlier_frames_to_agree():
    descriptors = two_laps()
    lonely = descriptors[:60].copy()
    lonely[50] = descriptors[3]  # one frame looks like an old one, its neighbors do not
    plain = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.5)
    steady = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.5, consistency=3, consistency_window=2)
    assert [r.query for r in run(plain, lonely) if r.match is not None] == [50]
    assert [r.query for r in run(steady, lonely) if r.match is not None] == []
    steady = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.5, consistency=3, consistency_window=2)
    results = run(steady, descriptors)
    assert [r.query for r in results if r.match is not None] == list(range(63, 120))
    assert [r.verdict for r in results[60:63]] == ["not consistent"] * 3


def test_consistency_follows_a_lap_driven_backwards():
    rng = np.random.default_rng(2)
    lap = rng.normal(size=(40, 8))
    steady = LoopDetector(None, check=None, exclude_recent=10, threshold=-0.1, consistency=2, consistency_window=1)
    results = run(steady, np.concatenate([lap, lap[::-1]]))
    accepted = {r.query: r.match for r in results if r.match is not None}
    assert accepted == {query: 79 - query for query in range(47, 80)}  # 45, 46 lead on; before, the place is too recent


def test_without_a_threshold_a_loop_is_as_similar_as_consecutive_frames(tmp_path):
    """A walk in small steps that comes back to where it began."""
    angles = np.concatenate([np.linspace(0, 3, 60), 3 + np.linspace(0.06, 3, 50), np.linspace(0.01, 1, 20)])
    rows = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    detector = LoopDetector(None, check=None, exclude_recent=10)
    results = run(detector, rows[:110])
    assert [r.verdict for r in results[11:20]] == ["too early"] * 9
    assert not detector.loops
    detector.save(tmp_path / "walk.npz")
    for one in (detector, LoopDetector.load(tmp_path / "walk.npz")):
        back = run(one, rows[110:])
        assert [r.match is not None for r in back] == [True] * 20
        assert all(abs(angles[r.match] - angles[r.query]) < 0.06 for r in one.loops)


def test_the_frames_of_a_loaded_detector_are_in_its_index(tmp_path):
    """Only those that are too recent wait, as they do in the detector that was saved: a visitor looks at each."""
    rows = np.random.default_rng(0).normal(size=(40, 8))
    by_seconds = DetectorSettings(exclude_recent=0, exclude_seconds=4.5, threshold=-1.0)
    for settings, waiting in ((DetectorSettings(exclude_recent=7, threshold=-1.0), 7), (by_seconds, 5)):
        detector = LoopDetector(None, check=None, **asdict(settings))
        for i, row in enumerate(rows):
            detector.add_descriptor(row, stamp=float(i))
        detector.save(tmp_path / "d.npz")
        again = LoopDetector.load(tmp_path / "d.npz")
        assert len(again._frames.waiting) == waiting
        one, other = (newest(Visitor(each).add_descriptor, rows[39]) for each in (detector, again))
        assert one == other


def test_a_loaded_detector_continues_identically(tmp_path):
    descriptors = two_laps(places=300)
    settings = DetectorSettings(exclude_recent=20, threshold=-0.4, consistency=2, top_k=3)
    whole = LoopDetector(None, check=None, **asdict(settings))
    expected = [newest(whole.add_descriptor, row, 0.1 * i, [i, 0, 0, 0, 0, 0, 1]) for i, row in enumerate(descriptors)]
    first = LoopDetector(None, check=None, **asdict(settings))
    for i, row in enumerate(descriptors[:302]):
        first.add_descriptor(row, 0.1 * i, [i, 0, 0, 0, 0, 0, 1])
    first.save(tmp_path / "detector.npz")
    second = LoopDetector.load(tmp_path / "detector.npz")
    assert second.settings == settings
    later = [
        newest(second.add_descriptor, row, 0.1 * i, [i, 0, 0, 0, 0, 0, 1])
        for i, row in enumerate(descriptors[302:], start=302)
    ]
    assert later == expected[302:]
    assert second.loops == whole.loops
    np.testing.assert_array_equal(second.poses, whole.poses)
    np.testing.assert_array_equal(second.stamps, whole.stamps)


def test_an_empty_detector_can_be_saved(tmp_path):
    LoopDetector(None, threshold=0.0, check=GeometricCheck()).save(tmp_path / "empty.npz")
    detector = LoopDetector.load(tmp_path / "empty.npz", describe=lambda image: image[0, 0].astype(float))
    assert len(detector) == 0
    detector.add(np.zeros((20, 20, 3), np.uint8))
    assert len(detector) == 1


def test_other_files_than_detectors_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", rows=np.zeros(3))
    (tmp_path / "text.npz").write_text("text")
    for name in ("other.npz", "text.npz", "none.npz"):
        with pytest.raises(InputError, match=r"expected a file that LoopDetector.save wrote"):
            LoopDetector.load(tmp_path / name)
    with pytest.raises(SpecError, match="cannot be written"):
        LoopDetector(None, check=None).save(tmp_path / "no" / "folder.npz")


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda d: d.add_descriptor(np.zeros(3)), "4 dimensions|those before 2"),
        (lambda d: d.add_descriptor([np.nan, 0.0]), "not finite"),
        (lambda d: d.add_descriptor(np.zeros(2), pose=[1, 2, 3]), "expected tx ty tz"),
        (lambda d: d.add(np.zeros((4, 4, 3), np.uint8)), "has no describe"),
        (lambda d: LoopDetector(None, check=None, top_k=0), "top_k is 0"),
        (lambda d: LoopDetector(None, check=None, metric="l1"), "unknown metric"),
    ],
)
def test_errors_are_reported(call, sentence):
    detector = LoopDetector(None, check=None)
    detector.add_descriptor([1.0, 2.0])
    with pytest.raises(InputError, match=sentence):
        call(detector)
    assert len(detector) == 1


def test_the_default_is_the_measured_detector(monkeypatch, tmp_path):
    """A name, a function or nothing: the check and the settings are those of benchmarks/revisits.py."""
    nets = {"default": lambda image: image.mean(axis=(0, 1)), "small": lambda image: image[0, 0].astype(float)}
    nets["small"].views = 3
    monkeypatch.setattr("loopclosure.detector.describers._entry_point", lambda name: lambda: nets[name])
    for detector, describe in (
        (LoopDetector(), nets["default"]),
        (LoopDetector("small"), nets["small"]),
        (LoopDetector(nets["default"]), nets["default"]),
    ):
        assert detector.describe is describe
        assert detector.check == GeometricCheck()
        assert detector.settings == DetectorSettings(views=getattr(describe, "views", 1))
        assert not detector.add(np.zeros((48, 64, 3), np.uint8), stamp=0.0)
        detector.save(tmp_path / "drive.npz")
        named = detector.describer != ""
        again = LoopDetector.load(tmp_path / "drive.npz")
        assert (again.describe, len(again)) == (describe if named else None, 1)


def test_a_file_of_a_detector_names_no_program_to_run(tmp_path):
    (tmp_path / "own.py").write_text("def own(image):\n    return image[0, 0]\n")
    LoopDetector(f"{tmp_path / 'own.py'}:own").save(tmp_path / "drive.npz")
    assert LoopDetector.load(tmp_path / "drive.npz").describe is None


def test_a_misspelled_setting_is_a_type_error():
    with pytest.raises(TypeError, match="treshold"):
        LoopDetector(None, check=None, treshold=1.0)


LAP = np.random.default_rng(0).normal(size=(40, 16)).astype(np.float32)


def near(rows: np.ndarray, seed: int) -> np.ndarray:
    return rows + 0.02 * np.random.default_rng(seed).normal(size=rows.shape).astype(np.float32)


def filled(**settings: Any) -> LoopDetector:
    detector = LoopDetector(None, check=None, threshold=-0.5, **settings)
    for i, row in enumerate(LAP):
        detector.add_descriptor(row, float(i))
    return detector


@pytest.mark.parametrize("views", [1, 2])
def test_a_visitor_searches_all_frames_and_adds_none(views: int, tmp_path) -> None:
    detector = filled(exclude_recent=30, views=views)
    detector.save(tmp_path / "before.npz")
    visitors = [Visitor(detector), Visitor(detector)]
    for i, row in enumerate(near(LAP, 1)):
        for visitor in visitors:
            result = newest(visitor.add_descriptor, row, float(i))
            assert (result.query, result.match) == (i, i)
    assert len(detector) == 40
    detector.save(tmp_path / "after.npz")
    assert (tmp_path / "after.npz").read_bytes() == (tmp_path / "before.npz").read_bytes()


def test_each_visitor_has_its_own_consistency() -> None:
    detector = filled(exclude_recent=5, consistency=2)
    one, other = Visitor(detector), Visitor(detector)
    verdicts = [newest(one.add_descriptor, row).verdict for row in near(LAP[:4], 1)]
    assert verdicts == ["not consistent", "not consistent", "accepted", "accepted"]
    assert newest(other.add_descriptor, LAP[4]).verdict == "not consistent"


def test_in_a_new_session_no_earlier_frame_is_recent(tmp_path) -> None:
    first = filled(exclude_recent=30, exclude_seconds=5)
    first.begin_session()
    first.save(tmp_path / "first.npz")
    for detector in (first, LoopDetector.load(tmp_path / "first.npz")):
        found = [newest(detector.add_descriptor, row, float(i)).match for i, row in enumerate(near(LAP[20:], 1))]
        assert found == list(range(20, 40))
        found = [newest(detector.add_descriptor, row, 100.0 + i).match for i, row in enumerate(near(LAP[:20], 2))]
        assert found == list(range(20))
    assert len(first) == 80
    detector.save(tmp_path / "second.npz")
    again = LoopDetector.load(tmp_path / "second.npz")
    assert again._likely.steps == detector._likely.steps
    assert len(again._likely.steps) == 78  # none from one session to the next


def test_a_visitor_is_checked_by_geometry_and_needs_images() -> None:
    detector = LoopDetector(lambda image: image[0, 0].astype(float) + 1, check=GeometricCheck(), exclude_recent=0)
    rng = np.random.default_rng(0)
    walls = [np.kron(rng.integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8) for _ in range(3)]
    for wall in walls:
        detector.add(wall)
    visitor = Visitor(detector)
    assert [newest(visitor.add, np.roll(wall, 3, 1)).match for wall in walls] == [0, 1, 2]
    assert newest(visitor.add, np.full((240, 320, 3), 7, np.uint8)).verdict == "not verified"
    with pytest.raises(InputError, match="needs the images"):
        visitor.add_descriptor(np.ones(3))
    with pytest.raises(InputError, match="no describe function"):
        Visitor(LoopDetector(None, check=None)).add(walls[0])


def test_frames_on_disk_close_the_same_loops(tmp_path) -> None:
    rng = np.random.default_rng(0)
    walls = [np.kron(rng.integers(0, 256, (24, 32, 3)), np.ones((10, 10, 1))).astype(np.uint8) for _ in range(6)]
    bare = np.full((240, 320, 3), 7, np.uint8)  # no points
    made = [
        LoopDetector(
            lambda image: image[5::60, 5::80].ravel(), check=GeometricCheck(), exclude_recent=0, in_memory=limit
        )
        for limit in (None, 2)
    ]
    for detector in made:
        for wall in [*walls, bare]:
            assert newest(detector.add, wall).match is None
        assert [newest(detector.add, np.roll(wall, 2, 1)).match for wall in walls] == [0, 1, 2, 3, 4, 5]
        for frame in (0, 3, 6, 12, 0):
            found, expected = (each.local_features(frame) for each in (detector, made[0]))
            np.testing.assert_array_equal(found.points, expected.points)
            np.testing.assert_array_equal(found.descriptors, expected.descriptors)
            assert found.size == expected.size == (320, 240)
        detector.save(tmp_path / "x.npz")
        again = LoopDetector.load(tmp_path / "x.npz", detector.describe, in_memory=1)
        assert [newest(again.add, wall).match for wall in walls[:2]] == [0, 1]
    with pytest.raises(InputError, match="0 frames are to be kept in memory; expected at least 1"):
        LoopDetector(None, check=None, in_memory=0)


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


@pytest.mark.parametrize("stamp", [np.inf, -np.inf, np.nan])
def test_a_nonfinite_stamp_is_refused_and_the_next_frame_is_accepted(stamp: float) -> None:
    detector = LoopDetector(None, check=None)
    detector.add_descriptor(np.ones(4), 1.0)
    with pytest.raises(InputError, match=r"frame 1 has stamp .*; expected seconds"):
        detector.add_descriptor(np.ones(4), stamp)
    detector.add_descriptor(np.ones(4), 2.0)
    assert len(detector) == 2
