from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from netspec.data.database import Writer, open_reader
from netspec.data.datum import array_to_datum, datum_to_array, parse_datum
from netspec.data.random_words import permutation, words
from netspec.data.sources import Cursor, DatabaseSource, Draws, batches, draw_skip
from netspec.data.transformer import Transformer
from netspec.errors import SpecError, Where
from netspec.fast.stacked import Stacker
from netspec.proto.schema import Datum, TransformationParameter

PLACE = Where("net.prototxt", 9, 5)


def source(path: Path, shapes: list[tuple[int, int, int]], batch_size: int, **transform: Any) -> DatabaseSource:
    with Writer(str(path)) as writer:
        for i, shape in enumerate(shapes):
            writer.put(b"%08d" % i, array_to_datum(np.full(shape, i, np.uint8), i).SerializeToString())
    reader = open_reader(str(path))
    transformer = Transformer(TransformationParameter(**transform), 1, lambda *path: PLACE)
    return DatabaseSource(reader, Cursor(len(reader), batch_size), transformer, PLACE, Stacker(transformer.decode))


def test_the_cursor_wraps_and_logs_it() -> None:
    cursor = Cursor(count=5, batch_size=2)
    assert [cursor.records(i) for i in range(4)] == [[0, 1], [2, 3], [4, 0], [1, 2]]
    assert [cursor.wraps(i) for i in range(5)] == [0, 0, 1, 0, 1]  # the last record is read in batches 2 and 4


def test_a_batch_can_be_larger_than_the_database() -> None:
    cursor = Cursor(count=3, batch_size=7)
    assert cursor.records(0) == [0, 1, 2, 0, 1, 2, 0]
    assert [cursor.wraps(i) for i in range(3)] == [2, 2, 3]


def test_records_are_skipped_only_at_the_start() -> None:
    cursor = Cursor(count=5, batch_size=4, skip=3)
    assert [cursor.records(0), cursor.records(1)] == [[3, 4, 0, 1], [2, 3, 4, 0]]


def test_each_epoch_has_its_own_order() -> None:
    cursor = Cursor(count=50, batch_size=10, shuffle=True, draws=Draws(1, "x"))
    epochs = [[record for i in range(5 * e, 5 * e + 5) for record in cursor.records(i)] for e in range(3)]
    assert all(sorted(epoch) == list(range(50)) for epoch in epochs)
    assert epochs[0] != epochs[1] != epochs[2] != list(range(50))
    again = Cursor(count=50, batch_size=10, shuffle=True, draws=Draws(1, "x"))
    assert again.records(12) == cursor.records(12)


def test_rand_skip_is_random_below_its_limit() -> None:
    skips = {draw_skip(10, seed, "data/TRAIN") for seed in range(100)}
    assert skips == set(range(10))
    assert draw_skip(0, 1, "data/TRAIN") == 0


def test_batches_have_images_labels_and_keys(tmp_path: Path) -> None:
    found = source(tmp_path / "db", [(2, 3, 4)] * 5, 2)
    data, labels = found.batch(2)
    assert list(found.shapes) == [(2, 2, 3, 4), (2,)]
    assert labels.tolist() == [4, 0]
    assert data[:, 1, 2, 3].tolist() == [4, 0]
    assert found.keys(2) == ["00000004", "00000000"]


def test_a_record_of_another_size_is_reported(tmp_path: Path) -> None:
    found = source(tmp_path / "db", [(3, 4, 4)] * 3 + [(1, 4, 4)], 2)
    found.batch(0)
    with pytest.raises(SpecError) as fault:
        found.batch(1)
    assert str(fault.value).startswith(
        'net.prototxt:9:5: record "00000003" gives 1 x 4 x 4, but the first record, "00000000", gives 3 x 4 x 4'
    )


def test_a_batch_of_one_accepts_any_size(tmp_path: Path) -> None:  # Caffe: the first datum of a batch sets its shape
    found = source(tmp_path / "db", [(3, 4, 4), (3, 6, 5)], 1)
    assert [found.batch(i)[0].shape for i in range(2)] == [(1, 3, 4, 4), (1, 3, 6, 5)]


def test_a_crop_makes_sizes_equal(tmp_path: Path) -> None:
    found = source(tmp_path / "db", [(3, 4, 4), (3, 6, 5)], 2, crop_size=3)
    assert found.batch(0)[0].shape == (2, 3, 3, 3)


