"""Geometric verification on synthetic views: a textured wall seen from two sides, and another wall."""

import cv2
import numpy as np
import pytest

from loopclosure.decision.decider import Decider
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import Agreement, GeometricCheck, LocalFeatures, Pairs
from loopclosure.errors import InputError
from newest import newest


def wall(seed):
    """A surface of blots of all sizes, (240, 320, 3)."""
    rng = np.random.default_rng(seed)
    image = np.full((240, 320, 3), 128, np.uint8)
    for _ in range(220):
        center = rng.integers(0, (320, 240))
        cv2.circle(image, tuple(int(c) for c in center), int(rng.integers(3, 22)), rng.integers(0, 256, 3).tolist(), -1)
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def seen_from_the_side(image):
    corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float32)
    moved = np.array([[12, 6], [300, 18], [312, 228], [4, 236]], np.float32)
    return cv2.warpPerspective(image, cv2.getPerspectiveTransform(corners, moved), (320, 240))


@pytest.fixture(scope="module")
def check():
    return GeometricCheck()


def test_only_the_same_wall_has_many_inliers(check):
    here, there, other = (check.describe(image) for image in (wall(0), seen_from_the_side(wall(0)), wall(1)))
    assert check.inliers(here, there) > 60
    assert check.inliers(here, other) == 0
    assert check.inliers(here, there) == check.inliers(here, there)


def test_matches_connect_equal_points(check):
    image = wall(0)
    shifted = np.roll(image, (10, 20), axis=(0, 1))
    a, b = check.describe(image), check.describe(shifted)
    matches = check.matches(a, b)
    assert len(np.unique(matches[:, 1])) == len(matches) > 50
    steps = b.points[matches[:, 1]] - a.points[matches[:, 0]]
    assert np.mean(np.all(np.abs(steps - [20, 10]) < 1.0, axis=1)) > 0.9


@pytest.mark.slow
def test_matches_are_those_of_the_plain_ratio_test(check):
    a, b = check.describe(wall(0)), check.describe(seen_from_the_side(wall(0)))
    distances = np.linalg.norm(a.descriptors[:, None].astype(float) - b.descriptors[None], axis=2)
    best: dict[int, tuple[float, int]] = {}
    for point, row in enumerate(distances):
        nearest, second = np.argsort(row, kind="stable")[:2]
        if row[nearest] < check.ratio * row[second]:
            best[int(nearest)] = min(best.get(int(nearest), (np.inf, -1)), (row[nearest], point))
    expected = sorted([point, nearest] for nearest, (_, point) in best.items())
    assert check.matches(a, b).tolist() == expected
    assert len(expected) > 50


def test_an_image_without_points_is_accepted(check):
    blank = check.describe(np.full((60, 80, 3), 200, np.uint8))
    assert blank.points.shape == (0, 2)
    assert check.inliers(blank, check.describe(wall(0))) == 0
    assert check.inliers(blank, blank) == 0


def test_gray_images_and_the_limit_of_points():
    few = GeometricCheck(max_features=30)
    assert len(few.describe(cv2.cvtColor(wall(0), cv2.COLOR_BGR2GRAY)).points) == 30


def test_invalid_settings_are_refused():
    with pytest.raises(InputError, match="expected at least 8"):
        GeometricCheck(max_features=3)


def test_geometry_is_checked_last(tmp_path, check):
    """Descriptors that call all walls alike: only the true pair survives, also after saving and loading."""
    detector = LoopDetector(lambda image: np.ones(2), exclude_recent=0, threshold=-1.0, check=check)
    assert newest(detector.add, wall(0)).verdict == "no candidate"
    wrong = newest(detector.add, wall(1))
    assert (wrong.match, wrong.verdict) == (None, "not verified")
    assert wrong.inliers is not None
    assert wrong.inliers < 20
    detector.save(tmp_path / "walls.npz")
    for again in (detector, LoopDetector.load(tmp_path / "walls.npz", lambda image: np.ones(2))):
        right = newest(again.add, seen_from_the_side(wall(1)))
        assert (right.match, right.verdict) == (1, "accepted")
        assert right.inliers is not None
        assert right.inliers > 60
    with pytest.raises(InputError, match="needs the images"):
        detector.add_descriptor(np.ones(2))


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        (Agreement(36, 28, 20), "not verified"),  # the windows of a facade repeat
        (Agreement(60, 32, 20), "not verified"),  # most of the points that match disagree
        (Agreement(60, 48, 20), "not verified"),  # enough, but of places that may look alike more is asked
        (Agreement(60, 52, 20), "accepted"),
    ],
)
def test_an_online_loop_needs_more_points_than_rule_out_chance(check, monkeypatch, found, verdict):
    """2.5 times as many until enough frames agree as a whole, and 70 % of those that match."""
    monkeypatch.setattr(GeometricCheck, "agreement", lambda *_: found)
    detector = LoopDetector(lambda image: np.ones(2), exclude_recent=0, check=check)
    detector.add(wall(0))
    result = newest(detector.add, wall(1))
    assert (result.verdict, result.inliers) == (verdict, found.inliers)


def test_online_more_points_are_needed_where_places_look_alike(check, monkeypatch, tmp_path):
    """More than a quarter agrees only in part: 1.8 times as many as needed are not enough, also after loading."""
    monkeypatch.setattr(Decider, "_learn", lambda *_: None)  # other places have no points in common
    found = Agreement(60, 36, 20)
    monkeypatch.setattr(GeometricCheck, "agreement", lambda *_: found)
    detector = LoopDetector(lambda image: np.ones(2), exclude_recent=0, check=check)
    for number in range(3):
        result = newest(detector.add, wall(number))
    assert (result.verdict, result.reason) == (
        "not verified",
        "enough points agree, but only a part of those that match",
    )
    detector.save(tmp_path / "d.npz")
    found = Agreement(40, 36, 20)
    for one in (detector, LoopDetector.load(tmp_path / "d.npz", detector.describe)):
        results = [newest(one.add, wall(number)) for number in range(14)]
        accepted = [bool(result) for result in results]
        assert accepted == sorted(accepted)
        assert True in accepted[6:]
        assert not any(accepted[:6])


