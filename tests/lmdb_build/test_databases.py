from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import lmdb
import numpy as np
import pytest

from lmdb_build.cli import main
from lmdb_build.databases import read_pairs
from netspec.data.database import open_reader
from netspec.data.datum import datum_to_array, parse_datum
from optional_packages import leveldb
from paths import ROOT

GOLDEN = ROOT / "tests" / "golden" / "images"
PNG = f"{GOLDEN}/png/"


def convert_pairs_lmdb(words: list[str]) -> int:
    return main(["convert", *words])


def convert_imageset(words: list[str]) -> int:
    return main(["imageset", *words])


def compute_image_mean(words: list[str]) -> int:
    return main(["mean", *words])


def log_of(err: str) -> list[str]:
    return [line.partition("] ")[2] for line in err.splitlines()]


def records(path: Path) -> list[tuple[bytes, bytes]]:
    with lmdb.open(str(path), readonly=True, lock=False) as env, env.begin() as transaction:
        return list(transaction.cursor())


def image(name: str, flag: int = cv2.IMREAD_COLOR) -> np.ndarray:
    found = cv2.imread(PNG + name, flag)
    assert found is not None, name
    return found


def pairs_in(path: Path) -> list[tuple[str, np.ndarray, int]]:
    datums = [(key.decode(), parse_datum(value)) for key, value in records(path)]
    return [(key, datum_to_array(datum), datum.label) for key, datum in datums]


@pytest.fixture
def pair_list(tmp_path: Path) -> str:
    (tmp_path / "pairs.txt").write_text("# seed: 1\n\n0.png 1.png 1\n2.png 3.png 0\n 4.png\t5.png 1\n")
    return str(tmp_path / "pairs.txt")


# Single images: the same bytes as Caffe's convert_imageset


@pytest.mark.parametrize(
    ("flags", "database"),
    [
        ([], "lmdb_plain"),
        (["-gray"], "lmdb_gray"),
        (["-resize_width=28", "-resize_height=20"], "lmdb_resized"),
        (["-encoded"], "lmdb_encoded"),
    ],
)
def test_records_of_single_images_are_byte_identical_to_caffes(tmp_path: Path, flags: list[str], database: str) -> None:
    assert convert_imageset(["-workers=2", *flags, PNG, str(GOLDEN / "list.txt"), str(tmp_path / "db")]) == 0
    assert records(tmp_path / "db") == records(GOLDEN / database)


def test_the_log_equals_caffes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    convert_imageset(["-shuffle", "-seed", "5", "-encode_type=png", PNG, str(GOLDEN / "list.txt"), f"{tmp_path}/db"])
    assert log_of(capsys.readouterr().err) == [
        "Shuffling data",
        "Shuffled with seed 5 (-seed)",
        "A total of 6 images.",
        "encode_type specified, assuming encoded=true.",
        f"Opened lmdb {tmp_path}/db",
        "Processed 6 files.",
    ]


@pytest.mark.slow
def test_every_thousand_records_are_logged(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "list.txt").write_text("0.png 1\n" * 2500)
    flags = ["-resize_width=2", "-resize_height=2", "-workers=1"]
    assert convert_imageset([*flags, PNG, f"{tmp_path}/list.txt", f"{tmp_path}/db"]) == 0
    assert [line for line in log_of(capsys.readouterr().err) if line.startswith("Processed")] == [
        "Processed 1000 files.",
        "Processed 2000 files.",
        "Processed 2500 files.",
    ]
    assert len(records(tmp_path / "db")) == 2500


@pytest.mark.slow
def test_shuffling_is_reproducible_and_keys_follow_the_new_order(tmp_path: Path) -> None:
    keys = []
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        assert convert_imageset(["-shuffle", "-seed", seed, PNG, str(GOLDEN / "list.txt"), f"{tmp_path}/{name}"]) == 0
        keys.append([key for key, _ in records(tmp_path / name)])
    assert keys[0] == keys[1] != keys[2]
    assert [key[:9] for key in keys[0]] == [b"%08d_" % i for i in range(6)]
    assert sorted(key[9:] for key in keys[0]) == [b"%d.png" % i for i in range(6)]


