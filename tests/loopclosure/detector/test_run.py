"""The detector on recordings: folders, sequences and videos, with any descriptor."""

import sys

import cv2
import numpy as np
import pytest

from loopclosure.descriptors.feature_file import Features, read_features
from loopclosure.descriptors.thumbnails import Thumbnailer
from loopclosure.detector.describers import load_describe
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.run import judged_by_poses, run_detector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.errors import InputError
from loopclosure.places.frames import Selection
from loopclosure.places.image_sequence import ImageSequence
from loopclosure.places.sequences import read_sequence
from netspec.errors import SpecError
from netspec.inspect.features import shipped


def small(image):
    return cv2.resize(image, (8, 6), interpolation=cv2.INTER_AREA).astype(np.float32)


def test_sequence_with_poses(two_laps):
    recording = read_sequence(two_laps)
    assert len(recording) == 40
    assert recording.stamps is not None
    assert recording.poses is not None
    np.testing.assert_allclose(recording.poses[5, :3], [0, 5, 1], atol=1e-3)
    detector = LoopDetector(small, exclude_recent=10, metric="cosine", threshold=0.95, check=None)
    results = run_detector(detector, recording)
    assert [r.match for r in results] == [None] * 20 + list(range(20))
    assert judged_by_poses(detector) == "20 of 20 loops are the same place by their poses (2 m, 15 degrees)"


def test_features_replace_describe(two_laps, two_laps_features):
    detector = LoopDetector(None, check=None, exclude_recent=5, threshold=-0.2)
    results = run_detector(
        detector, read_sequence(two_laps).taken(Selection(stride=2)), read_features(two_laps_features)
    )
    assert [r.match for r in results] == [None] * 10 + list(range(10))


@pytest.mark.slow
def test_features_with_verification_read_the_images(two_laps, two_laps_features):
    detector = LoopDetector(None, exclude_recent=10, threshold=-0.2, check=GeometricCheck(max_features=100, ratio=0.9))
    results = run_detector(detector, read_sequence(two_laps), read_features(two_laps_features))
    assert {r.verdict for r in results[20:]} <= {"accepted", "not verified"}
    assert all(r.inliers is not None for r in results[20:])


def write_video(path, count=30):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for i in range(count):
        image = np.zeros((48, 64, 3), np.uint8)
        image[:, (4 * (i % 15)) : (4 * (i % 15) + 8)] = 255
        writer.write(image)
    writer.release()


def test_video(tmp_path):
    write_video(tmp_path / "walk.avi")
    recording = read_sequence(tmp_path / "walk.avi").taken(Selection(stride=3))
    assert list(recording.names[:2]) == ["frame 0", "frame 3"]
    detector = LoopDetector(small, exclude_recent=2, metric="cosine", threshold=0.98, check=None)
    results = run_detector(detector, recording)
    assert [r.match for r in results] == [None] * 5 + list(range(5))
    assert detector.stamps[1] == pytest.approx(0.3)
    with pytest.raises(InputError, match="no names to find features by"):
        run_detector(detector, recording, Features(tmp_path / "f.npz", np.zeros((1, 2))))
    with pytest.raises(InputError, match="no such video"):
        read_sequence(tmp_path / "gone.mp4")