def test_an_invalid_record_is_reported(tmp_path: Path) -> None:
    with Writer(str(tmp_path / "db")) as writer:
        writer.put(b"first", array_to_datum(np.zeros((1, 1, 1), np.uint8)).SerializeToString())
        writer.put(b"second", b"\xff\xff\xff")
    reader = open_reader(str(tmp_path / "db"))
    transformer = Transformer(TransformationParameter(), 1, lambda *path: PLACE)
    found = DatabaseSource(reader, Cursor(2, 1), transformer, PLACE, Stacker(transformer.decode))
    with pytest.raises(SpecError, match=r'^net.prototxt:9:5: record "second" is not a Datum \(3 bytes\)$'):
        found.batch(1)


def datums(*labels: int, shape: tuple[int, int, int] = (2, 3, 4), floats: bool = False) -> list[bytes]:
    values = np.random.default_rng(len(labels)).integers(0, 256, (len(labels), *shape))
    typed = values.astype(np.float32) / 7 if floats else values.astype(np.uint8)
    return [array_to_datum(*each).SerializeToString() for each in zip(typed, labels, strict=True)]


def packed(record: bytes) -> bytes:
    """The same Datum with its floats packed, after an unknown field."""
    datum = Datum.FromString(record)
    numbers = np.array(datum.float_data, "<f4").tobytes()
    datum.ClearField("float_data")
    return b"\x78\x05" + datum.SerializeToString() + b"\x32" + bytes([len(numbers)]) + numbers


@pytest.mark.parametrize(
    ("records", "at_once"),
    [
        pytest.param(datums(0, 127, 128, 5, 300, 2**31 - 1, 70000), True, id="labels of one to five bytes"),
        pytest.param(datums(-1, -(2**31), 7), True, id="labels below zero"),
        pytest.param([bytes([8, 1, 16, 1, 24, 1, 34, 1, k]) for k in range(3)], True, id="no label"),
        pytest.param([bytes([40, k, 8, 1, 34, 1, k, 16, 1, 24, 1]) for k in range(3)], True, id="another order"),
        pytest.param(datums(1, 2, 3, 200, floats=True), True, id="floats"),
        pytest.param([packed(record) for record in datums(1, 2, 300, floats=True)], True, id="packed floats"),
        pytest.param(datums(3), True, id="one record"),
        pytest.param([record + b"\x28\x09" for record in datums(1, 2)], False, id="two labels, the last one counts"),
        pytest.param([record + b"\x35abcd" for record in datums(1, 2)], False, id="bytes before floats"),
        pytest.param([*datums(1), *datums(2, floats=True)], False, id="bytes and floats"),
        pytest.param([*datums(1, shape=(2, 3, 4)), *datums(1, shape=(2, 4, 3))], False, id="other shapes, equal sizes"),
        pytest.param([*datums(1, 2), *datums(300, shape=(2, 1, 12))], False, id="other shapes, other sizes"),
        pytest.param(datums(1, 2, shape=(1, 257, 256)), False, id="large"),
    ],
)
def test_small_records_read_together_equal_single_reads(tmp_path: Path, records: list[bytes], at_once: bool) -> None:
    one_by_one = [parse_datum(record) for record in records]
    found = Stacker()(records)
    assert (found is not None) == at_once
    if found is not None:
        assert found[1].tolist() == [np.float32(datum.label) for datum in one_by_one]
        expected = np.stack([datum_to_array(datum) for datum in one_by_one])
        assert found[0].dtype == expected.dtype
        assert (found[0] == expected).all()
    with Writer(str(tmp_path / "db")) as writer:
        for i, record in enumerate(records):
            writer.put(b"%08d" % i, record)
    reader = open_reader(str(tmp_path / "db"))
    transformer = Transformer(TransformationParameter(mean_value=[2.5], scale=0.3, mirror=True), 0, lambda *path: PLACE)
    cursor = Cursor(len(reader), len(records) + 1)  # which wraps
    for read_at_once in (Stacker(transformer.decode), None):
        read = DatabaseSource(reader, cursor, transformer, PLACE, read_at_once)
        if len({datum_to_array(datum).shape for datum in one_by_one}) > 1:
            with pytest.raises(SpecError, match="but the first record"):
                read.batch(0)
            continue
        arrays = [datum_to_array(datum) for datum in (*one_by_one, one_by_one[0])]
        data, labels = read.batch(0)
        assert (data == transformer(arrays, range(len(arrays)))).all()
        assert labels.tolist() == [np.float32(datum.label) for datum in (*one_by_one, one_by_one[0])]


