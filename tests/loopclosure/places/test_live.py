"""Images as they come: of files all, of cameras the newest."""

import threading
import time

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.places.frames import live_frames

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


def test_of_a_camera_the_newest_image_is_taken(camera) -> None:
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


def test_a_caller_that_stops_frees_the_camera(camera) -> None:
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
def test_what_cannot_be_opened(source: str, sentence: str, camera) -> None:
    if source != "none.avi":
        camera(0)
    with pytest.raises(InputError, match=sentence):
        next(live_frames(source))


@pytest.mark.slow
def test_detect_watches_a_video(tmp_path, capsys) -> None:
    """A drive past 12 places at one per second, and past them again."""
    video = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 1, (160, 120))
    walls = [np.random.default_rng(i).integers(0, 256, (15, 20, 3)).astype(np.uint8) for i in range(12)]
    for wall in [*walls, *walls[:4]]:
        video.write(cv2.resize(wall, (160, 120), interpolation=cv2.INTER_NEAREST))
    video.release()
    line = ["detect", "--video", str(tmp_path / "v.avi"), "--exclude-recent", "5", *THUMBNAILS]
    assert main([*line, "--out", str(tmp_path / "out"), "--save", str(tmp_path / "d.npz")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[:4] == [f"frame {12 + i}, {12 + i}.0 s: shows the place of frame {i}" for i in range(4)]
    rows = (tmp_path / "out" / "loops.csv").read_text().splitlines()[1:]
    assert [row.split(",")[-2:] for row in rows][0:1] == [["frame 12", "frame 0"]]
    assert main(["detect", *THUMBNAILS, "--out", str(tmp_path)]) == 2
    assert "expected the frames, or --video" in capsys.readouterr().err


def test_ctrl_c_ends_a_stream_and_keeps_what_was_found(camera, tmp_path, monkeypatch) -> None:
    camera(10**9)
    seen = []

    def describe(image: np.ndarray) -> np.ndarray:
        seen.append(1)
        if len(seen) == 5:
            raise KeyboardInterrupt
        return image.reshape(-1)

    monkeypatch.setattr("loopclosure.detector.run._entry_point", lambda name: lambda: describe)
    assert main(["detect", "--video", "0", "--out", str(tmp_path), "--save", str(tmp_path / "d.npz")]) == 130
    assert (tmp_path / "loops.csv").is_file()
    with np.load(tmp_path / "d.npz") as saved:
        assert len(saved["rows"]) == 4