@pytest.mark.parametrize("camera", [{}, {"focal_px": 260.0, "center_x_px": 160.0, "center_y_px": 120.0}])
@pytest.mark.parametrize("count", [8, 9, 10, 30])
def test_without_a_matrix_nothing_agrees(monkeypatch, camera, count):
    """OpenCV may return no matrix, and then a mask that it has not filled in."""
    for name in ("findFundamentalMat", "findEssentialMat"):
        monkeypatch.setattr(cv2, name, lambda a, *_: (None, np.full((len(a), 1), 205, np.uint8)))
    points = np.random.default_rng(0).uniform(0, 200, (count, 2)).astype(np.float32)
    local = LocalFeatures(points, np.eye(count, 128, dtype=np.uint8) * 200)
    check = GeometricCheck(**camera)
    assert len(check.matches(local, local)) == count
    assert check.inliers(local, local) == 0


def test_eight_points_on_a_line_do_not_agree(check):
    along = np.linspace(10, 200, 8)
    line = LocalFeatures(np.column_stack([along, along]).astype(np.float32), np.eye(8, 128, dtype=np.uint8) * 200)
    assert cv2.findFundamentalMat(line.points, line.points, cv2.FM_RANSAC, 2.0, 0.985)[0] is None
    assert check.inliers(line, line) == 0


@pytest.mark.slow
def test_the_required_number_of_inliers_excludes_chance():
    """Moisan and Stival's count: of eight matches all in an image of this size, of many a small share."""
    check = GeometricCheck()
    asked = [check.agreement(noise(count, 0), noise(count, 1)).needed for count in (12, 30, 100, 400)]
    assert asked[0] > 12
    assert asked == sorted(asked)
    assert asked[-1] < 400 // 4
    for count in (12, 30, 100, 400):
        assert [check.inliers(noise(count, a), noise(count, a + 1)) for a in range(8)] == [0] * 8


def noise(count, seed):
    """Points anywhere, each matched with one of the other image."""
    rng = np.random.default_rng(seed)
    descriptors = np.random.default_rng(99).integers(0, 255, (count, 128)).astype(np.uint8)
    return LocalFeatures(rng.uniform(0, 240, (count, 2)).astype(np.float32), descriptors, (320, 240))


def test_small_images_are_enlarged_and_points_stay_in_their_own_pixels():
    tiny = [
        cv2.resize(image, (80, 60), interpolation=cv2.INTER_AREA) for image in (wall(0), seen_from_the_side(wall(0)))
    ]
    as_they_are, check = GeometricCheck(least_side=1), GeometricCheck()
    small, large = (of.describe(tiny[0]) for of in (as_they_are, check))
    assert len(large.points) > len(small.points)
    assert np.all(large.points.max(axis=0) < [80, 60])
    assert large.size == (80, 60)
    assert check.inliers(large, check.describe(tiny[1])) > 20
    other = cv2.resize(wall(1), (80, 60), interpolation=cv2.INTER_AREA)
    assert check.inliers(large, check.describe(other)) == 0


def test_large_images_are_reduced_and_points_stay_in_their_own_pixels():
    """A picture and the same twice as large: points lie where they lay, and an edge of 480 pixels is searched."""
    small = cv2.resize(wall(0), (640, 480))
    large = cv2.resize(small, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    check = GeometricCheck()
    a, b = check.describe(small), check.describe(large)
    assert b.size == (1280, 960)
    pairs = check.matches(a, b)
    assert len(pairs) > 100
    moved = b.points[pairs[:, 1]] - (2 * a.points[pairs[:, 0]] + 0.5)
    assert np.abs(np.median(moved, axis=0)).max() < 0.2
    assert check.inliers(a, b) > 100


def test_images_and_pairs_are_processed_once(monkeypatch):
    images = {0: wall(0), 1: seen_from_the_side(wall(0))}
    read = []
    pairs = Pairs(lambda key: read.append(key) or images[key])
    found = pairs.agreement(GeometricCheck(), 0, 1)
    assert pairs.agreement(GeometricCheck(), 0, 1) is found
    pairs.agreement(GeometricCheck(ratio=0.7), 0, 1)
    assert read == [0, 1]


def with_patch(image, patch, corner):
    seen = image.copy()
    seen[corner[1] : corner[1] + len(patch), corner[0] : corner[0] + len(patch[0])] = patch
    return seen


def test_repeated_printed_codes_are_ignored(check):
    """A code of 60 pixels has more inliers than rule out chance; a poster of half the image is a place."""
    code = np.random.default_rng(5).integers(0, 2, (20, 20)).repeat(3, 0).repeat(3, 1)[..., None].repeat(3, 2) * 255
    here, there = with_patch(wall(0), code, (40, 50)), with_patch(wall(1), code, (190, 120))
    found = check.agreement(check.describe(here), check.describe(there))
    assert found.matches > 2 * found.needed > 0 == check.enough(found)
    poster = wall(2)[:160, :200]
    here, there = with_patch(wall(0), poster, (20, 30)), with_patch(wall(1), poster, (90, 50))
    assert check.inliers(check.describe(here), check.describe(there)) > 30
