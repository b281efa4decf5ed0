"""SSD's AnnotatedData: images and boxes as they are read, resized, cropped, augmented and sampled."""

import itertools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from annotated_records import annotated, write
from netspec import use_dialect
from netspec.data.datum import array_to_datum
from netspec.errors import SpecError
from netspec.graph.options import BuildOptions
from netspec.layers import Context, Layer, layer_class
from netspec.proto.schema import TEST, TRAIN
from netspec.proto.text import parse_net_text


@pytest.fixture(autouse=True)
def _ssd() -> None:
    use_dialect("ssd")


def reading(
    source: Path, transform: str = "", more: str = "", batch: int = 1, phase: int = TEST, seed: int = 0
) -> Layer:
    text = f"""layer {{ name: "data" type: "AnnotatedData" top: "data" top: "label" transform_param {{ {transform} }}
        data_param {{ source: "{source}" batch_size: {batch} backend: LMDB prefetch: 0 }}
        annotated_data_param {{ {more} }} }}"""
    net, places = parse_net_text(text, "net.prototxt")
    cls = layer_class("AnnotatedData")
    assert cls is not None
    at = lambda *path: places.at(0, *path, layer="data", type="AnnotatedData")  # noqa: E731
    return cls(net.layer[0], [], Context(phase, BuildOptions(data_seed=seed), at=at))


def batch_of(layer: Layer) -> tuple[np.ndarray, np.ndarray]:
    data, label = layer.run()
    assert [tuple(data.shape), tuple(label.shape)] == layer.top_shapes
    return data.numpy(), label.numpy()


