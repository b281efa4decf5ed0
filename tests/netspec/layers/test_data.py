"""The layers that read data (Data, ImageData, HDF5Data, WindowData), and those that make or hold it."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch
from google.protobuf import text_format

from contexts import context
from netspec.data.database import Writer, open_reader
from netspec.data.datum import array_to_datum, datum_to_array, parse_datum
from netspec.errors import SpecError, Where
from netspec.layers import Layer, layer_class
from netspec.layers.data.files import ReadingLayer
from netspec.layers.data.memory import MemoryData
from netspec.proto.schema import TEST, TRAIN, LayerParameter
from paths import GOLDEN

PAIRS = GOLDEN / "pairs" / "train_lmdb"
IMAGES = GOLDEN / "images"


def data_layer(text: str, phase: int = TEST, seed: int = 0, device: str = "cpu", **facts: Any) -> Layer:
    param = text_format.Merge(text, LayerParameter())
    cls = layer_class(param.type)
    assert cls is not None
    at = lambda *path: Where("net.prototxt", 1, 2, ".".join(map(str, path)))  # noqa: E731
    return cls(param, [], context(phase=phase, data_seed=seed, at=at, device=device, **facts))


def reading(text: str, **context: Any) -> ReadingLayer:
    layer = data_layer(text, **context)
    assert isinstance(layer, ReadingLayer)
    return layer


def pairs(
    batch_size: int = 32, more: str = "", transform: str = "", source: object = PAIRS, **context: Any
) -> ReadingLayer:
    return reading(
        f'name: "pair_data" type: "Data" top: "pair_data" top: "sim" transform_param {{ {transform} }}'
        f' data_param {{ source: "{source}" batch_size: {batch_size} backend: LMDB {more} }}',
        **context,
    )


def golden_records() -> list[tuple[np.ndarray, int]]:
    reader = open_reader(str(PAIRS))
    datums = [parse_datum(reader.record(i)) for i in range(len(reader))]
    return [(datum_to_array(datum), datum.label) for datum in datums]


# Data


def test_data_returns_the_records_in_order() -> None:
    layer = pairs(transform="scale: 0.00390625")
    assert layer.top_shapes == [(32, 2, 28, 28), (32,)]
    records = golden_records()
    for i in range(21):
        images, labels = layer.run()
        here = [records[(32 * i + j) % 640] for j in range(32)]
        assert images.dtype == labels.dtype == torch.float32
        assert (images.numpy() == np.stack([image for image, _ in here]) / np.float32(256)).all()
        assert labels.tolist() == [label for _, label in here]
    assert layer.keys(20) == [f"{k:08d}" for k in range(32)]
    assert layer.num_records == 640
    layer.close()


def test_restart_returns_to_the_first_record_or_to_any_iteration() -> None:
    layer = pairs(transform="mirror: true", phase=TRAIN)
    batches = [layer.run()[0] for _ in range(5)]
    layer.restart()
    assert torch.equal(layer.run()[0], batches[0])
    layer.restart(4)
    assert layer.iteration == 4
    assert torch.equal(layer.run()[0], batches[4])
    layer.close()


def test_seed_and_phase_change_the_crops_but_not_the_records() -> None:
    first, other, test = (
        pairs(64, transform="crop_size: 20", phase=phase, seed=seed).run()
        for phase, seed in ((TRAIN, 0), (TRAIN, 1), (TEST, 0))
    )
    assert not torch.equal(first[0], other[0])
    assert not torch.equal(first[0], test[0])
    assert torch.equal(first[1], other[1])


def test_data_logs_what_caffe_logs(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    layer = pairs(32)
    assert caplog.messages == [f"Opened lmdb {PAIRS}", "output data size: 32,2,28,28"]
    caplog.clear()
    for _ in range(60):
        layer.run()
    # golden/log/caffe_train.log: 60 iterations of 32 pass the last of 640 records three times
    assert caplog.messages == ["Restarting data prefetching from start."] * 3
    assert caplog.records[0].__dict__["site"] == "data_layer.cpp:73"
    layer.close()


def test_data_without_a_label_top_returns_images_only() -> None:
    text = f'name: "d" type: "Data" top: "data" data_param {{ source: "{PAIRS}" batch_size: 3 backend: LMDB }}'
    layer = reading(text)
    assert layer.top_shapes == [(3, 2, 28, 28)]
    assert len(layer.run()) == 1
    layer.close()


def test_encoded_records_equal_raw_records_and_become_gray_with_force_gray() -> None:
    raw, encoded = (pairs(6, source=IMAGES / name).run()[0] for name in ("lmdb_plain", "lmdb_encoded"))
    assert torch.equal(raw, encoded)
    grey = pairs(6, transform="force_gray: true", source=IMAGES / "lmdb_encoded")
    assert grey.top_shapes[0] == (6, 1, 48, 64)


def test_rand_skip_passes_over_the_first_records() -> None:
    layer = pairs(1, "rand_skip: 500", seed=4)
    skipped = int(layer.keys(0)[0])
    assert 0 < skipped < 500
    assert pairs(1, "rand_skip: 500", seed=4).keys(0) == [f"{skipped:08d}"]


def test_top_of_batch_size_one_has_the_shape_of_each_image(tmp_path: Path) -> None:
    with Writer(str(tmp_path / "db")) as writer:
        for i, width in enumerate((8, 9)):
            writer.put(b"%08d" % i, array_to_datum(np.zeros((3, 8, width), np.uint8)).SerializeToString())
    layer = pairs(1, source=tmp_path / "db")
    shapes = []
    for _ in range(2):
        layer.run()
        shapes.append(layer.top_shapes[0])
    assert shapes == [(1, 3, 8, 8), (1, 3, 8, 9)]
    layer.close()


# Layers built without opening their data

DATA = 'name: "d" type: "Data" top: "data" top: "label" data_param { source: "x" batch_size: 8 }'
LIST = 'name: "d" type: "ImageData" top: "data" top: "label" image_data_param { source: "x" %s }'
ROWS = 'name: "d" type: "HDF5Data" top: "data" top: "label" hdf5_data_param { source: "x" batch_size: 8 }'
CUT = "transform_param { crop_size: 6 mean_value: 1 mean_value: 2 mean_value: 3 }"
WINDOWS = 'name: "d" type: "WindowData" top: "data" top: "label" window_data_param { source: "x" batch_size: 8 }'
IMAGE_BATCH, GREY_BATCH, LABELS = [(8, 3, 6, 6), (8,)], [(8, 1, 5, 4), (8,)], [(2, 5), (2,)]


WITHOUT_DATA = {
    "Data_given": (DATA, {"data": (2, 5)}, LABELS),  # the label follows
    "Data_and_label_given": (DATA, {"data": (2, 5), "label": (2, 1)}, [(2, 5), (2, 1)]),
    "Data_cropped": (DATA + CUT, {}, IMAGE_BATCH),
    "ImageData_resized": (LIST % "batch_size: 8 new_height: 5 new_width: 4 is_color: false", {}, GREY_BATCH),
    "ImageData_cropped": (
        LIST % "batch_size: 8 new_height: 5 new_width: 4" + "transform_param { crop_size: 6 }",
        {},
        IMAGE_BATCH,
    ),
    "HDF5Data_given": (ROWS, {"data": (2, 5), "label": (2,)}, LABELS),
    "WindowData_cropped": (WINDOWS + "transform_param { crop_size: 6 }", {}, IMAGE_BATCH),
}


@pytest.mark.parametrize(("text", "given", "expected"), WITHOUT_DATA.values(), ids=WITHOUT_DATA)
def test_shapes_are_known_without_data(text: str, given: Mapping[str, tuple[int, ...]], expected: list) -> None:
    assert data_layer(text, open_data=False, given_shapes=given, device="meta").top_shapes == expected


@pytest.mark.parametrize(
    ("text", "wanted"),
    [(DATA, "--shape data=8,C,H,W"), (LIST % "batch_size: 8", "--shape data=8,C,H,W"), (ROWS, "--shape data=8,...")],
    ids=["Data", "ImageData", "HDF5Data"],
)
def test_an_unknown_shape_of_data_is_refused_with_the_option_to_give(text: str, wanted: str) -> None:
    with pytest.raises(SpecError, match=f'the shape of "data" is known only from its data; give {wanted}, or --data$'):
        data_layer(text, open_data=False)


def test_each_unknown_shape_of_hdf5_data_is_reported() -> None:
    reported: list[SpecError] = []
    with pytest.raises(SpecError, match=r"give --shape label=8,\.\.\., or --data") as raised:
        data_layer(ROWS, open_data=False, report=reported.append)
    assert [fault.message.partition(" is known")[0] for fault in [*reported, raised.value]] == [
        'the shape of "data"',
        'the shape of "label"',
    ]


def test_running_a_layer_built_without_data_is_an_error() -> None:
    with pytest.raises(SpecError, match="built without opening its data"):
        data_layer(DATA + CUT, open_data=False).run()


# ImageData


def image_data(tmp_path: Path, more: str = "", batch_size: int = 4) -> ReadingLayer:
    (tmp_path / "list.txt").write_text((IMAGES / "list.txt").read_text())
    source = f'source: "{tmp_path}/list.txt" root_folder: "{IMAGES}/png/"'
    return reading(LIST.replace('source: "x"', source) % f"batch_size: {batch_size} {more}")


@pytest.mark.parametrize(
    ("more", "database"),
    [("", "lmdb_plain"), ("is_color: false", "lmdb_gray"), ("new_width: 28 new_height: 20", "lmdb_resized")],
    ids=["color", "gray", "resized"],
)
def test_image_data_reads_the_same_images_as_convert_imageset_stores(tmp_path: Path, more: str, database: str) -> None:
    found, stored = image_data(tmp_path, more, 6).run(), pairs(6, source=IMAGES / database).run()
    assert torch.equal(found[0], stored[0])
    assert torch.equal(found[1], stored[1])


def test_image_data_is_shuffled_anew_each_epoch(tmp_path: Path) -> None:
    layer = image_data(tmp_path, "shuffle: true", 6)
    epochs = [layer.keys(i) for i in range(6)]
    assert all(sorted(epoch) == [f"{i}.png" for i in range(6)] for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) > 3


def test_image_data_reports_a_missing_image_with_its_line(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("0.png 0\nnix.png 1\n")
    source = f'source: "{tmp_path}/list.txt" root_folder: "{IMAGES}/png/"'
    layer = reading(LIST.replace('source: "x"', source) % "batch_size: 1")
    layer.run()
    with pytest.raises(SpecError, match=r'list.txt:2:1: image ".*/png/nix.png" cannot be read: No such file'):
        layer.run()
    layer.close()


# HDF5


def test_hdf5_output_writes_what_hdf5_data_reads(tmp_path: Path, build: Callable[..., Layer]) -> None:
    with h5py.File(tmp_path / "in.h5", "w") as file:
        file["data"], file["label"] = np.arange(30.0).reshape(5, 2, 3), np.arange(5)
    (tmp_path / "list.txt").write_text(f"{tmp_path}/in.h5\n")
    layer = reading(
        'name: "h" type: "HDF5Data" top: "data" top: "label"'
        f' hdf5_data_param {{ source: "{tmp_path}/list.txt" batch_size: 3 }}'
    )
    assert layer.top_shapes == [(3, 2, 3), (3,)]
    sink = build(f'type: "HDF5Output" hdf5_output_param {{ file_name: "{tmp_path}/out.h5" }}', (3, 2, 3), (3,), tops=0)
    for _ in range(2):
        assert sink.run(*layer.run()) == ()
    layer.close()
    sink.close()
    with h5py.File(tmp_path / "out.h5") as file:
        label, data = np.asarray(file["label"]), np.asarray(file["data"])
    assert label.ravel().tolist() == [0, 1, 2, 3, 4, 0]
    assert data.shape == (6, 2, 3, 1)


# WindowData


def test_window_data_returns_windows_and_ignores_the_scale_of_transform_param(tmp_path: Path) -> None:
    windows = f"# 0\n{IMAGES}/png/0.png\n3\n48\n64\n2\n4 0.9 0 0 20 20\n0 0.1 10 10 40 40\n"
    (tmp_path / "w.txt").write_text(windows)
    layer = reading(
        'name: "w" type: "WindowData" top: "data" top: "label" transform_param { crop_size: 9 scale: 0.5 }'
        f' window_data_param {{ source: "{tmp_path}/w.txt" batch_size: 4 }}'
    )
    data, label = layer.run()
    layer.close()
    assert data.shape == (4, 3, 9, 9)
    assert data.max() > 128
    assert label.tolist() == [0, 0, 0, 4]
    assert "transform_param.scale" in layer.ignores


# Input, DummyData and MemoryData


def test_input_has_one_shape_for_all_tops_or_one_each(build: Callable[..., Layer]) -> None:
    one = 'type: "Input" input_param { shape { dim: 2 dim: 3 } }'
    assert build(one, tops=2).top_shapes == [(2, 3), (2, 3)]
    two = 'type: "Input" input_param { shape { dim: 2 } shape { dim: 1 dim: 4 } }'
    layer = build(two, tops=2)
    assert layer.top_shapes == [(2,), (1, 4)]
    assert layer.is_input
    assert [top.tolist() for top in layer.run()] == [[0, 0], [[0, 0, 0, 0]]]


def test_input_without_a_shape_takes_a_given_one() -> None:
    text = 'name: "d" type: "Input" top: "data"'
    assert data_layer(text, given_shapes={"data": (1, 3)}).top_shapes == [(1, 3)]


def test_dummy_data_fills_constants_once_and_draws_the_rest(build: Callable[..., Layer]) -> None:
    layer = build(
        'type: "DummyData" dummy_data_param { shape { dim: 2 dim: 50 } shape { dim: 3 }'
        ' data_filler { type: "gaussian" std: 2 } data_filler { type: "constant" value: 7 } }',
        tops=2,
    )
    first, second = layer.run(), layer.run()
    assert not torch.equal(first[0], second[0])
    assert 1 < float(first[0].std()) < 3
    assert first[1] is second[1]
    assert first[1].tolist() == [7, 7, 7]


def test_dummy_data_without_filler_is_zero_and_reads_num_channels_height_and_width(build: Callable[..., Layer]) -> None:
    layer = build('type: "DummyData" dummy_data_param { num: 2 channels: 3 channels: 1 height: 4 width: 5 }', tops=2)
    assert layer.top_shapes == [(2, 3, 4, 5), (2, 1, 4, 5)]
    assert not any(top.any() for top in layer.run())


MEMORY = 'type: "MemoryData" memory_data_param { batch_size: 2 channels: 1 height: 1 width: 3 }'


def test_memory_data_repeats_its_arrays(build: Callable[..., Layer]) -> None:
    layer = build(MEMORY, tops=2)
    assert isinstance(layer, MemoryData)
    assert layer.top_shapes == [(2, 1, 1, 3), (2, 1, 1, 1)]
    with pytest.raises(SpecError, match="has no data yet"):
        layer.run()
    layer.set_input_arrays(np.arange(12).reshape(4, 1, 1, 3), np.array([8, 7, 6, 5])[::-1])
    labels = [layer.run()[1].ravel().tolist() for _ in range(3)]
    assert labels == [[5, 6], [7, 8], [5, 6]]
    layer.restart()
    images, label = layer.run()
    assert images.ravel().tolist() == [0, 1, 2, 3, 4, 5]
    assert label.ravel().tolist() == [5, 6]


@pytest.mark.parametrize(
    ("images", "labels"),
    [((3, 1, 1, 3), 3), ((2, 1, 3, 1), 2), ((2, 1, 1, 3), 4), ((0, 1, 1, 3), 0)],
    ids=["not_a_multiple", "other_size", "more_labels", "empty"],
)
def test_memory_data_refuses_arrays_of_other_shapes(build: Callable[..., Layer], images: tuple, labels: int) -> None:
    layer = build(MEMORY, tops=2)
    assert isinstance(layer, MemoryData)
    with pytest.raises(SpecError, match="n a multiple of batch_size 2"):
        layer.set_input_arrays(np.zeros(images), np.zeros(labels))


def test_set_input_arrays_of_a_net_fills_its_memory_data(net_of: Callable[..., Any]) -> None:
    net = net_of(f'layer {{ name: "m" {MEMORY} top: "data" top: "label" }}')
    net.set_input_arrays(np.arange(12).reshape(4, 1, 1, 3), np.array([5, 6, 7, 8]))
    assert [net()["label"].ravel().tolist() for _ in range(3)] == [[5, 6], [7, 8], [5, 6]]
    net.set_input_arrays(np.ones((2, 1, 1, 3)))
    assert net()["label"].ravel().tolist() == [0, 0]
    assert net.blobs["data"].unique().tolist() == [1]
    with pytest.raises(SpecError, match=r'net.prototxt:1:38: layer "m" \(MemoryData\): found images \(3, 1, 1, 3\)'):
        net.set_input_arrays(np.ones((3, 1, 1, 3)))
    with pytest.raises(SpecError, match="needs a MemoryData layer, and this net has none"):
        net_of("").set_input_arrays(np.ones((2, 1, 1, 3)))
