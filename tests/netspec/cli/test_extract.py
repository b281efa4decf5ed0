"""The commands ``extract`` and ``extract_features``: blobs over records and over images."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import netspec
from netspec.data.database import open_reader
from netspec.data.datum import datum_to_array, parse_datum
from paths import GOLDEN

NET = "sgd_step/train_val.prototxt"
INIT = "sgd_step/init.caffemodel"
Run = Callable[..., Any]  # the fixtures of conftest.py


def forward(names: list[str], **inputs: np.ndarray) -> dict[str, np.ndarray]:
    net = netspec.load_net(NET, weights=INIT)
    net.keep = names
    with torch.no_grad():
        net(**inputs)
    net.close()
    return {name: net.blobs[name].numpy() for name in names}


def test_extract_writes_blobs_and_keys_over_all_records(run: Run) -> None:
    words = ["--model", NET, "--weights", INIT, "--blob", "feat", "pool1", "--blob", "sim", "--out", "f.npz"]
    assert run("extract", *words).status == 0
    found = np.load("f.npz")
    assert found["feat"].shape == (200, 8)
    assert found["pool1"].shape == (200, 6 * 12 * 12)
    assert found["feat"].dtype == np.float32
    assert found["keys"].tolist() == [f"{i:08d}" for i in range(200)]
    first = forward(["feat", "sim"])
    np.testing.assert_allclose(found["feat"][:50], first["feat"], rtol=1e-5)
    np.testing.assert_array_equal(found["sim"][:50, 0], first["sim"])


def test_output_without_times_is_reproducible(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    for name in ("a.npz", "b.npz"):
        words = ["--model", NET, "--weights", INIT, "--blob", "feat", "--iterations", "1", "--out", name]
        assert run("extract", *words).status == 0
    assert Path("a.npz").read_bytes() == Path("b.npz").read_bytes()
    assert np.isnan(np.load("a.npz")["seconds_per_record"])


@pytest.mark.slow
def test_extract_reads_a_given_database_and_number_of_batches(run: Run) -> None:
    words = f"--model {NET} --weights {INIT} --blob sim --out f.npz --source pair_data=pairs/train_lmdb".split()
    assert run("extract", *words, "--iterations", "13").status == 0
    found = np.load("f.npz")
    labels = [parse_datum(open_reader("pairs/train_lmdb").record(i % 640)).label for i in range(650)]
    assert found["sim"][:, 0].tolist() == labels
    assert found["keys"].tolist()[638:642] == ["00000638", "00000639", "00000000", "00000001"]


def test_extract_without_weights_warns(run: Run) -> None:
    result = run("extract", "--model", NET, "--blob", "feat", "--out", "f.npz", "--iterations", 1)
    assert result.status == 0
    assert result.err == "warning: no --weights given: the weights are random\n"


@pytest.fixture
def images(run: Run) -> Path:
    """A folder of images in another order than that of their names, and a list with stamps in the form of TUM RGB-D."""
    folder = Path("walk")
    (folder / "rgb").mkdir(parents=True)
    random = np.random.default_rng(3)
    for name in ("2.png", "10.png", "1.png"):
        cv2.imwrite(str(folder / "rgb" / name), random.integers(0, 255, (35, 40, 3), np.uint8))
    (folder / "rgb.txt").write_text("# color images\n1.5 rgb/10.png\n2.25 rgb/1.png\n")
    return folder


def features_of(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    image = cv2.resize(image, (28, 28))
    pair = np.stack([image, image])[None].astype(np.float32) * 0.00390625
    net = netspec.load_net(NET, weights=INIT)
    layers = dict(zip([node.name for node in net.plan.nodes], net.layers, strict=True))
    net.close()
    blob = torch.from_numpy(pair[:, :1])
    with torch.no_grad():
        for name in ("conv1", "pool1", "conv2", "pool2", "ip1", "relu1", "feat"):
            (blob,) = layers[name].run(blob)
    return blob.numpy()[0]


IMAGES = ("--model", NET, "--weights", INIT, "--blob", "feat", "--out", "f.npz")


def test_extract_runs_a_tower_of_a_training_net_on_images(run: Run, images: Path) -> None:
    assert run("extract", *IMAGES, "--images", images / "rgb").status == 0
    found = np.load("f.npz")
    assert found["names"].tolist() == ["1.png", "2.png", "10.png"]
    assert "stamps" not in found
    assert 0 < float(found["seconds_per_image"]) < 10
    for row, name in zip(found["features"], found["names"], strict=True):
        np.testing.assert_allclose(row, features_of(images / "rgb" / str(name)), rtol=1e-4, atol=1e-6)


def test_extract_can_add_the_center_of_each_image(run: Run, images: Path) -> None:
    whole = images / "rgb" / "1.png"
    image = cv2.imread(str(whole))
    assert image is not None
    cv2.imwrite("middle.png", image[9:26, 10:30])  # round(35 / 4) and round(40 / 4) off each side
    assert run("extract", *IMAGES, "--images", images / "rgb", "--zooms", "1,0.5").status == 0
    found = np.load("f.npz")
    assert found["zooms"].tolist() == [1, 0.5]
    np.testing.assert_allclose(
        found["features"][0], [*features_of(whole), *features_of(Path("middle.png"))], rtol=1e-4, atol=1e-6
    )


def test_extract_can_feed_the_other_tower(run: Run, images: Path) -> None:
    words = ["--model", NET, "--weights", INIT, "--blob", "feat_p", "--out", "g.npz", "--images", images / "rgb"]
    assert run("extract", *words, "--input", "data_p").status == 0
    assert run("extract", *IMAGES, "--images", images / "rgb").status == 0
    np.testing.assert_allclose(np.load("g.npz")["features"], np.load("f.npz")["features"], rtol=1e-5)


def test_extract_from_images_needs_no_database_if_the_shape_is_given(run: Run, images: Path) -> None:
    Path("pairs").unlink()
    words = [*IMAGES, "--images", images / "rgb"]
    assert 'database "pairs/test_lmdb" does not exist' in run("extract", *words).fault
    assert run("extract", *words, "--shape", "data=1,1,28,28").status == 0


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("nowhere: cannot be read: No such file or directory; expected a folder of images", "--images nowhere"),
        ('list.txt:2:1: no such image "b.png" in .', "--images list.txt"),
        ("empty: contains no images; expected files that end in .png, ", "--images empty"),
        ('no blob "dat" in this net; did you mean "data"? it has: ', "--images walk/rgb --input dat"),
        ('input blob "sim" has shape (50,), expected N x 1 or 3 x ', "--images walk/rgb --input sim"),
        ('no data layer "pair" in this net; its data layers: pair_data', "--source pair=pairs/train_lmdb"),
        ('database "nowhere" does not exist', "--source pair_data=nowhere"),
        ("nowhere/f.npz: cannot be written: No such file or directory", "--out nowhere/f.npz"),
        ("nowhere.caffemodel: cannot be read: No such file or directory", "--weights nowhere.caffemodel"),
    ],
)
def test_extract_reports_errors_in_one_line(run: Run, images: Path, words: str, fault: str) -> None:
    Path("empty").mkdir()
    Path("list.txt").write_text("walk/rgb/1.png\nb.png\n")
    assert fault in run("extract", *IMAGES, *words.split()).fault


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("found zoom 2, expected a number above 0 and at most 1", "--images walk/rgb --zooms 1,2"),
        ('found zooms "1,x", expected numbers separated by commas', "--images walk/rgb --zooms 1,x"),
        ("--images needs exactly one --blob, found 2", "--images walk/rgb --blob sim"),
        ("--shape names x, expected the input blob data", "--images walk/rgb --shape x=1,1,9,9"),
        ("--zooms is for --images; a data layer's records have its shape and its transform_param", "--zooms 1,0.5"),
        ("--input is for --images", "--input x"),
        ("--shape is for --images", "--shape data=1,1,9,9"),
        ("--mean is for --images", "--mean 1"),
        ("--phase is for records; --images reads files and uses phase TEST", "--images walk/rgb --phase TRAIN"),
        ("--level is for records; --images reads files and uses phase TEST", "--images walk/rgb --level 7"),
        ("--stage is for records; --images reads files and uses phase TEST", "--images walk/rgb --stage x"),
        ("--iterations is for records; --images reads files and uses phase TEST", "--images walk/rgb --iterations 99"),
        ("--source is for records; --images reads files and uses phase TEST", "--images walk/rgb --source no=/nowhere"),
        ("--allow-python-layers is for records; --images", "--images walk/rgb --allow-python-layers"),
    ],
)
def test_extract_refuses_contradictory_options(run: Run, images: Path, words: str, fault: str) -> None:
    result = run("extract", *IMAGES, *words.split())
    assert result.status == 2
    assert fault in result.err.splitlines()[-1]
    assert not Path("f.npz").exists()


def test_extract_refuses_unknown_blobs(run: Run) -> None:
    words = ["--model", NET, "--blob", "feet", "--out", "f.npz", "--weights", INIT]
    expected = f'{NET}: no blob "feet" in this net; did you mean "feat"? it has: pair_data, sim, data, '
    assert run("extract", *words).fault.startswith(expected)
    assert run("extract", *words, "--images", "pairs", "--shape", "data=1,1,28,28").status == 1
    assert not Path("f.npz").exists()


# Whether the pixels are those of the training

INPUT = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 1 dim: 1 dim: 28 dim: 28 } } }
"""
OWN_SCALE = 'layer { name: "scale" type: "Power" bottom: "data" top: "data" power_param { scale: 0.00390625 } }'
CONV = """
layer {
  name: "conv1" type: "Convolution" bottom: "data" top: "conv1" convolution_param { num_output: 6 kernel_size: 5 }
}
"""
TRAINED = f"{INIT} was trained with transform_param {{ scale: 0.00390625 }}, but deploy.prototxt has no "


