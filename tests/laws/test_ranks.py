"""Parallel readers together read the records of a single reader: each once, in order, with the same transforms."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch

from netspec.graph.options import BuildOptions
from netspec.layers import Context, layer_class
from netspec.layers.data.files import ReadingLayer
from netspec.proto.schema import TRAIN
from netspec.proto.text import parse_net_text, parse_solver_text
from netspec.solver.options import TrainingOptions
from netspec.solver.solver import Solver
from paths import GOLDEN

BATCH, ITERATIONS = 3, 4
TRANSFORM = "transform_param { crop_size: 9 mirror: true }"
LAYERS = {
    "Data": f'data_param {{ source: "{GOLDEN}/pairs/train_lmdb" batch_size: %(batch)d backend: LMDB rand_skip: 300 }} '
    + TRANSFORM,
    "ImageData": 'image_data_param { source: "list.txt" batch_size: %(batch)d rand_skip: 5 } ' + TRANSFORM,
    "ImageData, shuffled": 'image_data_param { source: "list.txt" batch_size: %(batch)d shuffle: true rand_skip: 5 } '
    + TRANSFORM,
    "HDF5Data": 'hdf5_data_param { source: "files.txt" batch_size: %(batch)d }',
    "HDF5Data, shuffled": 'hdf5_data_param { source: "files.txt" batch_size: %(batch)d shuffle: true }',
    "WindowData": 'window_data_param { source: "windows.txt" batch_size: %(batch)d fg_fraction: 0 } ' + TRANSFORM,
}


def layer_text(name: str, batch: int) -> str:
    kind = name.partition(",")[0]
    return f'layer {{ name: "d" type: "{kind}" top: "data" top: "label" {LAYERS[name] % {"batch": batch}} }}'


@pytest.fixture(autouse=True)
def _data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write seven images, a list and a window file of them, and an HDF5 file of seven rows."""
    monkeypatch.chdir(tmp_path)
    random = np.random.default_rng(0)
    lines, windows = [], []
    for k in range(7):
        cv2.imwrite(f"{k}.png", random.integers(0, 255, (20, 30, 3), np.uint8))
        lines.append(f"{k}.png {k}")
        windows.append(f"# {k}\n{k}.png\n3\n20\n30\n1\n0 0.1 0 0 {9 + k} 9")
    Path("list.txt").write_text("\n".join(lines))
    Path("windows.txt").write_text("\n".join(windows))
    with h5py.File("rows.h5", "w") as file:
        file["data"], file["label"] = np.arange(14.0).reshape(7, 2), np.arange(7)
    Path("files.txt").write_text("rows.h5\n")


def reader(name: str, batch: int, seed: int, rank: int, ranks: int) -> ReadingLayer:
    (param,) = parse_net_text(layer_text(name, batch), "net.prototxt")[0].layer
    cls = layer_class(param.type)
    assert cls is not None
    layer = cls(param, [], Context(TRAIN, BuildOptions(data_seed=seed, rank=rank, ranks=ranks)))
    assert isinstance(layer, ReadingLayer)
    return layer


def interleaved(parts: list) -> list:
    """Return the first item of each part, then the second of each, and so on."""
    return [item for row in zip(*parts, strict=True) for item in row]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 7, 123456789])
@pytest.mark.parametrize("ranks", [1, 2, 3, 4])
@pytest.mark.parametrize("name", LAYERS)
def test_ranks_together_read_the_records_of_one_reader(name: str, ranks: int, seed: int) -> None:
    alone = reader(name, BATCH * ranks, seed, 0, 1)
    together = [reader(name, BATCH, seed, rank, ranks) for rank in range(ranks)]
    for iteration in range(ITERATIONS):
        assert interleaved([layer.keys(iteration) for layer in together]) == alone.keys(iteration)
        tops = [layer.run() for layer in together]
        for k, whole in enumerate(alone.run()):
            assert torch.equal(torch.stack(interleaved([top[k] for top in tops])), whole)
    for layer in (alone, *together):
        layer.close()


def test_replicas_of_a_solver_together_read_the_records_in_order() -> None:
    solver = training(ranks=3)
    keys = [net.layers[0].keys(0) for net in (solver.net, *solver.replicas.nets)]
    alone = training(ranks=1, batch=3 * BATCH)
    assert interleaved(keys) == alone.net.layers[0].keys(0)


def test_the_nets_of_a_solver_have_different_seeds() -> None:
    solver = training(ranks=3)
    nets = [solver.net, *solver.replicas.nets, *solver.test_nets]
    assert len(nets) == 5
    assert len({net.random.seed for net in nets}) == 5
    assert solver.net.random.seed == 7  # so that the same weights come out as of load_net(..., seed=7)


def training(ranks: int, batch: int = BATCH) -> Solver:
    net = layer_text("ImageData, shuffled", batch) + 'layer { type: "Silence" bottom: "data" bottom: "label" }'
    text = f'net_param {{ {net} }} base_lr: 1 lr_policy: "fixed" random_seed: 7 solver_mode: CPU '
    param, node = parse_solver_text(text + "test_iter: 1 test_iter: 1 test_interval: 1", "solver.prototxt")
    return Solver(param, node, TrainingOptions(devices=[torch.device("cpu")] * ranks))
