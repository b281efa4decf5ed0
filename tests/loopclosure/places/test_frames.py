"""Sources of frames: order, selection, and errors for broken ones."""

import csv
import struct
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.places.frames import (
    Selection,
    live_frames,
    read_bgr,
    video_frames,
    video_length,
)
from loopclosure.places.sequences import read_sequence
from netspec.errors import SpecError
from places_layouts import write_video


@pytest.mark.parametrize(
    ("selection", "expected"),
    [
        (Selection(), list(range(10))),
        (Selection(start=7), [7, 8, 9]),
        (Selection(start="60%", stride=2), [6, 8]),
        (Selection(stop="25%"), [0, 1]),
        (Selection(start="2", stop=99, stride=3, limit=2), [2, 5]),
    ],
)
def test_selection(selection, expected):
    assert selection.numbers(10).tolist() == expected


@pytest.mark.parametrize(
    ("selection", "sentence"),
    [
        (Selection(start=10), "no frame is left of 10"),
        (Selection(start="half"), '"half" is not a frame'),
        (Selection(stride=0), "stride of 0"),
        (Selection(limit=0), "limit of 0"),
    ],
)
def test_empty_selections_are_refused(selection, sentence):
    with pytest.raises(InputError, match=sentence):
        selection.numbers(10)


def test_unreadable_images_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be read: No such file"):
        read_bgr(tmp_path / "a.png")
    (tmp_path / "a.png").write_text("text")
    with pytest.raises(InputError, match="is not a readable image"):
        read_bgr(tmp_path / "a.png")


def test_video(tmp_path):
    path = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (32, 24))
    for i in range(5):
        writer.write(np.full((24, 32, 3), 40 * i, np.uint8))
    writer.release()
    frames = list(video_frames(path))
    assert [seconds for seconds, _ in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])
    assert frames[4][1].shape == (24, 32, 3)
    assert abs(float(frames[4][1].mean()) - 160) < 3
    assert video_length(path) == 5
    with pytest.raises(InputError, match="no such video"):
        next(iter(video_frames(tmp_path / "none.avi")))
    with pytest.raises(InputError, match="is a folder, and neither a video nor a ROS bag"):
        list(video_frames(tmp_path))


THUMBNAILS = ["--describe", "loopclosure.descriptors.thumbnails:Thumbnailer"]


class Camera:
    """Gives images 0, 1, ... as fast as they are asked for; None instead of one: no more come."""

    def __init__(self, images: int, seconds: float = 0.0, opened: bool = True) -> None:
        self.images, self.seconds, self.opened, self.read_so_far, self.released = images, seconds, opened, 0, False

    def isOpened(self) -> bool:
        return self.opened

    def read(self) -> tuple[bool, np.ndarray | None]:
        time.sleep(self.seconds)
        if self.read_so_far == self.images:
            return False, None
        self.read_so_far += 1
        return True, np.full((4, 4, 3), self.read_so_far - 1, np.uint8)

    def release(self) -> None:
        self.released = True


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch):
    def install(*arguments, **more) -> Camera:
        made = Camera(*arguments, **more)
        monkeypatch.setattr(cv2, "VideoCapture", lambda source: made if source == 0 else Camera(0, opened=False))
        return made

    return install


def test_the_newest_image_of_a_camera_is_used(camera) -> None:
    made = camera(40, 0.01)
    seen = []
    for stamp, image in live_frames("0"):
        seen.append((stamp, int(image[0, 0, 0])))
        while made.read_so_far < min(40, seen[-1][1] + 4):  # the camera goes on
            time.sleep(0.001)
    stamps, numbers = zip(*seen, strict=True)
    assert list(numbers) == sorted(set(numbers))
    assert list(stamps) == sorted(stamps)
    assert len(numbers) < 30  # some were dropped
    assert made.released


def test_the_camera_is_released(camera) -> None:
    made = camera(10**9, 0.001)
    frames = live_frames("0")
    next(frames)
    frames.close()
    assert made.released
    assert not [thread for thread in threading.enumerate() if thread.name == "camera"]


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("7", "camera 7 cannot be opened; expected the number of a camera"),
        ("rtsp://127.0.0.1:1/x", "stream rtsp://127.0.0.1:1/x cannot be opened"),
        ("none.avi", "no such video"),
    ],
)
def test_unreadable_sources_are_reported(source: str, sentence: str, camera) -> None:
    if source != "none.avi":
        camera(0)
    with pytest.raises(InputError, match=sentence):
        next(live_frames(source))


@pytest.mark.slow
def test_watch_reads_a_video_and_goes_on_with_another(tmp_path, capsys) -> None:
    """A drive past 12 places at one per second, and past them again."""
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1, (160, 120))
    walls = [np.random.default_rng(i).integers(0, 256, (15, 20, 3)).astype(np.uint8) for i in range(12)]
    for wall in [*walls, *walls[:4]]:
        video.write(cv2.resize(wall, (160, 120), interpolation=cv2.INTER_NEAREST))
    video.release()
    line = ["watch", "--video", str(tmp_path / "v.avi"), *THUMBNAILS]
    assert (
        main([*line, "--exclude-recent", "5", "--out", str(tmp_path / "out"), "--save", str(tmp_path / "d.npz")]) == 0
    )
    said = capsys.readouterr().out.splitlines()
    assert said[:4] == [f"frame {12 + i}, {12 + i}.0 s: shows the place of frame {i}" for i in range(4)]
    with (tmp_path / "out" / "loops.csv").open(encoding="utf-8") as table:
        first = next(csv.DictReader(table))
    assert (first["query_name"], first["match_name"]) == ("frame 12", "frame 0")
    assert main([*line, "--resume", str(tmp_path / "d.npz"), "--out", str(tmp_path / "again")]) == 0
    assert "loops in 16 frames" in capsys.readouterr().out