def conv1_of(run: Run, model: str, weights: str = INIT) -> tuple[np.ndarray, Any]:
    """The blob "conv1" of the images, and the messages of the command."""
    words = ["--model", model, "--weights", weights, "--blob", "conv1", "--images", "walk/rgb", "--out", "f.npz"]
    result = run("extract", *words)
    assert result.status == 0
    return np.load("f.npz")["features"], result


def test_a_deploy_file_without_the_scale_of_the_training_gets_a_warning(run: Run, images: Path) -> None:
    Path("deploy.prototxt").write_text(INPUT + CONV)
    found, result = conv1_of(run, "deploy.prototxt")
    assert result.err.startswith(f"warning: {TRAINED}")
    assert len(result.err.splitlines()) == 1
    assert "data (1 x 28 x 28): gray, 0 to 255 (no transform_param)" in result.out
    assert not np.allclose(found, conv1_of(run, NET)[0], atol=0.1)


def test_a_deploy_file_with_its_own_scaling_gets_no_warning(run: Run, images: Path) -> None:
    Path("deploy.prototxt").write_text(INPUT + OWN_SCALE + CONV)
    found, result = conv1_of(run, "deploy.prototxt")
    assert result.err == ""
    np.testing.assert_allclose(found, conv1_of(run, NET)[0], rtol=1e-4, atol=1e-5)


