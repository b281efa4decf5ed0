"""Images, poses and calibration from ROS 1 and ROS 2 bags, written with the library that reads them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.cli import main
from loopclosure.errors import InputError
from loopclosure.places.bags import open_bag
from loopclosure.places.sequences import read_sequence
from loopclosure.places.source import extract
from places_layouts import COUNT, path, picture, quaternions

pytest.importorskip("rosbags")
from faults.recordings import read_bag
from places_bags import START_S, Bag


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "ros", "encoding"), [("a.bag", 1, "rgb8"), ("b", 2, "bgr8"), ("c.bag", 1, "png"), ("d", 2, "png")]
)
def test_a_bag_becomes_a_sequence(name: str, ros: int, encoding: str, tmp_path: Path) -> None:
    bag = Bag(tmp_path / name, ros, encoding).file
    folder, said = extract(bag, tmp_path / "frames")
    assert said == f"{bag}: 48 frames of /cam/image, poses of /odom, moved from base to camera: {folder}"
    sequence = read_sequence(folder)
    assert len(sequence) == COUNT
    image = cv2.imread(str(sequence.paths[7]))
    np.testing.assert_array_equal(image, picture(7))
    assert sequence.stamps is not None
    assert sequence.stamps[7] == START_S + 7
    assert sequence.poses is not None
    np.testing.assert_allclose(sequence.poses[:, :3], path()[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(sequence.poses[:, 3:] * quaternions(path()), axis=1)), 1, atol=1e-5)
    assert sequence.camera is not None
    assert (sequence.camera.fy, sequence.camera.distortion[:2]) == (28.25, (0.1, -0.2))


@pytest.mark.slow
def test_a_damaged_bag_is_reported_in_one_line(tmp_path: Path) -> None:
    """Damage in the index, in a header, in a message, in the text file next to it."""
    whole = Bag(tmp_path / "whole.bag", 1, "mono8", count=3).file.read_bytes()
    folder = Bag(tmp_path / "two", 2, "mono8", count=3).file
    text = (folder / "metadata.yaml").read_text()
    damaged = {tmp_path / f"{at}.bag": whole[:at] + b"\xff\xff" + whole[at + 2 :] for at in range(20, len(whole), 997)}
    damaged |= {tmp_path / f"{word}.bag": whole.replace(word.encode(), b"xx") for word in ("op=", "topic=", "frame")}
    refused = 0
    for file, data in damaged.items():
        file.write_bytes(data)
        refused += is_refused(file)
    assert refused > 5
    for old, new in (("nanoseconds_since_epoch", "'data'"), ("storage_identifier", "other"), ("files:", "files: 7 #")):
        (folder / "metadata.yaml").write_text(text.replace(old, new))
        assert is_refused(folder) or old == "files:"
    (folder / "metadata.yaml").write_text(text)
    (folder / "two.db3").write_bytes((folder / "two.db3").read_bytes()[:9000])
    assert is_refused(folder)


def is_refused(file: Path) -> bool:
    try:
        read_bag(file)
    except InputError:
        return True
    return False


def test_errors_of_the_caller_of_a_bag_are_passed_on(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "a.bag", 1, count=1).file
    with pytest.raises(ZeroDivisionError), open_bag(bag):
        raise ZeroDivisionError


@pytest.mark.slow
def test_one_of_several_topics_must_be_chosen(tmp_path: Path) -> None:
    bag = Bag(tmp_path / "two.bag", 1, second_camera=True).file
    with pytest.raises(
        InputError, match="several topics with images: /cam/image, /other/image; choose one with topic="
    ):
        extract(bag, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()
    with pytest.raises(InputError, match='has no topic "/odom" with images; there are: /cam/image, /other/image'):
        extract(bag, tmp_path / "frames", "/odom")
    assert "48 frames of /other/image" in extract(bag, tmp_path / "frames", "/other/image")[1]


def test_other_files_than_bags_are_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "no.bag").write_bytes(b"nothing")
    (tmp_path / "no").mkdir()
    (tmp_path / "no" / "metadata.yaml").write_text("a: [")
    for name in ("no.bag", "no"):
        with pytest.raises(InputError, match="cannot be read as a ROS bag") as caught:
            extract(tmp_path / name, tmp_path / "frames")
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"gone\.bag: no such file"):
        extract(tmp_path / "gone.bag", tmp_path / "frames")


@pytest.mark.slow
def test_the_commands_accept_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = Bag(tmp_path / "drive.bag", 1).file
    line = f"evaluate {bag} --method thumbnails --out {tmp_path / 'report'}"
    assert main(line.split()) == 0
    line = f"detect {bag} --threshold -0.001 --exclude-recent 10 --out {tmp_path / 'found'}"
    assert main(line.split()) == 0
    assert "24 of 24 loops are the same place by their poses" in capsys.readouterr().out