def test_ctrl_c_ends_a_stream_and_keeps_results(camera, tmp_path, monkeypatch) -> None:
    camera(10**9)
    seen = []

    def describe(image: np.ndarray) -> np.ndarray:
        seen.append(1)
        if len(seen) == 5:
            raise KeyboardInterrupt
        return image.reshape(-1)

    monkeypatch.setattr("loopclosure.detector.describers._entry_point", lambda name: lambda: describe)
    assert main(["watch", "--video", "0", "--out", str(tmp_path), "--save", str(tmp_path / "d.npz")]) == 130
    assert (tmp_path / "loops.csv").is_file()
    with np.load(tmp_path / "d.npz") as saved:
        assert len(saved["rows"]) == 4


@pytest.mark.parametrize("begin", [b"", b"\x00\x00\x00\x18ftypmp42\x00\x00\x00\x00mp42isom"])
def test_a_video_that_cannot_be_decoded_is_reported(begin: bytes, tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"
    path.write_bytes(begin + bytes(range(256)) * 8)
    for read in (video_length, lambda path: list(video_frames(path))):
        with pytest.raises(InputError, match=r"drive\.mp4: cannot be decoded as a video by OpenCV .*; try ffmpeg -i"):
            read(path)


def stalled(path: Path, parts: list[tuple[int, float]]) -> None:
    """Give the frames of an .mp4 other durations: (how many frames, how many times as long) for each part."""
    data = path.read_bytes()
    table = data.index(b"stts") - 4
    size, _, _, _, _, delta = struct.unpack(">I4sIIII", data[table : table + 24])
    entries = b"".join(struct.pack(">II", count, round(delta * times)) for count, times in parts)
    new = struct.pack(">I4sII", 16 + len(entries), b"stts", 0, len(parts)) + entries
    changed = bytearray(data[:table] + new + data[table + size :])
    for box in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):  # around the table, at the end of the file
        at = data.index(box) - 4
        (before,) = struct.unpack(">I", data[at : at + 4])
        changed[at : at + 4] = struct.pack(">I", before + len(new) - size)
    path.write_bytes(bytes(changed))


def test_the_times_of_a_video_are_its_own(tmp_path: Path) -> None:
    path = tmp_path / "drive.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 2.0, (64, 48))
    for number in range(20):
        writer.write(np.full((48, 64, 3), 10 * number, np.uint8))
    writer.release()
    assert [seconds for seconds, _ in video_frames(path)] == [0.5 * i for i in range(20)]
    stalled(path, [(10, 0.5), (10, 1.5)])
    expected = [*(0.25 * i for i in range(10)), *(2.5 + 0.75 * i for i in range(10))]
    np.testing.assert_allclose([seconds for seconds, _ in video_frames(path)], expected, atol=1e-3)


@pytest.mark.parametrize(
    ("head", "row"), [("", "{square}"), ("number,timestamp [ms]\n", "{number},{square}000")], ids=["one", "named"]
)
def test_a_file_of_times(head: str, row: str, tmp_path: Path) -> None:
    text = head + "".join(row.format(number=i, square=i * i) + "\n" for i in range(48))
    video, times = write_video(tmp_path / "drive.avi"), tmp_path / "times.txt"
    times.write_text(text)
    sequence = read_sequence(video, times=times)
    assert [stamp for _, _, stamp in sequence.taken(Selection(start=3, stop=6)).frames()] == [9, 16, 25]
    times.write_text("1\n2\n")
    with pytest.raises(InputError, match=r"times\.txt: has 2 times, but there are 48 images"):
        read_sequence(video, times=times)


def test_an_unreadable_image_is_counted_once(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((24, 32, 3), number, np.uint8))
    (tmp_path / "1.png").write_bytes(b"broken")
    sequence = read_sequence(tmp_path)
    for _ in range(3):
        assert [index for index, _, _ in sequence.frames()] == [0, 2]
    assert sequence.unreadable == [1]


def test_photos_that_are_not_read_are_counted(tmp_path: Path) -> None:
    for name in ("1.png", "frame-1.color.png", "frame-1.depth.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((4, 4, 3), np.uint8))
    for name in ("a.HEIC", "b.HEIC", "c.gif", "notes.txt"):
        (tmp_path / name).touch()
    sequence = read_sequence(tmp_path)
    assert sequence.names == ("1.png", "frame-1.color.png")
    assert [doubt.split(" ")[:3] for doubt in sequence.doubts] == [
        ["2", "files", ".HEIC"],
        ["1", "files", ".gif"],
        ["1", "depth", "images"],
    ]


@pytest.mark.parametrize(("folder", "inner"), [("image_02", True), (".", False)])
def test_a_drive_of_kitti_raw(folder: str, inner: bool, tmp_path: Path) -> None:
    (tmp_path / "image_02" / "data").mkdir(parents=True)
    cv2.imwrite(str(tmp_path / "image_02" / "data" / "0.png"), np.zeros((4, 4, 3), np.uint8))
    if inner:
        assert len(read_sequence(tmp_path / folder)) == 1
    else:
        with pytest.raises(SpecError, match="image_02/data has some: name one folder"):
            read_sequence(tmp_path)