def noise(height: int, width: int, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(height).integers(0, 256, (height, width, channels), np.uint8)


OBJECTS = [(3, (0.1, 0.2, 0.5, 0.75), False), (3, (0.0, 0.0, 0.25, 0.5), True), (5, (0.5, 0.25, 1.0, 1.0), False)]


@pytest.mark.parametrize("encode", [False, True], ids=["raw", "encoded"])
def test_tops_are_images_and_rows_of_boxes(tmp_path: Path, encode: bool) -> None:
    first, second = noise(8, 12), noise(8, 12) // 2
    source = write(tmp_path, annotated(first, OBJECTS, encode), annotated(second, OBJECTS[2:], encode))
    data, label = batch_of(reading(source, "mean_value: 10 mean_value: 20 mean_value: 30 scale: 0.5", batch=2))
    expected = (np.stack([first, second]).astype(float) - [10, 20, 30]) * 0.5
    np.testing.assert_allclose(data, expected.transpose(0, 3, 1, 2))
    rows = [
        (0, 3, 0, 0.1, 0.2, 0.5, 0.75, 0),
        (0, 3, 1, 0.0, 0.0, 0.25, 0.5, 1),
        (0, 5, 0, 0.5, 0.25, 1.0, 1.0, 0),
        (1, 5, 0, 0.5, 0.25, 1.0, 1.0, 0),
    ]
    np.testing.assert_allclose(label[0, 0], rows, atol=1e-6)


def test_label_without_boxes_is_one_row_of_minus_one(tmp_path: Path) -> None:
    layer = reading(write(tmp_path, annotated(noise(4, 4), [])))
    assert layer.top_shapes[1] == (1, 1, 1, 8)
    assert np.array_equal(batch_of(layer)[1], np.full((1, 1, 1, 8), -1))


def test_label_of_records_without_a_type_is_that_of_the_datum(tmp_path: Path) -> None:
    datum = annotated(noise(4, 4), OBJECTS)
    datum.ClearField("type")
    source = write(tmp_path, datum)
    assert batch_of(reading(source))[1].tolist() == [[[[7]]]]
    assert batch_of(reading(source, more="anno_type: BBOX"))[1].shape == (1, 1, 3, 8)


@pytest.mark.parametrize(
    ("height", "width", "inner"), [(10, 20, (15, 30)), (20, 10, (30, 15))], ids=["landscape", "portrait"]
)
def test_resize_mode_fit_large_size_and_pad_moves_the_boxes(
    tmp_path: Path, height: int, width: int, inner: tuple[int, int]
) -> None:
    image = noise(height, width)
    resize = "resize_param { resize_mode: FIT_LARGE_SIZE_AND_PAD height: 30 width: 30 pad_value: 9 }"
    data, label = batch_of(reading(write(tmp_path, annotated(image, OBJECTS)), resize))
    top, left = (30 - inner[0]) // 2, (30 - inner[1]) // 2
    expected = np.full((3, 30, 30), 9.0)
    small = cv2.resize(image, inner[::-1]).transpose(2, 0, 1)
    expected[:, top : top + inner[0], left : left + inner[1]] = small
    np.testing.assert_array_equal(data[0], expected)
    moved = [
        [
            ((30 - inner[1]) / 2 + x * inner[1]) / 30 if k % 2 == 0 else ((30 - inner[0]) / 2 + x * inner[0]) / 30
            for k, x in enumerate(box)
        ]
        for _, box, _ in OBJECTS
    ]
    np.testing.assert_allclose(label[0, 0, :, 3:7], moved, atol=1e-6)


def test_resize_mode_fit_small_size_scales_boxes_by_height_scale_and_width_scale(tmp_path: Path) -> None:
    resize = "resize_param { resize_mode: FIT_SMALL_SIZE height: 8 width: 8 %s }"
    source = write(tmp_path, annotated(noise(10, 20), OBJECTS))
    data, label = batch_of(reading(source, resize % ""))
    assert data.shape == (1, 3, 8, 16)
    np.testing.assert_allclose(label[0, 0, :, 3:7], [box for _, box, _ in OBJECTS], atol=1e-6)
    scaled = batch_of(reading(source, resize % "height_scale: 16 width_scale: 32"))[1]
    np.testing.assert_allclose(scaled[0, 0, :, 3:7], np.array([box for _, box, _ in OBJECTS]) / 2, atol=1e-6)


@pytest.mark.parametrize(
    ("constraint", "kept"),
    [
        ("", [1, 2]),
        ("emit_type: CENTER", [1]),
        ("emit_type: MIN_OVERLAP emit_overlap: 0.1", [1, 2]),
        ("emit_type: MIN_OVERLAP emit_overlap: 0.3", [1]),
    ],
    ids=["none", "CENTER", "MIN_OVERLAP_0.1", "MIN_OVERLAP_0.3"],
)
def test_emit_constraint_selects_boxes(tmp_path: Path, constraint: str, kept: list[int]) -> None:
    boxes = [(1, (0.3, 0.3, 0.6, 0.6), False), (2, (0.0, 0.0, 0.48, 0.48), False)]  # 23 % of the second are inside
    emit = f"emit_constraint {{ {constraint} }}" if constraint else ""
    label = batch_of(reading(write(tmp_path, annotated(noise(20, 20), boxes)), f"crop_size: 10 {emit}"))[1]
    assert label[0, 0, :, 1].tolist() == kept


SSD = """mirror: true mean_value: 104 mean_value: 117 mean_value: 123
    resize_param { prob: 1 resize_mode: WARP height: 60 width: 60 interp_mode: LINEAR interp_mode: AREA
                   interp_mode: NEAREST interp_mode: CUBIC interp_mode: LANCZOS4 }
    emit_constraint { emit_type: CENTER }
    expand_param { prob: 0.5 max_expand_ratio: 3 }"""
DISTORT = """distort_param { brightness_prob: 0.5 brightness_delta: 32 contrast_prob: 0.5 contrast_lower: 0.5
    contrast_upper: 1.5 hue_prob: 0.5 hue_delta: 18
    saturation_prob: 0.5 saturation_lower: 0.5 saturation_upper: 1.5 }"""
SAMPLERS = "batch_sampler { max_sample: 1 max_trials: 1 } " + " ".join(
    f"""batch_sampler {{ sampler {{ min_scale: 0.3 max_scale: 1 min_aspect_ratio: 0.5 max_aspect_ratio: 2 }}
        sample_constraint {{ {limit} }} max_sample: 1 max_trials: 50 }}"""
    for limit in ("min_jaccard_overlap: 0.1", "min_jaccard_overlap: 0.7", "max_jaccard_overlap: 1.0")
)


@pytest.mark.slow
def test_boxes_stay_on_their_objects_in_augmented_images(tmp_path: Path) -> None:
    image = np.full((90, 120, 3), (104, 117, 123), np.uint8)
    image[30:60, 20:80] = 255
    source = write(tmp_path, annotated(image, [(1, (20 / 120, 30 / 90, 80 / 120, 60 / 90), False)]))
    layer = reading(source, SSD, SAMPLERS, batch=64, phase=TRAIN)
    data, label = batch_of(layer)
    rows = {int(row[0]): row for row in label[0, 0]}
    assert len(rows) > 50
    shapes = set()
    for i, row in rows.items():
        bright = data[i].min(axis=0) > 60
        ys, xs = np.nonzero(bright)
        found = np.array([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1])
        np.testing.assert_allclose(found, row[3:7] * 60, atol=2.5)
        shapes.add(tuple(found))
    assert len(shapes) > 40


def test_augmentation_is_determined_by_the_seed_and_differs_in_each_epoch(tmp_path: Path) -> None:
    source = write(tmp_path, annotated(noise(40, 50), OBJECTS))
    runs = [reading(source, SSD + DISTORT, SAMPLERS, batch=4, phase=TRAIN, seed=seed) for seed in (1, 1, 2)]
    first, again, other = (batch_of(layer) for layer in runs)
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])
    assert len({image.tobytes() for image in first[0]}) == 4


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ("brightness_prob: 1 brightness_delta: 40", lambda x: None),
        ("contrast_prob: 1 contrast_lower: 0.5 contrast_upper: 0.5", lambda x: np.rint(x * 0.5)),
        ("contrast_prob: 1 contrast_lower: 3 contrast_upper: 3", lambda x: np.minimum(x * 3.0, 255)),
        ("saturation_prob: 1 saturation_lower: 0 saturation_upper: 0", lambda x: x.max(axis=2, keepdims=True) + 0 * x),
        ("hue_prob: 0 hue_delta: 90", lambda x: x),
    ],
    ids=["brightness", "less_contrast", "more_contrast", "no_saturation", "hue_prob_0"],
)
def test_distort_param_changes_the_colors(
    tmp_path: Path, settings: str, expected: Callable[[np.ndarray], np.ndarray | None]
) -> None:
    image = noise(6, 6)
    data, _ = batch_of(reading(write(tmp_path, annotated(image, [])), f"distort_param {{ {settings} }}", phase=TRAIN))
    wanted = expected(image)
    found = data[0].transpose(1, 2, 0)
    if wanted is None:  # one number is added to all
        inside = (found > 0) & (found < 255)
        assert len(np.unique((found - image)[inside])) == 1
    else:
        np.testing.assert_array_equal(found, wanted)


