"""Caffe's data for PyTorch: what a DataLoader gives is what a net reads, whatever the number of workers."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import netspec
from netspec.data.database import Writer, open_reader
from netspec.data.datum import datum_to_array, parse_datum
from netspec.datasets import Batches, Records
from netspec.errors import SpecError
from paths import GOLDEN

TRAIN = str(GOLDEN / "pairs" / "train_lmdb")
TRANSFORM = "crop_size: 20 mirror: true scale: 0.5 mean_value: 7"
NET = f"""
layer {{ name: "data" type: "Data" top: "data" top: "label" include {{ phase: TRAIN }}
  transform_param {{ {TRANSFORM} }} data_param {{ source: "{TRAIN}" batch_size: 50 backend: LMDB }} }}
layer {{ name: "data" type: "Data" top: "data" include {{ phase: TEST }}
  data_param {{ source: "{TRAIN}" batch_size: 64 backend: LMDB }} }}
layer {{ name: "pool" type: "Pooling" bottom: "data" top: "pool" pooling_param {{ kernel_size: 2 }} }}
layer {{ name: "drop" type: "Silence" bottom: "label" include {{ phase: TRAIN }} }}
"""
WORKERS = [0, pytest.param(2, marks=pytest.mark.slow)]


@pytest.fixture
def model(tmp_path: Path) -> str:
    (tmp_path / "net.prototxt").write_text(NET)
    return str(tmp_path / "net.prototxt")


@pytest.mark.parametrize("workers", WORKERS)
def test_batches_are_those_that_the_net_reads(model: str, workers: int) -> None:
    net = netspec.load_net(model, phase="TRAIN", seed=5)
    net.keep = ["data", "label"]
    batches = Batches(model, "TRAIN", seed=5, iterations=30)  # past the end, and on from the start
    loader = DataLoader(batches, batch_size=None, num_workers=workers)
    for batch in loader:
        net()
        assert list(batch) == ["data", "label"]
        for name, blob in batch.items():
            assert torch.equal(blob, net.blobs[name])
    net.close()


def test_an_epoch_reads_each_record_and_the_phase_chooses_the_layer(model: str) -> None:
    assert len(Batches(model, "TRAIN")) == 13
    test = Batches(model, "test")
    assert len(test) == 10
    assert list(test[9]) == ["data"]
    assert test[0]["data"].shape == (64, 2, 28, 28)
    assert test.keys(9)[-1] == "00000639"
    with pytest.raises(IndexError):
        test[10]


def test_it_goes_on_at_an_iteration_and_shares_out_ranks(model: str) -> None:
    batches = Batches(model, "TRAIN", iterations=20)
    (late,) = DataLoader(batches, batch_size=None, sampler=range(7, 8))  # pyright: ignore[reportArgumentType]
    assert torch.equal(late["data"], batches[7]["data"])
    ranks = [Batches(model, "TRAIN", rank=rank, ranks=2) for rank in range(2)]
    assert len(ranks[0]) == 7
    assert [key for pair in zip(*(part.keys(0) for part in ranks), strict=True) for key in pair] == [
        f"{k:08d}" for k in range(100)
    ]


@pytest.mark.parametrize("workers", WORKERS)
def test_records_are_transformed_as_a_net_transforms_them(model: str, workers: int) -> None:
    records = Records(TRAIN, TRANSFORM, seed=5)
    loader = DataLoader(records, batch_size=50, num_workers=workers)
    net = netspec.load_net(model, phase="TRAIN", seed=5)
    net.keep = ["data", "label"]
    net()
    for mine, name in zip(next(iter(loader)), ("data", "label"), strict=True):
        assert torch.equal(mine, net.blobs[name])
    net.close()


def test_records_without_a_transformation_are_those_of_the_database() -> None:
    records, reader = Records(TRAIN), open_reader(TRAIN)
    assert len(records) == 640
    for number in (0, 3, 639, -1):
        image, label = records[number]
        datum = parse_datum(reader.record(number % 640))
        np.testing.assert_array_equal(image, datum_to_array(datum).astype(np.float32))
        assert (float(label), records.key(number)) == (datum.label, f"{number % 640:08d}")
    assert sum(1 for _ in records) == 640


@pytest.mark.slow
@pytest.mark.parametrize("workers", WORKERS)
def test_each_epoch_has_its_own_draws(workers: int) -> None:
    records = Records(TRAIN, TRANSFORM)
    loader = DataLoader(records, batch_size=640, num_workers=workers, persistent_workers=workers > 0)
    epochs = []
    for epoch in (0, 1, 0):
        records.set_epoch(epoch)
        epochs.append(next(iter(loader))[0])
    assert torch.equal(epochs[0], epochs[2])
    assert not torch.equal(epochs[0], epochs[1])


@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
@pytest.mark.parametrize("kind", ["lmdb", "leveldb", "hdf5"])
def test_workers_however_they_start_read_every_kind(tmp_path: Path, kind: str, start: str) -> None:
    images = np.random.default_rng(0).integers(0, 255, (40, 1, 4, 5), np.uint8)
    path = tmp_path / "data"
    if kind == "hdf5":
        with h5py.File(path, "w") as file:
            file["data"], file["label"] = images.astype(np.float32), np.arange(40.0)
    else:
        if kind == "leveldb":
            pytest.importorskip("plyvel")
        from netspec.data.datum import array_to_datum

        with Writer(str(path), kind) as writer:
            for k, image in enumerate(images):
                writer.put(b"%03d" % k, array_to_datum(image, k).SerializeToString())
    loader = DataLoader(Records(path), batch_size=8, num_workers=2, multiprocessing_context=start)
    found, labels = (torch.cat(parts) for parts in zip(*loader, strict=True))
    np.testing.assert_array_equal(found, images)
    assert labels.tolist() == list(range(40))


def test_hdf5_rows_of_a_list_have_the_tops_that_are_asked_for(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["x"] = np.arange(6.0).reshape(3, 2)
    (tmp_path / "list.txt").write_text(f"{tmp_path}/a.h5 {tmp_path}/a.h5\n")
    records = Records(tmp_path / "list.txt", tops=["x"])
    assert len(records) == 6
    assert [row.tolist() for row in records[4]] == [[2.0, 3.0]]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda model: Batches(model, layer="dat"), 'no data layer "dat" in phase TRAIN; did you mean "data"'),
        (lambda model: Batches(model, "DEPLOY"), "found phase 'DEPLOY', expected TRAIN or TEST"),
        (lambda model: netspec.load_net(model, "DEPLOY"), "found phase 'DEPLOY', expected TRAIN or TEST"),
        (lambda model: Batches("none.prototxt"), "none.prototxt"),
        (lambda model: Records("nowhere"), 'database "nowhere" does not exist'),
        (lambda model: Records(TRAIN, phase="DEPLOY"), "found phase 'DEPLOY', expected TRAIN or TEST"),
        (lambda model: Records(TRAIN, "crop: 3"), 'no field "crop"'),
        (lambda model: Records(TRAIN, "crop_size: 99"), "crop_size 99 is larger than the image"),
        (lambda model: Records(model, "scale: 2"), "Caffe does not transform data of HDF5 files"),
    ],
)  # fmt: skip
def test_faults(model: str, make: Callable[[str], object], said: str) -> None:
    with pytest.raises(SpecError, match=said):
        make(model)


def test_a_net_without_data_layers(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text('layer { name: "x" type: "Input" top: "x" input_param { shape { dim: 1 } } }')
    with pytest.raises(SpecError, match=r"no layer reads records in phase TRAIN; its data layers: none"):
        Batches(path)
