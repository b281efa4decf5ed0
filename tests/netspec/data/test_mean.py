from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lmdb_build.mean import channel_means, compute_mean
from netspec.data.database import Writer, open_reader
from netspec.data.datum import array_to_datum
from netspec.data.mean import read_mean
from netspec.errors import SpecError, Where
from netspec.proto.schema import BlobProto, BlobShape
from paths import GOLDEN

PLACE = Where("db")


def test_float_records_are_included() -> None:
    reader = open_reader(str(GOLDEN / "features" / "feat_lmdb"))
    assert compute_mean(reader, PLACE).shape == (8, 1, 1)


def test_channel_means_are_summed_as_caffe_sums_them() -> None:
    plane = np.random.default_rng(0).uniform(100, 200, 300).astype(np.float32)
    total = np.float32(0)
    for value in plane:
        total += value
    assert channel_means(plane.reshape(1, 15, 20)) == [float(total / np.float32(300))]


def test_an_image_of_another_size_is_reported(tmp_path: Path) -> None:
    with Writer(str(tmp_path / "db")) as writer:
        for i, width in enumerate((4, 4, 5)):
            writer.put(b"%08d" % i, array_to_datum(np.zeros((1, 3, width), np.uint8)).SerializeToString())
    with pytest.raises(SpecError, match=r'^db: record "00000002" is 1 x 3 x 5, but the first, .* 1 x 3 x 4'):
        compute_mean(open_reader(str(tmp_path / "db")), PLACE)


def test_means_with_a_new_shape_field_are_read(tmp_path: Path) -> None:
    proto = BlobProto(shape=BlobShape(dim=[1, 2, 1, 2]), data=[1, 2, 3, 4])
    (tmp_path / "m").write_bytes(proto.SerializeToString())
    assert read_mean(str(tmp_path / "m")).tolist() == [[[1, 2]], [[3, 4]]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"\xff\xff", "is not a BlobProto with a mean image"),
        (BlobProto(shape=BlobShape(dim=[2, 2]), data=[1]).SerializeToString(), "1 numbers in data, expected 4"),
        (BlobProto(shape=BlobShape(dim=[2]), data=[1, 2]).SerializeToString(), r"contains a blob of shape \(2,\)"),
    ],
)
def test_an_invalid_mean_image_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "m").write_bytes(content)
    with pytest.raises(SpecError, match=message):
        read_mean(str(tmp_path / "m"), Where("net.prototxt", 2, 5))