def test_describe_by_name(tmp_path, monkeypatch):
    (tmp_path / "my_describe.py").write_text(
        "def flat(image):\n    return image.mean(axis=(0, 1))\n\n\n"
        "def make(power, name='x'):\n    return lambda image: image.mean(axis=(0, 1)) ** power\n\n\n"
        "class Row:\n    def __init__(self, row=0):\n        self.row = row\n\n"
        "    def __call__(self, image):\n        return image[self.row, 0]\n\n\n"
        "def mean():\n    return flat\n\n\n"
        "def pair(first, second):\n    return first\n\n\n"
        "number = 3\n\n\n"
        "def refuse(power):\n    raise ValueError(f'{power} is not a power')\n\n\n"
        "def absent(file):\n    return open(file)\n"
    )
    monkeypatch.chdir(tmp_path)
    image = np.full((4, 4, 3), 3, np.uint8)
    image[1] = 5
    assert load_describe("my_describe.py:flat", {})(image).tolist() == [3.5] * 3
    assert load_describe(f"{tmp_path}/my_describe.py:make", {"power": "2"})(image).tolist() == [12.25] * 3
    assert load_describe("my_describe.py:Row", {})(image).tolist() == [3] * 3
    assert load_describe("my_describe.py:Row", {"row": "1"})(image).tolist() == [5] * 3
    assert load_describe("my_describe.py:mean", {})(image).tolist() == [3.5] * 3
    for specification, options, sentence in (
        ("my_describe.py:pair", {}, "--describe my_describe.py:pair: .*missing 2 required"),
        ("my_describe.py", {}, "expected module:function or FILE.py:function"),
        ("my_describe:flat", {}, "lies in the working directory, not in an installed package; .* ./my_describe.py"),
        ("gone.py:f", {}, "cannot import"),
        ("no_such_module:f", {}, "cannot import"),
        ("my_describe.py:g", {}, 'has no "g"'),
        ("my_describe.py:number", {}, "cannot be called"),
        ("my_describe.py:make", {"power": "2", "x": "1"}, "unexpected keyword"),
        ("my_describe.py:refuse", {"power": "2"}, r"--describe my_describe.py:refuse: 2 is not a power"),
        ("my_describe.py:absent", {"file": "gone"}, r"--describe my_describe.py:absent: .*No such file.*gone"),
    ):
        with pytest.raises(InputError, match=sentence):
            load_describe(specification, options)


def test_no_code_of_the_working_directory_runs_unrequested(tmp_path, monkeypatch):
    """Not even a module with the name of one that an installed package imports."""
    for name in ("my_describe", "wave", "sndhdr_of_mine"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('ran')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "wave", raising=False)
    with pytest.raises(InputError, match="name its file"):
        load_describe("my_describe:flat", {})
    assert callable(load_describe("wave:open", {}))
    monkeypatch.syspath_prepend("")  # as python -c and python -m have it
    with pytest.raises(InputError, match="name its file"):
        load_describe("sndhdr_of_mine:flat", {})


def test_a_video_shorter_than_its_header_is_accepted(tmp_path, monkeypatch):
    image = np.zeros((8, 8, 3), np.uint8)
    recording = ImageSequence.of_video(tmp_path / "v.avi", 100).at([0, 5, 99])
    monkeypatch.setattr(
        "loopclosure.places.image_sequence.video_frames", lambda path: ((i / 10, image) for i in range(30))
    )
    frames = recording.frames()
    assert [next(frames)[2], next(frames)[2]] == [0.0, 0.5]
    with pytest.raises(InputError, match=r"v\.avi: ends after 30 frames, though .* 99 is wanted .* write .*,stop=30"):
        next(frames)
    with pytest.raises(InputError, match="threshold is nan"):
        LoopDetector(None, check=None, threshold=float("nan"))


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """A distribution with two describers; one of them cannot be imported."""
    info = tmp_path / "brings_describers-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: brings-describers\nVersion: 1\n")
    lines = (
        "[loopclosure.describers]\nthumbs = loopclosure.descriptors.thumbnails:Thumbnailer\nlost = nowhere:describe\n"
    )
    (info / "entry_points.txt").write_text(lines)
    monkeypatch.syspath_prepend(tmp_path)


def test_a_describer_is_found_by_the_name_of_its_entry_point(installed):
    assert load_describe("thumbs", {"width": "8"}) == Thumbnailer(width=8)
    assert load_describe("thumbs") == Thumbnailer()
    with pytest.raises(
        InputError, match=r'no describer has the name "thumb"; expected module:function, or a name \(.*thumbs\)'
    ):
        load_describe("thumb")
    with pytest.raises(InputError, match="--describe lost: nowhere:describe cannot be imported: No module named"):
        load_describe("lost")
    with pytest.raises(InputError, match=r"--describe thumbs: .*unexpected keyword argument 'size'"):
        load_describe("thumbs", {"size": "8"})


def test_the_nets_that_come_with_the_package_describe():
    """By the fastest engine that is installed, with the numbers of torch."""
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    for net in (shipped.default, shipped.small):
        by_torch = net(engine="torch")(image)
        np.testing.assert_allclose(net()(image), by_torch, rtol=0, atol=1e-4 * np.abs(by_torch).max())
    assert (shipped.folder("siamese_8") / "train_val.prototxt").is_file()
    with pytest.raises(SpecError, match='the net "siamese_9" is not installed'):
        shipped.folder("siamese_9")