def longer(record: bytes, count: int) -> bytes:
    """The same Datum with ``count`` more numbers than its shape has."""
    datum = Datum.FromString(record)
    if datum.data:
        datum.data += bytes(range(count))
    else:
        datum.float_data.extend(range(count))
    return datum.SerializeToString()


LONG = [longer(record, k) for k, record in zip((72, 72, 5), datums(1, 2, 3), strict=True)]
LONG_FLOATS = [longer(record, 3) for record in datums(1, 2, floats=True)]


@pytest.mark.parametrize(
    ("records", "at_once"),
    [
        pytest.param(LONG[:2], True, id="bytes"),
        pytest.param([*datums(7), *LONG], True, id="other lengths"),
        pytest.param(LONG_FLOATS, True, id="floats"),
        pytest.param([packed(record) for record in LONG_FLOATS], True, id="packed floats"),
        pytest.param([LONG[0], LONG[1] + b"\x28\x09"], False, id="one by one"),
        pytest.param(datums(1, 2), True, id="none of them"),
    ],
)
def test_surplus_numbers_of_a_record_are_ignored(
    tmp_path: Path, records: list[bytes], at_once: bool, caplog: pytest.LogCaptureFixture
) -> None:  # as data_transformer.cpp does; nets are trained from such databases
    with Writer(str(tmp_path / "db")) as writer:
        for i, record in enumerate(records):
            writer.put(b"%08d" % i, record)
    transformer = Transformer(TransformationParameter(), 0, lambda *path: PLACE)
    reader, cursor = open_reader(str(tmp_path / "db")), Cursor(len(records), len(records))
    found = DatabaseSource(reader, cursor, transformer, PLACE, Stacker(transformer.decode))
    assert (found.together(0, 1) is not None) == at_once
    data, _ = found.batch(0)
    stored = [
        np.frombuffer(each.data, np.uint8) if each.data else each.float_data for each in map(parse_datum, records)
    ]
    assert (data == np.stack([np.array(each[:24], np.float32).reshape(2, 3, 4) for each in stored])).all()
    reported = [each.getMessage() for each in caplog.records if "only the first values" in each.getMessage()]
    assert len(reported) == (max(map(len, stored)) > 24)
    assert all(message.startswith("net.prototxt:9:5: a record contains ") for message in reported)


@pytest.mark.parametrize("ranks", [1, 3])
@pytest.mark.parametrize("shapes", [[(2, 3, 4)] * 7, [(2, 3, 4), (3, 6, 5), (3, 6, 5)]])
def test_several_iterations_together_equal_single_iterations(
    tmp_path: Path, ranks: int, shapes: list[tuple[int, int, int]]
) -> None:
    alike = len(set(shapes)) == 1
    found = source(tmp_path / "db", shapes, 4 if alike else 1, crop_size=2, mirror=True)
    found.cursor = Cursor(len(shapes), 4 if alike else 1, 1, True, Draws(1, "x", ranks - 1, ranks))
    for one, at_once in zip([found.batch(i) for i in range(3, 8)], batches(found, 3, 5), strict=True):
        assert all((a == b).all() for a, b in zip(one, at_once, strict=True))


def test_records_of_changing_forms_are_read() -> None:
    read = Stacker()
    for shape in ((2, 3, 4), (2, 4, 3), (24, 1, 1)):  # of one size
        found = read(datums(1, 2, shape=shape))
        assert found is not None
        assert found[0].shape == (2, *shape)
    assert read([b"\xff\xff\xff"] * 2) is None
    assert read([record[:-3] for record in datums(1, 2)]) is None
    assert read([b""]) is None


def test_random_numbers_never_change() -> None:
    # A resumed run must draw what the first one would have drawn, whatever the versions of numpy.
    assert words(1, "a", 0, 1).tolist() == [
        [16125938745833911740, 11915995768183236433, 13288515000938474924, 528424593193280505]
    ]
    assert permutation(1, "a", 9).tolist() == [3, 5, 6, 1, 7, 2, 0, 4, 8]


def test_seed_and_stream_change_random_numbers() -> None:
    drawn = [words(seed, stream, 0, 4).tolist() for seed in (0, 1) for stream in ("data/TRAIN", "data/TEST")]
    assert all(drawn[i] != drawn[j] for i in range(4) for j in range(i))