def test_weights_without_a_transform_get_no_warning(run: Run, images: Path) -> None:
    Path("deploy.prototxt").write_text(INPUT + CONV)
    net = netspec.load_net("deploy.prototxt", seed=0)
    for weights in ("deploy.caffemodel", "deploy.caffemodel.h5"):
        netspec.save_weights(net, weights)
        assert conv1_of(run, "deploy.prototxt", weights)[1].err == ""


# extract_features


def test_extract_features_equals_caffes(run: Run) -> None:
    result = run("extract_features", INIT, NET, "feat,sim", "feat_lmdb,sim_lmdb", 4, "lmdb", "CPU")
    assert result.status == 0
    golden = (GOLDEN / "log" / "extract_features.log").read_text().splitlines()
    reported = [line for line in result.messages if "blob sim" not in line]
    assert reported == [line.partition("] ")[2] for line in golden]
    ours, caffes = open_reader("feat_lmdb"), open_reader(str(GOLDEN / "features" / "feat_lmdb"))
    assert len(ours) == len(caffes) == 200
    for i in range(200):
        assert ours.key(i) == caffes.key(i)
        found, expected = (datum_to_array(parse_datum(db.record(i))) for db in (ours, caffes))
        assert found.shape == expected.shape
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_extract_features_reports_errors_in_one_line(run: Run) -> None:
    def fault(*words: str) -> str:
        return run("extract_features", INIT, NET, *words).fault

    assert 'no blob "feet" in this net; did you mean "feat"? it has: ' in fault("feet", "db", "1", "lmdb")
    assert "found 2 blob names and 1 databases, expected one database per blob" in fault("feat,sim", "db", "1", "lmdb")
    Path("db").mkdir()
    assert fault("feat", "db", "1", "lmdb").startswith("db: already exists; ")


def test_extract_warns_of_nonfinite_descriptors(run: Run) -> None:
    Path("dark").mkdir()
    for name, value in (("a.png", 9), ("b.png", 0)):
        cv2.imwrite(f"dark/{name}", np.full((8, 8, 3), value, np.uint8))
    Path("log.prototxt").write_text(
        'input: "data" input_dim: 1 input_dim: 3 input_dim: 8 input_dim: 8\n'
        'layer { name: "log" type: "Log" bottom: "data" top: "log" }\n'
    )
    result = run("extract", "--model", "log.prototxt", "--blob", "log", "--images", "dark", "--out", "f.npz")
    assert result.status == 0
    assert "features: 1 of 2 rows have a NaN or an infinity, the first is row 1 (from 0)" in result.err
