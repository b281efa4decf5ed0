"""SSD's VideoData compared with the frames that OpenCV reads, and how it is told from the VideoData of tsn."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import netspec.pycaffe as caffe
from fresh_dialects import used_by
from netspec.cli import main
from netspec.errors import SpecError
from netspec.net.net import Net
from places_layouts import COUNT, write_video

LAYER = """layer { name: "data" type: "VideoData" top: "data" top: "label"
  video_data_param { %s } data_param { batch_size: %d prefetch: %d } transform_param { %s } }"""
RESIZED = "mean_value: 104 mean_value: 117 mean_value: 123 resize_param { height: 20 width: 30 }"


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "v.avi")


def frames_of(video: Path) -> np.ndarray:
    capture = cv2.VideoCapture(str(video))
    return np.stack([capture.read()[1] for _ in range(COUNT)])


def text(video: object, more: str = "", batch: int = 1, ahead: int = 4, transform: str = "") -> str:
    return LAYER % (f'video_type: VIDEO video_file: "{video}" {more}', batch, ahead, transform)


@pytest.mark.parametrize("ahead", [0, 1, 4])
@pytest.mark.parametrize("skip", [0, 2])
def test_frames_come_in_order_until_the_video_ends(
    net_of: Callable[..., Net], video: Path, skip: int, ahead: int
) -> None:
    net = net_of(text(video, f"skip_frames: {skip}", 2, ahead))
    given = frames_of(video)[skip :: skip + 1]
    for i in range(len(given) // 2):
        net()
        expected = given[2 * i : 2 * i + 2].transpose(0, 3, 1, 2)
        assert np.array_equal(net.blobs["data"].numpy(), expected)
        assert net.blobs["label"].tolist() == [0, 0]
    with pytest.raises(SpecError, match=r'^net.prototxt:2:\d+: .*video ".*v.avi" has ended: there is no frame \d+$'):
        net()


def test_frames_are_resized_by_resize_param_and_mean_values_subtracted(net_of: Callable[..., Net], video: Path) -> None:
    net = net_of(text(video, batch=3, transform=RESIZED))
    net()
    resized = np.stack([cv2.resize(frame, (30, 20)) for frame in frames_of(video)[:3]])
    assert np.array_equal(
        net.blobs["data"].numpy(), (resized - np.array([104, 117, 123], np.float32)).transpose(0, 3, 1, 2)
    )


def test_pycaffe_reads_frames_until_the_video_ends(video: Path) -> None:
    path = video.with_name("net.prototxt")
    path.write_text(text(video, transform=RESIZED))
    net = caffe.Net(str(path), caffe.TEST)
    seen = [net.forward()["data"].copy() for _ in range(COUNT)]
    assert seen[0].shape == (1, 3, 20, 30)
    with pytest.raises(SpecError, match="has ended"):
        net.forward()


def test_shapes_are_known_without_the_video(net_of: Callable[..., Net]) -> None:
    net = net_of(text("none.avi", transform=RESIZED), open_data=False)
    assert net.shapes == {"data": (1, 3, 20, 30), "label": (1,)}


def test_frames_of_a_camera_are_the_next_ones_with_skip_frames_left_out(
    net_of: Callable[..., Net], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Camera:
        count = 0

        def isOpened(self) -> bool:
            return True

        def grab(self) -> bool:
            Camera.count += 1
            return True

        def read(self) -> tuple[bool, np.ndarray]:
            self.grab()
            return True, np.full((4, 6, 3), Camera.count, np.uint8)

    opened = []
    monkeypatch.setattr(cv2, "VideoCapture", lambda name: opened.append(name) or Camera())
    net = net_of(LAYER % ("video_type: WEBCAM device_id: 3 skip_frames: 1", 2, 0, ""))
    seen = []
    for _ in range(2):
        net()
        seen += net.blobs["data"][:, 0, 0, 0].tolist()
    assert opened == [3]
    assert seen == [2, 4, 6, 8]  # the first frame of all says the shape, and counts as left out
    assert net.layers[0].num_records == 0


@pytest.mark.parametrize(
    ("given", "fault"),
    [
        ('video_type: VIDEO video_file: "none.avi"', 'video "none.avi" cannot be opened'),
        ('video_type: VIDEO video_file: "net.prototxt"', 'video "net.prototxt" cannot be opened'),
        ("video_type: VIDEO", "video_file is missing; set it to the path of the video"),
        ("video_type: WEBCAM device_id: 97", "camera 97 cannot be opened"),
        ('video_type: VIDEO video_file: "v.avi" skip_frames: 99', f'video "v.avi" has {COUNT} frames, too few for'),
    ],
    ids=["missing_file", "not_a_video", "no_video_file", "no_camera", "skip_frames"],
)
def test_errors_are_reported_in_one_line_with_their_place(
    video: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], given: str, fault: str
) -> None:
    monkeypatch.chdir(video.parent)
    Path("net.prototxt").write_text(LAYER % (given, 1, 4, ""))
    assert main(["check", "net.prototxt", "--data"]) == 1
    said = [line for line in "".join(capfd.readouterr()).splitlines() if "uses the dialect" not in line]
    assert said[0].startswith("net.prototxt:2:")
    assert fault in said[0]
    assert "Traceback" not in "".join(said)


def test_invalid_settings_are_refused(net_of: Callable[..., Net], video: Path) -> None:
    with pytest.raises(SpecError, match="batch_size of data_param must be above 0"):
        net_of(text(video, batch=0))
    with pytest.raises(SpecError, match="expected one resize_param"):
        net_of(text(video, transform=2 * "resize_param { height: 2 width: 2 prob: 0.5 }"))


@pytest.mark.parametrize(
    ("given", "dialects"),
    [
        ('video_type: VIDEO video_file: "v.avi"', ["ssd_video"]),
        ("skip_frames: 2", ["ssd_video"]),
        ('source: "list.txt" batch_size: 2 num_segments: 3', ["tsn"]),
        ("device_id: 1", ["ssd_video"]),
        ("", []),
    ],
    ids=["video_file", "skip_frames", "num_segments", "device_id", "no_field"],
)
def test_fields_of_video_data_param_show_their_dialect(
    net_of: Callable[..., Net], given: str, dialects: list[str]
) -> None:
    net = LAYER % (given, 1, 4, "")
    assert used_by(net) == dialects
    if not dialects:
        with pytest.raises(SpecError, match='dialects "ssd_video" and "tsn" have "video_data_param"; add --plugin ssd'):
            net_of(net)