def test_names_can_contain_spaces(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a place.png"), image("0.png"))
    (tmp_path / "list.txt").write_text("a place.png 4\n")
    assert convert_imageset([str(tmp_path), f"{tmp_path}/list.txt", f"{tmp_path}/db"]) == 0
    assert [(key, label) for key, _, label in pairs_in(tmp_path / "db")] == [("00000000_a place.png", 4)]


# Pairs


def test_a_pair_is_stacked_along_the_channels(tmp_path: Path, pair_list: str) -> None:
    assert convert_pairs_lmdb([PNG, pair_list, f"{tmp_path}/db"]) == 0
    found = pairs_in(tmp_path / "db")
    assert [(key, label) for key, _, label in found] == [("00000000", 1), ("00000001", 0), ("00000002", 1)]
    for (a, b), (_, array, _) in zip([("0", "1"), ("2", "3"), ("4", "5")], found, strict=True):
        assert array.shape == (6, 48, 64)
        assert (array[:3] == image(f"{a}.png").transpose(2, 0, 1)).all()
        assert (array[3:] == image(f"{b}.png").transpose(2, 0, 1)).all()


def test_gray_pairs_have_two_channels_and_any_size(tmp_path: Path, pair_list: str) -> None:
    flags = ["--gray=true", "--resize_width", "10", "--resize_height=12", "-nocheck_size", "-backend", "lmdb"]
    assert convert_pairs_lmdb([PNG, *flags, pair_list, f"{tmp_path}/db"]) == 0
    expected = [cv2.resize(image(f"{n}.png", cv2.IMREAD_GRAYSCALE), (10, 12)) for n in (0, 1)]
    assert (pairs_in(tmp_path / "db")[0][1] == np.stack(expected)).all()


def test_encoded_pairs_become_two_databases(tmp_path: Path, pair_list: str) -> None:
    assert convert_pairs_lmdb(["-encoded", "-shuffle", PNG, pair_list, f"{tmp_path}/db/"]) == 0
    assert convert_pairs_lmdb(["-shuffle", PNG, pair_list, f"{tmp_path}/raw"]) == 0
    assert sorted(os.listdir(tmp_path)) == ["db_a", "db_b", "pairs.txt", "raw"]
    firsts, seconds, stacked = (pairs_in(tmp_path / name) for name in ("db_a", "db_b", "raw"))
    for first, second, raw in zip(firsts, seconds, stacked, strict=True):
        assert first[0] == second[0] == raw[0]
        assert first[2] == second[2] == raw[2]
        assert (np.concatenate([first[1], second[1]]) == raw[1]).all()


def test_encode_type_alone_means_encoded(tmp_path: Path, pair_list: str) -> None:
    assert convert_pairs_lmdb(["-encode_type", "jpg", PNG, pair_list, f"{tmp_path}/db"]) == 0
    datum = parse_datum(records(tmp_path / "db_b")[0][1])
    assert datum.encoded
    assert datum.data[:2] == b"\xff\xd8"  # JPEG
    assert (datum.channels, datum.height, datum.width) == (3, 48, 64)


def test_gray_encoded_images_are_gray(tmp_path: Path) -> None:  # Caffe stores the color file as it is
    assert convert_imageset(["-gray", "-encoded", PNG, str(GOLDEN / "list.txt"), f"{tmp_path}/db"]) == 0
    assert [array.shape for _, array, _ in pairs_in(tmp_path / "db")] == [(1, 48, 64)] * 6


def test_quoted_names_can_contain_spaces(tmp_path: Path) -> None:
    (tmp_path / "l").write_text('"a place.png" b.png 1\nc.png "d e.png" 0\n')
    assert [entry.images for entry in read_pairs(f"{tmp_path}/l")] == [("a place.png", "b.png"), ("c.png", "d e.png")]


def test_leveldb_can_be_written(tmp_path: Path, pair_list: str) -> None:
    leveldb()
    assert convert_pairs_lmdb(["-backend=leveldb", PNG, pair_list, f"{tmp_path}/db"]) == 0
    assert (tmp_path / "db" / "CURRENT").exists()


# What goes wrong: one line, status 1, no database


def check_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], command: object, arguments: list[str], message: str
) -> None:
    assert callable(command)
    before = sorted(os.listdir(tmp_path))
    assert command([*arguments, f"{tmp_path}/db"]) == 1
    last = capsys.readouterr().err.splitlines()[-1]
    assert message in last
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_missing_image_is_reported_with_its_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], workers: str
) -> None:
    (tmp_path / "l").write_text("# pairs\n0.png 1.png 1\n2.png nix.png 0\n")
    message = f'{tmp_path}/l:3:1: image "{PNG}nix.png" cannot be read: No such file or directory'
    check_refused(tmp_path, capsys, convert_pairs_lmdb, ["-workers", workers, PNG, f"{tmp_path}/l"], message)