def test_random_order_prob_permutes_the_channels(tmp_path: Path) -> None:
    image = noise(3, 3)
    layer = reading(write(tmp_path, annotated(image, [])), "distort_param { random_order_prob: 1 }", batch=40)
    orders = set()
    for one in batch_of(layer)[0]:
        orders.add(tuple(next(c for c in range(3) if np.array_equal(plane, image[:, :, c])) for plane in one))
    assert orders == set(itertools.permutations(range(3)))


CONSTRAINTS = {
    "min_jaccard_overlap": ("min_jaccard_overlap: 0.4", lambda jaccard, sample, object_: jaccard >= 0.4),
    "max_jaccard_overlap": ("max_jaccard_overlap: 0.2", lambda jaccard, sample, object_: jaccard <= 0.2),
    "sample_coverage": (
        "min_sample_coverage: 0.5 max_sample_coverage: 0.8",
        lambda jaccard, sample, object_: 0.5 <= sample <= 0.8,
    ),
    "min_object_coverage": ("min_object_coverage: 0.9", lambda jaccard, sample, object_: object_ >= 0.9),
}


@pytest.mark.slow
@pytest.mark.parametrize(("limits", "meets"), CONSTRAINTS.values(), ids=CONSTRAINTS)
def test_sampled_windows_meet_their_constraint(tmp_path: Path, limits: str, meets: Callable[..., bool]) -> None:
    """The image shows its own coordinates, so that the window can be read from it."""
    y, x = np.mgrid[:200, :200].astype(np.uint8)
    image = np.dstack([y, x, np.zeros_like(x)])
    box = (0.2, 0.3, 0.7, 0.8)
    more = f"""batch_sampler {{ sampler {{ min_scale: 0.2 max_scale: 1 min_aspect_ratio: 0.5 max_aspect_ratio: 2 }}
        sample_constraint {{ {limits} }} max_sample: 1 max_trials: 500 }}"""
    layer = reading(write(tmp_path, annotated(image, [(1, box, False)])), "", more, phase=TRAIN)
    for _ in range(20):
        data, _ = batch_of(layer)
        top, left, low, right = data[0, 0].min(), data[0, 1].min(), data[0, 0].max() + 1, data[0, 1].max() + 1
        window = np.array([left, top, right, low]) / 200
        across = min(window[2], box[2]) - max(window[0], box[0])
        down = min(window[3], box[3]) - max(window[1], box[1])
        common = max(across, 0) * max(down, 0)
        area, own = (window[2] - window[0]) * (window[3] - window[1]), 0.25
        measured = [common / (area + own - common), common / area, common / own]
        assert any(meets(*(m + slack for m in measured)) for slack in (-0.02, 0, 0.02))  # whole pixels


