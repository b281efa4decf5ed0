"""Describer, which computes the descriptor of an image with a net, alone and in a loop-closure detector."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.detector.detector import LoopDetector
from netspec.data.database import open_reader
from netspec.data.datum import datum_to_array, parse_datum
from netspec.errors import SpecError
from netspec.inspect.features.describer import Describer
from netspec.inspect.features.records import extract_records
from netspec.load import load_net
from newest import newest
from paths import GOLDEN


@pytest.fixture
def describe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Describer:
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    (tmp_path / "sgd_step").symlink_to(GOLDEN / "snapshot")
    monkeypatch.chdir(tmp_path)
    return Describer("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel")


def test_descriptors_equal_those_of_the_whole_net(describe: Describer) -> None:
    net = load_net("sgd_step/train_val.prototxt", weights="sgd_step/init.caffemodel")
    expected = extract_records(net, ["feat"], 1)["feat"]
    net.close()
    reader = open_reader("pairs/test_lmdb")
    for k in range(3):
        image = datum_to_array(parse_datum(reader.record(k)))[0]  # the first of the pair
        assert np.allclose(describe(image), expected[k], atol=1e-5)
        assert np.allclose(describe(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)), expected[k], atol=1e-2)


def test_describer_reads_weights_from_several_files(describe: Describer) -> None:
    image = np.random.default_rng(2).integers(0, 256, (28, 28), dtype=np.uint8)
    both = Describer("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel,sgd_step/init.caffemodel")
    assert np.array_equal(both(image), describe(image))
    with pytest.raises(SpecError, match=r"^gone\.caffemodel: cannot be read: No such file"):
        Describer("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel, gone.caffemodel")


def test_fingerprint_depends_on_net_weights_and_scale_only(describe: Describer, tmp_path: Path) -> None:
    prototxt, weights = Path("sgd_step/train_val.prototxt"), Path("sgd_step/init.caffemodel")
    (tmp_path / "same.prototxt").write_text(f"# a comment\n{prototxt.read_text()}")
    assert Describer("same.prototxt", weights, engine="onnxruntime", cache=tmp_path).fingerprint == describe.fingerprint
    others = [Describer(prototxt, weights, scale=2), Describer(prototxt, f"{weights},{weights}")]
    assert len({describe.fingerprint, *(other.fingerprint for other in others)}) == 3


def test_images_of_any_size_are_resized(describe: Describer) -> None:
    image = np.random.default_rng(0).integers(0, 256, (60, 90, 3), dtype=np.uint8)
    small = cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), (28, 28))
    assert np.array_equal(describe(image), describe(small))


def test_zooms_are_center_crops_that_a_detector_uses(describe: Describer) -> None:
    near = Describer("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel", zooms="1,0.5")
    images = np.random.default_rng(1).integers(0, 256, (8, 56, 56, 3), dtype=np.uint8)
    descriptor = near(images[0])
    np.testing.assert_allclose(descriptor, [*describe(images[0]), *describe(images[0][14:42, 14:42])], atol=1e-6)
    detectors = [LoopDetector(d, exclude_recent=2, threshold=-1e-3, check=None) for d in (describe, near)]
    for detector in detectors:
        for image in images:
            detector.add(image)
    # A step ahead, the camera sees what was in the middle.
    assert [newest(detector.add, images[3][14:42, 14:42]).match for detector in detectors] == [None, 3]


@pytest.mark.parametrize(
    ("zooms", "fault"), [("1,x", "expected numbers"), (1.5, "at most 1"), ("0", "a number above 0")]
)
def test_invalid_zooms_are_refused(describe: Describer, zooms: str | float, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        Describer("sgd_step/train_val.prototxt", "sgd_step/init.caffemodel", zooms=zooms)


def test_a_detector_accepts_a_describer(describe: Describer) -> None:
    images = np.random.default_rng(1).integers(0, 256, (8, 28, 28, 3), dtype=np.uint8)
    detector = LoopDetector(describe, exclude_recent=2, threshold=-1e-3, check=None)
    for image in images:
        detector.add(image)
    assert newest(detector.add, images[3]).match == 3