@pytest.mark.parametrize(
    ("text", "flags", "message"),
    [
        ("text.png 0.png 1", [], 'l:1:1: image "{root}/text.png" cannot be decoded as an image'),
        ("text.png 0.png 1", ["-encoded"], 'l:1:1: image "{root}/text.png" cannot be decoded as an image'),
        ("0.png small.png 1", [], "set -resize_width and -resize_height"),
        ("0.png 0.png 1\nsmall.png small.png 1", ["-check_size"], 'l:2:1: "small.png" gives 6 x 5 x 5, but'),
        ("0.png 0 1", ["-encoded"], 'l:1:1: image "{root}/0" has no extension that gives its format; set -encode_type'),
        ("0.png 0.png 1", ["-encode_type=abc"], 'cannot be encoded as "abc"'),
        ("0.png 1.png", [], "l:1:1: found '0.png 1.png', expected two images and a label"),
    ],
)
def test_images_that_cannot_be_converted_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, flags: list[str], message: str
) -> None:
    root = tmp_path / "images"
    root.mkdir()
    for name in ("0.png", "0"):
        (root / name).write_bytes((GOLDEN / "png" / "0.png").read_bytes())
    (root / "text.png").write_text("no image")
    cv2.imwrite(str(root / "small.png"), np.zeros((5, 5, 3), np.uint8))
    (tmp_path / "l").write_text(text + "\n")
    arguments = ["-workers=1", *flags, str(root), f"{tmp_path}/l"]
    check_refused(tmp_path, capsys, convert_pairs_lmdb, arguments, message.format(root=root))


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_unreadable_images_are_skipped_like_in_caffe(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], workers: str
) -> None:
    (tmp_path / "text.png").write_text("no image")
    (tmp_path / "l").write_text(f"{PNG}0.png 1\nnix.png 2\n{tmp_path}/text.png 3\n{PNG}1.png 4\n")
    arguments = ["-workers", workers, "", f"{tmp_path}/l", str(tmp_path / "written")]
    assert convert_imageset(arguments) == 0
    lines = capsys.readouterr().err.splitlines()
    assert [sum(word in line for line in lines) for word in ("read: No such file", "cannot be decoded")] == [1, 1]
    assert lines[-2].endswith("Processed 2 files.")
    assert lines[-1].endswith("Skipped 2 of 4 images, which cannot be read")
    reader = open_reader(str(tmp_path / "written"))
    assert [reader.key(i)[:8] for i in range(len(reader))] == [b"00000000", b"00000003"]
    (tmp_path / "none").write_text("nix.png 2\n")
    check_refused(tmp_path, capsys, convert_imageset, [PNG, f"{tmp_path}/none"], 'none:1:1: image "')


def test_an_invalid_label_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "l").write_text("0.png cat\n")
    check_refused(
        tmp_path, capsys, convert_imageset, [PNG, f"{tmp_path}/l"], 'l:1:1: found "0.png cat", expected an image'
    )


def test_an_existing_database_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str], pair_list: str) -> None:
    (tmp_path / "db").mkdir()
    check_refused(tmp_path, capsys, convert_pairs_lmdb, [PNG, pair_list], "already exists")


@pytest.mark.parametrize(
    "flags", [["-resize_width=4"], ["-gray=maybe"], ["-colour"], ["-backend=sqlite"], ["-resize_width=x"]]
)
def test_wrong_usage_is_status_2(tmp_path: Path, pair_list: str, flags: list[str]) -> None:
    assert convert_pairs_lmdb([*flags, PNG, pair_list, f"{tmp_path}/db"]) == 2
    assert sorted(os.listdir(tmp_path)) == ["pairs.txt"]


# compute_image_mean, and the script in tools/


def test_the_mean_image_and_its_log_equal_caffes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute_image_mean([str(GOLDEN / "lmdb_plain"), f"{tmp_path}/mean.binaryproto"]) == 0
    assert (tmp_path / "mean.binaryproto").read_bytes() == (GOLDEN / "mean.binaryproto").read_bytes()
    found = [line.split(None, 3)[3] for line in capsys.readouterr().err.splitlines()]
    assert found == [  # golden/log/compute_image_mean.log
        f"db_lmdb.cpp:35] Opened lmdb {GOLDEN}/lmdb_plain",
        "compute_image_mean.cpp:70] Starting iteration",
        "compute_image_mean.cpp:101] Processed 6 files.",
        f"compute_image_mean.cpp:108] Write to {tmp_path}/mean.binaryproto",
        "compute_image_mean.cpp:114] Number of channels: 3",
        "compute_image_mean.cpp:119] mean_value channel [0]: 110.656",
        "compute_image_mean.cpp:119] mean_value channel [1]: 128.153",
        "compute_image_mean.cpp:119] mean_value channel [2]: 122.765",
    ]


def test_the_mean_of_a_missing_database_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compute_image_mean([f"{tmp_path}/nix"]) == 1
    assert capsys.readouterr().err.startswith(f'{tmp_path}/nix: database "{tmp_path}/nix" does not exist')


@pytest.mark.slow
def test_the_script_works_from_any_folder_without_torch(tmp_path: Path, pair_list: str) -> None:
    (tmp_path / "torch.py").write_text("raise ImportError('not needed here')")

    def script(name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(ROOT / "tools" / name), *arguments]
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)

    done = script("convert_pairs_lmdb", PNG, pair_list, "pairs_lmdb")
    assert (done.returncode, done.stdout) == (0, "")
    assert "A total of 3 pairs." in done.stderr
    refused = script("convert_pairs_lmdb", PNG, pair_list, "pairs_lmdb")
    assert refused.returncode == 1
    assert "Traceback" not in refused.stderr