INVALID = {
    "resize_param_width": ("resize_param { height: 5 }", "", 1, "height and width must both be above 0"),
    "FIT_SMALL_SIZE": ("resize_param { height: 5 width: 5 resize_mode: FIT_SMALL_SIZE }", "", 2, "batch_size: 1"),
    "max_expand_ratio": ("expand_param { max_expand_ratio: 1 }", "", 1, "max_expand_ratio must be above 1"),
    "mean_values": ("mean_value: 1 mean_value: 2", "", 1, "found 2 mean_value for 3 channels"),
    "crop_size": ("crop_size: 99", "", 1, "the crop is 99 x 99, larger than the image, 8 x 8"),
    "contrast": ("distort_param { contrast_lower: 2 contrast_upper: 1 }", "", 1, "found contrast from 2 to 1"),
    "sampler_scale": ("", "batch_sampler { sampler { max_scale: 2 } }", 1, "found scales 1 to 2"),
    "sampler_ratio": ("", "batch_sampler { sampler { min_aspect_ratio: 0 } }", 1, "found aspect ratios 0 to 1"),
    "size_of_a_record": ("", "", 2, 'record "0001" gives 3 x 8 x 9, the first 3 x 8 x 8'),
}


@pytest.mark.parametrize(("transform", "more", "batch", "fault"), INVALID.values(), ids=INVALID)
def test_invalid_settings_are_refused(tmp_path: Path, transform: str, more: str, batch: int, fault: str) -> None:
    source = write(tmp_path, annotated(noise(8, 8), OBJECTS), annotated(noise(8, 9), OBJECTS))
    with pytest.raises(SpecError, match=fault):
        batch_of(reading(source, transform, more, batch))


def test_a_database_of_plain_images_is_refused_with_its_kind(tmp_path: Path) -> None:
    with pytest.raises(SpecError, match='record "0000" is no AnnotatedDatum; for a database of plain images use'):
        reading(write(tmp_path, array_to_datum(noise(4, 4).transpose(2, 0, 1), 1)))


def test_shapes_are_known_without_data() -> None:
    text = "type: 'AnnotatedData' top: 'data' top: 'label' data_param { source: 'x' batch_size: 8 }"
    means = "mean_value: 1 mean_value: 2 mean_value: 3"
    for transform, shape in (
        (f"{means} resize_param {{ height: 5 width: 6 }}", (8, 3, 5, 6)),
        (f"{means} resize_param {{ height: 5 width: 6 }} crop_size: 4", (8, 3, 4, 4)),
        ("force_gray: true crop_h: 4 crop_w: 3", (8, 1, 4, 3)),
    ):
        net, _ = parse_net_text(f"layer {{ {text} transform_param {{ {transform} }} }}", "net.prototxt")
        cls = layer_class("AnnotatedData")
        assert cls is not None
        layer = cls(net.layer[0], [], Context(options=BuildOptions(open_data=False)))
        assert layer.top_shapes == [shape, (1, 1, 1, 8)]


def test_one_of_several_resize_params_is_drawn_every_ten_batches(tmp_path: Path) -> None:
    source = write(tmp_path, annotated(noise(8, 12), OBJECTS), annotated(noise(10, 10), OBJECTS))
    sizes = " ".join(f"resize_param {{ prob: 0.5 height: {size} width: {size} }}" for size in (6, 9))
    layer = reading(source, sizes, batch=2)
    seen = [batch_of(layer)[0].shape[2] for _ in range(80)]
    assert set(seen) == {6, 9}
    assert all(len(set(seen[i : i + 10])) == 1 for i in range(0, 80, 10))
    with pytest.raises(SpecError, match="found 2 resize_param with a sum of prob of 2, expected 1"):
        reading(source, sizes.replace("0.5", "1"))


def test_yolo_data_type_1_returns_boxes_by_center_and_size(tmp_path: Path) -> None:
    source = write(tmp_path, annotated(noise(8, 12), OBJECTS))
    _, label = batch_of(reading(source, more="yolo_data_type: 1 yolo_data_jitter: 0 train_diffcult: false"))
    assert label.shape == (1, 1, 300, 5)
    expected = [(2, 0.3, 0.475, 0.4, 0.55), (4, 0.75, 0.625, 0.5, 0.75)]
    np.testing.assert_allclose(label[0, 0, :2], expected, atol=1e-6)
    assert not label[0, 0, 2:].any()


def test_yolo_data_jitter_crops_other_windows_in_each_batch(tmp_path: Path) -> None:
    source = write(tmp_path, annotated(noise(40, 40), OBJECTS))
    layer = reading(source, "resize_param { height: 20 width: 20 }", more="yolo_data_type: 1 yolo_data_jitter: 0.5")
    sums = {float(batch_of(layer)[0].sum()) for _ in range(10)}
    assert len(sums) > 5
