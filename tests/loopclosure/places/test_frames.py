"""Sources of frames: order, selection, and what is said of broken ones."""

import os

import cv2
import numpy as np
import pytest

from loopclosure.errors import InputError
from loopclosure.places.frames import Selection, image_paths, read_bgr, video_frames, video_length, write_picture
from netspec.errors import SpecError


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
def test_selections_of_nothing(selection, sentence):
    with pytest.raises(InputError, match=sentence):
        selection.numbers(10)


def write_images(folder, names):
    folder.mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((4, 4, 3), np.uint8))
    return folder


def test_folders_lists_and_sequences(tmp_path):
    plain = write_images(tmp_path / "plain", ["10.png", "9.jpg", "1.png"])
    (plain / "notes.txt").write_text("not an image")
    assert [p.name for p in image_paths(plain)] == ["1.png", "9.jpg", "10.png"]
    write_images(tmp_path / "outer" / "images", ["a.png"])
    assert [p.name for p in image_paths(tmp_path / "outer")] == ["a.png"]
    (tmp_path / "list.txt").write_text("# chosen\nplain/9.jpg\n12.5 plain/1.png  # twice seen\n")
    assert [p.name for p in image_paths(tmp_path / "list.txt")] == ["9.jpg", "1.png"]
    write_images(tmp_path / "tum" / "rgb", ["2.png", "1.png"])
    (tmp_path / "tum" / "rgb.txt").write_text("# x\n5.0 rgb/2.png\n6.0 rgb/1.png\n")
    assert [p.name for p in image_paths(tmp_path / "tum")] == ["2.png", "1.png"]


def test_broken_sources(tmp_path):
    (tmp_path / "empty").mkdir()
    with pytest.raises(SpecError, match="contains no images"):
        image_paths(tmp_path / "empty")
    (tmp_path / "list.txt").write_text("\ngone.png\n")
    with pytest.raises(SpecError, match=r'list.txt:2:1: no such image "gone.png"'):
        image_paths(tmp_path / "list.txt")
    with pytest.raises(SpecError, match="cannot be read"):
        image_paths(tmp_path / "absent.txt")
    with pytest.raises(SpecError, match="single image"):
        image_paths(tmp_path / "a.png")
    with pytest.raises(InputError, match="no such image"):
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


def test_a_video_whose_name_is_not_utf8_is_refused(tmp_path):
    for read in (video_length, lambda path: next(video_frames(path))):
        with pytest.raises(InputError, match="no video whose path is not UTF-8; rename it"):
            read(tmp_path / os.fsdecode(b"caf\xe9.mp4"))


def test_pictures_are_written_into_a_folder_of_any_name(tmp_path):
    folder = tmp_path / os.fsdecode(b"caf\xe9")
    folder.mkdir()
    image = np.random.default_rng(0).integers(0, 256, (4, 5, 3), np.uint8)
    write_picture(folder / "a.png", image, cv2.IMWRITE_PNG_COMPRESSION, 1)
    assert np.array_equal(read_bgr(folder / "a.png"), image)
    with pytest.raises(InputError, match="cannot be written: No such file or directory"):
        write_picture(folder / "nowhere" / "a.png", image)
