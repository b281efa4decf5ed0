"""features.npz: netspec writes it and loopclosure reads it as docs/features.md says."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from loopclosure.descriptors.feature_file import NOT_FEATURES, read_features
from netspec.cli import main
from paths import GOLDEN, ROOT

# The shape and type of each documented array.
TABLE = {
    name: (shape, kind)
    for name, shape, kind in re.findall(
        r"^\| `(\w+)` \| (\(.*?\)) \| (\w+) \|", (ROOT / "docs" / "features.md").read_text(), re.MULTILINE
    )
}
KINDS = {"float32": "f4", "float64": "f8", "int64": "i8"}
IMAGES, VIEWS = 3, 2


@pytest.fixture
def extract(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "pairs").symlink_to(GOLDEN / "pairs")
    (tmp_path / "net.prototxt").write_bytes((GOLDEN / "snapshot" / "train_val.prototxt").read_bytes())
    monkeypatch.chdir(tmp_path)
    lines = []
    for k in range(IMAGES):
        cv2.imwrite(f"{k}.png", np.random.default_rng(k).integers(0, 255, (20, 30, 3), np.uint8))
        lines.append(f"{k / 4} {k}.png\n")
    Path("list.txt").write_text("".join(lines))
    net = ["--model", "net.prototxt", "--blob", "feat"]
    assert main(["extract", *net, "--out", "images.npz", "--images", "list.txt", "--zooms", "1,0.5"]) == 0
    assert main(["extract", *net, "--out", "records.npz", "--iterations", "1"]) == 0
    return tmp_path


def arrays(path: str) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.mark.usefixtures("extract")
def test_written_files_follow_the_documentation() -> None:
    images, records = arrays("images.npz"), arrays("records.npz")
    assert set(images) == {"features", "names", "stamps", "seconds_per_image", "zooms"}
    assert set(records) == {"feat", "keys", "seconds_per_record", "parameters"}
    assert set(images) | set(records) - {"feat"} == set(TABLE)
    sizes = {"N": IMAGES, "V": VIEWS, "D": images["features"].shape[1]}
    for name, values in (*images.items(), *((name, records[name]) for name in records if name != "feat")):
        shape, kind = TABLE[name]
        letters = re.findall(r"[A-Z]", shape)
        assert values.ndim == len(letters), name
        if name in images:
            assert values.shape == tuple(sizes[letter] for letter in letters), name
        assert values.dtype.kind == "U" if kind == "string" else values.dtype.str[1:] == KINDS[kind], name


@pytest.mark.usefixtures("extract")
def test_read_files_follow_the_documentation() -> None:
    assert {*NOT_FEATURES, "features"} == set(TABLE)
    images = read_features("images.npz")
    assert (len(images.features), images.views, images.names) == (IMAGES, VIEWS, [f"{k}.png" for k in range(IMAGES)])
    assert images.stamps is not None
    assert images.stamps.tolist() == [0, 0.25, 0.5]
    assert 0 < images.seconds_per_image < 10
    np.testing.assert_array_equal(read_features("records.npz").features, arrays("records.npz")["feat"])
