"""Temporal segment networks: videos as folders of frames, crops of several sizes, shuffled databases."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fresh_dialects import used_by
from netspec import use_dialect
from netspec.errors import SpecError
from netspec.layers import Context, Layer
from netspec.layers.data.files import ReadingLayer
from netspec.net.one_layer import make_layer
from netspec.proto.schema import TEST, TRAIN
from paths import GOLDEN


def layer_of(text: str, phase: int) -> Layer:
    use_dialect("tsn")
    return make_layer(text, (), Context(phase), 2)


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    """Two videos of 12 frames, images and flow; all pixels of frame i are i, of its flow along x 100 + i, y 200 + i."""
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        for i in range(1, 13):
            for file, value in ((f"img_{i:05d}", i), (f"flow_x_{i:05d}", 100 + i), (f"flow_y_{i:05d}", 200 + i)):
                cv2.imwrite(str(tmp_path / name / f"{file}.png"), np.full((8, 10, 3), value, np.uint8))
    (tmp_path / "list.txt").write_text(f"{tmp_path}/one 12 3\n{tmp_path}/two 12 5\n")
    return tmp_path


def video(videos: Path, given: str, transform: str = "", phase: int = TEST) -> Layer:
    settings = f'source: "{videos}/list.txt" batch_size: 2 {given}'
    text = f"type: 'VideoData' video_data_param {{ {settings} }} transform_param {{ {transform} }}"
    return layer_of(text, phase)


def test_frames_in_testing_are_the_middle_ones_of_each_segment(videos: Path) -> None:
    layer = video(videos, 'new_length: 2 num_segments: 2 modality: RGB name_pattern: "img_%05d.png"')
    frames, labels = layer.run()
    layer.close()
    assert frames.shape == (2, 12, 8, 10)
    assert frames[0, :, 0, 0].tolist() == [3, 3, 3, 4, 4, 4, 9, 9, 9, 10, 10, 10]
    assert labels.flatten().tolist() == [3, 5]


def test_mirrored_flow_is_negated_along_x(videos: Path) -> None:
    given = 'new_length: 2 num_segments: 1 modality: FLOW name_pattern: "flow_%c_%05d.png"'
    layer = video(videos, given, "mirror: true is_flow: true crop_size: 6 mean_value: 128", TRAIN)
    seen = set()
    for _ in range(20):
        for frames in layer.run()[0]:
            x1, y1, x2, y2 = (frames[:, 0, 0] + 128).tolist()
            mirrored = x1 > 130
            assert ((255 - x1 if mirrored else x1), y1, (255 - x2 if mirrored else x2)) == (y1 - 100, y1, y2 - 100)
            assert y2 == y1 + 1
            seen.add((mirrored, y1))
    layer.close()
    assert {mirrored for mirrored, _ in seen} == {False, True}
    assert len(seen) > 10  # parts begin anywhere


def test_multi_scale_crops_are_resized_to_crop_size() -> None:
    """Images are 40 x 30 at least; all sizes come to crop_size."""
    given = "crop_size: 16 multi_scale: true fix_crop: true more_fix_crop: true scale_ratios: [1, 0.75] max_distort: 1"
    text = f"type: 'Data' data_param {{ source: '{GOLDEN}/pairs/train_lmdb' backend: LMDB batch_size: 4 }}"
    layer = layer_of(f"{text} transform_param {{ {given} }}", TRAIN)
    batches = [layer.run()[0] for _ in range(3)]
    layer.close()
    assert {tuple(batch.shape[2:]) for batch in batches} == {(16, 16)}
    assert not torch.equal(batches[0], batches[1])


def test_the_first_epoch_is_read_in_order_and_later_ones_are_shuffled() -> None:
    text = f"type: 'Data' data_param {{ source: '{GOLDEN}/pairs/train_lmdb' backend: LMDB batch_size: 1 %s }}"
    layer, plain = (layer_of(text % given, TRAIN) for given in ("shuffle: true", ""))
    assert isinstance(layer, ReadingLayer)
    assert isinstance(plain, ReadingLayer)
    count = layer.num_records
    first, second = ([layer.keys(i)[0] for i in range(n * count, (n + 1) * count)] for n in (0, 1))
    assert first == [plain.keys(i)[0] for i in range(count)] == sorted(second)
    assert first != second
    layer.close()
    plain.close()


@pytest.mark.parametrize(
    ("given", "transform", "fault"),
    [
        ("new_height: 4", "", "new_height and new_width must be given together"),
        ("num_segments: 0", "", "num_segments must be at least 1"),
        ('name_pattern: "img.png"', "", r"expected a pattern as flow_%c_%05d.jpg"),
        ('name_pattern: "flow_%c_%05d.png"', "multi_scale: true", "multi_scale and fix_crop need crop_size"),
        ('name_pattern: "none_%c_%05d.png"', "", "none_x_00005.png"),
    ],
    ids=["new_width", "num_segments", "name_pattern", "multi_scale", "missing_frame"],
)
def test_invalid_settings_are_refused(videos: Path, given: str, transform: str, fault: str) -> None:
    with pytest.raises(SpecError, match=fault):
        video(videos, f"new_length: 4 {given}", transform)


def test_a_line_without_a_label_is_refused(videos: Path) -> None:
    (videos / "list.txt").write_text("one 12\n")
    with pytest.raises(SpecError, match='found "one 12", expected the folder of a video, how many frames it has'):
        video(videos, "")


def test_shuffle_activates_tsn_in_data_param_only() -> None:
    """Caffe has a field shuffle too, in image_data_param and hdf5_data_param."""
    text = """layer { name: "data" type: "Data" top: "data" data_param { source: "x" %s } }
        layer { name: "image" type: "ImageData" top: "image" image_data_param { source: "x" shuffle: true } }"""
    assert used_by(text % "") == []
    assert used_by(text % "shuffle: true") == ["tsn"]
