"""Every format that is read, with a small good file of it and the function that reads it to the end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import cv2
import h5py
import lmdb
import numpy as np

from faults import recordings
from lmdb_build.mean import write_mean
from lmdb_build.pairs.list_file import read_pair_list
from loopclosure.descriptors.feature_file import read_features
from loopclosure.detector.detector import LoopDetector
from loopclosure.detector.verification import GeometricCheck
from loopclosure.places.frames import read_bgr
from loopclosure.places.masks import read_coordinates, read_truth_matrix
from loopclosure.places.pose_files import read_poses
from loopclosure.words.chow_liu import learn_tree
from loopclosure.words.vocabulary import Extractor, Vocabulary
from loopclosure.words.word_model import Training, WordModel
from netspec.cli.scores import Score, Scores, Snapshot, read_scores
from netspec.data.database import open_reader
from netspec.data.datum import array_to_datum, datum_to_array, parse_datum
from netspec.data.hdf5 import Hdf5Source
from netspec.data.images import read_image, read_image_list
from netspec.data.mean import read_mean, read_mean_option
from netspec.data.windows import read_window_file
from netspec.errors import SpecError, raise_fault
from netspec.files.image_list import list_images
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.net.build import build_net
from netspec.net.extra_file import Digest
from netspec.net.net import Net
from netspec.net.weights import load_weights, save_weights
from netspec.proto.schema import TEST
from netspec.proto.text import parse_net_text, parse_solver_text
from netspec.solver.checks import check_settings
from netspec.solver.extra import Extra, changes, read_extra, resume, write_extra
from netspec.solver.snapshot import State, read_state, write_state

NET = (Path(__file__).parent / "nets" / "formats.prototxt").read_text()
LAYERS = (Path(__file__).parent / "nets" / "layers.prototxt").read_text()
SOLVER = (Path(__file__).parent / "nets" / "solver.prototxt").read_text()


@dataclass(frozen=True)
class Format:
    """``write(path)`` writes a good file, ``read(path)`` reads it; ``path`` ends in ``suffix``.

    If the file of a format is in its own folder, ``x``, ``inside`` is its name there.
    """

    suffix: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]
    inside: str = ""


@cache
def net() -> Net:
    message, source = parse_net_text(NET, "net.prototxt")
    return build_net(with_state(message, TEST), source, BuildOptions(seed=0))


def numbers(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).random(shape).astype(np.float32)


def state(path: Path) -> None:
    write_state(path, State(7, "x.caffemodel", 1, [numbers(3, 2), numbers(3)]))


def extra(path: Path) -> None:
    arrays = [{"shape": [1, 2], "float32": "AACAPwAAAEA="}] * 2
    carried = {"0": {"next": 7}, "3": {"state": arrays}}
    settings = {"solver": {"base_lr": 0.5, "stepvalue": [3, 9]}, "train net": {"data_param.source": "db"}}
    write_extra(path, Extra(1, [0.5, 0.25], [65536, 3], [carried, {}], settings, Digest(3, "ab"), Digest(4, "cd")))


def read_and_compare(path: Path) -> None:
    found = read_extra(path.with_suffix(""))
    assert found is not None
    changes(found.settings, {"solver": {"base_lr": 0.1}, "train net": {}})
    for states in found.nets:
        resume(remembering(), states)


@cache
def remembering() -> Net:
    text = """layer { name: "x" type: "MemoryData" top: "x" top: "l"
      memory_data_param { batch_size: 1 channels: 1 height: 1 width: 1 } }
    layer { name: "i" type: "Input" top: "s" top: "c"
      input_param { shape { dim: 1 dim: 1 dim: 2 } shape { dim: 1 dim: 1 } } }
    layer { name: "relu" type: "ReLU" bottom: "s" top: "s" }
    layer { name: "lstm" type: "LSTM" bottom: "s" bottom: "c" top: "y" recurrent_param { num_output: 2 } }"""
    message, source = parse_net_text(text, "net.prototxt")
    return build_net(with_state(message, TEST), source, BuildOptions(seed=0))


def database(path: Path) -> None:
    with lmdb.open(str(path), map_size=1 << 22, lock=False) as env, env.begin(write=True) as transaction:
        for i in range(60):
            picture = (255 * numbers(1, 8, 8)).astype(np.uint8) if i % 10 else np.zeros((3, 48, 48), np.uint8)
            transaction.put(b"%08d" % i, array_to_datum(picture, i).SerializeToString())


def all_records(path: Path) -> None:
    reader = open_reader(str(path))
    for i in range(len(reader)):
        try:
            datum_to_array(parse_datum(reader.record(i)))
        except ValueError as fault:  # in the layer, with the name of the record
            raise SpecError(str(fault)) from None


def detector(path: Path, check: GeometricCheck | None = None) -> None:
    made = LoopDetector(lambda image: image.ravel()[:8], check=check, threshold=0.0, exclude_recent=2)
    for i in range(12):
        picture = cv2.GaussianBlur((255 * np.random.default_rng(i % 5).random((40, 40, 3))).astype(np.uint8), (5, 5), 2)
        made.add(picture, float(i), [i, 0, 0, 0, 0, 0, 1])
    made.save(path)


def go_on(path: Path) -> None:
    made = LoopDetector.load(path, lambda image: image.ravel()[: made.descriptors[0].size if len(made) else 8])
    made.add(np.zeros((40, 40, 3), np.uint8), 1e9, [0, 0, 0, 0, 0, 0, 1])
    made.save(path)


def word_model(path: Path) -> None:
    words = np.random.default_rng(0).integers(0, 3, (12, 6)).astype(np.int32)
    vocabulary = Vocabulary(numbers(6, 128), Extractor(), "by hand")
    WordModel(vocabulary, words, [Path(f"{i}.png") for i in range(12)], learn_tree(words), Training()).save(path)


def features(path: Path) -> None:
    np.savez_compressed(
        path, features=numbers(6, 5), names=np.array([f"{i}.png" for i in range(6)]), stamps=np.arange(6.0)
    )


def rows(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"], file["label"] = numbers(5, 2, 3), np.arange(5.0)
        file.create_dataset("packed", data=numbers(40, 4), chunks=(8, 4), compression="gzip")


def all_rows(path: Path) -> None:
    listed = path.with_suffix(".txt")
    listed.write_text(f"{path}\n")
    for tops in (["data", "label"], ["packed"]):
        source = Hdf5Source(str(listed), tops, 4)
        for i in range(3):
            source.batch(i)


def built(path: Path) -> None:
    """Build a net without memory, data or files, and its messages."""
    message, source = parse_net_text(path.read_bytes().decode(errors="surrogateescape"), "net.prototxt")
    options = BuildOptions("meta", seed=0, open_data=False, write_files=False)
    repr(build_net(with_state(message, TEST, 0, ["x"]), source, options))


def text(words: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(words)


def picture(path: Path) -> None:
    cv2.imwrite(str(path), (255 * numbers(24, 32, 3)).astype(np.uint8))


def either_picture(path: Path) -> None:
    for read in (lambda path: read_image(str(path)), read_bgr):
        try:
            read(path)
        except ValueError:
            continue


POSES = "".join(f"{i}.5 {i} 0 1 0 0 0 1\n" for i in range(6))
WINDOWS = "# 0\na.png\n3\n48\n64\n2\n4 0.9 0 0 20 20\n0 0.1 10 10 40 40\n# 1\nb.png\n3\n48\n64\n0\n"
PARAM = SimpleNamespace(fg_threshold=0.5, bg_threshold=0.5, root_folder="")


def solved(path: Path) -> None:
    solver, node = parse_solver_text(path.read_bytes().decode(errors="surrogateescape"), "solver.prototxt")
    check_settings(solver, node, raise_fault)


FORMATS = {
    "net.prototxt": Format(".prototxt", text(LAYERS), built),
    "solver.prototxt": Format(".prototxt", text(SOLVER), solved),
    "caffemodel": Format(".caffemodel", lambda path: save_weights(net(), path), lambda path: load_weights(net(), path)),
    "caffemodel.h5": Format(
        ".caffemodel.h5", lambda path: save_weights(net(), path), lambda path: load_weights(net(), path)
    ),
    "solverstate": Format(".solverstate", state, read_state),
    "solverstate.h5": Format(".solverstate.h5", state, read_state),
    "solverstate.extra": Format(".extra", extra, read_and_compare),
    "hdf5 data": Format(".h5", rows, all_rows),
    "lmdb": Format("", database, all_records, inside="data.mdb"),
    "mean": Format(
        ".binaryproto", lambda path: write_mean(str(path), numbers(3, 4, 4)), lambda path: read_mean(str(path))
    ),
    "mean.npy": Format(".npy", lambda path: np.save(path, numbers(3, 4, 4)), lambda path: read_mean_option(str(path))),
    "detector": Format(".npz", detector, go_on),
    "detector with points": Format(".npz", lambda path: detector(path, GeometricCheck()), go_on),
    "word model": Format(".npz", word_model, WordModel.load),
    "features": Format(".npz", features, read_features),
    "truth.npy": Format(".npy", lambda path: np.save(path, np.eye(6)), read_truth_matrix),
    "truth.txt": Format(".txt", lambda path: np.savetxt(path, np.eye(6), "%d"), read_truth_matrix),
    "coordinates": Format(".txt", text("a.png 1 2\nb.png 3 4\n"), read_coordinates),
    "groundtruth": Format(".txt", text("# stamp tx ty tz qx qy qz qw\n" + POSES), read_poses),
    "image list": Format(
        ".txt", text("a.png 0\nb c.png 1\n# note\nd.png 2\n"), lambda path: read_image_list(str(path))
    ),
    "pair list": Format(".txt", text('# seed: 1\na.png b.png 1\n"c d.png" e.png 0\n'), read_pair_list),
    "frame list": Format(".txt", text("a.png 1.5\nb.png 2.5\n"), list_images),
    "window file": Format(
        ".txt", text(WINDOWS), lambda path: read_window_file(SimpleNamespace(source=str(path), **vars(PARAM)), None)
    ),
    "scores": Format(
        ".json",
        lambda path: Scores([Score(1, 0, {"loss": [0.5]})], [Snapshot(1, "x.caffemodel")]).write(path),
        read_scores,
    ),
    "euroc images": Format("", recordings.euroc, recordings.read_folder, recordings.EUROC_LISTING),
    "euroc sensor.yaml": Format("", recordings.euroc, recordings.read_folder, recordings.EUROC_SENSOR),
    "euroc poses": Format("", recordings.euroc, recordings.read_folder, recordings.EUROC_POSES),
    "kitti calib.txt": Format("", recordings.kitti, recordings.read_folder, "calib.txt"),
    "kitti times.txt": Format("", recordings.kitti, recordings.read_folder, "times.txt"),
    "kitti poses": Format("", recordings.kitti, recordings.read_folder, "poses.txt"),
    "poses": Format(".txt", recordings.poses, recordings.all_poses),
    "ROS 1 bag": Format(".bag", recordings.bag, recordings.read_bag),
    "ROS 2 metadata.yaml": Format("", recordings.bag, recordings.read_bag, "metadata.yaml"),
    "ROS 2 bag": Format("", recordings.bag, recordings.read_bag, recordings.BAG_FILE),
    "truth of lists": Format(".json", recordings.lists, recordings.read_matches_of_four),
    "png": Format(".png", picture, either_picture),
    "jpeg": Format(".jpg", picture, either_picture),
}
